# SPDX-License-Identifier: Apache-2.0
"""All nodes of the loop in one process, on one executor: same classes, same topics."""

import sys


def main() -> None:
    """Run the nodes until the plant simulator has ended."""
    from fam_bundle_control.lag_table_server_node import LagTableServer
    from fam_bundle_control.pressure_controller_node import PressureController
    from fam_bundle_control.recruitment_supervisor_node import RecruitmentSupervisor
    from fam_bundle_control.strain_controller_node import StrainController
    from fam_bundle_node.run import run_nodes
    from fam_bundle_sim.plant_simulator_node import PlantSimulator

    nodes = [
        LagTableServer,
        RecruitmentSupervisor,
        StrainController,
        PressureController,
        PlantSimulator,
    ]
    sys.exit(run_nodes(nodes))
