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

"""One to sixteen motor units: recruited one after the other, released in reverse."""

import dataclasses

from fam_bundle_control.allocation import BATCH
from fam_bundle_control.predictors import predictor_start
from fam_bundle_control.pressure_loop import pressure_loop_step, PressureLoop
from fam_bundle_control.recruitment import recruitment_start, recruitment_step
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.pressure_pi import PressureGains
from fam_bundle_model.reference import still
import numpy as np
import pytest

DT = 0.001
STILL = still()


@pytest.mark.parametrize('count', [1, 2, 3, 16])
def test_units_are_recruited_in_order_and_released_in_reverse(
    configuration, law, constant_table, count
):
    fams = dataclasses.replace(configuration.fam, count=(1,) * count)
    units = motor_units(dataclasses.replace(configuration, fam=fams))
    policy, table = law('baseline'), constant_table(0.2, count=count)
    state, visited = recruitment_start(), []
    integral, references, spool = np.zeros((3, count))
    saturated = np.zeros(count, dtype=bool)
    for tick in range(6 * count + 6):
        recruited = state.recruited
        full = tick < 3 * count
        pressures = np.zeros(count)
        pressures[:recruited] = 6e5 if full else 1e5
        strain = 0.05 + 1e-4 * tick
        state, output = recruitment_step(
            policy, units, table, STILL, state, 0.0, strain, 180.0, 6.5e5, pressures, DT
        )
        visited.append(output.recruited)
        pressure_loop_step(
            PressureLoop((PressureGains(5e-6, 1e-6, 0.3),) * count, BATCH, 7e5),
            units,
            integral,
            output.recruited,
            4e5,
            output.pressure_compensation,
            strain,
            6.5e5,
            pressures,
            DT,
            references,
            spool,
            saturated,
        )
        assert np.count_nonzero(references) == output.recruited
        assert np.all(references[: output.recruited] == 4e5)
        assert np.all(np.abs(spool) <= 1.0)
    steps = np.diff(visited)
    assert set(steps) <= {-1, 0, 1}
    assert max(visited) == count
    assert visited[-1] == 1
    assert np.sum(steps) == visited[-1] - visited[0] <= 0


@pytest.mark.parametrize('count', [1, 16])
def test_anticipatory_recruitment_stays_within_the_units_there_are(
    configuration, law, constant_table, count
):
    fams = dataclasses.replace(configuration.fam, count=(1,) * count)
    units = motor_units(dataclasses.replace(configuration, fam=fams))
    policy, table = law('lag_pressure'), constant_table(0.5, 2e4, count=count)
    state, visited = recruitment_start(), []
    for tick in range(2000):
        strain = 0.06 * (1.0 - np.cos(2.0 * np.pi * tick / 2000.0))
        pressures = np.where(np.arange(count) < state.recruited, 6e5, 0.0)
        state, output = recruitment_step(
            policy,
            units,
            table,
            STILL,
            state,
            0.0,
            strain,
            60.0 * count**0.5,
            6.5e5,
            pressures,
            DT,
        )
        visited.append(output.recruited)
        assert 1 <= output.recruited <= count
    assert np.max(np.abs(np.diff(visited))) <= 1
    if count > 1:
        assert visited[-1] < max(visited) > visited[0]


def test_a_middle_state_is_released_although_the_next_unit_could_never_help(
    configuration, law, constant_table
):
    """What the next unit would take to fill says nothing about giving one back."""
    fams = dataclasses.replace(configuration.fam, count=(2, 2, 2))
    units = motor_units(dataclasses.replace(configuration, fam=fams))
    table = constant_table(0.2, count=3)
    table.lag[2] = np.inf
    policy = law('lag')
    pressures = np.array([5e5, 5e5, 0.0])
    state = recruitment_start()._replace(
        recruited=2,
        expected=predictor_start()._replace(strain=0.14, started=True),
        force=180.0,
        dwell=9.0,
        armed=True,
        started=True,
    )
    for tick in range(4000):
        strain = max(0.14 - 3e-5 * tick, 0.01)
        state, _ = recruitment_step(
            policy, units, table, STILL, state, 0.0, strain, 180.0, 6.5e5, pressures, DT
        )
        if state.recruited == 1:
            return
    raise AssertionError('never released')
