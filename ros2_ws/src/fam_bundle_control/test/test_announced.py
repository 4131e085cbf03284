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

"""Which trajectory counts at a tick does not depend on when its news came, if it came in time."""

import itertools

from fam_bundle_control.announced import Announced, Announcement, BEGINNING, NOTICE
from fam_bundle_model.reference import still
from hypothesis import given
from hypothesis import strategies as st
import pytest

TICK = 1_000_000  # ns
FIRST = Announcement(BEGINNING, still(0.0), live=False)


def news(tick, strain=0.01, live=False):
    return Announcement(tick * TICK or BEGINNING, still(strain), live)


def test_news_count_from_the_first_tick_after_the_notice_on():
    known, goal = Announced(FIRST, NOTICE), news(10)
    assert known.add(goal) == 0
    last = 10 * TICK + NOTICE
    assert known.at(0) is FIRST
    assert known.at(last) is FIRST
    assert known.at(last + TICK) is goal
    assert known.at(last + 2 * TICK) is goal


@given(st.lists(st.tuples(st.integers(1, 300), st.integers(0, 50)), max_size=6))
def test_the_same_counts_however_long_the_news_took(delays):
    """News of one run come in order, each at most a notice after its tick."""
    announced = [news(tick, 1e-3 * k) for k, (tick, _) in enumerate(sorted(delays))]
    arrivals = itertools.accumulate((t + d for t, d in sorted(delays)), max)
    at_once, slowly = Announced(FIRST, NOTICE), Announced(FIRST, NOTICE)
    for one in announced:
        at_once.add(one)
    coming = [*zip(arrivals, announced, strict=True)]
    for tick in range(400):
        while coming and coming[0][0] < tick:
            assert slowly.add(coming.pop(0)[1]) == 0
        assert slowly.at(tick * TICK) is at_once.at(tick * TICK)


@pytest.mark.parametrize('late', [1, 7])
def test_by_how_much_news_are_late_is_told_and_they_count_at_once(late):
    known, goal = Announced(FIRST, NOTICE), news(10)
    now = 10 * TICK + NOTICE + late * TICK
    known.at(now)
    assert known.add(goal) == late * TICK
    assert known.at(now + TICK) is goal


def test_late_news_that_change_nothing_are_not_late():
    known = Announced(FIRST, NOTICE)
    known.at(10 * NOTICE)
    assert known.add(FIRST) == 0
    known.add(news(1, live=True))
    known.at(10 * NOTICE + TICK)
    assert known.add(news(2, strain=0.02, live=True)) == 0, 'nobody looks ahead along live values'


def test_a_new_run_begins_with_the_first_and_with_what_was_announced_for_its_beginning():
    known = Announced(FIRST, NOTICE)
    known.add(news(100))
    known.at(100 * TICK + 2 * NOTICE)
    known.add(news(400))
    goal = news(0)
    known.add(goal)
    known.begin()
    assert known.at(0) is FIRST
    assert known.at(NOTICE) is goal
    assert known.at(1000 * TICK) is goal


def test_what_waits_from_an_earlier_run_is_dropped_when_the_new_one_is_announced():
    known = Announced(FIRST, NOTICE)
    known.begin()
    known.at(0)
    known.add(news(400))  # on its way since before tick 0
    known.add(FIRST)
    goal = news(200)
    known.add(goal)
    assert known.at(1000 * TICK) is goal
