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

"""
Compiled and interpreted plant and sensors give the same bits over an open-loop run.

This file runs itself a second time with FAM_BUNDLE_INTERPRET=1 and compares every number.
"""

import json
import os
from pathlib import Path
import subprocess
import sys

from fam_bundle_model import compile
from fam_bundle_model.parameters import load_configuration, SensorParameters
from fam_bundle_sim.plant import plant, plant_step, resting_state, truth
from fam_bundle_sim.sensors import measure, noise_samples, sensors
import numpy as np

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'


def evaluate():
    """Return the bits of each tick's state and readings."""
    configuration = load_configuration(CONFIGURATION)
    rig = plant(configuration)
    state, pressure = resting_state(configuration, rig), np.empty(2)
    parameters = SensorParameters(strain_noise=1e-5, pressure_noise=100.0, force_resolution=0.1)
    law, samples = sensors(parameters, 2), noise_samples(parameters, 2)
    random = np.random.default_rng(2)
    rows, command = [], np.zeros(2)
    for k in range(600):
        if k % 50 == 0:
            command = random.uniform(-0.2, 0.5, 2)
        plant_step(rig, state, command, 1e-3, 2)
        seen = measure(law, truth(rig, state, pressure), next(samples), pressure)
        rows.append(np.array([*state, *seen, *pressure]).tobytes().hex())
    return rows


def test_compiled_and_interpreted_plants_give_the_same_bits(tmp_path):
    environment = {**os.environ, 'FAM_BUNDLE_INTERPRET': '1'}
    environment['PYTHONPATH'] = os.pathsep.join(filter(None, sys.path))
    path = tmp_path / 'bits.json'
    subprocess.run([sys.executable, __file__, str(path)], env=environment, check=True, timeout=300)
    interpreted = json.loads(path.read_text())
    assert interpreted['compiled'] is False
    assert evaluate() == interpreted['rows']


if __name__ == '__main__':
    numbers = {'rows': evaluate(), 'compiled': compile._DECORATOR is not None}
    Path(sys.argv[1]).write_text(json.dumps(numbers))
