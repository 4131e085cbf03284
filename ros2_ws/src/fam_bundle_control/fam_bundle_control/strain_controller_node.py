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

"""ROS node of the outer loop: bundle_state in, pressure_reference out."""

import functools
import sys
import time
from typing import Any

from builtin_interfaces.msg import Time
from fam_bundle_control.strain_loop import (
    strain_loop,
    strain_loop_retuned,
    strain_loop_start,
    strain_loop_step,
)
from fam_bundle_control.trajectory import goal_parameters, RETURN, Score, Trajectory
from fam_bundle_model.bundle import motor_units, reachable
from fam_bundle_model.compile import direct
from fam_bundle_model.parameters import ReferenceParameters, seconds
from fam_bundle_model.reference import strain_reference
from fam_bundle_model.schema import ConfigurationError, declarations
from fam_bundle_msgs.action import TrackStrain
from fam_bundle_msgs.msg import BundleState, PressureReference, StrainReference
from fam_bundle_msgs.msg import Reference as ReferenceMessage
from fam_bundle_node.loop_node import Controller
from fam_bundle_node.qos import CHANGES, NEWEST
from fam_bundle_node.reference_message import to_message
from fam_bundle_node.run import run_node
from fam_bundle_node.stamps import nanoseconds
from fam_bundle_node.ticked_action import TickedAction
import numpy as np
from rclpy.action import CancelResponse, GoalResponse
from rclpy.action.server import ServerGoalHandle

GOAL_FIELDS = tuple(declarations(ReferenceParameters))
FEEDBACK_PERIOD = 0.05  # s of the run
PATIENCE = 5.0  # s without a sample after which a goal is given up
SAFE = 'the plant is safe and follows nothing'
WARNING_PERIOD = 1.0  # s between two warnings of live values that are not taken


class StrainController(Controller):
    """Owns the reference trajectory and the outer PI."""

    LIVE = ('strain_loop',)

    def __init__(self) -> None:
        """Compile the law before the first tick needs it."""
        super().__init__(
            'strain_controller',
            (
                'fam',
                'source',
                'oil',
                'load',
                'strain_loop',
                'allocation',
                'reference',
                'simulation',
            ),
        )
        self.law = strain_loop(self.configuration)
        self.units = motor_units(self.configuration)
        self.trajectory = Trajectory(self.configuration, reachable(self.configuration, self.units))
        self.reference = direct(strain_reference, self.trajectory.law, 0.0)
        self.time: float | None = None
        self.safe = False
        self.stamp = Time()
        self.message = PressureReference()
        self.restart()
        self.publisher = self.loop_publisher(PressureReference, 'pressure_reference')
        model = (self.law, self.units, self.state_of_law)
        measured = (0.0, 0.0, 0.0, np.zeros(len(self.units)), 1.0)
        self.step = direct(strain_loop_step, *model, *measured)
        self.latched = self.create_publisher(ReferenceMessage, 'reference', CHANGES)
        self.announce()
        self.warned_at = -WARNING_PERIOD
        if self.configuration.reference.kind == 'topic':
            self.create_subscription(StrainReference, 'strain_reference', self.on_live, NEWEST)
        self.goal: ServerGoalHandle | None = None
        self.actions = TickedAction(
            self,
            TrackStrain,
            'track_strain',
            goal_callback=self.on_goal,
            handle_accepted_callback=self.on_accepted,
            cancel_callback=self.on_cancel,
        )
        self.loop_subscription(BundleState, 'bundle_state', self.on_bundle_state)

    def retune(self) -> None:
        """Take new gains over; the integral share makes up for the proportional one."""
        before, self.law = self.law, strain_loop(self.configuration)
        error = self.message.strain_error
        self.state_of_law = strain_loop_retuned(self.state_of_law, error, before, self.law)

    def restart(self) -> None:
        """Set in at the first motor unit's measured pressure."""
        self.state_of_law = strain_loop_start()

    def on_bundle_state(self, seen: BundleState) -> None:
        """Answer one tick."""
        dt = self.time_step(seen)
        if seen.tick == 0:
            self.begin_run()
        self.stamp, self.time = seen.header.stamp, seconds(nanoseconds(seen.header.stamp))
        self.safe = seen.safe
        reference = self.reference(self.trajectory.law, self.time)
        self.state_of_law, output = self.step(
            self.law,
            self.units,
            self.state_of_law,
            reference,
            seen.strain,
            seen.source_pressure,
            np.array(seen.mu_pressure),
            dt,
        )
        answer = self.message
        answer.header, answer.tick = seen.header, seen.tick
        answer.strain_reference, answer.strain_error = reference, output.error
        answer.pressure, answer.pressure_unlimited = output.pressure, output.unlimited
        self.publisher.publish(answer)
        self.meter.answered(seen.tick, seen.steady_time)
        if self.goal is not None:
            self.follow_goal(seen.strain, output.error, dt)

    def begin_run(self) -> None:
        """Go back to the configured reference."""
        self.stamp = Time()
        if self.goal is not None:
            self.end_goal('a new run began')
        if self.trajectory.begin():
            self.announce()

    def announce(self) -> None:
        """Publish the trajectory, that holds from the next sample on."""
        message = to_message(self.trajectory.law, self.trajectory.kind)
        message.header.stamp = self.stamp
        self.latched.publish(message)

    def on_live(self, message: StrainReference) -> None:
        """Take a value from outside."""
        refusal = self.trajectory.take_live(message.strain, self.time or 0.0)
        if not refusal:
            self.announce()
        elif time.monotonic() - self.warned_at > WARNING_PERIOD:
            self.warned_at = time.monotonic()
            self.get_logger().warning(f'strain_reference: {refusal}; not taken')

    # ---- The action ----

    def on_goal(self, wanted: TrackStrain.Goal) -> GoalResponse:
        """Accept a goal that can be tracked, if there is none."""
        fields = {name: getattr(wanted, name) for name in GOAL_FIELDS}
        lists = {n: list(v) if hasattr(v, 'tolist') else v for n, v in fields.items()}
        configuration = self.configuration
        try:
            if self.time is None:
                raise ConfigurationError('no bundle_state has come yet')
            if self.safe:
                raise ConfigurationError(SAFE)
            period = configuration.simulation.period
            parameters = goal_parameters(configuration.reference, lists, period)
            self.planned = self.trajectory.plan(parameters, self.time), parameters
        except (ValueError, ArithmeticError) as error:  # no goal may end the node
            self.get_logger().warning(f'track_strain: {error}; rejected')
            return GoalResponse.REJECT
        return GoalResponse.ACCEPT

    def on_accepted(self, goal: ServerGoalHandle) -> None:
        """Begin to track a goal."""
        self.goal, self.score, self.next_feedback = goal, Score(), 0.0
        goal.execute()
        self.trajectory.pursue(*self.planned)
        self.announce()

    def on_cancel(self, _: Any) -> CancelResponse:
        """Go back to where the run began; the goal is cancelled when that is reached."""
        if self.trajectory.kind != RETURN:
            self.trajectory.turn_back(self.time)
            self.announce()
        return CancelResponse.ACCEPT

    def follow_goal(self, strain: float, error: float, dt: float) -> None:
        """Score one tick, tell how it goes, and see whether the goal is done."""
        since = self.time - self.trajectory.law.start
        if self.safe:
            self.give_up(SAFE)
            return
        if self.trajectory.is_done(self.time):
            self.end_goal('')
            return
        if since >= 0.0 and self.trajectory.kind != RETURN:
            self.score.note(error, dt)
        if self.time >= self.next_feedback:
            self.next_feedback = self.time + FEEDBACK_PERIOD
            feedback = TrackStrain.Feedback(time=since, strain=strain, error=error)
            self.goal.publish_feedback(feedback)

    def give_up(self, why: str) -> None:
        """End the goal early; the reference is held."""
        self.trajectory.hold(self.time)
        self.announce()
        self.end_goal(why)

    def end_goal(self, why: str) -> None:
        """End the goal: as reached, or cancelled, or early."""
        goal, self.goal = self.goal, None
        self.trajectory.settle()
        self.actions.end(goal, functools.partial(conclude, score=self.score, why=why))

    def look_after(self) -> None:
        """Give a goal up when the loop has stopped, besides what every node does."""
        super().look_after()
        if self.goal is not None and time.monotonic() - self._tick_at > PATIENCE:
            self.give_up('bundle_state stayed away')

    def close(self) -> None:
        """End the action too."""
        super().close()
        self.actions.destroy()


def conclude(goal: ServerGoalHandle, score: Score, why: str) -> TrackStrain.Result:
    """Set the end state of a goal and return its result."""
    if goal.is_cancel_requested:
        goal.canceled()
    elif why:
        goal.abort()
    else:
        goal.succeed()
    return TrackStrain.Result(message=why, **vars(score))


def main() -> None:
    """Run the node."""
    sys.exit(run_node(StrainController))
