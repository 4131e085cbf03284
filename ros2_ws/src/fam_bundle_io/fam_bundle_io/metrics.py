# SPDX-License-Identifier: Apache-2.0
"""How well a run tracked its reference (equations 17 and 18)."""

from typing import NamedTuple

import numpy as np

from fam_bundle_io.trace import Trace


class Tracking(NamedTuple):
    """Integral absolute strain error in s, and largest absolute strain error."""

    iae: float
    max_error: float


def tracking(trace: Trace, start: float, stop: float) -> Tracking:
    """Return the metrics over ``start <= time < stop`` (s).

    Each tick stands for the time until the next one, or until ``stop``: in real time periods can
    be skipped.

    Raises ValueError when the trace has fewer than two ticks in that window.
    """
    time = trace['time']
    window = (time >= start - 1e-9) & (time < stop - 1e-9)
    if np.count_nonzero(window) < 2:
        raise ValueError(f'the trace has no ticks from {start:g} s to {stop:g} s')
    error = np.abs(trace['strain_reference'] - trace['strain'])[window]
    step = np.diff(time[window], append=stop)
    return Tracking(float((error * step).sum()), float(error.max()))


def shift_times(trace: Trace) -> tuple[list[float], list[float]]:
    """Return the times in s of the upshifts and of the downshifts."""
    change = np.diff(trace['recruitment_state'].astype(int), prepend=1)
    time = trace['time']
    return time[change > 0].tolist(), time[change < 0].tolist()
