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
When valves may move: states of the bridge, its fault latch, the limits of pressure. Pure.

::

    unconfigured ─configured─► inactive ─arm─► armed ─activate─► active
          ▲                       ▲  ▲           │                  │
       released                   │  └──disarm───┴──────disarm──────┘
                                  └─reset─ fault ◄─latch─ any of them
"""

import enum

from fam_bundle_io.hardware.calibration import Calibration, MU_PRESSURE, SOURCE_PRESSURE, Values
from fam_bundle_io.hardware.limits import Limits
import numpy as np


class State(enum.Enum):
    """Valves follow commands when active, and in no other state."""

    UNCONFIGURED = 'unconfigured'
    INACTIVE = 'inactive'
    ARMED = 'armed'
    ACTIVE = 'active'
    FAULT = 'fault'


class Refused(ValueError):
    """A transition that is not allowed now; the message says why."""


class Safety:
    """State and fault; the first fault stays until it is reset, also while unconfigured."""

    def __init__(self, calibration: Calibration, limits: Limits, nominal_pressure: float) -> None:
        """Be unconfigured. ``nominal_pressure`` is the source's set value in Pa."""
        units = len(calibration.mu_pressure)
        self.state = State.UNCONFIGURED
        self.fault = ''
        self.limits = limits
        self.highest = limits.overpressure_ratio * nominal_pressure
        self._above = np.zeros(units, dtype=np.int64)  # samples in a row, by unit
        self._flag = np.empty(units, dtype=np.bool_)

    def configured(self) -> None:
        """Go on from unconfigured, or from a fault after which the card was opened anew."""
        self._require('configure', State.UNCONFIGURED, State.FAULT)
        self._above.fill(0)
        self.state = State.FAULT if self.fault else State.INACTIVE

    def released(self) -> None:
        """Be unconfigured; a fault stays."""
        self.state = State.UNCONFIGURED

    def arm(self, *, measuring: bool) -> None:
        """Follow commands once they come regularly. Raises Refused unless all sensors measure."""
        self._require('arm', State.INACTIVE)
        if not measuring:
            raise Refused('arm: not every sensor measures')
        self.state = State.ARMED

    def activate(self) -> None:
        """Follow commands."""
        self._require('activate', State.ARMED)
        self.state = State.ACTIVE

    def disarm(self) -> None:
        """Follow no commands any more; elsewhere than in armed and active nothing changes."""
        if self.state in (State.ARMED, State.ACTIVE):
            self.state = State.INACTIVE

    def latch(self, reason: str) -> None:
        """Go to the fault state for ``reason``; the first one stays."""
        self.fault = self.fault or reason
        if self.state is not State.UNCONFIGURED:
            self.state = State.FAULT

    def reset(self, values: Values, *, measuring: bool) -> None:
        """End a fault. Raises Refused unless sensors measure and every unit is depressurised."""
        self._require('reset_fault', State.FAULT)
        if not measuring:
            raise Refused(f'reset_fault: not every sensor measures; the fault was: {self.fault}')
        pressurised = self.pressurised(values)
        if pressurised:
            raise Refused(f'reset_fault: {pressurised}')
        self._above.fill(0)
        self.fault, self.state = '', State.INACTIVE

    def pressurised(self, values: Values) -> str:
        """Return which motor unit is not depressurised, or nothing; ``values`` (channels,)."""
        bound = self.limits.depressurised
        for unit, pressure in enumerate(values[MU_PRESSURE:].tolist()):
            if not pressure < bound:
                return f'mu_pressure[{unit}] = {pressure:.4g} Pa: must be < {bound:g} Pa'
        return ''

    def watch_pressure(self, values: Values) -> str:
        """Return which motor unit has been above its limit for too long, or nothing."""
        margin = self.limits.overpressure_margin
        bound = min(self.highest, float(values[SOURCE_PRESSURE]) + margin)
        pressures = values[MU_PRESSURE:]
        np.greater(pressures, bound, out=self._flag)
        np.add(self._above, 1, out=self._above)
        np.multiply(self._above, self._flag, out=self._above)
        if not self._flag.any():
            return ''
        for unit in np.flatnonzero(self._above >= self.limits.overpressure_samples):
            pressure = float(pressures[unit])
            return f'mu_pressure[{unit}] = {pressure:.4g} Pa: must be <= {bound:.4g} Pa'
        return ''

    def _require(self, call: str, *states: State) -> None:
        if self.state not in states:
            fault = f' ({self.fault})' if self.state is State.FAULT else ''
            wanted = ' or '.join(state.value for state in states)
            raise Refused(f'{call}: the bridge is {self.state.value}{fault}; must be {wanted}')
