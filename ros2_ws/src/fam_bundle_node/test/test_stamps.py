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

"""Time steps come from the stamps of messages."""

from types import SimpleNamespace

from fam_bundle_node.stamps import begins_anew, nanoseconds, StampClock
from fam_bundle_node.ticks import TickError
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

FIRST_STEP = 1_000_000  # ns


def stamp(ns):
    return SimpleNamespace(**dict(zip(('sec', 'nanosec'), divmod(ns, 10**9), strict=True)))


@settings(deadline=None)
@given(st.integers(0, 2**31 * 10**9 - 1))
def test_stamp_is_read_to_the_nanosecond(ns):
    assert nanoseconds(stamp(ns)) == ns


def test_time_steps_come_from_stamps():
    clock = StampClock(FIRST_STEP)
    stamps = [SimpleNamespace(sec=s, nanosec=n) for s, n in ((5, 999_000_000), (6, 0), (6, 500))]
    assert [clock.since_last(stamp) for stamp in stamps] == [0.001, 0.001, 5e-7]


def test_the_first_step_is_given_even_at_time_zero():
    assert StampClock(FIRST_STEP).since_last(stamp(0)) == 0.001


@settings(deadline=None)
@given(st.integers(0, 10**15), st.lists(st.integers(1, 10**12)))
def test_steps_add_up_without_rounding_of_the_stamps(start, steps):
    clock, now = StampClock(FIRST_STEP), start
    clock.since_last(stamp(now))
    for step in steps:
        now += step
        assert clock.gap(stamp(now)) == clock.since_last(stamp(now)) == step / 1e9


@pytest.mark.parametrize('back', [0, 1, FIRST_STEP, 10**9])
def test_time_that_stands_still_or_goes_back_is_refused_and_forgotten(back):
    clock = StampClock(FIRST_STEP)
    clock.since_last(stamp(10**9))
    with pytest.raises(TickError, match='does not follow'):
        clock.since_last(stamp(10**9 - back))
    assert clock.since_last(stamp(10**9 + FIRST_STEP)) == 0.001


def test_there_is_no_gap_before_the_first_stamp():
    assert StampClock(FIRST_STEP).gap(stamp(10**9)) == 0.0


def test_looking_at_the_gap_changes_nothing():
    clock = StampClock(FIRST_STEP)
    clock.since_last(stamp(0))
    assert [clock.gap(stamp(ns)) for ns in (10**9, 10**8, 10**9)] == [1.0, 0.1, 1.0]
    assert clock.since_last(stamp(2 * FIRST_STEP)) == 0.002


def test_after_a_restart_the_next_stamp_is_the_first():
    clock = StampClock(FIRST_STEP)
    clock.since_last(stamp(10**9))
    clock.restart()
    assert clock.gap(stamp(0)) == 0.0
    assert clock.since_last(stamp(0)) == 0.001
    assert clock.since_last(stamp(3 * FIRST_STEP)) == 0.003


@pytest.mark.parametrize(
    ('tick', 'safe', 'gap', 'anew'),
    [
        (1, False, 0.001, False),
        (1, False, 0.015, False),
        (1, False, 0.016, True),
        (1, False, 0.0, False),  # the first stamp
        (1, False, -0.001, True),
        (1, True, 0.001, True),
        (0, False, 0.001, True),
    ],
)
def test_a_law_begins_anew_with_a_run_while_safe_and_after_a_gap(tick, safe, gap, anew):
    assert begins_anew(tick, safe, gap, timeout=0.015) is anew
