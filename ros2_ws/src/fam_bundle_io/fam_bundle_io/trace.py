# Copyright 2026 fam_bundle maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The trace of a run: one array per signal, one row per tick; SI units."""

from pathlib import Path
from typing import Any, cast

from fam_bundle_model.files import whole_file
import numpy as np
import numpy.typing as npt

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
    """
    Return a trace of ``ticks`` rows to be filled: (ticks,) or, per motor unit, (ticks, units).

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
