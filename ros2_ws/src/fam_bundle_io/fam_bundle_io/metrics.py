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

"""What a trace says of a run: tracking (equations 17 and 18), shifts, states, saturation."""

from itertools import pairwise
from typing import NamedTuple

from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration
import numpy as np
import numpy.typing as npt

SATURATED = 0.97  # share of the source pressure from which a unit counts as saturated
AT_LEAST = 1e-3  # share of the reference's range within which it is at its least
SLACK = 1e-9  # s by which rounding may move the edge of a window
SWING = 0.05  # share of the reference's range by which it must turn to ask for another shift


class NotMeasurable(ValueError):
    """A trace of which something cannot be measured: it is too short, or not finite."""


class Tracking(NamedTuple):
    """Integral absolute strain error in s, and largest absolute strain error."""

    iae: float
    max_error: float


class Window(NamedTuple):
    """Start and end of a part of a run in s; the end does not belong to it."""

    start: float
    stop: float


def tracking(trace: Trace, start: float, stop: float) -> Tracking:
    """
    Return the metrics over ``start <= time < stop`` (s), equations 17 and 18.

    Each tick stands for the time until the next one, or until ``stop``: in real time periods can
    be skipped.

    Raises NotMeasurable when the trace has fewer than two ticks in that window.
    """
    window = ticks_in(trace, Window(start, stop))
    if np.count_nonzero(window) < 2:
        raise NotMeasurable(f'the trace has no ticks from {start:g} s to {stop:g} s')
    error = np.abs(trace['strain_reference'] - trace['strain'])[window]
    step = np.diff(trace['time'][window], append=stop)
    return Tracking(float((error * step).sum()), float(error.max()))


def ticks_in(trace: Trace, window: Window) -> npt.NDArray[np.bool_]:
    """Return which ticks lie in ``window``."""
    time = trace['time']
    found = (time >= window.start - SLACK) & (time < window.stop - SLACK)
    return np.asarray(found, dtype=np.bool_)


def slice_of(trace: Trace, window: Window) -> slice:
    """Return the ticks in ``window``, of which there must be one."""
    inside = np.flatnonzero(ticks_in(trace, window))
    return slice(int(inside[0]), int(inside[-1]) + 1)


def steps(trace: Trace) -> npt.NDArray[np.float64]:
    """Return the time in s that each tick stands for; the last one as long as most do."""
    step = np.diff(trace['time'])
    return np.append(step, np.median(step) if step.size else 0.0)


def shift_times(trace: Trace) -> tuple[list[float], list[float]]:
    """
    Return the times in s of the upshifts and of the downshifts.

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
    """
    Return how many shifts the reference gave no reason for: none unless the scheme chatters.

    The reference crosses the strain at which a step of the ladder is needed at most once in each
    of its rises and falls, wherever that strain is. So each rise accounts for one shift up over
    each step, each fall for one down. A shift up during a fall is late or early: it counts for
    the rise before or after it; likewise down. What was before the run counts as either. What
    rises or falls by less than ``SWING`` of the reference's range is part of what is around it.
    """
    reference, state = trace['strain_reference'], trace['recruitment_state'].astype(int)
    before = np.concatenate(([1 if trace['time'][0] == 0.0 else state[0]], state[:-1]))
    turns, rises_first = _turns(reference, SWING * float(np.ptp(reference)))
    needless = 0
    for step in range(int(state.min()), int(state.max())):
        for up in (True, False):
            low, high = (before, state) if up else (state, before)
            shifts = np.flatnonzero((low <= step) & (high > step))
            used = -2
            for phase in np.searchsorted(turns, shifts, side='right').tolist():
                # Odd phases go the way of the first one.
                own = (phase % 2 == 1) == (rises_first == up)
                around = (phase,) if own else (phase - 1, phase + 1)
                free = [p for p in around if used < p <= len(turns)]
                used = free[0] if free else used
                needless += not free
    return needless


def _turns(values: npt.NDArray[np.float64], enough: float) -> tuple[list[int], bool]:
    """
    Return where ``values`` begin to rise or fall, in turn, by more than ``enough``.

    And whether they rise first.
    """
    change = np.sign(np.diff(values))
    moving = np.flatnonzero(change)
    corners = moving[1:][np.diff(change[moving]) != 0]
    turns: list[int] = []
    rising = falling = rises_first = False
    lowest = highest = 0
    for k in [*corners.tolist(), len(values) - 1]:
        lowest = k if values[k] < values[lowest] else lowest
        highest = k if values[k] > values[highest] else highest
        if not rising and values[k] - values[lowest] > enough:
            rising, falling = True, False
            rises_first = rises_first or not turns
            turns.append(lowest)
            highest = k
        elif not falling and values[highest] - values[k] > enough:
            rising, falling = False, True
            turns.append(highest)
            lowest = k
    return turns, rises_first


# ---- Cycles ----


def valleys(reference: npt.NDArray[np.float64]) -> list[int]:
    """Return the first tick, those of the reference's valleys inside the run, and its end."""
    inner = (reference[1:-1] < reference[:-2]) & (reference[1:-1] <= reference[2:])
    return [0, *(np.flatnonzero(inner) + 1).tolist(), len(reference)]


def whole_cycles(trace: Trace, configuration: Configuration | None = None) -> list[Window]:
    """
    Return the cycles of the reference that the trace holds from their first tick to the last.

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
    """
    Return whether the reference has a valley at ``tick``, one of ``valleys``.

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
