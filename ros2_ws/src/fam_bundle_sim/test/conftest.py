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

"""The shipped rig, and open-loop valve steps for it."""

from pathlib import Path

from fam_bundle_model.parameters import load_configuration
from fam_bundle_sim.plant import plant
import numpy as np
import pytest

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'


@pytest.fixture(scope='session')
def configuration():
    return load_configuration(CONFIGURATION)


@pytest.fixture(scope='session')
def rig(configuration):
    return plant(configuration)


@pytest.fixture(scope='session')
def valve_steps():
    """
    Open-loop spool commands: (duration in s, command of each unit).

    The first unit lifts the load, the second fills through its whole slack, pulls, and is vented.
    """
    return [
        (0.40, np.array([0.05, -1.0])),
        (0.60, np.array([0.15, -0.5])),
        (0.80, np.array([0.02, 0.5])),
        (0.30, np.array([-0.02, 0.2])),
        (0.50, np.array([0.05, -0.3])),
        (0.30, np.array([-0.1, -1.0])),
    ]
