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

"""Oil does not pull: a unit shut in by its valve cannot hold more than a vacuum."""

from fam_bundle_sim.plant import plant_step, resting_state, truth
import numpy as np

ATMOSPHERE = 101325.0  # Pa


def test_no_unit_is_drawn_below_absolute_vacuum(rig, configuration):
    """The second unit's valve stays shut while the first contracts the bundle."""
    state, pressure = resting_state(configuration, rig), np.empty(2)
    lowest = 0.0
    for _ in range(700):
        plant_step(rig, state, np.array([0.15, 0.0]), 0.001, 4)
        truth(rig, state, pressure)
        lowest = min(lowest, pressure[1])
    assert lowest >= -ATMOSPHERE
