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

"""ROS node of the inner loops: three topics of one tick in, valve_command out."""

from collections.abc import Callable
import sys
from typing import Any

from fam_bundle_control.pressure_loop import pressure_loop, pressure_loop_step
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.compile import direct
from fam_bundle_model.hydraulics import TO_TANK
from fam_bundle_msgs.msg import BundleState, PressureReference, RecruitmentState, ValveCommand
from fam_bundle_node.loop_node import Controller
from fam_bundle_node.run import run_node
from fam_bundle_node.ticks import TickJoin
import numpy as np

TOPICS = ('bundle_state', 'pressure_reference', 'recruitment_state')


class PressureController(Controller):
    """Computes a tick when it holds the measurement and both references of that tick."""

    def __init__(self) -> None:
        """Compile the law before the first tick needs it."""
        super().__init__(
            'pressure_controller',
            ('fam', 'source', 'oil', 'pressure_loop', 'allocation', 'simulation'),
        )
        self.law = pressure_loop(self.configuration)
        self.units = motor_units(self.configuration)
        units = len(self.units)
        self.integral = np.zeros(units)
        self.wanted, self.spool = np.zeros(units), np.zeros(units)
        self.saturated = np.zeros(units, dtype=np.bool_)
        measured = (0, 0.0, 0.0, 0.0, 0.0, np.zeros(units), 1.0)  # changes nothing
        filled = (self.wanted, self.spool, self.saturated)
        model = (self.law, self.units, self.integral)
        self.step = direct(pressure_loop_step, *model, *measured, *filled)
        self.message = ValveCommand()
        self.join = TickJoin(TOPICS, self.counts, strict=not self.realtime)
        self.publisher = self.loop_publisher(ValveCommand, 'valve_command')
        self.listen(PressureReference, 'pressure_reference')
        self.listen(RecruitmentState, 'recruitment_state')
        self.listen(BundleState, 'bundle_state')

    def restart(self) -> None:
        """Start without integral share: the references start from the measured pressure."""
        self.integral[:] = 0.0

    def missing(self) -> str:
        """Return what this node waits for."""
        waiting = self.join.waits_for('bundle_state')
        if waiting is None:
            return super().missing()
        tick, topics = waiting
        return f'{" and ".join(topics)} of tick {tick}'

    def listen(self, message_type: type, topic: str) -> None:
        """Subscribe to one of the three topics."""
        self.loop_subscription(message_type, topic, self.collector(topic))

    def collector(self, topic: str) -> Callable[[Any], None]:
        """Return the callback that answers once all three messages of a tick are there."""

        def collect(message: Any) -> None:
            complete = self.join.add(topic, message)
            if complete is not None:
                self.answer(*complete)

        return collect

    def answer(
        self, seen: BundleState, reference: PressureReference, recruitment: RecruitmentState
    ) -> None:
        """Answer one tick."""
        dt = self.time_step(seen)
        self.step(
            self.law,
            self.units,
            self.integral,
            recruitment.recruited,
            reference.pressure,
            recruitment.pressure_compensation,
            seen.strain,
            seen.source_pressure,
            np.array(seen.mu_pressure),
            dt,
            self.wanted,
            self.spool,
            self.saturated,
        )
        if self.trouble:
            self.spool[:] = TO_TANK
        command = self.message
        command.header, command.tick = seen.header, seen.tick
        command.vent = bool(self.trouble)
        command.spool = self.spool.tolist()
        command.pressure_reference = self.wanted.tolist()
        command.saturated = self.saturated.tolist()
        self.publisher.publish(command)
        self.meter.answered(seen.tick, seen.steady_time)


def main() -> None:
    """Run the node."""
    sys.exit(run_node(PressureController))
