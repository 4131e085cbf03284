# SPDX-License-Identifier: Apache-2.0
"""ROS node of the outer loop: bundle_state in, pressure_reference out."""

import sys

from fam_bundle_control.reference import strain_reference
from fam_bundle_control.strain_loop import strain_loop, strain_loop_start, strain_loop_step
from fam_bundle_model.parameters import seconds
from fam_bundle_msgs.msg import BundleState, PressureReference
from fam_bundle_node.loop_node import LoopNode, run_node
from fam_bundle_node.stamps import StampClock
from fam_bundle_node.ticks import check_finite, check_length


class StrainController(LoopNode):
    """Owns the reference trajectory and the outer PI."""

    def __init__(self) -> None:
        """Compile the law before the first tick needs it."""
        super().__init__(
            'strain_controller', ('fam', 'strain_loop', 'source', 'reference', 'simulation')
        )
        self.law = strain_loop(self.configuration)
        self.state = strain_loop_start()
        self.clock = StampClock(self.configuration.period_ns())
        self.publisher = self.loop_publisher(PressureReference, 'pressure_reference')
        strain_loop_step(self.law, self.state, 0.0, 0.0, 0.0, 0.0, 1.0)
        self.loop_subscription(BundleState, 'bundle_state', self.on_bundle_state)

    def on_bundle_state(self, seen: BundleState) -> None:
        """Answer one tick."""
        units = len(self.configuration.fam.count)
        check_length('bundle_state', seen.tick, seen.mu_pressure, units)
        measured = (seen.strain, seen.source_pressure, *seen.mu_pressure)
        check_finite('bundle_state', seen.tick, measured)
        dt = self.clock.since_last(seen.header.stamp)
        time = seconds(seen.tick * self.configuration.period_ns())
        reference = strain_reference(self.configuration.reference, time)
        self.state, output = strain_loop_step(
            self.law,
            self.state,
            reference,
            seen.strain,
            seen.source_pressure,
            seen.mu_pressure[0],
            dt,
        )
        self.publisher.publish(
            PressureReference(
                header=seen.header,
                tick=seen.tick,
                strain_reference=reference,
                strain_error=output.error,
                pressure=output.pressure,
                pressure_unlimited=output.unlimited,
            )
        )


def main() -> None:
    """Run the node."""
    sys.exit(run_node(StrainController))
