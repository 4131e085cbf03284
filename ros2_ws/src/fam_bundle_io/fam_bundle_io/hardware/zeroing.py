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

"""Zero strain and pressures while every motor unit is vented: a mean, or a refusal. Pure."""

import math

from fam_bundle_io.hardware.calibration import (
    Calibration,
    MU_PRESSURE,
    SensorCalibration,
    SOURCE_PRESSURE,
    STRAIN,
    Values,
    Volts,
    zeroed,
)
from fam_bundle_io.hardware.limits import Limits
import numpy as np


class Zeroing:
    """
    Takes samples until it has enough; then there is a ``result`` or a ``refusal``.

    The source's pressure is zeroed too if the source is off, that is below
    ``limits.depressurised``.
    """

    def __init__(
        self, calibration: Calibration, limits: Limits, period: float, values: Values
    ) -> None:
        """Begin; ``values`` (channels,) are the newest, ``period`` is in s."""
        units = len(calibration.mu_pressure)
        self.calibration, self.limits = calibration, limits
        self.channels = [STRAIN, *range(MU_PRESSURE, MU_PRESSURE + units)]
        if values[SOURCE_PRESSURE] < limits.depressurised:
            self.channels.append(SOURCE_PRESSURE)
        self.samples = max(round(limits.zero_time / period), 2)
        self.taken = 0
        self.result: Calibration | None = None
        self.refusal = ''
        self._first: Volts = np.empty(0)
        self._sum = np.zeros(len(values))
        self._squares = np.zeros(len(values))

    def done(self) -> bool:
        """Return whether there is a result or a refusal."""
        return self.result is not None or bool(self.refusal)

    def refuse(self, reason: str) -> None:
        """End without a result; the first reason stays."""
        self.refusal = self.refusal or f'zero: {reason}'

    def take(self, volts: Volts) -> None:
        """Take one sample (channels,) in V."""
        if self.done():
            return
        if self.taken == 0:
            self._first = volts.copy()
        # Counted from the first sample: squares of 5 V would drown microvolts.
        moved = volts - self._first
        self._sum += moved
        self._squares += moved * moved
        self.taken += 1
        if self.taken == self.samples:
            self._finish()

    def _finish(self) -> None:
        sensors, names = self.calibration.sensors(), self.calibration.names()
        means: dict[int, float] = {}
        for i in self.channels:
            mean = self._sum[i] / self.taken
            variance = max(self._squares[i] / self.taken - mean * mean, 0.0)
            sensor = sensors[i]
            assert isinstance(sensor, SensorCalibration)
            gain = abs(sensor.gain)
            means[i] = float(self._first[i] + mean)
            wanted = sensor.zero_value / sensor.gain + sensor.offset
            self._check(i, names[i], 'standard deviation', math.sqrt(variance) * gain, sensor.unit)
            self._check(i, names[i], 'shift', abs(means[i] - wanted) * gain, sensor.unit)
        if not self.refusal:
            self.result = zeroed(self.calibration, means)

    def _check(self, i: int, name: str, what: str, found: float, unit: str) -> None:
        limits = self.limits
        bounds = {
            'standard deviation': (limits.zero_strain_deviation, limits.zero_pressure_deviation),
            'shift': (limits.zero_strain_shift, limits.zero_pressure_shift),
        }[what]
        bound = bounds[0 if i == STRAIN else 1]
        if not found <= bound:
            self.refuse(f'{name}: {what} {found:.4g} {unit}'.rstrip() + f'; must be <= {bound:g}')
