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
Tells measurements from what only looks like one: dead, frozen and jumping channels.

Pure, and without new arrays while all channels are well.
"""

from fam_bundle_io.hardware.calibration import (
    Calibration,
    FORCE,
    SOURCE_FLOW,
    STRAIN,
    Values,
    Volts,
)
from fam_bundle_io.hardware.limits import Limits
import numpy as np

# Without these the loop goes on, with the last good value.
EXPENDABLE = (FORCE, SOURCE_FLOW)
# Times ``sensor_samples``, for which a channel that came back elsewhere must be steady.
STEADY = 2


class SensorWatch:
    """
    Holds the last good value of each channel, and says when one is lost.

    A sample is no measurement while its volts are outside the live range, have not changed in
    the last bit for too long, or its value is farther from the last good one than the rig can
    go in a sample. One that is steady for long enough measures again, wherever it is: the rig
    has moved meanwhile. ``degraded`` (channels,) marks the expendable channels that are lost now.
    """

    def __init__(self, calibration: Calibration, limits: Limits) -> None:
        """Have seen nothing yet."""
        sensors = calibration.sensors()
        count = len(sensors)
        self.names = calibration.names()
        self.limits = limits
        self.units = tuple(sensor.unit for sensor in sensors)
        self.live_minimum = np.array([sensor.live_minimum for sensor in sensors])
        self.live_maximum = np.array([sensor.live_maximum for sensor in sensors])
        # A meter without flow gives no pulses at all: its zero volts are not a frozen channel.
        self.can_freeze = np.array([sensor.type != 'frequency' for sensor in sensors])
        self.rate = np.full(count, limits.pressure_rate)
        self.rate[STRAIN], self.rate[FORCE] = limits.strain_rate, limits.force_rate
        self.rate[SOURCE_FLOW] = limits.flow_rate
        self.good: Values = np.zeros(count)
        self.degraded = np.zeros(count, dtype=np.bool_)
        self.has_values = False  # every channel has had a good value
        self.measuring = False  # every channel that is not expendable, in the newest sample
        self.bad = np.zeros(count, dtype=np.int64)  # counts samples that are no measurement
        self._equal = np.zeros(count, dtype=np.int64)  # to the sample before, in a row
        self._new = np.ones(count, dtype=np.bool_)  # has had no good value yet
        self._before: Volts = np.full(count, np.nan)
        self._last: Values = np.full(count, np.nan)
        self._steady = np.zeros(count, dtype=np.int64)  # samples without a jump, in a row
        self._room: Values = np.empty(count)
        self._step: Values = np.empty(count)
        self._well = np.empty(count, dtype=np.bool_)
        self._flag = np.empty(count, dtype=np.bool_)
        self._essential = np.array([i not in EXPENDABLE for i in range(count)])

    def forget(self) -> None:
        """Take the next sample as the first: the scaling, or the card, is another now."""
        self._new.fill(True)
        self._before.fill(np.nan)
        self._last.fill(np.nan)
        self.bad.fill(0)
        self._equal.fill(0)
        self._steady.fill(0)
        self.degraded.fill(False)
        self.has_values = self.measuring = False

    def look(self, volts: Volts, values: Values, elapsed: float) -> str:
        """
        Put the last good value in place of each in ``values`` (channels,) that is none.

        ``volts`` (channels,) are what they come from; ``elapsed`` s have passed since the last
        look. Returns why the loop cannot go on, or nothing.
        """
        well, flag = self._well, self._flag
        self._count_equal(volts)
        self._judge(volts, values, elapsed)
        np.logical_not(well, out=flag)
        self._count_bad()
        np.copyto(self.good, values, where=well)
        np.logical_and(self._new, flag, out=self._new)
        self.measuring = not flag.any()
        if self.measuring:
            self.has_values = True
            return ''
        np.copyto(values, self.good)
        self.has_values = not self._new.any()
        np.logical_and(flag, self._essential, out=flag)
        self.measuring = not flag.any()
        return self._lost(volts)

    def _count_equal(self, volts: Volts) -> None:
        np.equal(volts, self._before, out=self._flag)
        np.logical_and(self._flag, self.can_freeze, out=self._flag)
        np.add(self._equal, 1, out=self._equal)
        np.multiply(self._equal, self._flag, out=self._equal)
        np.copyto(self._before, volts)

    def _count_steady(self, values: Values) -> None:
        np.subtract(values, self._last, out=self._step)
        np.abs(self._step, out=self._step)
        np.less_equal(self._step, self._room, out=self._flag)
        np.add(self._steady, 1, out=self._steady)
        np.multiply(self._steady, self._flag, out=self._steady)
        np.copyto(self._last, values)

    def _count_bad(self) -> None:
        """Count bad samples up and good ones down: a loose contact adds up, a spike does not."""
        for _ in range(2):
            np.add(self.bad, self._flag, out=self.bad)
        np.subtract(self.bad, 1, out=self.bad)
        np.maximum(self.bad, 0, out=self.bad)
        np.minimum(self.bad, self.limits.sensor_samples, out=self.bad)
        np.greater_equal(self.bad, self.limits.sensor_samples, out=self.degraded)

    def _judge(self, volts: Volts, values: Values, elapsed: float) -> None:
        """Fill ``_well``; comparisons with NaN are false, so NaN is not well."""
        well, flag = self._well, self._flag
        np.multiply(self.rate, elapsed, out=self._room)
        self._count_steady(values)
        np.subtract(values, self.good, out=self._step)
        np.abs(self._step, out=self._step)
        np.less_equal(self._step, self._room, out=well)
        np.logical_or(well, self._new, out=well)
        np.greater_equal(self._steady, STEADY * self.limits.sensor_samples, out=flag)
        np.logical_or(well, flag, out=well)
        np.greater_equal(volts, self.live_minimum, out=flag)
        np.logical_and(well, flag, out=well)
        np.less_equal(volts, self.live_maximum, out=flag)
        np.logical_and(well, flag, out=well)
        if self.limits.frozen_samples:
            np.less(self._equal, self.limits.frozen_samples, out=flag)
            np.logical_and(well, flag, out=well)

    def _lost(self, volts: Volts) -> str:
        """Return the first that is lost for good and that the loop cannot do without."""
        for i in np.flatnonzero(self.degraded):
            if i not in EXPENDABLE:
                return self._reason(int(i), float(volts[i]))
        return ''

    def _reason(self, i: int, volts: float) -> str:
        name, low, high = self.names[i], self.live_minimum[i], self.live_maximum[i]
        if not low <= volts <= high:
            return f'{name} = {volts:.4g} V: must be >= {low:g} and <= {high:g} V'
        if self.limits.frozen_samples and self._equal[i] >= self.limits.frozen_samples:
            return f'{name}: frozen at {volts:.4g} V for {self._equal[i]} samples'
        return f'{name}: jumped by {self._step[i]:.4g} {self.units[i]}'.rstrip()
