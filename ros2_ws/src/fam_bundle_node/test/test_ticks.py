# SPDX-License-Identifier: Apache-2.0
"""Ticks come one by one, and a tick's messages are brought together."""

import itertools
import math
from types import SimpleNamespace

import pytest

from fam_bundle_node.stamps import StampClock
from fam_bundle_node.ticks import TickError, TickJoin, TickOrder, check_finite, check_length

TOPICS = ('a', 'b', 'c')


def message(tick: int, topic: str = '') -> SimpleNamespace:
    return SimpleNamespace(tick=tick, topic=topic)


def test_successive_ticks_pass_from_any_start() -> None:
    order = TickOrder()
    for tick in range(7, 12):
        order.check('a', tick)
        order.check('b', tick + 100)


@pytest.mark.parametrize('tick', [3, 4, 6, 2**63])
def test_tick_that_does_not_follow_is_named(tick: int) -> None:
    order = TickOrder()
    order.check('bundle_state', 4)
    with pytest.raises(TickError, match=f'bundle_state: tick {tick} .* expected 5'):
        order.check('bundle_state', tick)


@pytest.mark.parametrize('arrival', list(itertools.permutations(TOPICS)))
def test_join_completes_in_any_order_of_arrival(arrival: tuple[str, ...]) -> None:
    join = TickJoin(TOPICS)
    for tick in range(3):
        found = [join.add(topic, message(tick, topic)) for topic in arrival]
        assert found[:2] == [None, None]
        assert [m.topic for m in found[2]] == list(TOPICS)
        assert {m.tick for m in found[2]} == {tick}


def test_join_names_what_is_missing() -> None:
    join = TickJoin(TOPICS)
    join.add('a', message(8))
    with pytest.raises(TickError, match=r'a: tick 9 came while a waits at tick 8 for b, c'):
        join.add('a', message(9))


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
def test_value_that_is_not_finite_is_refused(bad: float) -> None:
    check_finite('valve_command', 3, (0.0, -1.0))
    with pytest.raises(TickError, match='valve_command: tick 3'):
        check_finite('valve_command', 3, (0.0, bad))


def test_wrong_number_of_units_is_refused() -> None:
    check_length('bundle_state', 3, (1.0, 2.0), 2)
    with pytest.raises(TickError, match='bundle_state: tick 3 holds 1 values for 2 motor units'):
        check_length('bundle_state', 3, (1.0,), 2)


def test_time_that_stands_still_is_refused() -> None:
    clock = StampClock(1_000_000)
    clock.since_last(SimpleNamespace(sec=1, nanosec=0))
    with pytest.raises(TickError, match='does not follow'):
        clock.since_last(SimpleNamespace(sec=1, nanosec=0))


def test_time_steps_come_from_stamps() -> None:
    clock = StampClock(1_000_000)
    stamps = [SimpleNamespace(sec=s, nanosec=n) for s, n in ((5, 999_000_000), (6, 0), (6, 500))]
    assert [clock.since_last(stamp) for stamp in stamps] == [0.001, 0.001, 5e-7]
