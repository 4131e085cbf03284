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

"""The valves open to the tank when commands stay away, and stay open after a fault."""

from fam_bundle_node.command_watch import CommandWatch
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest

limits = pytest.mark.parametrize('limit', [2, 5, 20])


class Rig:
    """Takes samples under a watch; ``newest`` is the one that was taken last."""

    def __init__(self, limit):
        """Run, with every sample answered."""
        self.watch, self.newest = CommandWatch(limit), 0
        self.watch.answer(0)
        self.answered(2 * limit)
        assert not self.watch.safe

    def sample(self, periods=1):
        """Return whether the next sample finds the rig in the safe state."""
        self.newest += 1
        self.watch.next_sample(self.newest, periods)
        return self.watch.safe

    def silent(self, count):
        """Return the same of ``count`` samples that nobody answers."""
        return [self.sample() for _ in range(count)]

    def answered(self, count, delay=0, periods=1):
        """Return the same of ``count`` samples, each answered when ``delay`` more were taken."""
        found = []
        for _ in range(count):
            found.append(self.sample(periods))
            self.watch.answer(self.newest - delay)
        return found


@limits
def test_it_goes_safe_when_the_newest_answer_is_so_many_samples_old(limit):
    rig = Rig(limit)
    last = rig.newest
    assert rig.silent(limit) == [False] * (limit - 1) + [True]
    assert rig.silent(3 * limit) == [True] * 3 * limit
    assert rig.watch.state() == f'safe: valve_command: no answer since tick {last}'


@limits
def test_it_leaves_the_safe_state_after_so_many_answered_samples(limit):
    rig = Rig(limit)
    rig.silent(10 * limit)
    rig.watch.answer(rig.newest)
    assert rig.answered(limit) == [True] * (limit - 1) + [False]
    assert rig.watch.state() == 'running'


@limits
def test_one_answer_alone_does_not_end_the_safe_state(limit):
    rig = Rig(limit)
    rig.silent(limit)
    rig.answered(1)
    assert all(rig.silent(10 * limit))


@pytest.mark.parametrize('delay', [1, 2, 5])
def test_answers_that_are_always_a_few_samples_late_are_no_reason(delay):
    rig = Rig(20)
    assert not any(rig.answered(200, delay))
    rig.silent(30)
    assert all(rig.answered(20, delay))
    assert not any(rig.answered(200, delay)[delay:])


@limits
def test_answers_that_are_too_old_are_a_reason(limit):
    rig = Rig(limit)
    assert rig.answered(50, delay=limit)[-1]


def test_schedule_that_was_held_up_for_less_does_not_blame_the_controllers():
    rig = Rig(20)
    assert not any(rig.answered(100, periods=19))
    assert rig.watch.state() == 'running'


@limits
def test_schedule_that_was_held_up_for_longer_makes_it_safe(limit):
    rig = Rig(limit)
    assert rig.sample(limit + 1)
    assert f'held up for {limit + 1} periods before tick {rig.newest}' in rig.watch.state()
    rig.watch.answer(rig.newest)
    assert rig.answered(limit) == [True] * (limit - 1) + [False]


def test_another_hold_up_begins_the_wait_anew():
    rig = Rig(5)
    rig.sample(6)
    rig.watch.answer(rig.newest)
    assert all(rig.answered(4))
    assert all(rig.answered(1, periods=1000))
    assert rig.answered(5) == [True] * 4 + [False]


@settings(deadline=None)
@given(
    st.integers(2, 6),
    st.lists(st.tuples(st.none() | st.integers(0, 8), st.integers(1, 9)), max_size=60),
)
def test_no_stale_command_is_followed_and_nothing_else_is_a_reason(limit, story):
    """Each sample of the story comes after some periods; its answer belongs to an older one."""
    rig = Rig(limit)
    answered, cause, taken = rig.newest, False, {rig.newest: 0}
    for delay, periods in story:
        period = taken[rig.newest] + periods
        behind = rig.newest + 1 - answered >= limit or period - taken[answered] >= 2 * limit
        cause = cause or behind or periods > limit
        safe = rig.sample(periods)
        taken[rig.newest] = period
        assert safe or not (behind or periods > limit)
        assert cause or not safe
        if delay is not None:
            answered = max(answered, rig.newest - delay)
            rig.watch.answer(answered)


def test_fault_stays_until_it_is_reset():
    rig = Rig(5)
    rig.watch.latch('asked for')
    assert rig.watch.safe
    assert all(rig.answered(1000))
    assert rig.watch.state().startswith('fault: asked for;')
    assert '~/reset_fault' in rig.watch.state()


def test_the_first_reason_of_a_fault_stays():
    rig = Rig(5)
    rig.watch.latch('first')
    rig.watch.latch('second')
    rig.silent(100)
    rig.sample(100)
    assert 'first' in rig.watch.state()
    assert 'second' not in rig.watch.state()


@limits
def test_after_a_reset_it_still_waits_for_answers(limit):
    rig = Rig(limit)
    rig.watch.latch('asked for')
    rig.answered(3 * limit)
    rig.watch.reset()
    assert rig.watch.safe
    assert rig.watch.state() == 'safe: asked for; reset, waiting for commands'
    assert rig.answered(limit) == [True] * (limit - 1) + [False]


def test_reset_does_not_end_a_silence():
    rig = Rig(5)
    rig.watch.latch('asked for')
    rig.silent(10)
    rig.watch.reset()
    assert all(rig.silent(100))


def test_reset_without_a_fault_changes_nothing():
    rig = Rig(5)
    rig.watch.reset()
    assert rig.watch.state() == 'running'
    rig.silent(10)
    state = rig.watch.state()
    rig.watch.reset()
    assert rig.watch.state() == state


def test_a_fault_can_come_again():
    rig = Rig(5)
    rig.watch.latch('first')
    rig.watch.reset()
    rig.watch.latch('second')
    assert rig.watch.state().startswith('fault: second')


def test_two_answers_after_a_silence_do_not_end_the_safe_state():
    watch = CommandWatch(5)
    for tick in range(1, 20):
        watch.next_sample(tick, 1)
    assert watch.safe
    for tick in (20, 21):
        watch.answer(tick - 1)
        watch.next_sample(tick, 1)
    for tick in range(22, 40):
        watch.next_sample(tick, 1)
        assert watch.safe


def test_a_stuttering_schedule_does_not_hold_an_old_command_for_long():
    """Neither rule alone would end it: few samples, and no hold-up beyond the limit."""
    watch = CommandWatch(20)
    watch.answer(0)
    held = 0
    for tick in range(1, 20):
        watch.next_sample(tick, 19)
        if watch.safe:
            break
        held += 19
    assert held < 2 * 20


def test_answers_that_jitter_around_the_next_sample_end_the_safe_state():
    watch = CommandWatch(20)
    for tick in range(1, 40):
        watch.next_sample(tick, 1)
    assert watch.safe
    for tick in range(40, 80):
        watch.answer(tick - 1 - tick % 2)  # every other answer comes after the next sample
        watch.next_sample(tick, 1)
    assert not watch.safe


def test_a_short_safe_state_is_news_even_when_it_is_over():
    watch = CommandWatch(5)
    watch.answer(0)
    watch.next_sample(1, 100)
    for tick in range(2, 20):
        watch.answer(tick - 1)
        watch.next_sample(tick, 1)
    assert not watch.safe
    assert watch.take_news().startswith('safe: the schedule was held up for 100 periods')
    assert watch.take_news() == ''
