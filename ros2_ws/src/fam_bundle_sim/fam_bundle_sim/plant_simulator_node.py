# SPDX-License-Identifier: Apache-2.0
"""ROS node of the simulated rig: valve_command in, bundle_state out; it paces the graph."""

import sys
import time

import numpy as np
from rclpy.duration import Duration

from fam_bundle_model.parameters import seconds
from fam_bundle_msgs.msg import BundleState, ValveCommand
from fam_bundle_node.loop_node import LoopNode, run_node
from fam_bundle_node.ticks import TickError, check_finite, check_length
from fam_bundle_sim.plant import plant, plant_step, resting_state, truth
from fam_bundle_sim.sensors import measure, noise_samples, sensors

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
    'run',
)

LAST_MESSAGES = Duration(seconds=5)
MATCHING_PERIOD = 0.02  # s between two looks at who listens


class PlantSimulator(LoopNode):
    """Takes tick k + 1 only when the valve command of tick k has come (lock-step).

    It ends by itself after the run's last tick.
    """

    def __init__(self) -> None:
        """Rest until the loop is complete, then publish tick 0."""
        super().__init__('plant_simulator', GROUPS)
        units = len(self.configuration.fam.count)
        self.rig = plant(self.configuration)
        self.state = resting_state(self.configuration, self.rig)
        self.sensors = sensors(self.configuration.sensors, units)
        self.noise = noise_samples(self.configuration.sensors, units)
        self.mu_pressure = np.zeros(units)
        self.ticks = self.configuration.ticks()
        self.step_ns = self.configuration.period_ns()
        self.tick = 0
        self.started_at = self.published_at = time.monotonic()
        self.publisher = self.loop_publisher(BundleState, 'bundle_state')
        self.loop_subscription(ValveCommand, 'valve_command', self.on_valve_command)
        self.advance(self.state.copy(), np.zeros(units))  # compiles the plant
        self.timer = self.create_timer(MATCHING_PERIOD, self.start)

    def start(self) -> None:
        """Publish tick 0 once everybody listens, and begin to watch for answers."""
        present, wanted = self.publisher.get_subscription_count(), self.configuration.run.listeners
        if present < wanted:
            timeout = self.configuration.run.start_timeout
            if time.monotonic() - self.started_at > timeout:
                self.fail(f'bundle_state: {present} of {wanted} listeners after {timeout:g} s')
            return
        self.timer.cancel()
        self.get_logger().info(f'running {self.ticks} ticks in lock-step')
        self.started_at = time.monotonic()
        self.publish_state()
        self.create_timer(0.5, self.watch)

    def watch(self) -> None:
        """End the run when an answer stays away."""
        timeout = self.configuration.run.answer_timeout
        if time.monotonic() - self.published_at > timeout:
            self.fail(f'valve_command: tick {self.tick} has not come within {timeout:g} s')

    def publish_state(self) -> None:
        """Measure and publish the current tick."""
        true = truth(self.rig, self.state, self.mu_pressure)
        seen = measure(self.sensors, true, next(self.noise), self.mu_pressure)
        stamp_ns = self.tick * self.step_ns
        message = BundleState(
            tick=self.tick, mu_pressure=self.mu_pressure.tolist(), **seen._asdict()
        )
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(stamp_ns, 1_000_000_000)
        message.header.frame_id = 'bundle'
        self.publisher.publish(message)
        self.published_at = time.monotonic()

    def on_valve_command(self, command: ValveCommand) -> None:
        """Advance the plant by one tick under the command of this tick."""
        if command.tick != self.tick:
            raise TickError(f'valve_command: tick {command.tick} came, expected {self.tick}')
        check_length('valve_command', command.tick, command.spool, len(self.mu_pressure))
        check_finite('valve_command', command.tick, command.spool)
        self.tick += 1
        if self.tick == self.ticks:
            elapsed = time.monotonic() - self.started_at
            self.get_logger().info(f'ran {self.ticks} ticks in {elapsed:.4f} s')
            self.publisher.wait_for_all_acked(LAST_MESSAGES)  # a recorder may be behind
            self.succeed()
            return
        self.advance(self.state, np.clip(command.spool, -1.0, 1.0))
        self.publish_state()

    def advance(self, state: np.ndarray, spool: np.ndarray) -> None:
        """Advance ``state`` in place by one tick."""
        substeps = self.configuration.simulation.substeps
        plant_step(self.rig, state, spool, seconds(self.step_ns), substeps)


def main() -> None:
    """Run the node."""
    sys.exit(run_node(PlantSimulator))
