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

"""
From which tick on an announced trajectory counts, however early or late its news comes.

The strain controller tracks a new trajectory from the tick after its stamp on. Whoever predicts
with it may have answered that tick before the news comes. So there it counts a fixed notice later,
and what is predicted does not depend on how long the news took. All times in whole ns of the run.
"""

from collections import deque
from typing import NamedTuple

from fam_bundle_model.reference import Reference

NOTICE = 50_000_000  # ns of the run: in real time far more than a message takes
BEGINNING = -1  # before every tick of a run


class Announcement(NamedTuple):
    """A trajectory, the time after which it is tracked, and whether a live value gave it."""

    since: int
    law: Reference
    live: bool


class Announced:
    """The trajectory that counts at a tick: ``first`` until another's ``notice`` is over."""

    def __init__(self, first: Announcement, notice: int) -> None:
        """Know of ``first`` alone; it is that of every run's beginning."""
        self._first = self._present = first
        self._notice, self._seen = notice, BEGINNING
        self._waiting: deque[Announcement] = deque()

    def begin(self) -> None:
        """Begin a new run; what was announced for its beginning may be here already."""
        self._present, self._seen = self._first, BEGINNING
        self._waiting = deque(w for w in self._waiting if w.since == BEGINNING)

    def add(self, news: Announcement) -> int:
        """
        Take news; return by how much its ticks were missed, 0 where that changes nothing.

        Those announced before it for a later time are of an earlier run, and are dropped.
        """
        self._waiting = deque(w for w in self._waiting if w.since <= news.since)
        self._waiting.append(news)
        same = news.law is self._present.law or (news.live and self._present.live)
        return 0 if same else max(self._seen - news.since - self._notice, 0)

    def at(self, now: int) -> Announcement:
        """Return what counts at the tick of time ``now``; never asked for an earlier one."""
        self._seen = now
        while self._waiting and self._waiting[0].since + self._notice < now:
            self._present = self._waiting.popleft()
        return self._present
