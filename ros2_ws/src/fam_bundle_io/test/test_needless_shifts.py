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

"""Which shifts a reference gives a reason for, on references that cross any level by hand."""

from collections.abc import Sequence
from itertools import pairwise

from fam_bundle_io.metrics import needless_shifts, shortest_interval
from fam_bundle_io.trace import empty_trace, Trace
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import numpy.typing as npt
import pytest

TICK = 0.01  # s
Array = npt.NDArray[np.float64]


def trace(reference: Array, shifts: Sequence[tuple[float, int]], start: int = 1) -> Trace:
    """Return a trace whose recruitment state changes at each time (s) to the state beside it."""
    made = empty_trace(len(reference), 4)
    made['time'] = TICK * np.arange(len(reference))
    made['strain_reference'] = reference
    made['recruitment_state'][:] = start
    for time, state in shifts:
        made['recruitment_state'][round(time / TICK) :] = state  # noqa: E203
    return made


def sine(cycles: int) -> Array:
    """Return cycles of 10 s from the valley at 0 s over the peak at 5 s."""
    time = TICK * np.arange(round(10.0 * cycles / TICK))
    return np.asarray(0.06 * (1.0 - np.cos(2.0 * np.pi * 0.1 * time)))


def test_a_pair_of_shifts_in_each_cycle_is_needed() -> None:
    assert needless_shifts(trace(sine(2), [(3.5, 2), (7.5, 1), (13.5, 2), (17.5, 1)])) == 0


def test_late_shifts_are_needed_too() -> None:
    # Up after the peak, down just after it or after the valley.
    assert needless_shifts(trace(sine(2), [(5.2, 2), (10.3, 1), (15.2, 2)])) == 0
    assert needless_shifts(trace(sine(2), [(4.4, 2), (5.7, 1), (14.4, 2), (15.7, 1)])) == 0


def test_a_second_pair_in_one_rise_is_needless() -> None:
    found = trace(sine(2), [(2.0, 2), (2.4, 1), (3.0, 2), (7.5, 1), (13.5, 2), (17.5, 1)])
    assert needless_shifts(found) > 0


def test_a_second_pair_around_the_peak_is_needless() -> None:
    shifts = [(4.8, 2), (4.9, 1), (5.1, 2), (7.0, 1), (14.8, 2), (14.9, 1), (15.1, 2)]
    assert needless_shifts(trace(sine(2), shifts)) > 0


def test_each_step_of_the_ladder_has_a_shift_of_its_own() -> None:
    up = [(2.0, 2), (3.0, 3), (4.0, 4)]
    down = [(6.0, 3), (7.0, 2), (8.0, 1)]
    assert needless_shifts(trace(sine(1), up + down)) == 0
    assert needless_shifts(trace(sine(1), [(2.0, 4), (8.0, 1)])) == 0  # all steps at once
    assert needless_shifts(trace(sine(1), [*up, (4.2, 3), (4.4, 4), *down])) > 0


def test_a_ramp_asks_for_one_shift() -> None:
    ramp = np.minimum(np.linspace(0.0, 0.2, 1000), 0.1)
    assert needless_shifts(trace(ramp, [(3.0, 2)])) == 0
    assert needless_shifts(trace(ramp, [(3.0, 2), (3.5, 1), (4.0, 2)])) == 1


def test_holding_still_asks_for_no_second_shift() -> None:
    still = np.full(1000, 0.05)
    assert needless_shifts(trace(still, [(0.5, 2)])) == 0
    assert needless_shifts(trace(still, [(0.5, 2), (2.0, 1), (3.0, 2), (4.0, 1)])) == 2


def test_ripple_is_no_rise_of_its_own() -> None:
    time = TICK * np.arange(1000)
    ripple = 0.001 * np.sin(2.0 * np.pi * 2.0 * time)
    shifts = [(3.0, 2), (3.4, 1), (3.9, 2), (7.0, 1)]
    assert needless_shifts(trace(sine(1) + ripple, shifts)) > 0
    # A dip deeper than a twentieth of the range asks for a pair.
    dip = np.where(np.abs(time - 3.5) < 0.5, -0.04 * np.cos(np.pi * (time - 3.5)), 0.0)
    assert needless_shifts(trace(sine(1) + dip, shifts)) == 0


def test_a_record_that_begins_within_a_run_has_no_shift_at_its_beginning() -> None:
    found = trace(sine(1), [(7.5, 1)], start=2)
    late = {name: values[100:] for name, values in found.items()}
    assert needless_shifts(late) == 0


@given(st.lists(st.floats(0.1, 29.9), max_size=12, unique=True))
def test_on_sines_more_than_a_pair_each_cycle_is_chatter(times: list[float]) -> None:
    """Counting per cycle says the same, and never counts a shift that has a reason."""
    shifts = [(time, 2 - k % 2) for k, time in enumerate(sorted(times))]
    shifts = [
        shift for k, shift in enumerate(shifts) if k == 0 or shift[0] - shifts[k - 1][0] > 0.1
    ]
    found = trace(sine(3), shifts)
    change = np.diff(found['recruitment_state'], prepend=1)
    if max((change > 0).sum(), (change < 0).sum()) > 4:  # the start may ask for one more
        assert needless_shifts(found) > 0
    rises = [int(10.0 * k / TICK) for k in range(4)]
    ups = [(change[a:b] > 0).sum() for a, b in pairwise(rises)]
    if max(ups) > 2:
        assert needless_shifts(found) > 0


@pytest.mark.parametrize(('shifts', 'expected'), [([], np.inf), ([(1.0, 2)], np.inf)])
def test_fewer_than_two_shifts_have_no_interval(
    shifts: list[tuple[float, int]], expected: float
) -> None:
    assert shortest_interval(trace(sine(1), shifts)) == expected


def test_shortest_interval_counts_shifts_of_both_kinds() -> None:
    found = trace(sine(2), [(3.0, 2), (7.0, 1), (13.0, 2), (15.5, 1)])
    assert shortest_interval(found) == pytest.approx(2.5)
