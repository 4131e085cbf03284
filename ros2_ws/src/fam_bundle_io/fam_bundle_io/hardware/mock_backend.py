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
A card that is none: every input mirrors an output. No physics, no clock.

Input i reads ``rest_i + 0.01 (out_j - safe_j) + 0.001 (-1)^k`` V, where j is i modulo the number
of outputs, ``rest_i`` what the sensor gives at zero, and k counts the reads: the last term keeps
the inputs from looking dead. The watchdog expires, and a call fails, when told to.
"""

from fam_bundle_io.hardware.backend import BackendError, Card, Volts
import numpy as np

SHARE, RIPPLE = 0.01, 0.001


class MockBackend(Card):
    """See Backend. ``outputs`` is what is out, ``broken`` what a call raises, by its name."""

    def __init__(self) -> None:
        """Hold nothing yet."""
        super().__init__()
        self.outputs: Volts = np.empty(0)
        self.broken: dict[str, OSError] = {}
        self._watched = self._locked = False
        self._reads = 0

    def expire(self) -> None:
        """Let the watchdog expire, if it runs."""
        if self._watched:
            np.copyto(self.outputs, self.setup.safe_volts)
            self._watched, self._locked = False, True

    def _check(self, call: str) -> None:
        if call in self.broken:
            raise self.broken[call]
        if self._locked:
            raise BackendError(0, f'{call}: refused since the watchdog has expired')

    def _open(self) -> None:
        setup = self.setup
        self._watched = self._locked = False
        self._check('configure')
        self.outputs = setup.safe_volts.copy()
        offsets = [sensor.offset for sensor in setup.calibration.sensors()]
        self._rest = np.array(offsets)
        self._mirrored = np.arange(setup.inputs.size) % setup.outputs.size
        self._moved = np.empty(setup.outputs.size)

    def _start_watchdog(self) -> None:
        self._check('arm')
        self._watched = True

    def _read(self, volts: Volts) -> None:
        self._check('read')
        self._reads += 1
        np.subtract(self.outputs, self.setup.safe_volts, out=self._moved)
        np.multiply(self._moved, SHARE, out=self._moved)
        np.take(self._moved, self._mirrored, out=volts)
        np.add(volts, self._rest, out=volts)
        np.add(volts, RIPPLE if self._reads % 2 == 0 else -RIPPLE, out=volts)

    def _write(self, volts: Volts) -> None:
        self._check('write')
        np.copyto(self.outputs, volts)

    def _reload(self) -> bool:
        if self._locked:
            return False
        self._check('reload_watchdog')
        return True

    def _stop_watchdog(self) -> None:
        self._watched = False

    def _let_go(self) -> None:
        self._watched = False
