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
