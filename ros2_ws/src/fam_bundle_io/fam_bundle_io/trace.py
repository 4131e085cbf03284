# SPDX-License-Identifier: Apache-2.0
"""The trace of a run: one array per signal, one row per tick; SI units."""

from pathlib import Path
from typing import Any, cast

import numpy as np
import numpy.typing as npt

from fam_bundle_model.files import whole_file

Trace = dict[str, npt.NDArray[Any]]

SCALARS = (
    'time',
    'strain_reference',
    'strain',
    'pressure_reference',
    'source_pressure',
    'recruitment_state',
    'time_to_saturation',
    'time_to_desaturation',
    'recruitment_lag',
    'pressure_compensation',
    'deslack_pressure',
    'force',
    'source_flow',
    'prediction_error',
)
PER_UNIT = ('mu_pressure', 'spool')


def empty_trace(ticks: int, units: int) -> Trace:
    """Return a trace of ``ticks`` rows to be filled: (ticks,) or, per motor unit, (ticks, units).

    ``recruitment_state`` is a whole number, the count of recruited motor units.
    """
    trace: Trace = {name: np.empty(ticks) for name in SCALARS}
    trace |= {name: np.empty((ticks, units)) for name in PER_UNIT}
    trace['recruitment_state'] = np.empty(ticks, dtype=np.int64)
    return trace


def save_trace(trace: Trace, path: Path) -> None:
    """Write ``trace`` as an ``npz`` file; whole or not at all."""
    with whole_file(path) as file:
        np.savez(file, **cast(Any, trace))


def load_trace(path: Path) -> Trace:
    """Return the trace in ``path``; raises OSError or ValueError when it holds none."""
    with np.load(path, allow_pickle=False) as data:
        return {name: data[name] for name in data.files}
