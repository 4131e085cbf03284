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
Compiled and interpreted controllers give the same bits over a run of random measurements.

This file runs itself a second time with FAM_BUNDLE_INTERPRET=1 and compares every number.
"""

import dataclasses
import json
import os
from pathlib import Path
import subprocess
import sys

from fam_bundle_control.pressure_loop import pressure_loop, pressure_loop_step
from fam_bundle_control.recruitment import recruitment, recruitment_start, recruitment_step
from fam_bundle_control.strain_loop import strain_loop, strain_loop_start, strain_loop_step
from fam_bundle_model import compile
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.lag_table import LagTable
from fam_bundle_model.parameters import AllocationParameters, ALLOCATIONS, load_configuration
from fam_bundle_model.reference import still
import numpy as np

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'


def flat(values):
    """Yield all numbers in nested tuples; what stands in arrays shows in the ticks after it."""
    for value in values:
        if isinstance(value, tuple):
            yield from flat(value)
        elif not isinstance(value, np.ndarray):
            yield value


def evaluate():
    """Return the bits of each tick's outputs, by scheme and law."""
    configuration = load_configuration(CONFIGURATION)
    units, dt, held = motor_units(configuration), 1e-3, still()
    random = np.random.default_rng(5)
    axis = np.linspace(0.0, 7e5, 6)
    table = LagTable(axis, axis, random.random((2, 6, 6)), 1e5 * random.random((2, 6, 6)))
    found = {}
    schemes = ('lag_pressure', 'baseline', 'lag')
    predictors = ('constant_rate', 'sinusoid', 'constant_acceleration')
    for scheme, allocation, expected in zip(schemes, ALLOCATIONS, predictors, strict=True):
        chosen = dataclasses.replace(configuration.recruitment, scheme=scheme, predictor=expected)
        changed = dataclasses.replace(
            configuration,
            recruitment=chosen,
            allocation=AllocationParameters(policy=allocation),
        )
        policy, outer = recruitment(changed), strain_loop(changed)
        inner = pressure_loop(changed)
        state, outer_state = recruitment_start(), strain_loop_start()
        integral, references, spool = np.zeros((3, 2))
        saturated = np.zeros(2, dtype=bool)
        rows = []
        for k in range(1500):
            strain = 0.06 * (1.0 - np.cos(k / 240.0)) + 1e-5 * random.standard_normal()
            pressures = random.uniform(0.0, 6.5e5, 2)
            force, source = random.uniform(150.0, 220.0), random.uniform(5e5, 6.9e5)
            outer_state, asked = strain_loop_step(
                outer, units, outer_state, strain + 1e-3, strain, source, pressures, dt
            )
            state, decided = recruitment_step(
                policy, units, table, held, state, 0.0, strain, force, source, pressures, dt
            )
            pressure_loop_step(
                inner,
                units,
                integral,
                decided.recruited,
                asked.pressure,
                decided.pressure_compensation,
                strain,
                source,
                pressures,
                dt,
                references,
                spool,
                saturated,
            )
            rows.append(
                [
                    *asked,
                    *decided,
                    *state[:1],
                    *flat(state.expected),
                    *state[2:],
                    *integral,
                    *references,
                    *spool,
                    *saturated,
                ]
            )
        found[scheme] = [np.array(r, dtype=float).tobytes().hex() for r in rows]
        found[scheme + ' states'] = sorted({r[3] for r in rows})
    return found


def test_compiled_and_interpreted_controllers_give_the_same_bits(tmp_path):
    environment = {**os.environ, 'FAM_BUNDLE_INTERPRET': '1'}
    environment['PYTHONPATH'] = os.pathsep.join(filter(None, sys.path))
    path = tmp_path / 'bits.json'
    subprocess.run([sys.executable, __file__, str(path)], env=environment, check=True, timeout=300)
    interpreted = json.loads(path.read_text())
    assert interpreted.pop('compiled') is False
    compiled = evaluate()
    assert compiled['lag_pressure states'] == compiled['baseline states'] == [1, 2]
    assert compiled == interpreted


if __name__ == '__main__':
    numbers = {**evaluate(), 'compiled': compile._DECORATOR is not None}
    Path(sys.argv[1]).write_text(json.dumps(numbers))
