# SPDX-License-Identifier: Apache-2.0
"""ROS node of the outer loop: bundle_state in, pressure_reference out."""

import sys

import numpy as np

from fam_bundle_control.strain_loop import strain_loop, strain_loop_start, strain_loop_step
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.compile import direct
from fam_bundle_model.parameters import seconds
from fam_bundle_model.reference import reference_law, strain_reference
from fam_bundle_msgs.msg import BundleState, PressureReference
from fam_bundle_node.loop_node import Controller
from fam_bundle_node.run import run_node
from fam_bundle_node.stamps import nanoseconds


class StrainController(Controller):
    """Owns the reference trajectory and the outer PI."""

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
        self.trajectory = reference_law(self.configuration.reference)
        self.message = PressureReference()
        self.restart()
        self.publisher = self.loop_publisher(PressureReference, 'pressure_reference')
        model = (self.law, self.units, self.state_of_law)
        measured = (0.0, 0.0, 0.0, np.zeros(len(self.units)), 1.0)
        self.step = direct(strain_loop_step, *model, *measured)
        self.loop_subscription(BundleState, 'bundle_state', self.on_bundle_state)

    def restart(self) -> None:
        """Set in at the first motor unit's measured pressure."""
        self.state_of_law = strain_loop_start()

    def on_bundle_state(self, seen: BundleState) -> None:
        """Answer one tick."""
        dt = self.time_step(seen)
        time = seconds(nanoseconds(seen.header.stamp))
        reference = strain_reference(self.trajectory, time)
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


def main() -> None:
    """Run the node."""
    sys.exit(run_node(StrainController))
