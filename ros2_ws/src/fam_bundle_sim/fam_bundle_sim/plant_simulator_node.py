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

"""ROS node of the simulated rig: valve_command in, bundle_state out; it paces the graph."""

import sys
import threading
import time

from fam_bundle_model.compile import direct
from fam_bundle_model.hydraulics import TO_TANK
from fam_bundle_model.parameters import Configuration, seconds
from fam_bundle_msgs.msg import BundleState, ValveCommand
from fam_bundle_node.answers import Answers
from fam_bundle_node.command_watch import CommandWatch
from fam_bundle_node.loop_node import LoopNode
from fam_bundle_node.pacing import Lockstep, Pacing, Periodic
from fam_bundle_node.run import run_node
from fam_bundle_node.steady_timer import SteadyTimer
from fam_bundle_sim.plant import plant, plant_step, resting_state, truth
from fam_bundle_sim.sensors import measure, noise_samples, sensors
import numpy as np
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
)

MATCHING_PERIOD = 0.02  # s between two looks at who listens
SAMPLES = 4096  # whose times are kept for their answers


def make_pacing(configuration: Configuration) -> Pacing:
    """Return what paces the plant."""
    run = configuration.run
    if run.pace == 'lockstep':
        return Lockstep()
    return Periodic(configuration.period_ns(), round(run.busy_tail * 1e9))


class PlantSimulator(LoopNode):
    """
    Takes a step when its pacing says so, under the newest valve command.

    Tick 0 is published once everybody listens; its answer proves the loop closed and starts the
    pacing. The node ends by itself after the run's last tick.
    """

    OWNS_RUN = True

    def __init__(self) -> None:
        """Rest until the loop is complete."""
        super().__init__('plant_simulator', GROUPS)
        units = self.motor_units()
        self.rig = plant(self.configuration)
        self.state_vector = resting_state(self.configuration, self.rig)
        self.sensors = sensors(self.configuration.sensors, units)
        self.noise = noise_samples(self.configuration.sensors, units)
        self.mu_pressure = np.zeros(units)
        self.period_ns = self.configuration.period_ns()
        self.periods = self.configuration.ticks()
        self.period = 0  # since the start of the run
        self.answers = Answers(self.counts, realtime=self.realtime)
        self.started_at = self.published_at = time.monotonic_ns()
        self.sampled_at = [0] * SAMPLES  # when (ns), by tick
        self.spool = np.zeros(units)
        limit = round(self.configuration.run.command_timeout * 1e9 / self.period_ns)
        self.watch = CommandWatch(limit)
        self.failed = ''  # why a step went wrong
        self.lock = threading.Lock()  # command and watch are shared with the pacing's thread
        self.pacing = make_pacing(self.configuration)
        self.publisher = self.loop_publisher(BundleState, 'bundle_state')
        self.loop_subscription(ValveCommand, 'valve_command', self.on_valve_command)
        self.create_service(Trigger, '~/reset_fault', self.on_reset_fault)
        self.compile_plant()
        self.starter = SteadyTimer(self, MATCHING_PERIOD, self.start, self.fail_on)

    def compile_plant(self) -> None:
        """Compile what each tick calls, on copies of what it changes."""
        vented, substeps = np.zeros(len(self.spool)), self.configuration.simulation.substeps
        state, pressure = self.state_vector.copy(), self.mu_pressure.copy()
        still = (self.rig, state, vented, seconds(self.period_ns), substeps)
        self.plant_step = direct(plant_step, *still)
        self.truth = direct(truth, self.rig, state, pressure)
        sample = np.zeros(len(self.sensors.noise))
        true = truth(self.rig, state, pressure)
        self.measure = direct(measure, self.sensors, true, sample, pressure)

    def start(self) -> None:
        """Publish tick 0 once everybody listens, and begin to look after the run."""
        present, wanted = self.publisher.get_subscription_count(), self.configuration.run.listeners
        if present < wanted:
            timeout = self.configuration.run.start_timeout
            if time.monotonic_ns() - self.started_at > timeout * 1e9:
                self.fail(f'bundle_state: {present} of {wanted} listeners after {timeout:g} s')
            return
        self.starter.cancel()
        how = 'in real time' if self.realtime else 'in lock-step'
        self.get_logger().info(f'running {self.periods} ticks {how}')
        self.started_at = time.monotonic_ns()
        self.publish_state()

    def look_after(self) -> None:
        """End a run that stands still or is over."""
        super().look_after()
        if self.done.done():
            return
        silence = (time.monotonic_ns() - self.published_at) * 1e-9
        run = self.configuration.run
        over = self.realtime and self.period >= self.periods
        waits = self.answers.sample >= 0 and (not self.realtime or self.answers.answered < 0)
        if self.failed:
            self.fail(self.failed)
        elif over and (
            self.answers.answered == self.answers.sample or silence > run.command_timeout
        ):
            self.finish()
        elif waits and silence > run.answer_timeout:
            timeout = f'{run.answer_timeout:g} s'
            self.fail(f'valve_command: tick {self.answers.sample} has not come within {timeout}')

    def state(self) -> str:
        """Return 'running', or what the plant waits for, or why it is safe."""
        if self.answers.sample < 0:
            return f'waiting for {self.configuration.run.listeners} listeners of bundle_state'
        if self.answers.answered < 0:
            return 'waiting for valve_command of tick 0'
        return self.watch.state()

    def news(self) -> str:
        """Return why the plant has been safe since the last look: it may follow commands again."""
        return self.watch.take_news()

    def on_valve_command(self, command: ValveCommand) -> None:
        """Hold the command; go on where the pacing waits for it."""
        first = self.answers.answered < 0
        if not self.answers.admit(command.tick):
            return
        self.meter.answered(command.tick, self.sampled_at[command.tick % SAMPLES])
        with self.lock:
            self.watch.answer(command.tick)
            self.spool = np.clip(command.spool, -1.0, 1.0)
            if command.vent:
                self.watch.latch('pressure_controller asks for the safe state')
        if first:
            self.started_at = time.monotonic_ns()
            self.pacing.start(self.step, self.on_failed_step)
        else:
            self.pacing.answered()

    def step(self, periods: int) -> None:
        """Advance by ``periods``, more than 1 after an overrun, and publish the next sample."""
        self.meter.skipped(periods)
        with self.lock:
            safe, spool, held_for = self.watch.safe, self.spool, self.watch.held_for()
            if self.realtime:
                self.watch.next_sample(self.answers.sample + 1, periods)
        self.period += periods
        if self.period >= self.periods:
            self.end()
            return
        vented = np.full(len(spool), TO_TANK)
        for passed in range(periods):
            # A hold-up longer than the time-out: as a rig's watchdog would do.
            limit = self.watch.limit
            held = not safe and passed < limit and held_for + passed < 2 * limit
            self.advance(self.state_vector, spool if held else vented)
        self.publish_state(self.pacing.due)

    def publish_state(self, due: int | None = None) -> None:
        """Measure and publish the next sample, which was due (ns) or is taken now."""
        true = self.truth(self.rig, self.state_vector, self.mu_pressure)
        seen = self.measure(self.sensors, true, next(self.noise), self.mu_pressure)
        steady_time = time.monotonic_ns() if due is None else due
        self.answers.sample += 1
        self.published_at = self.sampled_at[self.answers.sample % SAMPLES] = steady_time
        message = BundleState(
            tick=self.answers.sample,
            steady_time=steady_time,
            safe=self.watch.safe,
            mu_pressure=self.mu_pressure.tolist(),
            **seen._asdict(),
        )
        stamp = message.header.stamp
        stamp.sec, stamp.nanosec = divmod(self.period * self.period_ns, 1_000_000_000)
        message.header.frame_id = 'bundle'
        self.publisher.publish(message)

    def end(self) -> None:
        """Take no further step; in real time the last answer may still come."""
        self.pacing.stop()
        if not self.realtime:
            self.finish()

    def finish(self) -> None:
        """Say how fast the run was, and end the node."""
        elapsed = (time.monotonic_ns() - self.started_at) * 1e-9
        self.report()
        samples, whole = self.answers.sample + 1, self.meter.whole_run(self.period_ns)
        self.get_logger().info(f'ran {samples} ticks in {elapsed:.4f} s; {whole.words()}')
        self.succeed()

    def on_failed_step(self, error: BaseException) -> None:
        """End the node after an error in the pacing's thread."""
        self.failed = f'{type(error).__name__}: {error}'

    def on_reset_fault(self, _: Trigger.Request, response: Trigger.Response) -> Trigger.Response:
        """End a latched fault."""
        with self.lock:
            response.message = self.watch.fault or 'no fault'
            response.success = bool(self.watch.fault)
            self.watch.reset()
        return response

    def get_trouble(self, reason: str) -> None:
        """Latch a fault: three commands in a row could not be used."""
        with self.lock:
            self.watch.latch(reason)

    def advance(self, state: np.ndarray, spool: np.ndarray) -> None:
        """Advance ``state`` in place by one period."""
        substeps = self.configuration.simulation.substeps
        self.plant_step(self.rig, state, spool, seconds(self.period_ns), substeps)

    def close(self) -> None:
        """End the threads of pacing and timers."""
        super().close()
        self.starter.cancel()
        self.pacing.stop()


def main() -> None:
    """Run the node."""
    sys.exit(run_node(PlantSimulator))
