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

"""What becomes of a command on its way to the valves: refused, held, slowed, ramped to safe."""

import math

from fam_bundle_io.hardware.calibration import Calibration, Values
from fam_bundle_io.hardware.limits import Limits
from fam_bundle_model.hydraulics import TO_TANK
import numpy as np
import numpy.typing as npt


class CommandGate:
    """
    Holds the newest good command and how old it is.

    ``applied`` (units,) is the spool that goes out; ``limited`` says that it is not the one that
    was asked for. Times are in ns of one steady clock.
    """

    def __init__(self, calibration: Calibration, limits: Limits) -> None:
        """Have no command; the spools are at the tank."""
        units = len(calibration.valves)
        self.limits = limits
        self.slew = np.array([valve.slew_limit for valve in calibration.valves])
        self.applied: Values = np.full(units, TO_TANK)
        self.limited = False
        self.stale = False
        self.rejected = 0  # all that could not be used
        self.fresh = 0  # good ones in a row since the last reset
        self._rejected_in_row = 0
        self._wanted: Values = np.full(units, TO_TANK)
        self._safe: Values = np.full(units, TO_TANK)
        self._room: Values = np.empty(units)
        self._next: Values = np.empty(units)
        self._differs = np.empty(units, dtype=np.bool_)
        self._newest: int | None = None  # stamp of the newest command, good or bad
        self._good: int | None = None  # stamp of the newest good one

    def reset(self) -> None:
        """Forget every command; the spools are at the tank."""
        self.applied.fill(TO_TANK)
        self._wanted.fill(TO_TANK)
        self.limited = self.stale = False
        self.fresh = self._rejected_in_row = 0
        self._newest = self._good = None

    def take(self, spool: npt.NDArray[np.float64] | None, stamp: int, now: int) -> str:
        """
        Take the command of ``stamp``, the moment it came; the same stamp again is no news.

        Returns why commands can no longer be trusted, or nothing.
        """
        if spool is None or stamp == self._newest:
            return ''
        wrong = self._wrong(spool, stamp, now)
        self._newest = stamp
        if wrong:
            self.rejected += 1
            self._rejected_in_row += 1
            self.fresh = 0
            many = self._rejected_in_row >= self.limits.rejected_commands
            return f'{self._rejected_in_row} commands in a row refused; {wrong}' if many else ''
        if self._good is not None and now - self._good > self._ns(self.limits.command_stale):
            self.fresh = 0
        self._good = stamp
        self._rejected_in_row = 0
        self.fresh += 1
        np.copyto(self._wanted, spool)
        return ''

    def age(self, now: int) -> float:
        """Return how old the newest good command is in s; infinity without one."""
        return math.inf if self._good is None else (now - self._good) * 1e-9

    def is_fresh(self, now: int) -> bool:
        """Return whether the newest good command may be followed."""
        return self.age(now) <= self.limits.command_stale

    def apply(self, now: int, elapsed: float) -> str:
        """
        Move ``applied`` towards the command, or towards safe where it is stale.

        ``elapsed`` s have passed since the last move. Returns why the loop cannot go on, or
        nothing.
        """
        age = self.age(now)
        if age > self.limits.command_lost:
            return f'no command for {age:.3g} s: must be <= {self.limits.command_lost:g} s'
        self.stale = age > self.limits.command_stale
        if self.stale:
            # Twice the spool's range of 1 lies between its ends.
            self._room.fill(2.0 / self.limits.ramp_time * elapsed)
            self._move(self._safe)
        else:
            np.multiply(self.slew, elapsed, out=self._room)
            self._move(self._wanted)
        return ''

    def _move(self, target: Values) -> None:
        """Move ``applied`` to ``target``, or by ``_room`` where that is less."""
        np.subtract(self.applied, self._room, out=self._next)
        np.maximum(self._next, target, out=self._next)
        np.add(self.applied, self._room, out=self.applied)
        np.minimum(self._next, self.applied, out=self.applied)
        np.not_equal(self.applied, self._wanted, out=self._differs)
        self.limited = bool(self._differs.any())

    def _wrong(self, spool: npt.NDArray[np.float64], stamp: int, now: int) -> str:
        """Return what is wrong with a command, or nothing."""
        if spool.shape != self.applied.shape or spool.dtype != self.applied.dtype:
            return (
                f'spool of type {spool.dtype} and shape {spool.shape}: '
                f'must be float64 {self.applied.shape}'
            )
        lowest, highest = float(spool.min()), float(spool.max())
        # NaN fails both comparisons.
        if not (lowest >= -1.0 and highest <= 1.0):
            worst = lowest if not lowest >= -1.0 else highest
            return f'spool = {worst:g}: must be >= -1 and <= 1'
        if stamp > now:
            return f'its stamp lies {(stamp - now) * 1e-9:.3g} s ahead'
        if self._good is not None and stamp < self._good:
            return f'it is {(self._good - stamp) * 1e-9:.3g} s older than the last one'
        return ''

    @staticmethod
    def _ns(seconds: float) -> int:
        return round(seconds * 1e9)
