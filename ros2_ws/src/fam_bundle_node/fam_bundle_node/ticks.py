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

"""Ticks arithmetic: what belongs together, what is missing, twice or late. Pure Python."""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Any

# A step of the tick beyond this is believed only when CONFIRMED ticks in a row say so.
LARGEST_GAP = 20
CONFIRMED = 3
# Ticks that a join keeps open at a time.
WINDOW = 128


class TickError(RuntimeError):
    """Data that may not be used; the message names topic, tick and reason."""


@dataclass
class TickCounts:
    """What went wrong with the messages that a node consumes, since its start."""

    missing: int = 0
    duplicate: int = 0
    out_of_order: int = 0
    late: int = 0
    refused: int = 0


class TickOrder:
    """Lock-step: each topic's ticks come one by one, or anew from 0."""

    def __init__(self) -> None:
        """Start with no tick seen; the first one may be any."""
        self._last: dict[str, int] = {}

    def check(self, topic: str, tick: int) -> None:
        """Raise TickError unless ``tick`` follows the last one of ``topic`` or begins a run."""
        last = self._last.get(topic)
        if last is not None and tick not in (0, last + 1):
            raise TickError(f'{topic}: tick {tick} came after tick {last}, expected {last + 1}')
        self._last[topic] = tick


class TickFilter:
    """Real time: admits the ticks of one topic in rising order, once each, and counts the rest."""

    def __init__(self, counts: TickCounts) -> None:
        """Count into ``counts``; the first tick may be any."""
        self._counts = counts
        self._last: int | None = None
        self._candidate = -1
        self._seen = 0

    def admit(self, tick: int) -> bool:
        """
        Return whether ``tick`` is to be used.

        A jump, back or far ahead, is believed when ``CONFIRMED`` rising ticks in a row say so:
        one stray message must not blind the loop to all that follow. Tick 0 begins a new run.
        """
        step = 1 if self._last is None or tick == 0 else tick - self._last
        if step == 0:
            self._counts.duplicate += 1
            return False
        if not 1 <= step <= LARGEST_GAP:
            rises = 1 <= tick - self._candidate <= LARGEST_GAP
            self._seen = self._seen + 1 if rises else 1
            self._candidate = tick
            if self._seen < CONFIRMED:
                self._counts.out_of_order += 1
                return False
        self._counts.missing += max(step - 1, 0)
        self._last, self._seen = tick, 0
        return True


class TickJoin:
    """Collects one message per topic until all hold the same tick."""

    def __init__(self, topics: Iterable[str], counts: TickCounts, *, strict: bool) -> None:
        """Wait for all of ``topics``; ``strict`` allows one open tick at a time."""
        self._topics = tuple(topics)
        self._counts = counts
        self._strict = strict
        self._open: dict[int, dict[str, Any]] = {}
        self._done: int | None = None

    def _is_new_run(self, topic: str, tick: int) -> bool:
        """
        Return whether a tick that has been there begins a new run: tick 0 on any topic.

        And any tick on the first topic, whose ticks were checked before.
        """
        if tick == 0:
            been = any(topic in held for held in self._open.values())
            return been or self._done is not None
        return topic == self._topics[0] and self._done is not None and tick < self._done

    def add(self, topic: str, message: Any) -> tuple[Any, ...] | None:
        """
        Return the messages of a tick in the order of the topics once all are there.

        A message of a tick that is done with, or that was there before, is counted and dropped;
        tick 0 begins a new run.
        Raises TickError, if strict, when ``message`` is of another tick than those that wait.
        """
        tick: int = message.tick
        if self._is_new_run(topic, tick):
            begun = self._open.get(0, {})
            self._open.clear()
            self._done = None
            if tick == 0 and begun and topic not in begun:
                # Whoever joins late is sent the run before by each publisher in turn.
                self._open[0] = begun
        if self._strict and self._open and tick not in self._open:
            self._refuse(topic, tick)
        if self._done is not None and tick <= self._done:
            self._counts.duplicate += tick == self._done
            self._counts.late += tick < self._done
            return None
        held = self._open.setdefault(tick, {})
        if topic in held:
            self._counts.duplicate += 1
            return None
        held[topic] = message
        if len(held) < len(self._topics):
            if len(self._open) > WINDOW:
                del self._open[next(iter(self._open))]
                self._counts.missing += 1
            return None
        complete = tuple(held[t] for t in self._topics)
        self._done = tick
        self._drop_all_but_the_next(tick)
        return complete

    def _drop_all_but_the_next(self, done: int) -> None:
        """Drop what was passed by, and what came so far ahead of its time that it is a stray."""
        passed = [tick for tick in self._open if tick <= done]
        strays = [tick for tick in self._open if tick > done + WINDOW]
        self._counts.missing += len(passed) - 1
        self._counts.late += len(strays)
        for tick in passed + strays:
            del self._open[tick]

    def waits_for(self, topic: str) -> tuple[int, list[str]] | None:
        """Return the oldest open tick that ``topic`` has come for, and which topics it lacks."""
        for tick, held in sorted(self._open.items()):
            if topic in held:
                return tick, [t for t in self._topics if t not in held]
        return None

    def _refuse(self, topic: str, tick: int) -> None:
        waiting, held = next(iter(self._open.items()))
        missing = ', '.join(t for t in self._topics if t not in held)
        raise TickError(
            f'{topic}: tick {tick} came while {next(iter(held))} waits at tick {waiting} '
            f'for {missing}'
        )


class Strikes:
    """Three messages that may not be used are a fault, if few good ones come in between."""

    def __init__(self, limit: int = 3, within: int = LARGEST_GAP) -> None:
        """Call it a fault at ``limit`` strikes with at most ``within`` good ones after each."""
        self._limit, self._within = limit, within
        self._count = 0
        self._good = 0

    @property
    def clear(self) -> bool:
        """Whether nothing is held against the source of the messages."""
        return self._count == 0

    def strike(self) -> bool:
        """Note one that may not be used; return whether that is a fault now."""
        self._count += 1
        self._good = 0
        return self._count >= self._limit

    def good(self) -> None:
        """Note one that may be used."""
        self._good += 1
        if self._good > self._within:
            self._count = 0
