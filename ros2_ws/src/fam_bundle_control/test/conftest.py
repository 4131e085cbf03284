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

"""The shipped bundle, and laws and lag tables that the tests choose themselves."""

import dataclasses
from pathlib import Path

from fam_bundle_control.recruitment import (
    Recruitment,
    recruitment,
    recruitment_start,
    recruitment_step,
)
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.lag_table import LagTable
from fam_bundle_model.parameters import load_configuration
from fam_bundle_model.reference import still
import numpy as np
import pytest

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
DT = 0.001
STILL = still()


@pytest.fixture(scope='session')
def configuration():
    return load_configuration(CONFIGURATION)


@pytest.fixture(scope='session')
def units(configuration):
    return motor_units(configuration)


@pytest.fixture(scope='session')
def law(configuration):
    """Return a function from a scheme to a recruitment law with round numbers."""

    def make(scheme='baseline', **changes) -> Recruitment:
        chosen = dataclasses.replace(configuration.recruitment, scheme=scheme)
        made = recruitment(dataclasses.replace(configuration, recruitment=chosen))
        values = {
            'upshift_pressure': 500e3,
            'downshift_pressure': 250e3,
            'minimum_dwell': 0.0,
            'force_time_constant': 0.03,
            'minimum_strain_rate': 1e-3,
            'strain_rate_time_constant': 0.03,
            **changes,
        }
        expected = {name: values.pop(name) for name in made.predictor._fields if name in values}
        return made._replace(predictor=made.predictor._replace(**expected), **values)

    return make


@pytest.fixture(scope='session')
def constant_table():
    """Return a function from a lag and a source drop to a table that holds nothing else."""

    def make(lag, drop=0.0, count=2):
        axis = np.linspace(0.0, 1e6, 2)
        shape = (count, 2, 2)
        return LagTable(axis, axis, np.full(shape, float(lag)), np.full(shape, float(drop)))

    return make


class Supervisor:
    """Steps a recruitment law with measurements by name; keeps what was not given."""

    def __init__(self, law, units, table):
        self.law, self.units, self.table = law, units, table
        self.state = recruitment_start()
        self.seen = {'strain': 0.05, 'force': 180.0, 'source': 650e3, 'pressures': (0.0, 0.0)}
        self.output = None

    def step(self, ticks=1, **seen):
        self.seen.update(seen)
        s = self.seen
        for _ in range(ticks):
            self.state, self.output = recruitment_step(
                self.law,
                self.units,
                self.table,
                STILL,
                self.state,
                0.0,
                s['strain'],
                s['force'],
                s['source'],
                np.array(s['pressures']),
                DT,
            )
        return self.output

    def move(self, rate, ticks, **seen):
        """Step ``ticks`` with the strain moving at ``rate`` 1/s; return the last output."""
        for _ in range(ticks):
            self.step(strain=self.seen['strain'] + rate * DT, **seen)
        return self.output


@pytest.fixture(scope='session')
def supervise(units):
    def make(law, table):
        return Supervisor(law, units, table)

    return make
