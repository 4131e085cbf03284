# SPDX-License-Identifier: Apache-2.0
"""What a trace says of a run: tracking (equations 17 and 18), shifts, states, saturation."""

from itertools import pairwise
from typing import NamedTuple

import numpy as np
import numpy.typing as npt

from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration

SATURATED = 0.97  # share of the source pressure from which a unit counts as saturated
AT_LEAST = 1e-3  # share of the reference's range within which it is at its least
SLACK = 1e-9  # s by which rounding may move the edge of a window
SWING = 0.05  # share of the reference's range by which it must turn to ask for another shift


class Tracking(NamedTuple):
    """Integral absolute strain error in s, and largest absolute strain error."""

    iae: float
    max_error: float


class Window(NamedTuple):
    """Start and end of a part of a run in s; the end does not belong to it."""

    start: float
    stop: float


def tracking(trace: Trace, start: float, stop: float) -> Tracking:
    """Return the metrics over ``start <= time < stop`` (s).

    Each tick stands for the time until the next one, or until ``stop``: in real time periods can
    be skipped.

    Raises ValueError when the trace has fewer than two ticks in that window.
    """
    window = ticks_in(trace, Window(start, stop))
    if np.count_nonzero(window) < 2:
        raise ValueError(f'the trace has no ticks from {start:g} s to {stop:g} s')
    error = np.abs(trace['strain_reference'] - trace['strain'])[window]
    step = np.diff(trace['time'][window], append=stop)
    return Tracking(float((error * step).sum()), float(error.max()))


def ticks_in(trace: Trace, window: Window) -> npt.NDArray[np.bool_]:
    """Return which ticks lie in ``window``."""
    time = trace['time']
    found = (time >= window.start - SLACK) & (time < window.stop - SLACK)
    return np.asarray(found, dtype=np.bool_)


def steps(trace: Trace) -> npt.NDArray[np.float64]:
    """Return the time in s that each tick stands for; the last one as long as most do."""
    step = np.diff(trace['time'])
    return np.append(step, np.median(step) if step.size else 0.0)


def shift_times(trace: Trace) -> tuple[list[float], list[float]]:
    """Return the times in s of the upshifts and of the downshifts.

    A run begins with one unit; where the trace begins later, nothing is known of what was before.
    """
    state, time = trace['recruitment_state'].astype(int), trace['time']
    before = 1 if time.size and time[0] == 0.0 else state[:1]
    change = np.diff(state, prepend=before)
    return time[change > 0].tolist(), time[change < 0].tolist()


def shortest_interval(trace: Trace) -> float:
    """Return the least time in s between two shifts; infinity with fewer than two."""
    up, down = shift_times(trace)
    return float(np.diff(sorted(up + down)).min(initial=np.inf))


def needless_shifts(trace: Trace) -> int:
    """Return how many shifts the reference gave no reason for: none unless the scheme chatters.

    The reference has to cross the strain at which a step of the ladder is needed once for each
    shift over that step. Wherever that strain is, between two upshifts over one step the
    reference must then have fallen and risen again, between two downshifts risen and fallen. If
    it did not, by more than ``SWING`` of its range, the second shift was needless. An upshift
    acts one recruitment lag later: it may come as much before the reference turns.
    """
    reference, state = trace['strain_reference'], trace['recruitment_state'].astype(int)
    before = np.concatenate(([1 if trace['time'][0] == 0.0 else state[0]], state[:-1]))
    enough = SWING * float(np.ptp(reference))
    lag = np.where(np.isfinite(trace['recruitment_lag']), trace['recruitment_lag'], 0.0)
    until = np.searchsorted(trace['time'], trace['time'] + lag, side='right')
    needless = 0
    for step in range(int(state.min()), int(state.max())):
        ups = np.flatnonzero((before <= step) & (state > step))
        needless += sum(_dip(reference[a : until[b]]) <= enough for a, b in pairwise(ups))
        downs = np.flatnonzero((before > step) & (state <= step))
        needless += sum(_dip(-reference[a : b + 1]) <= enough for a, b in pairwise(downs))
    return needless


def _dip(values: npt.NDArray[np.float64]) -> float:
    """Return how far ``values`` fall and rise again."""
    left = np.maximum.accumulate(values)
    right = np.maximum.accumulate(values[::-1])[::-1]
    return float((np.minimum(left, right) - values).max())


# ---- Cycles ----


def valleys(reference: npt.NDArray[np.float64]) -> list[int]:
    """Return the first tick, those of the reference's valleys inside the run, and its end."""
    inner = (reference[1:-1] < reference[:-2]) & (reference[1:-1] <= reference[2:])
    return [0, *(np.flatnonzero(inner) + 1).tolist(), len(reference)]


def whole_cycles(trace: Trace, configuration: Configuration | None = None) -> list[Window]:
    """Return the cycles of the reference that the trace holds from their first tick to the last.

    A reference that does not repeat is one cycle, the whole run.
    Where no ``configuration`` tells them they are taken from valley to valley of the reference.
    """
    time, step = trace['time'], float(steps(trace)[-1])
    if configuration is not None:
        cycles = [Window(*cycle) for cycle in configuration.cycles()]
    else:
        edges = [*time.tolist(), float(time[-1]) + step]
        reference = trace['strain_reference']
        marks = [m for m in valleys(reference) if _is_valley(trace, m)]
        cycles = [Window(edges[a], edges[b]) for a, b in pairwise(marks)]
    # In real time the first or last period of a cycle may be skipped.
    slack = 1.5 * step
    return [c for c in cycles if c.start > time[0] - slack and c.stop < time[-1] + step + slack]


def _is_valley(trace: Trace, tick: int) -> bool:
    """Return whether the reference has a valley at ``tick``, one of ``valleys``.

    Those inside the run are valleys; its ends are, where the reference is at its least there: a
    run that begins later than at 0 s, or is cut short, begins or ends within a cycle.
    """
    time, reference = trace['time'], trace['strain_reference']
    if 0 < tick < len(time):
        return True
    if tick == 0 and time[0] > SLACK:
        return False
    least, largest = float(reference.min()), float(reference.max())
    return bool(reference[min(tick, len(time) - 1)] < least + AT_LEAST * (largest - least))


# ---- States and saturation ----


def time_in_state(trace: Trace, window: Window) -> dict[int, float]:
    """Return the time in s within ``window`` for which each number of units was recruited."""
    inside = ticks_in(trace, window)
    state, step = trace['recruitment_state'][inside], steps(trace)[inside]
    return {int(k): float(step[state == k].sum()) for k in np.unique(state)}


def time_at_source(trace: Trace, window: Window) -> list[float]:
    """Return the time in s within ``window`` at which each unit was at the source pressure."""
    inside = ticks_in(trace, window)
    source = trace['source_pressure'][inside, None]
    at_source = trace['mu_pressure'][inside] >= SATURATED * source
    return [float(t) for t in (at_source * steps(trace)[inside, None]).sum(axis=0)]
