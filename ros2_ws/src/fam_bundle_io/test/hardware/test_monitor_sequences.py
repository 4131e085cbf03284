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

"""No sequence of calls, commands, time and faults leaves a valve powered while not active."""

import math

from benches import CONFIG, NOMINAL, PERIOD, RESTING_VOLTS, SAFE_VOLTS
import fake_quanser
from fam_bundle_io.hardware import backend as backend_module
from fam_bundle_io.hardware.backend import make_setup
from fam_bundle_io.hardware.calibration import load_hardware
from fam_bundle_io.hardware.limits import Limits
from fam_bundle_io.hardware.monitor import Monitor
from fam_bundle_io.hardware.quanser_backend import QuanserBackend
from fam_bundle_io.hardware.safety import Refused, State
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import initialize, invariant, precondition, rule, RuleBasedStateMachine
import numpy as np
import pytest

SAFE = {0: -9.375, 1: -9.375}  # the shipped valves: full spool to the tank
BREAKABLE = (
    'open', 'set_analog_output_ranges', 'write_analog', 'task_start', 'task_read_analog',
    'watchdog_start', 'watchdog_reload', 'watchdog_stop', 'watchdog_clear', 'task_stop', 'close',
)  # fmt: skip
NEEDED = {'write_analog', 'watchdog_stop'}  # to go safe
SPOOL = st.floats(-1.0, 1.0)
HARDWARE = load_hardware(CONFIG / 'volts_calibration.yaml')
LIMITS = Limits(activation_commands=2, frozen_samples=0, zero_time=0.01)


class Bridge(RuleBasedStateMachine):
    """The monitor on a card of the fake vendor, whose clock is the only one."""

    def __init__(self):
        super().__init__()
        self.patch = pytest.MonkeyPatch()
        self.board = fake_quanser.install(self.patch)
        self.patch.setattr(backend_module.time, 'sleep', self.board.advance)
        self.board.inputs = dict(enumerate(RESTING_VOLTS))
        setup = make_setup(HARDWARE, 'quanser', PERIOD)
        object.__setattr__(setup, 'options', {'board_type': 'fake'})
        self.monitor = Monitor(QuanserBackend(), setup, LIMITS, NOMINAL, self.clock)
        self.spool, self.stamp = np.zeros(2), 0
        self.fault, self.reset = '', False
        self.hindered = False  # to go safe, at the last tick or since
        self.heard = -math.inf  # when the newest good command came

    def clock(self):
        return round(self.board.time * 1e9)

    def teardown(self):
        try:
            self.monitor.close()
            if self.board.outputs:
                assert self.board.outputs == SAFE
        finally:
            self.patch.undo()

    # ---- Calls ----

    @initialize(active=st.booleans())
    def begin(self, active):
        if active:
            self.bring_to_active(0.5, -0.5)
            assert self.monitor.state is State.ACTIVE

    @precondition(lambda self: self.monitor.state is not State.ACTIVE)
    @rule(first=SPOOL, second=SPOOL)
    def bring_to_active(self, first, second):
        """Mend everything and go the documented way: sequences are about what follows."""
        self.mend()
        self.rest()
        self.attempt(self.monitor.configure)
        self.hold(2)
        self.reset_fault()
        self.a_fault_ends_by_a_reset_and_only_when_depressurised()
        self.attempt(self.monitor.arm)
        self.follow(first, second, 3)

    def attempt(self, call):
        try:
            call()
        except (Refused, OSError):
            return

    @rule()
    def configure(self):
        self.attempt(self.monitor.configure)

    @rule()
    def arm(self):
        self.attempt(self.monitor.arm)

    @rule()
    def disarm(self):
        self.monitor.disarm()

    @rule()
    def zero(self):
        self.attempt(self.monitor.zero)

    @rule()
    def reset_fault(self):
        self.reset = True
        self.attempt(self.monitor.reset_fault)

    @rule()
    def emergency_stop(self):
        self.monitor.emergency_stop('button')

    @rule()
    def close(self):
        self.monitor.close()
        assert not self.board.outputs or self.board.outputs == SAFE

    # ---- Ticks ----

    def tick(self):
        age = self.board.time - self.heard
        self.attempt(lambda: self.monitor.tick(self.spool, self.stamp))
        if self.monitor.state is State.ACTIVE:
            assert age <= LIMITS.command_lost + 1e-9
            if age > LIMITS.command_stale + 1e-9:
                assert self.board.left < self.board.timeout  # was not reloaded
        if not NEEDED & set(self.board.broken):
            self.hindered = False

    @rule(first=SPOOL, second=SPOOL, count=st.integers(1, 6))
    def follow(self, first, second, count):
        for _ in range(count):
            self.spool, self.stamp = np.array([first, second]), self.clock()
            self.heard = self.board.time
            self.tick()

    @rule(count=st.integers(1, 130))
    def hold(self, count):
        for _ in range(count):
            self.tick()

    @rule(
        bad=st.sampled_from([math.nan, math.inf, -math.inf, 1.0 + 1e-12, -7.0]),
        count=st.integers(1, 4),
    )
    def command_what_cannot_be(self, bad, count):
        for _ in range(count):
            self.spool, self.stamp = np.array([0.0, bad]), self.clock()
            self.tick()

    @rule(ahead=st.integers(1, 10**9), count=st.sampled_from([1, 30, 130]))
    def command_from_the_future(self, ahead, count):
        self.spool, self.stamp = np.array([1.0, 1.0]), self.clock() + ahead
        self.hold(count)

    @precondition(lambda self: self.monitor.state is not State.UNCONFIGURED)
    @rule(error=st.sampled_from([KeyboardInterrupt, SystemExit, MemoryError, TypeError]))
    def interrupt(self, error):
        self.board.broken['task_read_analog'] = error()
        try:
            self.tick()
        except (KeyboardInterrupt, SystemExit):
            assert self.board.outputs == SAFE or self.hindered
        finally:
            del self.board.broken['task_read_analog']

    # ---- The world ----

    @rule(seconds=st.sampled_from([1e-4, 1e-3, 0.015, 0.03, 0.09, 0.11, 0.5]))
    def let_pass(self, seconds):
        self.board.advance(seconds)

    @rule(call=st.sampled_from(BREAKABLE), code=st.integers(1, 999))
    def break_a_call(self, call, code):
        self.hindered = self.hindered or call in NEEDED
        self.board.broken[call] = fake_quanser.HILError(-code, 'broken')

    @rule()
    def mend(self):
        self.board.broken.clear()

    @rule(
        channel=st.integers(0, 5),
        volts=st.sampled_from([0.0, 0.5, 0.55, 0.6, 2.4, 2.6, 9.99, math.nan]),
    )
    def wire(self, channel, volts):
        self.board.inputs[channel] = volts

    @rule()
    def rest(self):
        self.board.inputs = dict(enumerate(RESTING_VOLTS))

    # ---- What must hold ----

    @invariant()
    def valves_are_powered_only_while_active(self):
        if self.monitor.state is State.ACTIVE or self.board.outputs == SAFE:
            return
        if not self.board.outputs:
            assert self.monitor.state is State.UNCONFIGURED  # never opened
            return
        # Only a card that could not be written at its last tick is late, and its watchdog runs.
        assert self.monitor.state is State.FAULT
        assert not self.monitor._sample.safe_out
        assert self.hindered
        assert self.board.timeout == LIMITS.watchdog_timeout and not self.board.expired
        assert self.board.left <= self.board.timeout

    @invariant()
    def what_is_said_to_be_out_is_out(self):
        if self.monitor._sample.safe_out and self.monitor.state is not State.UNCONFIGURED:
            assert self.board.outputs == SAFE

    @invariant()
    def a_fault_ends_by_a_reset_and_only_when_depressurised(self):
        if self.fault and not self.monitor.fault:
            assert self.reset
            assert np.all(self.monitor._sample.values[4:] < 20e3)
        elif self.fault:
            assert self.monitor.fault == self.fault
        self.fault, self.reset = self.monitor.fault, False

    @invariant()
    def a_fault_and_its_state_go_together(self):
        if self.monitor.state is not State.UNCONFIGURED:
            assert (self.monitor.state is State.FAULT) == bool(self.monitor.fault)


Bridge.TestCase.settings = settings(
    max_examples=150,
    stateful_step_count=40,
    deadline=None,
    suppress_health_check=[HealthCheck.too_slow],
)
TestNoSequenceLeavesAValvePowered = Bridge.TestCase


def test_the_machine_does_reach_the_active_state_and_a_powered_valve():
    """Else all of the above would hold for nothing."""
    bridge = Bridge()
    try:
        bridge.begin(True)
        bridge.follow(0.5, 0.25, 1)
        assert bridge.monitor.state is State.ACTIVE
        assert bridge.board.outputs == {0: 9.375 * 0.5, 1: 9.375 * 0.25}
        bridge.break_a_call('write_analog', 5)
        bridge.follow(0.6, 0.6, 1)
        assert bridge.monitor.state is State.FAULT
        assert bridge.board.outputs != SAFE
        bridge.valves_are_powered_only_while_active()
        bridge.let_pass(0.11)
        assert bridge.board.outputs == SAFE
    finally:
        bridge.teardown()


def test_the_safe_volts_of_this_test_are_the_ends_of_the_spools():
    assert tuple(SAFE.values()) != SAFE_VOLTS  # of the other calibration
    for channel, valve in enumerate(HARDWARE.calibration.valves):
        assert SAFE[channel] == valve.null_volts - valve.full_scale_volts
