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

"""Times and time steps from the stamps of messages. Pure Python."""

from typing import Protocol

from fam_bundle_model.parameters import seconds
from fam_bundle_node.ticks import TickError


class Stamp(Protocol):
    """A time in whole seconds and nanoseconds, as in ``builtin_interfaces/Time``."""

    sec: int
    nanosec: int


def nanoseconds(stamp: Stamp) -> int:
    """Return ``stamp`` in ns."""
    return stamp.sec * 1_000_000_000 + stamp.nanosec


def begins_anew(tick: int, safe: bool, gap: float, timeout: float) -> bool:
    """
    Return whether a law starts again at a sample that came ``gap`` s after the one before.

    At the start of a run, while the plant is safe, for a law whose output is not applied must not
    wind up, and where the time between has no meaning: it went back, or is beyond ``timeout`` s.
    """
    return tick == 0 or safe or not 0.0 <= gap <= timeout


class StampClock:
    """Turns the stamps of successive messages into time steps."""

    def __init__(self, first_step_ns: int) -> None:
        """Take ``first_step_ns`` as the step before the first stamp."""
        self._first_step_ns = first_step_ns
        self._last_ns: int | None = None

    def restart(self) -> None:
        """Take the next stamp as the first."""
        self._last_ns = None

    def gap(self, stamp: Stamp) -> float:
        """Return the time in s since the stamp before, or 0 at the first one."""
        return 0.0 if self._last_ns is None else seconds(nanoseconds(stamp) - self._last_ns)

    def since_last(self, stamp: Stamp) -> float:
        """Return the time in s since the stamp before; raises TickError when time stands still."""
        now_ns = nanoseconds(stamp)
        last_ns = now_ns - self._first_step_ns if self._last_ns is None else self._last_ns
        if now_ns <= last_ns:
            raise TickError(f'stamp {now_ns} ns does not follow stamp {last_ns} ns')
        self._last_ns = now_ns
        return seconds(now_ns - last_ns)
