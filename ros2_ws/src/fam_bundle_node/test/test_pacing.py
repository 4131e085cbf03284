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

"""Steps keep to an absolute schedule, skip what they missed, and end when they are told to."""

import itertools
import random
import threading

from fam_bundle_node.pacing import Blocking, Lockstep, Periodic, Schedule, wait_until
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

PERIOD = 1_000_000  # ns
HANG = 60.0  # s; only a test that has failed waits so long
times = st.integers(0, 60 * PERIOD)


class World:
    """Its time moves on by reading the clock, and by sleeping, which may end early or late."""

    def __init__(self, now=0, reading=0, late=(0,)):
        self.now, self.reading = now, reading
        self.late = itertools.cycle(late)
        self.sleeps = []

    def clock(self):
        self.now += self.reading
        return self.now

    def sleep(self, seconds):
        self.sleeps.append((self.now, seconds))
        self.now += max(round(seconds * 1e9) + next(self.late), 0)


def paced(world, work, busy_tail=0):
    """
    Return when, for which due time and after how many periods each step is taken.

    ``work`` is how long each of the steps takes.
    """
    pacing = Periodic(PERIOD, busy_tail, clock=world.clock, sleep=world.sleep)
    steps, errors, ended, durations = [], [], threading.Event(), iter(work)

    def step(periods):
        steps.append((world.now, pacing.due, periods))
        world.now += next(durations)
        if len(steps) == len(work):
            pacing.stop()
            ended.set()

    pacing.start(step, lambda error: (errors.append(error), ended.set()))
    assert ended.wait(HANG)
    assert errors == []
    return steps


def blocking(reads, step):
    """Return what a blocking pacing reported when its ``reads`` had come to an end."""
    errors, ended = [], threading.Event()
    pacing = Blocking(iter(reads).__next__)
    pacing.start(step, lambda error: (errors.append(error), ended.set()))
    assert ended.wait(HANG)
    pacing.stop()
    return errors


def test_schedule_does_not_drift_however_late_it_wakes_up_within_a_period():
    chance = random.Random(1)
    late = [chance.randrange(PERIOD) for _ in range(997)]
    steps = paced(World(now=12_345, late=late), [0] * 100_000)
    assert [due for _, due, _ in steps] == [12_345 + n * PERIOD for n in range(1, 100_001)]
    assert {periods for _, _, periods in steps} == {1}
    assert steps[-1][0] - steps[-1][1] == late[99_999 % 997]


@settings(deadline=None, max_examples=100)
@given(st.lists(times, min_size=1), st.lists(times, min_size=1), st.integers(0, 2 * PERIOD))
def test_skipped_periods_are_counted_and_not_caught_up(work, late, busy_tail):
    start = last_due = 777
    total = 0
    for when, due, periods in paced(World(start - 5_000, 5_000, late), work, busy_tail):
        total += periods
        assert periods >= 1
        assert total == (when - start) // PERIOD
        assert when >= last_due + PERIOD  # it waited for what was due next
        assert due == start + total * PERIOD
        assert when < due + PERIOD  # what is due next lies ahead
        last_due = due


@pytest.mark.parametrize('missed', [1, 2, 50, 100_000])
def test_after_an_overrun_one_late_step_is_followed_by_a_wait(missed):
    world = World()
    steps = paced(world, [0, missed * PERIOD + PERIOD // 2, 0, 0, 0])
    resumed = (missed + 2) * PERIOD
    assert steps[2] == (resumed + PERIOD // 2, resumed, missed)
    assert steps[3:] == [(resumed + n * PERIOD, resumed + n * PERIOD, 1) for n in (1, 2)]
    assert (resumed + PERIOD // 2, 0.0005) in world.sleeps


@settings(deadline=None)
@given(st.lists(st.integers(1, 10**12), min_size=1), st.integers(1, 10**9))
def test_what_is_due_next_lies_after_now(waits, period):
    schedule, now, total = Schedule(99, period), 99, 0
    for wait in waits:
        now = max(now + wait, schedule.next_due())
        total += schedule.take(now)
        assert total == (now - 99) // period
        assert now < schedule.next_due() <= now + period


def test_a_period_that_is_taken_early_is_done_with():
    schedule = Schedule(0, PERIOD)
    assert schedule.take(PERIOD - 1) == 1
    assert schedule.next_due() == 2 * PERIOD
    assert schedule.take(2 * PERIOD) == 1


def test_first_step_is_due_one_period_after_the_start():
    assert paced(World(now=5), [0]) == [(5 + PERIOD, 5 + PERIOD, 1)]


@settings(deadline=None)
@given(
    st.integers(0, 10**12),
    st.integers(-10, 5 * PERIOD),
    st.integers(0, 2 * PERIOD),
    st.lists(st.integers(-PERIOD, 3 * PERIOD), min_size=1),
)
def test_only_the_time_before_the_busy_tail_is_slept(now, ahead, busy_tail, late):
    world, due = World(now, 7_000, late), now + ahead
    returned = wait_until(due, busy_tail, world.clock, world.sleep)
    assert returned == world.now >= due
    for begin, seconds in world.sleeps:
        assert seconds > 0.0
        assert begin + seconds * 1e9 <= due - busy_tail + 1e-3


def test_punctual_sleeper_returns_within_one_look_at_the_clock():
    world = World(reading=100)
    assert wait_until(PERIOD, 50_000, world.clock, world.sleep) == PERIOD
    assert len(world.sleeps) == 1


def test_without_a_busy_tail_nobody_is_kept_awake():
    world, looks = World(), []
    wait_until(PERIOD, 0, lambda: looks.append(0) or world.now, world.sleep)
    assert world.sleeps == [(0, 0.001)]
    assert len(looks) == 2


def test_nothing_is_slept_when_it_is_due_already():
    world = World(now=PERIOD)
    assert wait_until(PERIOD, 0, world.clock, world.sleep) == PERIOD
    assert world.sleeps == []


@pytest.mark.parametrize('pacing', [Lockstep(), Blocking(lambda: 1)])
def test_without_a_clock_nobody_says_when_a_step_was_due(pacing):
    assert pacing.due is None


def test_lockstep_steps_at_once_and_then_only_after_an_answer():
    pacing, steps = Lockstep(), []
    pacing.answered()
    assert steps == []
    pacing.start(lambda periods: steps.append((periods, threading.get_ident())), pytest.fail)
    for answers in range(4):
        assert steps == [(1, threading.get_ident())] * (answers + 1)
        pacing.answered()
    pacing.stop()
    pacing.answered()
    assert len(steps) == 5


def test_blocking_counts_what_read_returns():
    steps = []
    blocking([1, 1, 3, 1, 70], steps.append)
    assert steps == [1, 1, 3, 1, 70]


def test_clock_does_not_wait_for_answers():
    steps = []
    pacing = Blocking(iter([1, 2]).__next__)
    pacing.answered()
    ended = threading.Event()
    pacing.start(lambda _: steps.append(threading.get_ident()), lambda _: ended.set())
    assert ended.wait(HANG)
    pacing.answered()
    assert len(steps) == 2
    assert threading.get_ident() not in steps


@pytest.mark.parametrize('error', [ValueError('broken'), SystemExit(3)])
def test_what_a_step_raises_is_reported_once_and_no_step_follows(error):
    steps = []

    def step(periods):
        steps.append(periods)
        if len(steps) == 2:
            raise error

    assert blocking([1] * 10, step) == [error]
    assert steps == [1, 1]


def test_what_a_read_raises_is_reported():
    steps, error = [], OSError('unplugged')

    def reads():
        yield 1
        raise error

    assert blocking(reads(), steps.append) == [error]
    assert steps == [1]


@pytest.mark.parametrize('threaded', ['periodic', 'blocking'])
def test_stop_returns_when_the_last_step_has_ended(monkeypatch, threaded):
    world, inside, awaited, order, threads = World(), threading.Event(), threading.Event(), [], []
    join = threading.Thread.join
    if threaded == 'periodic':
        pacing = Periodic(PERIOD, clock=world.clock, sleep=world.sleep)
    else:
        pacing = Blocking(lambda: 1)

    def step(_):
        threads.append(threading.current_thread())
        inside.set()
        awaited.wait(HANG)
        order.append('step ended')

    pacing.start(step, order.append)
    assert inside.wait(HANG)
    # The step ends only once somebody waits for its thread.
    monkeypatch.setattr(threading.Thread, 'join', lambda t, _=None: (awaited.set(), join(t)))
    pacing.stop()
    order.append('stopped')
    assert not threads[0].is_alive()
    assert order == ['step ended', 'stopped']


def test_a_sample_that_comes_after_the_stop_is_not_stepped():
    steps, threads, stopped = [], [], threading.Event()

    def reads():
        yield 1
        pacing.stop()
        threads.append(threading.current_thread())
        stopped.set()
        yield 2

    pacing = Blocking(reads().__next__)
    pacing.start(steps.append, steps.append)
    assert stopped.wait(HANG)
    threads[0].join(HANG)
    assert steps == [1]


@pytest.mark.parametrize('pacing', [Lockstep(), Periodic(PERIOD), Blocking(lambda: 1)])
def test_stop_may_come_before_the_start_and_twice(pacing):
    pacing.stop()
    pacing.stop()
