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

"""Ticks come in order and once each, and a tick's messages are brought together."""

from dataclasses import dataclass
import itertools
import weakref

from fam_bundle_node.ticks import (
    CONFIRMED,
    LARGEST_GAP,
    Strikes,
    TickCounts,
    TickError,
    TickFilter,
    TickJoin,
    TickOrder,
    WINDOW,
)
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import pytest

TOPICS = ('a', 'b', 'c')
BASE = 2**40
starts = st.integers(0, 2**63)
# How far from the last tick one is that a loss does not explain.
far = (st.integers(-60, 60) | st.integers(1 - BASE, 2**62)).filter(
    lambda distance: not 0 <= distance <= LARGEST_GAP
)
both_modes = pytest.mark.parametrize('strict', [True, False])


@dataclass(eq=False)
class Message:
    tick: int
    topic: str = ''


def test_successive_ticks_pass_from_any_start():
    order = TickOrder()
    for tick in range(7, 12):
        order.check('a', tick)
        order.check('b', tick + 100)


@pytest.mark.parametrize('tick', [3, 4, 6, 2**63])
def test_tick_that_does_not_follow_is_named(tick):
    order = TickOrder()
    order.check('bundle_state', 4)
    with pytest.raises(TickError, match=f'bundle_state: tick {tick} .* expected 5'):
        order.check('bundle_state', tick)


def test_each_topic_may_begin_anew_from_0():
    order = TickOrder()
    for tick in (0, 1, 2, 0, 1):
        order.check('a', tick)
    with pytest.raises(TickError, match='a: tick 3 came after tick 1, expected 2'):
        order.check('a', 3)


# In real time


@pytest.fixture
def counts():
    return TickCounts()


def admitted(ticks, counts, last=None):
    """Return those of ``ticks`` that a filter admits which has just admitted ``last``."""
    passes = TickFilter(counts).admit
    if last is not None:
        assert passes(last)
    return [tick for tick in ticks if passes(tick)]


@settings(deadline=None)
@given(starts, st.lists(st.integers(1, LARGEST_GAP)))
def test_rising_ticks_pass_and_gaps_are_counted(start, steps):
    counts, ticks = TickCounts(), list(itertools.accumulate(steps, initial=start))
    assert admitted(ticks, counts) == ticks
    assert counts == TickCounts(missing=sum(steps) - len(steps))


def test_ticks_that_come_twice_are_refused(counts):
    assert admitted([5, 5, 6, 6, 6, 7], counts) == [5, 6, 7]
    assert counts == TickCounts(duplicate=3)


def test_ticks_that_overtake_each_other_are_used_once_and_in_order(counts):
    assert admitted([11, 13, 12, 14, 16, 15, 17], counts, last=10) == [11, 13, 14, 16, 17]
    assert counts.out_of_order == 2


@settings(deadline=None)
@given(st.lists(st.tuples(st.integers(1, 4), far), min_size=1, max_size=40))
def test_stray_tick_is_refused_and_hides_nothing_that_follows(story):
    """After some live ticks each time comes one from long ago or from the future."""
    counts, stream, last = TickCounts(), [(BASE, True)], BASE
    for count, distance in story:
        stream += [(last + n, True) for n in range(1, count + 1)]
        last += count
        stream.append((last + distance, False))
    passes = TickFilter(counts).admit
    assert [passes(tick) for tick, _ in stream] == [live for _, live in stream]
    assert counts == TickCounts(out_of_order=len(story))


def test_a_first_tick_that_is_a_stray_does_not_hide_the_rest(counts):
    live = list(range(70, 90))
    assert admitted([10**9, *live], counts) == [10**9, *live[CONFIRMED - 1 :]]  # noqa: E203


@pytest.mark.parametrize('last', [1, 15, 21, 10**9])
def test_restart_at_0_is_followed_at_once(last, counts):
    assert admitted(range(30), counts, last) == list(range(30))
    assert counts == TickCounts()


@settings(deadline=None)
@given(far)
def test_jump_is_followed_once_ticks_in_a_row_confirm_it(distance):
    assume(distance <= -CONFIRMED or distance > 0)  # else it runs into what is expected
    counts, stream = TickCounts(), range(BASE + distance, BASE + distance + 30)
    assert admitted(stream, counts, last=BASE) == list(stream[CONFIRMED - 1 :])  # noqa: E203
    assert counts.out_of_order == CONFIRMED - 1
    assert counts.missing == 0 or distance > 0  # nothing is missed on the way back


def test_jump_back_is_followed_after_a_stray_from_the_future(counts):
    back = list(range(5, 20))
    assert admitted([10**9, *back], counts, last=10**6) == back[CONFIRMED - 1 :]  # noqa: E203


@pytest.mark.parametrize('strays', [(99, 7), (99, 98, 97), (50, 50, 50), (90, 91, 90, 91)])
def test_strays_that_do_not_follow_each_other_confirm_nothing(strays, counts):
    assert admitted([*strays, 11, 12], counts, last=10) == [11, 12]
    assert counts == TickCounts(out_of_order=len(strays))


@settings(deadline=None, max_examples=300)
@given(st.lists(st.integers(-3, 30), max_size=80), st.lists(st.integers(0, 90), max_size=80))
def test_every_tick_is_admitted_once_between_jumps_and_accounted_for(steps, wild):
    """Whatever comes: wild ticks and a walk that mostly rises, mixed."""
    walk = [abs(tick) for tick in itertools.accumulate(steps)]
    ticks = [
        tick for pair in itertools.zip_longest(walk, wild) for tick in pair if tick is not None
    ]
    counts = TickCounts()
    passes = TickFilter(counts).admit
    last, heard, used = None, [], 0
    for tick in ticks:
        if tick != last:
            heard.append(tick)
        if not passes(tick):
            continue
        row = heard[-CONFIRMED:]
        rises = all(1 <= b - a <= LARGEST_GAP for a, b in itertools.pairwise(row))
        jump = tick == 0 or (rises and len(row) == CONFIRMED and tick != last)
        assert last is None or last < tick <= last + LARGEST_GAP or jump
        last, used = tick, used + 1
    assert used + counts.duplicate + counts.out_of_order == len(ticks)
    assert counts.late == counts.refused == 0


# Joining


def add(join, tick, topics=TOPICS):
    """Return the ticks of what is completed by a message of ``tick`` for each of ``topics``."""
    found = [join.add(topic, Message(tick, topic)) for topic in topics]
    assert all([m.topic for m in done] == list(TOPICS) for done in found if done)
    assert all({m.tick for m in done} == {tick} for done in found if done)
    return [tick for done in found if done]


def completed(join, stream):
    """Return the ticks that a ``stream`` of topics and ticks completes."""
    return [done for topic, tick in stream for done in add(join, tick, topic)]


def interleaved(topics, first=0):
    """Return the topics in this order, each with its own ticks counted from ``first``."""
    ticks = {topic: itertools.count(first) for topic in TOPICS}
    return [(topic, next(ticks[topic])) for topic in topics]


@both_modes
@settings(deadline=None)
@given(st.lists(st.permutations(TOPICS), max_size=20), starts)
def test_tick_after_tick_completes_in_any_order_of_arrival(strict, arrivals, first):
    counts = TickCounts()
    join = TickJoin(TOPICS, counts, strict=strict)
    for tick, arrival in enumerate(arrivals, first):
        assert add(join, tick, arrival[:2]) == []
        assert add(join, tick, arrival[2]) == [tick]
    assert counts == TickCounts()


def test_strict_join_names_what_is_missing(counts):
    join = TickJoin(TOPICS, counts, strict=True)
    join.add('a', Message(8))
    with pytest.raises(TickError, match=r'a: tick 9 came while a waits at tick 8 for b, c'):
        join.add('a', Message(9))


@settings(deadline=None)
@given(st.permutations(TOPICS * 12), starts)
def test_without_loss_every_tick_completes_once_and_in_order(topics, first):
    counts = TickCounts()
    join = TickJoin(TOPICS, counts, strict=False)
    assert completed(join, interleaved(topics, first)) == list(range(first, first + 12))
    assert counts == TickCounts()


@pytest.mark.parametrize('order', [''.join(o) for o in itertools.permutations(TOPICS)])
def test_a_topic_may_run_ahead_by_the_whole_window(order, counts):
    join = TickJoin(TOPICS, counts, strict=False)
    stream = interleaved(''.join(topic * WINDOW for topic in order) * 3)
    assert completed(join, stream) == list(range(3 * WINDOW))
    assert counts == TickCounts()


@settings(deadline=None)
@given(
    st.permutations(TOPICS * 12),
    st.sets(st.tuples(st.sampled_from(TOPICS), st.integers(0, 11)), max_size=15),
)
def test_what_a_topic_drops_costs_no_other_tick(topics, dropped):
    counts = TickCounts()
    join = TickJoin(TOPICS, counts, strict=False)
    stream = [message for message in interleaved(topics) if message not in dropped]
    heard, lacking = {tick for _, tick in stream}, {tick for _, tick in dropped}
    whole = [tick for tick in range(12) if tick not in lacking]
    assert completed(join, stream) == whole
    given_up = [tick for tick in heard & lacking if whole and tick < whole[-1]]
    assert counts == TickCounts(missing=len(given_up))


def test_flood_of_future_ticks_fills_no_memory_and_hides_nothing(counts):
    join, alive = TickJoin(TOPICS, counts, strict=False), weakref.WeakSet()
    assert add(join, 4) == [4]
    for tick in range(10**6, 10**6 + 5000):
        message = Message(tick)
        alive.add(message)
        join.add('a', message)
        assert len(alive) <= WINDOW + 1
    assert completed(join, interleaved(TOPICS * 50, first=5)) == list(range(5, 55))


def test_flood_between_the_messages_of_a_tick_loses_it_no_sooner_than_the_window(counts):
    join = TickJoin(TOPICS, counts, strict=False)
    add(join, 5, 'ab')
    for tick in range(10**6, 10**6 + WINDOW - 1):
        add(join, tick, 'a')
    assert add(join, 5, 'c') == [5]


def test_topic_that_was_silent_for_long_is_waited_for_again(counts):
    join = TickJoin(TOPICS, counts, strict=False)
    for tick in range(3 * WINDOW):
        add(join, tick, 'ab')
    assert add(join, 3 * WINDOW) == [3 * WINDOW]
    assert counts.missing == 3 * WINDOW


@both_modes
def test_messages_that_come_twice_are_counted_and_not_used(strict, counts):
    join = TickJoin(TOPICS, counts, strict=strict)
    assert add(join, 7, 'aab') == []
    assert add(join, 7, 'c') == [7]
    assert add(join, 7, 'cba') == []
    assert counts == TickCounts(duplicate=4)


@both_modes
def test_messages_of_ticks_that_are_done_with_are_counted_and_not_used(strict, counts):
    join = TickJoin(TOPICS, counts, strict=strict)
    for tick in (7, 8, 9):
        assert add(join, tick) == [tick]
    assert add(join, 8, 'bc') == add(join, 3, 'b') == []
    assert counts == TickCounts(late=3)
    assert add(join, 10) == [10]


def test_what_comes_for_a_tick_that_was_given_up_is_late(counts):
    join = TickJoin(TOPICS, counts, strict=False)
    assert completed(join, [('a', 7), ('b', 7), *((t, 8) for t in TOPICS), ('c', 7)]) == [8]
    assert counts == TickCounts(missing=1, late=1)


def test_a_stray_from_the_future_is_not_used_when_its_tick_comes(counts):
    join = TickJoin(TOPICS, counts, strict=False)
    assert add(join, 1) == [1]
    assert add(join, 500, 'b') == []
    for tick in range(2, 100):
        assert add(join, tick) == [tick]
    assert counts == TickCounts(late=1)
    assert add(join, 500, 'ac') == []


@both_modes
def test_the_first_topic_leads_back_when_its_ticks_do(strict, counts):
    """Its ticks have passed a filter: a plant whose new tick 0 was lost is followed."""
    join = TickJoin(TOPICS, counts, strict=strict)
    for tick in (500, 501, 7, 8):
        assert add(join, tick) == [tick]


@pytest.mark.parametrize('order', [''.join(o) for o in itertools.permutations(TOPICS)])
def test_who_joins_late_is_sent_the_run_before_and_takes_the_tick_that_waits(order, counts):
    """Publisher by publisher: what each has kept of the last run, then tick 0 of this one."""
    join = TickJoin(TOPICS, counts, strict=False)
    stream = [(topic, tick) for topic in order for tick in (*range(500, 600), 0)]
    assert completed(join, stream)[-1] == 0
    assert add(join, 1, TOPICS) == [1]


@both_modes
@pytest.mark.parametrize('open_topics', ['', 'a', 'bc'])
def test_tick_0_begins_a_new_run(strict, open_topics, counts):
    join = TickJoin(TOPICS, counts, strict=strict)
    for run in range(3):
        for tick in range(5 + run):
            assert add(join, tick) == [tick]
        add(join, 5 + run, open_topics)  # the run is cut off here
    assert counts == TickCounts()


def test_it_can_be_asked_what_a_topic_waits_for(counts):
    join = TickJoin(TOPICS, counts, strict=False)
    assert join.waits_for('a') is None
    add(join, 9, 'a')
    add(join, 8, 'ca')
    add(join, 7, 'b')
    assert join.waits_for('a') == (8, ['b'])
    assert join.waits_for('b') == (7, ['a', 'c'])
    assert add(join, 8, 'b') == [8]
    assert join.waits_for('a') == (9, ['b', 'c'])


# Strikes


def test_three_in_a_row_are_a_fault():
    strikes = Strikes()
    assert strikes.clear
    assert [strikes.strike() for _ in range(4)] == [False, False, True, True]
    assert not strikes.clear


def test_a_few_spread_out_are_none():
    strikes = Strikes(limit=3, within=20)
    for _ in range(100):
        assert not strikes.strike()
        assert not strikes.strike()
        for _ in range(21):
            strikes.good()


def test_a_fault_is_forgotten_after_good_messages_in_a_row_only():
    strikes = Strikes(limit=1, within=20)
    assert strikes.strike()
    for _ in range(20):
        strikes.good()
    assert not strikes.clear
    assert strikes.strike()
    for _ in range(20):
        strikes.good()
    assert not strikes.clear
    strikes.good()
    assert strikes.clear
