# SPDX-License-Identifier: Apache-2.0
"""Ticks arithmetic: what belongs together, and what is missing. Pure Python."""

import math
from collections.abc import Iterable
from typing import Any


class TickError(RuntimeError):
    """A tick that is missing, repeated or out of order; the message names topic and tick."""


class TickOrder:
    """Checks that each topic's ticks come one by one."""

    def __init__(self) -> None:
        """Start with no tick seen; the first one may be any."""
        self._last: dict[str, int] = {}

    def check(self, topic: str, tick: int) -> None:
        """Raise TickError unless ``tick`` follows the last one of ``topic``."""
        last = self._last.get(topic)
        if last is not None and tick != last + 1:
            raise TickError(f'{topic}: tick {tick} came after tick {last}, expected {last + 1}')
        self._last[topic] = tick


class TickJoin:
    """Collects one message per topic until all hold the same tick."""

    def __init__(self, topics: Iterable[str]) -> None:
        """Wait for all of ``topics``."""
        self._topics = tuple(topics)
        self._held: dict[str, Any] = {}

    def add(self, topic: str, message: Any) -> tuple[Any, ...] | None:
        """Return the messages of a tick in the order of the topics once all are there.

        Raises TickError when ``message`` is of another tick than those that wait.
        """
        for other, held in self._held.items():
            if held.tick != message.tick:
                missing = ', '.join(t for t in self._topics if t not in self._held)
                raise TickError(
                    f'{topic}: tick {message.tick} came while {other} waits at tick {held.tick} '
                    f'for {missing}'
                )
        self._held[topic] = message
        if len(self._held) < len(self._topics):
            return None
        complete = tuple(self._held[t] for t in self._topics)
        self._held.clear()
        return complete


def check_finite(topic: str, tick: int, values: Iterable[float]) -> None:
    """Raise TickError when one of ``values`` is not a finite number."""
    for value in values:
        if not math.isfinite(value):
            raise TickError(f'{topic}: tick {tick} holds {value}; every value must be finite')


def check_length(topic: str, tick: int, values: Iterable[float], units: int) -> None:
    """Raise TickError unless there is one of ``values`` for each motor unit."""
    count = len(tuple(values))
    if count != units:
        raise TickError(f'{topic}: tick {tick} holds {count} values for {units} motor units')
