# SPDX-License-Identifier: Apache-2.0
"""ROS node that decides the recruitment state: bundle_state in, recruitment_state out."""

import sys

import numpy as np

from fam_bundle_control.recruitment import (
    RecruitmentOutput,
    recruitment,
    recruitment_start,
    recruitment_step,
)
from fam_bundle_control.recruitment import RecruitmentState as RecruitmentMemory
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.lag_table import PHYSICS, LagTable, lag_table_hash
from fam_bundle_msgs.msg import BundleState, RecruitmentState
from fam_bundle_msgs.msg import LagTable as LagTableMessage
from fam_bundle_node.lag_table_message import from_message
from fam_bundle_node.loop_node import LoopNode, run_node
from fam_bundle_node.qos import LATCHED
from fam_bundle_node.stamps import StampClock
from fam_bundle_node.ticks import check_finite, check_length


class RecruitmentSupervisor(LoopNode):
    """Waits for the lag table, then decides at each tick."""

    def __init__(self) -> None:
        """Wait for the table."""
        super().__init__('recruitment_supervisor', ('recruitment', *PHYSICS))
        self.law = recruitment(self.configuration)
        self.units = motor_units(self.configuration)
        self.table: LagTable | None = None
        self.state = recruitment_start()
        self.clock = StampClock(self.configuration.period_ns())
        self.publisher = self.loop_publisher(RecruitmentState, 'recruitment_state')
        self.create_subscription(LagTableMessage, 'lag_table', self.on_lag_table, LATCHED)

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
            self.table = from_message(message)
        except ValueError as error:
            self.fail(f'lag_table: its parts do not fit together ({error})')
            return
        if first:
            self.decide(0.0, 0.0, 0.0, np.zeros(len(self.units)), 1.0)  # compiles the law
            self.loop_subscription(BundleState, 'bundle_state', self.on_bundle_state)

    def decide(
        self,
        strain: float,
        force: float,
        source_pressure: float,
        mu_pressure: np.ndarray,
        dt: float,
    ) -> tuple[RecruitmentMemory, RecruitmentOutput]:
        """Return the law's next state and its output."""
        return recruitment_step(
            self.law,
            self.units,
            self.table,
            self.state,
            strain,
            force,
            source_pressure,
            mu_pressure,
            dt,
        )

    def on_bundle_state(self, seen: BundleState) -> None:
        """Answer one tick."""
        check_length('bundle_state', seen.tick, seen.mu_pressure, len(self.units))
        measured = (seen.strain, seen.force, seen.source_pressure, *seen.mu_pressure)
        check_finite('bundle_state', seen.tick, measured)
        self.state, output = self.decide(
            seen.strain,
            seen.force,
            seen.source_pressure,
            np.array(seen.mu_pressure),
            self.clock.since_last(seen.header.stamp),
        )
        self.publisher.publish(
            RecruitmentState(header=seen.header, tick=seen.tick, **output._asdict())
        )


def main() -> None:
    """Run the node."""
    sys.exit(run_node(RecruitmentSupervisor))
