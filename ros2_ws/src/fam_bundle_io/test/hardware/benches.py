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

"""Every backend on a bench: what is at its terminals, time that passes, calls that fail."""

import contextlib
from pathlib import Path

import fake_nidaqmx
import fake_quanser
from fam_bundle_io.hardware.backend import load_backend, make_setup
import numpy as np

CONFIG = Path(__file__).parents[3] / 'fam_bundle_bringup' / 'config'
PERIOD = 0.001
NOMINAL = 689.5e3
# For the fakes: volts of sensors at rest, the source on, every motor unit vented.
RESTING_VOLTS = (0.3, 1.8, 2.5, 0.0, 0.5, 0.5)
# Written down by hand: the middle less full scale, and with the opposite sign.
SAFE_VOLTS = (0.25 - 9.375, 9.375)


class Bench:
    """One backend and what lies behind it."""

    def __init__(self, name, hardware, configuration):
        self.name = name
        self.backend = load_backend(name)
        self.setup = make_setup(hardware, name, PERIOD, configuration)
        self.read_volts = np.empty(self.setup.inputs.size)

    def outputs(self):
        """Return the volts at the terminals."""
        return self.backend.outputs.tolist()

    def let_pass(self, seconds):
        """Let time pass in which nobody looks after the watchdog."""
        raise NotImplementedError

    def fail(self, call, code):
        """Let ``read``, ``write`` or ``open`` fail from now on with the vendor's code."""
        raise NotImplementedError

    def mend(self):
        """Let everything work again."""
        raise NotImplementedError


class MockBench(Bench):
    """The mock card, whose terminals are set by hand."""

    def let_pass(self, seconds):
        if seconds > self.setup.watchdog_timeout:
            self.backend.expire()

    def fail(self, call, code):
        self.backend.broken[{'open': 'configure'}.get(call, call)] = OSError(code, 'broken')

    def mend(self):
        self.backend.broken.clear()


class VoltsBench(Bench):
    """The simulated rig in volts, in this process."""

    def let_pass(self, seconds):
        for _ in range(round(seconds / PERIOD) + 1):
            with contextlib.suppress(OSError):
                self.backend.read(self.read_volts)

    def fail(self, call, code):
        self.backend.inject(f'{call}_error')

    def mend(self):
        self.backend.heal()


class QuanserBench(Bench):
    """Quanser's card, with a fake in place of its module."""

    def __init__(self, name, hardware, configuration, monkeypatch):
        super().__init__(name, hardware, configuration)
        self.board = fake_quanser.install(monkeypatch)
        self.board.inputs = dict(enumerate(RESTING_VOLTS))

    def outputs(self):
        return [self.board.outputs[channel] for channel in self.setup.outputs.tolist()]

    def let_pass(self, seconds):
        self.board.advance(seconds)

    def fail(self, call, code):
        error = fake_quanser.HILError(code, 'broken')
        calls = {'read': 'task_read_analog', 'write': 'write_analog', 'open': 'task_start'}
        self.board.broken[calls[call]] = error

    def mend(self):
        self.board.broken.clear()


class NidaqmxBench(Bench):
    """A card of National Instruments, with a fake in place of its module."""

    def __init__(self, name, hardware, configuration, monkeypatch):
        super().__init__(name, hardware, configuration)
        self.device = fake_nidaqmx.install(monkeypatch)
        self.device.inputs = dict(enumerate(RESTING_VOLTS))

    def outputs(self):
        return [self.device.outputs[channel] for channel in self.setup.outputs.tolist()]

    def let_pass(self, seconds):
        self.device.advance(seconds)

    def fail(self, call, code):
        error = fake_nidaqmx.DaqError('broken', code)
        self.device.broken[{'open': 'start'}.get(call, call)] = error

    def mend(self):
        self.device.broken.clear()
