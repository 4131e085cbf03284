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
What paces the owner of the plant: each other, a steady clock, or the hardware.

Pure Python. A pacing calls ``step(periods)`` for every tick; ``periods`` is 1, or more when it
was held up: it skips what it missed and never fires back to back to catch up.
"""

from collections.abc import Callable
import threading
import time
from typing import Protocol

Clock = Callable[[], int]
Sleep = Callable[[float], None]
Step = Callable[[int], None]


class Pacing(Protocol):
    """Drives the steps of a loop."""

    # When the newest step was due (ns), or None where no clock says so.
    due: int | None

    def start(self, step: Step, failed: Callable[[BaseException], None]) -> None:
        """
        Begin to call ``step``.

        A pacing with a thread of its own tells ``failed`` what a step raised and ends; one
        without lets it rise to whoever called.
        """

    def answered(self) -> None:
        """Note that the answer to the newest tick has come."""

    def stop(self) -> None:
        """Call no further step; wait up to a second for the last one to end."""


class Schedule:
    """Absolute times ``origin + n x period`` (ns), and which of them is next."""

    def __init__(self, origin: int, period: int) -> None:
        """Start at period 0, which is taken as done."""
        self._origin = origin
        self._period = period
        self._done = 0

    def next_due(self) -> int:
        """Return when the next period is due (ns)."""
        return self._origin + (self._done + 1) * self._period

    def take(self, now: int) -> int:
        """
        Return how many periods have come due by ``now`` (ns), at least 1; be done with them.

        More than 1 after an overrun. The next due time then lies after ``now``.
        """
        periods = max((now - self._origin) // self._period - self._done, 1)
        self._done += periods
        return periods


def wait_until(due: int, busy_tail: int, clock: Clock, sleep: Sleep) -> int:
    """Wait until ``due`` (ns), the last ``busy_tail`` ns of it awake, and return the time then."""
    now = clock()
    while now < due:
        if due - now > busy_tail:
            sleep((due - busy_tail - now) / 1e9)
        now = clock()
    return now


class Lockstep:
    """Takes the next step when the answer to the last one has come, in the same thread."""

    due: int | None = None

    def __init__(self) -> None:
        """Stand still."""
        self._step: Step | None = None

    def start(self, step: Step, failed: Callable[[BaseException], None]) -> None:
        """Take the first step at once."""
        self._step = step
        step(1)

    def answered(self) -> None:
        """Take the next step."""
        if self._step is not None:
            self._step(1)

    def stop(self) -> None:
        """Take no further step."""
        self._step = None


class _Threaded:
    """Steps in a thread of its own, one for each return of ``wait``."""

    due: int | None = None

    def __init__(self, wait: Callable[[], int]) -> None:
        self._wait = wait
        self._stopped = threading.Event()
        self._thread: threading.Thread | None = None

    def start(self, step: Step, failed: Callable[[BaseException], None]) -> None:
        """Take the first step when it is due."""

        def run() -> None:
            try:
                while not self._stopped.is_set():
                    periods = self._wait()
                    if not self._stopped.is_set():
                        step(periods)
            except BaseException as error:  # a thread must not die silently
                failed(error)

        self._thread = threading.Thread(target=run, name='pacing', daemon=True)
        self._thread.start()

    def answered(self) -> None:
        """Do nothing: the clock goes on."""

    def stop(self) -> None:
        """Take no further step."""
        self._stopped.set()
        if self._thread is not None and self._thread is not threading.current_thread():
            self._thread.join(1.0)


class Periodic(_Threaded):
    """Steps on an absolute schedule of a steady clock."""

    def __init__(
        self,
        period: int,
        busy_tail: int = 0,
        *,
        clock: Clock = time.monotonic_ns,
        sleep: Sleep = time.sleep,
    ) -> None:
        """
        Step every ``period`` ns, the last ``busy_tail`` ns of each wait spent awake.

        The first step is due one period after ``start``.
        """
        super().__init__(self._until_due)
        self._period, self._busy_tail = period, busy_tail
        self._clock, self._sleep = clock, sleep
        self._schedule = Schedule(0, period)

    def start(self, step: Step, failed: Callable[[BaseException], None]) -> None:
        """Take the first step in one period."""
        self._schedule = Schedule(self._clock(), self._period)
        super().start(step, failed)

    def _until_due(self) -> int:
        due = self._schedule.next_due()
        now = wait_until(due, self._busy_tail, self._clock, self._sleep)
        periods = self._schedule.take(now)
        self.due = due + (periods - 1) * self._period
        return periods


class Blocking(_Threaded):
    """Steps when a read of the hardware returns, which its own clock paces."""

    def __init__(self, read: Callable[[], int]) -> None:
        """Call ``read`` for each step: it blocks until the next sample and counts the periods."""
        super().__init__(read)
