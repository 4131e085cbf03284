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
ROS node of a real rig: valve_command in, bundle_state out, like the plant simulator.

A managed node. ``configure`` opens the card, which is then read; ``activate`` allows ``~/arm``,
which begins a run. Only the thread of the card touches it; callbacks ask it for what they want.
"""

from collections.abc import Callable
import dataclasses
import functools
from pathlib import Path
import sys
import time
from typing import Any

from fam_bundle_io.hardware.backend import check_rig, load_backend, make_setup
from fam_bundle_io.hardware.calibration import hardware_text, HardwareFile, load_hardware
from fam_bundle_io.hardware.card_thread import CardThread, Hooks
from fam_bundle_io.hardware.monitor import Monitor, Sample
from fam_bundle_io.hardware.safety import Refused, State
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_msgs.msg import BackendInfo, BridgeState, BundleState, ValveCommand
from fam_bundle_msgs.srv import InjectFault
from fam_bundle_node.answers import Answers
from fam_bundle_node.loop_node import LoopNode, RCLError
from fam_bundle_node.qos import LATCHED
from fam_bundle_node.run import run_node
from fam_bundle_node.steady_timer import SteadyTimer
from fam_bundle_node.ticks import TickError
import numpy as np
from rclpy.duration import Duration
from rclpy.lifecycle import LifecycleState, TransitionCallbackReturn
from rclpy.lifecycle.node import LifecycleNodeMixin
from std_srvs.srv import Trigger

GROUPS = (
    'fam',
    'source',
    'valve',
    'hose',
    'oil',
    'load',
    'sensors',
    'simulation',
    'reference',
    'bridge',
)
SAMPLES = 4096  # whose times are kept for their answers
START_PERIOD = 0.05  # s between two tries to start by itself
REPORT_PERIOD = 100_000_000  # ns between two reports of a bridge without a run
ZERO_SLACK = 2.0  # s beyond the time of zeroing
LAST_REPORT = Duration(seconds=1)
CONFIGURE_TIMEOUT = 60.0  # s; a simulated rig compiles its laws, a card may load firmware


class HardwareBridge(LoopNode, LifecycleNodeMixin):
    """Publishes what the sensors measure and puts commands out, as far as the monitor lets it."""

    OWNS_RUN = True

    def __init__(self) -> None:
        """Find backend and hardware file; raises ConfigurationError where they cannot be used."""
        super().__init__('hardware_bridge', GROUPS)
        try:
            self.hardware = load_hardware(Path(self.configuration.bridge.hardware))
            self.thread = self._make_thread(self.hardware)
        except (ConfigurationError, OSError) as error:
            self.destroy_node()
            raise ConfigurationError(str(error)) from None
        self.answers = Answers(self.counts, realtime=self.realtime)
        self.sampled_at = [0] * SAMPLES  # when (ns), by tick
        self._seen = State.UNCONFIGURED, ''  # state and fault of the newest sample
        self._reported_idle = self._periods = 0
        self._end: tuple[str, int] | None = None  # why the run is over, and the exit status
        self._broken = ''  # why the thread of the card has ended
        self._states = self.loop_publisher(BundleState, 'bundle_state')
        self._reports = self.loop_publisher(BridgeState, 'bridge_state')
        self._infos = self.create_publisher(BackendInfo, 'backend_info', LATCHED)
        LifecycleNodeMixin.__init__(self)
        guarded = self._guarded
        self.loop_subscription(ValveCommand, 'valve_command', guarded(self.on_valve_command))
        self.create_service(Trigger, '~/arm', guarded(self.on_arm))
        self.create_service(Trigger, '~/disarm', guarded(self.on_disarm))
        self.create_service(Trigger, '~/zero', guarded(self.on_zero))
        self.create_service(Trigger, '~/reset_fault', guarded(self.on_reset_fault))
        self.create_service(Trigger, '~/emergency_stop', guarded(self.on_emergency_stop))
        if hasattr(self.backend, 'inject'):
            self.create_service(InjectFault, '~/inject_fault', guarded(self.on_inject_fault))
        self.thread.start()
        self._starter = SteadyTimer(self, START_PERIOD, self.start, self.fail_on)
        self._started_at = time.monotonic()

    def _make_thread(self, hardware: HardwareFile) -> CardThread:
        configuration = self.configuration
        bridge, run, period = (
            configuration.bridge,
            configuration.run,
            configuration.simulation.period,
        )
        setup = make_setup(hardware, bridge.backend, period, configuration)
        clock = time.monotonic_ns if self.realtime else None
        nominal = configuration.source.nominal_pressure
        self.backend: Any = load_backend(bridge.backend)
        check_rig(hardware, Path(bridge.hardware), bridge.backend, self.motor_units())
        self.monitor = Monitor(self.backend, setup, hardware.limits, nominal, clock=clock)
        return CardThread(
            self.monitor,
            Hooks(self.publish_state, self.publish_idle, self.run_ended, self.card_failed),
            period=period,
            units=self.motor_units(),
            realtime=self.realtime,
            patience=bridge.answer_share * period if self.realtime else run.answer_timeout,
            start_timeout=run.start_timeout,
        )

    # ---- In the thread of the card ----

    def publish_state(self, sample: Sample, tick: int, periods: int) -> None:
        """Publish a sample of the run."""
        stamp = periods * self.configuration.period_ns()
        if tick > 0:
            self.meter.skipped(periods - self._periods)
        self._periods = periods
        self.answers.sample = tick
        taken = sample.time if self.realtime else time.monotonic_ns()
        self.sampled_at[tick % SAMPLES] = taken
        strain, force, source_pressure, source_flow = sample.values[:4].tolist()
        message = BundleState(
            tick=tick,
            steady_time=taken,
            safe=sample.state is not State.ACTIVE,
            strain=strain,
            force=force,
            source_pressure=source_pressure,
            source_flow=source_flow,
            mu_pressure=sample.values[4:].tolist(),
        )
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp, 1_000_000_000)
        message.header.frame_id = 'bundle'
        self._publish(self._states, message)
        report = self._report_of(sample, tick)
        report.header = message.header
        self._publish(self._reports, report)

    def publish_idle(self, sample: Sample) -> None:
        """Report on a bridge without a run, ten times a second."""
        self._seen = sample.state, sample.fault
        now = time.monotonic_ns()
        if now - self._reported_idle < REPORT_PERIOD:
            return
        self._reported_idle = now
        report = self._report_of(sample, 0)
        report.header.stamp = self.get_clock().now().to_msg()
        self._publish(self._reports, report)

    def _report_of(self, sample: Sample, tick: int) -> BridgeState:
        self._seen = sample.state, sample.fault
        return BridgeState(
            state=sample.state.value,
            tick=tick,
            fault=sample.fault,
            trouble=sample.trouble,
            safe_out=sample.safe_out,
            stale=sample.stale,
            limited=sample.limited,
            rejected=sample.rejected,
            spool=sample.spool.tolist(),
            valve_volts=sample.valve_volts.tolist(),
            sensor_volts=sample.volts.tolist(),
            degraded=sample.degraded.tolist(),
        )

    def _publish(self, publisher: Any, message: Any) -> None:
        try:
            publisher.publish(message)
        except RCLError:
            if self.context.ok():  # else a signal has ended the context meanwhile
                raise

    def run_ended(self, reason: str) -> None:
        """Note that the run is over."""
        if reason:
            self._end = reason, 1
        else:
            self._end = '', 0

    def card_failed(self, error: BaseException) -> None:
        """Latch a fault for an error that nobody expected; the thread closes the card."""
        self._broken = f'{type(error).__name__}: {error}'
        self.monitor.emergency_stop(self._broken)

    # ---- Callbacks ----

    def _guarded(self, callback: Callable[..., Any]) -> Callable[..., Any]:
        """
        Return ``callback`` so that an error that nobody expected is a fault and is said.

        The executor would end the node for it, and with it the one who tells why.
        """

        @functools.wraps(callback)
        def guarded(*arguments: Any) -> Any:
            try:
                return callback(*arguments)
            except (TickError, RCLError):
                raise  # the loop's own, for those who receive
            except Exception as error:
                reason = f'{callback.__name__}: {type(error).__name__}: {error}'
                self.monitor.emergency_stop(reason)
                self.get_logger().error(reason)
                response = arguments[-1]
                if hasattr(response, 'success'):
                    response.success, response.message = False, reason
                return response

        return guarded

    def on_valve_command(self, command: ValveCommand) -> None:
        """Hand the command to the thread of the card."""
        if not self.thread.running or not self.answers.admit(command.tick):
            return
        self.meter.answered(command.tick, self.sampled_at[command.tick % SAMPLES])
        if command.vent:
            self.monitor.emergency_stop('pressure_controller asks for the safe state')
        self.thread.command(command.tick, np.array(command.spool))

    def on_arm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Begin a run: the valves follow commands as soon as the loop has closed."""
        return self._answer(response, self.arm, 'armed: tick 0 is out')

    def on_disarm(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Put the safe volts out and end the run."""
        return self._answer(
            response, self.disarm, 'disarmed: every motor unit is open to the tank'
        )

    def on_zero(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """Zero strain and pressures, and say to which offsets."""
        said: list[str] = []
        response = self._answer(response, lambda: said.append(self.zero()), '')
        response.message = response.message or said[0]
        return response

    def on_reset_fault(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """End a latched fault; the card is opened anew where its watchdog had expired."""
        return self._answer(response, self.reset_fault, 'the fault is over: inactive')

    def on_emergency_stop(
        self, _: Trigger.Request, response: Trigger.Response
    ) -> Trigger.Response:
        """Put the safe volts out and latch a fault, without waiting for the thread."""
        self.monitor.emergency_stop('emergency stop')
        response.success, response.message = True, 'every motor unit is opened to the tank'
        return response

    def on_inject_fault(
        self, request: InjectFault.Request, response: InjectFault.Response
    ) -> InjectFault.Response:
        """Break the simulated rig on purpose, or mend it."""

        def inject(_: Monitor) -> None:
            if request.fault:
                self.backend.inject(request.fault, *map(int, request.channels))
            else:
                self.backend.heal()

        return self._answer(response, lambda: self.thread.ask(inject), '')

    def _answer(self, response: Any, action: Callable[[], Any], done: str) -> Any:
        try:
            action()
            response.success, response.message = True, done
        except (ValueError, OSError, RuntimeError) as error:
            response.success, response.message = False, f'{error}'
            self.get_logger().warning(response.message)
        return response

    def arm(self) -> None:
        """Begin a run. Raises Refused where that is not allowed now."""
        if self._state_machine.current_state[1] != 'active':
            raise Refused('arm: the node is not active; configure and activate it first')
        present, wanted = self._states.get_subscription_count(), self.configuration.run.listeners
        if present < wanted:
            raise Refused(f'arm: bundle_state has {present} of {wanted} listeners')
        if self.thread.running:
            raise Refused('arm: a run is under way')

        def begin(monitor: Monitor) -> None:
            monitor.arm()
            self.answers.begin()
            self.thread.begin(self.configuration.ticks())

        self.thread.ask(begin)
        self.get_logger().info(f'armed for {self.configuration.ticks()} ticks')

    def disarm(self) -> None:
        """End the run and put the safe volts out."""

        def end(monitor: Monitor) -> None:
            self.thread.end()
            monitor.disarm()

        self.thread.ask(end)

    def zero(self) -> str:
        """Zero, and return what became of it; raises Refused where it is not allowed now."""

        def begin(monitor: Monitor) -> None:
            if self.thread.running:
                raise Refused('zero: a run is under way')
            monitor.zero()

        self.thread.ask(begin)
        end = time.monotonic() + self.hardware.limits.zero_time + ZERO_SLACK
        while not self.thread.ask(lambda m: m.zeroing is None or m.zeroing.done()):
            if time.monotonic() > end:
                raise Refused('zero: not enough samples came')
            time.sleep(START_PERIOD)
        zeroing = self.monitor.zeroing
        if zeroing is None or zeroing.result is None:
            raise Refused(zeroing.refusal if zeroing else 'zero: interrupted')
        self.hardware = dataclasses.replace(self.hardware, calibration=zeroing.result)
        self.publish_info()
        moved = ', '.join(
            f'{name} {before.offset:g} -> {after.offset:g} V'
            for name, before, after in zip(
                zeroing.result.names(),
                zeroing.calibration.sensors(),
                zeroing.result.sensors(),
                strict=True,
            )
            if before.offset != after.offset
        )
        return f'zeroed: {moved or "nothing moved"}'

    def reset_fault(self) -> None:
        """End a latched fault. Raises Refused unless every motor unit is depressurised."""

        def reset(monitor: Monitor) -> None:
            if monitor.state is State.FAULT and not monitor.readable:
                monitor.configure()
                monitor.tick()
            monitor.reset_fault()
            self.thread.end()  # not before: a refusal must not end the run of an active bridge

        self.thread.ask(reset, CONFIGURE_TIMEOUT)

    # ---- Transitions ----

    def on_configure(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Open the card: from now on it is read, with the safe volts out."""
        return self._transition(
            'configure', lambda: self.thread.ask(lambda m: m.configure(), CONFIGURE_TIMEOUT)
        )

    def on_activate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Allow ``~/arm``."""
        return TransitionCallbackReturn.SUCCESS

    def on_deactivate(self, state: LifecycleState) -> TransitionCallbackReturn:
        """End the run and put the safe volts out."""
        return self._transition('deactivate', self.disarm)

    def on_cleanup(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of the card."""
        return self._transition('cleanup', self._release)

    def on_shutdown(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of the card and end the node."""
        done = self._transition('shutdown', self._release)
        self.succeed()
        return done

    def on_error(self, state: LifecycleState) -> TransitionCallbackReturn:
        """Let go of the card: the node may be configured again."""
        self.monitor.emergency_stop(f'the transition from {state.label} failed')
        return self._transition('error', self._release)

    def _release(self) -> None:
        def release(monitor: Monitor) -> None:
            self.thread.end()
            monitor.close()

        self.thread.ask(release)

    def _transition(self, name: str, action: Callable[[], Any]) -> TransitionCallbackReturn:
        """Do what a transition asks for; rclpy would keep an error of it to itself."""
        try:
            action()
        except Exception as error:
            self.get_logger().error(f'{name}: {error}')
            if name != 'configure':  # which leaves the card closed
                self.monitor.emergency_stop(f'{name}: {error}')
            return TransitionCallbackReturn.FAILURE
        if name == 'configure':
            self.publish_info()
        return TransitionCallbackReturn.SUCCESS

    # ---- The rest of a node of the loop ----

    def start(self) -> None:
        """Go as far by itself as ``bridge.start`` says."""
        wanted, reached = self.configuration.bridge.start, self._state_machine.current_state[1]
        if wanted == 'unconfigured':
            self._starter.cancel()
        elif reached == 'unconfigured':
            if self.trigger_configure() != TransitionCallbackReturn.SUCCESS:
                self.fail('the card cannot be configured: see above')
        elif wanted == 'inactive':
            self._starter.cancel()
        elif reached == 'inactive':
            self.trigger_activate()
        else:
            self._arm_by_itself()

    def _arm_by_itself(self) -> None:
        try:
            self.arm()
        except Refused as error:
            timeout = self.configuration.run.start_timeout
            if time.monotonic() - self._started_at > timeout or self._seen[0] is State.FAULT:
                self.fail(f'{error}; {self._seen[1]}'.removesuffix('; '))
            return
        self._starter.cancel()

    def publish_info(self) -> None:
        """Publish which card runs by which calibration."""
        calibration = self.hardware.calibration
        message = BackendInfo(
            backend=self.configuration.bridge.backend,
            calibration_id=calibration.id,
            calibration_hash=calibration.hash(),
            hardware=hardware_text(self.hardware),
        )
        message.header.stamp = self.get_clock().now().to_msg()
        self._infos.publish(message)

    def look_after(self) -> None:
        """End the node after a run that it was to begin by itself."""
        super().look_after()
        if self.done.done():
            return
        if self._broken:
            self.report()
            self.fail(self._broken)
        if self._end is None:
            return
        reason, status = self._end
        self._end = None
        if reason:
            self.get_logger().error(reason)
        if status and not self.thread.running and self.configuration.bridge.start == 'armed':
            self.fail(reason)
        elif self.configuration.bridge.start == 'armed':
            self.finish()

    def finish(self) -> None:
        """Say how the run was, and end the node."""
        self.report()
        whole = self.meter.whole_run(self.configuration.period_ns())
        self.get_logger().info(f'ran {self.answers.sample + 1} ticks; {whole.words()}')
        self.succeed()

    def state(self) -> str:
        """Return 'running', or in which state the bridge is and why."""
        state, fault = self._seen
        if fault:
            return f'fault: {fault}; reset with ~/reset_fault'
        if state is State.ACTIVE:
            return 'running'
        return f'safe: {state.value}'

    def get_trouble(self, reason: str) -> None:
        """Stop: three commands in a row could not be used."""
        self.monitor.emergency_stop(reason)

    def fail_on(self, error: Exception) -> None:
        """Latch a fault, then end the node after an error that nobody expected."""
        self.monitor.emergency_stop(f'{type(error).__name__}: {error}')
        super().fail_on(error)

    def close(self) -> None:
        """Put the safe volts out and let go of the card, whatever came before."""
        if not self.thread.stop():
            self.get_logger().fatal('the card does not answer: its watchdog is what is left')
        elif self.context.ok():
            self._publish(self._reports, self._report_of(self.monitor.sample, 0))
            self._reports.wait_for_all_acked(LAST_REPORT)
        super().close()
        self._starter.cancel()


def main() -> None:
    """Run the node."""
    sys.exit(run_node(HardwareBridge))
