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

"""ROS node that decides the recruitment state: bundle_state in, recruitment_state out."""

import sys

from fam_bundle_control.announced import Announced, Announcement, BEGINNING, NOTICE
from fam_bundle_control.recruitment import (
    recruitment,
    recruitment_start,
    recruitment_step,
)
from fam_bundle_control.trajectory import FROM_OUTSIDE, LIVE
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.compile import direct
from fam_bundle_model.lag_table import lag_table_hash, LagTable, PHYSICS
from fam_bundle_model.parameters import seconds
from fam_bundle_model.reference import reference_law
from fam_bundle_msgs.msg import BundleState, RecruitmentState
from fam_bundle_msgs.msg import LagTable as LagTableMessage
from fam_bundle_msgs.msg import Reference as ReferenceMessage
from fam_bundle_node import lag_table_message, reference_message
from fam_bundle_node.loop_node import Controller
from fam_bundle_node.qos import CHANGES, LATCHED
from fam_bundle_node.run import run_node
from fam_bundle_node.stamps import nanoseconds
import numpy as np


class RecruitmentSupervisor(Controller):
    """Waits for the lag table, then decides at each tick."""

    LIVE = ('recruitment',)

    def __init__(self) -> None:
        """Wait for the table."""
        super().__init__(
            'recruitment_supervisor', ('recruitment', 'allocation', 'reference', *PHYSICS)
        )
        self.retune()
        self.units = motor_units(self.configuration)
        reference = self.configuration.reference
        self.first = Announcement(BEGINNING, reference_law(reference), reference.kind == LIVE)
        self.announced = Announced(self.first, NOTICE)
        self.table: LagTable | None = None
        self.message = RecruitmentState()
        self.restart()
        self.publisher = self.loop_publisher(RecruitmentState, 'recruitment_state')
        self.create_subscription(LagTableMessage, 'lag_table', self.on_lag_table, LATCHED)
        if self.configuration.recruitment.predictor == 'preview':
            self.create_subscription(ReferenceMessage, 'reference', self.on_reference, CHANGES)

    def retune(self) -> None:
        """Decide by the settings of now; filters and what is recruited stay."""
        self.laws = [recruitment(self.configuration, live=live) for live in (False, True)]

    def restart(self) -> None:
        """Find the recruited motor units from their pressures."""
        self.memory = recruitment_start()

    def on_lag_table(self, message: LagTableMessage) -> None:
        """Take the table if it belongs to these parameters; start with the first one."""
        expected = lag_table_hash(self.configuration)
        if message.parameters_hash != expected:
            self.fail(
                f'lag_table: built from parameters {message.parameters_hash[:12]}, not '
                f'{expected[:12]}; start lag_table_server with the same parameter file'
            )
            return
        first = self.table is None
        try:
            self.table = lag_table_message.from_message(message)
        except ValueError as error:
            self.fail(f'lag_table: its parts do not fit together ({error})')
            return
        if first:
            law, trajectory = self.laws[False], self.first.law
            model = (law, self.units, self.table, trajectory, recruitment_start())
            measured = (0.0, 0.0, 0.0, 0.0, np.zeros(len(self.units)), 1.0)
            self.decide = direct(recruitment_step, *model, *measured)
            self.loop_subscription(BundleState, 'bundle_state', self.on_bundle_state)

    def on_reference(self, message: ReferenceMessage) -> None:
        """Take note of a trajectory that will be tracked."""
        law = self.first.law
        if message.kind in FROM_OUTSIDE:
            try:
                law = reference_message.from_message(message)
            except ValueError as error:
                self.fail(f'reference: its parts do not fit together ({error})')
                return
        since = nanoseconds(message.header.stamp) or BEGINNING
        late = self.announced.add(Announcement(since, law, message.kind == LIVE))
        if late:
            self.miss(late)

    def miss(self, late: int) -> None:
        """Say that news of a trajectory came too late for its ticks, by ``late`` ns."""
        reason = f'reference: came {1e-6 * late:g} ms too late to be foreseen in time'
        if self.realtime:
            self.counts.late += 1
            self.get_logger().warning(reason)
        else:
            self.fail(reason)

    def on_bundle_state(self, seen: BundleState) -> None:
        """Answer one tick."""
        dt = self.time_step(seen)
        if seen.tick == 0:
            self.announced.begin()
        now = nanoseconds(seen.header.stamp)
        known = self.announced.at(now)
        self.memory, output = self.decide(
            self.laws[known.live],
            self.units,
            self.table,
            known.law,
            self.memory,
            seconds(now),
            seen.strain,
            seen.force,
            seen.source_pressure,
            np.array(seen.mu_pressure),
            dt,
        )
        answer = self.message  # the same one for all ticks: a new one costs as much as half a law
        answer.header, answer.tick = seen.header, seen.tick
        answer.recruited = output.recruited
        answer.strain_rate = output.strain_rate
        answer.deslack_pressure = output.deslack_pressure
        answer.recruitment_lag = output.recruitment_lag
        answer.source_pressure_drop = output.source_pressure_drop
        answer.time_to_saturation = output.time_to_saturation
        answer.time_to_desaturation = output.time_to_desaturation
        answer.pressure_compensation = output.pressure_compensation
        answer.lag_outside_table = output.lag_outside_table
        answer.prediction_error = output.prediction_error
        self.publisher.publish(answer)
        self.meter.answered(seen.tick, seen.steady_time)

    def missing(self) -> str:
        """Return what this node waits for."""
        return 'lag_table' if self.table is None else super().missing()


def main() -> None:
    """Run the node."""
    sys.exit(run_node(RecruitmentSupervisor))
