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
The plant's trajectory against an independent right-hand side and scipy's stiff integrator.

The reference has the pressures as states (equation 7); the plant has the oil contents. For a
slack FAM the reference's volume changes with its own pressure, V'(e_b) de_b/dP.
"""

import dataclasses
import math

from fam_bundle_model import fam
from fam_bundle_model.parameters import GRAVITY
from fam_bundle_sim.plant import plant_step, resting_state, truth
import numpy as np
import pytest
from scipy.integrate import solve_ivp

PERIOD = 0.001


def run(rig, state, steps, substeps, every=1):
    """Return the plant's strain and unit pressures at each tick, (ticks, 1 + units)."""
    state, rows = state.copy(), []
    pressure = np.empty(len(rig.units))
    for duration, command in steps:
        for _ in range(round(duration / PERIOD)):
            plant_step(rig, state, command, PERIOD, substeps)
            strain = truth(rig, state, pressure).strain
            rows.append([strain, *pressure])
    return np.array(rows)[every - 1 :: every]  # noqa: E203


def series_flow(hydraulics, spool, source, pressure):
    """Flow through orifice and hose: Q R + (Q / K)^2 = dP by the quadratic formula."""
    difference = (source if spool > 0.0 else 0.0) - pressure
    k2 = (spool * hydraulics.valve_conductance) ** 2
    half = 0.5 * k2 * hydraulics.hose_resistance
    if k2 == 0.0:
        return 0.0
    return math.copysign(math.sqrt(half**2 + k2 * abs(difference)) - half, difference)


def reference_rates(rig, command):
    """Return the right-hand side over (strain, rate, source, pressures, spools)."""
    h, n = rig.hydraulics, len(rig.units)
    modulus, length = h.bulk_modulus, rig.units[0].fam.length

    def rates(_, y):
        strain, speed, source = y[:3]
        force = drawn = 0.0
        pressure_rates, spool_rates = [], []
        for i, unit in enumerate(rig.units):
            pressure, spool = y[3 + i], y[3 + n + i]
            law = unit.fam
            q = series_flow(h, spool, source, pressure)
            drawn += q if spool > 0.0 else 0.0
            # Flow is counted as oil at zero pressure; in the FAM it is denser.
            q *= math.exp(-pressure / modulus) / unit.fams
            e_b, slope = fam.interpolate(law.compression, 0, law.pressure_step, pressure)
            if strain < e_b:
                volume = fam.volume(law, strain)
                swept = length * fam.mesh_coefficient(law, strain) * speed
                pressure_rates.append((q - swept) * modulus / volume)
            else:
                compliance = fam.volume(law, e_b) / modulus
                compliance += length * fam.mesh_coefficient(law, e_b) * slope
                pressure_rates.append(q / compliance)
            force += unit.fams * fam.force(law, pressure, strain)
            spool_rates.append((command[i] - spool) / h.spool_time_constant)
        friction = rig.friction_force * math.tanh(speed / rig.friction_rate)
        pull = force - rig.mass * GRAVITY - rig.damping * length * speed - friction
        settled = h.nominal_pressure - h.droop * max(drawn, 0.0)
        return [
            speed,
            pull / (rig.mass * length),
            (settled - source) / h.source_time_constant,
            *pressure_rates,
            *spool_rates,
        ]

    return rates


def reference_run(rig, configuration, steps, every):
    """Return strain and unit pressures every ``every`` ticks by Radau with tight tolerances."""
    state = resting_state(configuration, rig)
    pressure = np.empty(len(rig.units))
    truth(rig, state, pressure)
    n = len(rig.units)
    y = np.concatenate([state[:3], pressure, np.zeros(n)])
    rows = []
    for duration, command in steps:
        ticks = round(duration / PERIOD)
        times = PERIOD * np.arange(every, ticks + 1, every)
        solution = solve_ivp(
            reference_rates(rig, command),
            (0.0, ticks * PERIOD),
            y,
            'Radau',
            t_eval=times,
            rtol=1e-6,
            atol=[1e-9, 1e-8, 1e-1] + [1e-1] * n + [1e-8] * n,
        )
        assert solution.success
        rows.append(solution.y[[0, *range(3, 3 + n)]].T)
        y = solution.y[:, -1]
    return np.concatenate(rows)


def test_strain_agrees_with_the_independent_integration(rig, configuration, valve_steps):
    every = 10
    found = run(rig, resting_state(configuration, rig), valve_steps, 8, every)
    expected = reference_run(rig, configuration, valve_steps, every)
    assert np.ptp(found[:, 0]) > 0.05  # the run goes through slack and taut, up and down
    # The two differ by the table of the slack pressure (under 1 Pa of 1e5) and by the plant's step
    # across the taut border: 1e-5 of the pressure, and with 1e-6 of strain per Pa far below this.
    assert np.max(np.abs(found[:, 0] - expected[:, 0])) < 1e-6
    assert np.max(np.abs(found[:, 1:] - expected[:, 1:])) < 50.0


def test_second_unit_goes_through_slack_and_taut(rig, configuration, valve_steps):
    rows = run(rig, resting_state(configuration, rig), valve_steps, 4)
    taut = [
        strain < fam.buckling_strain(rig.units[1].fam, pressure) for strain, _, pressure in rows
    ]
    assert 0.2 < np.mean(taut) < 0.8


def test_halving_the_substep_hardly_changes_the_strain(rig, configuration, valve_steps):
    start = resting_state(configuration, rig)
    shipped = configuration.simulation.substeps
    coarse = run(rig, start, valve_steps, shipped)
    fine = run(rig, start, valve_steps, 2 * shipped)
    assert np.max(np.abs(coarse[:, 0] - fine[:, 0])) < 1e-4


def test_integration_converges_with_the_fourth_order(rig, configuration):
    """Where nothing switches: the first unit taut, the second slack and closed."""
    lifted = dataclasses.replace(configuration.simulation, initial_strain=0.06)
    start = resting_state(dataclasses.replace(configuration, simulation=lifted), rig)
    steps = [(0.1, np.array([0.1, 0.0]))]
    exact = run(rig, start, steps, 128)[:, 0]
    errors = [np.max(np.abs(run(rig, start, steps, n)[:, 0] - exact)) for n in (8, 16)]
    assert errors[0] / errors[1] > 8.0


@pytest.mark.parametrize('strain', [0.0, 0.03, 0.06])
def test_the_resting_state_is_at_rest(rig, configuration, strain):
    simulation = dataclasses.replace(configuration.simulation, initial_strain=strain)
    start = resting_state(dataclasses.replace(configuration, simulation=simulation), rig)
    rows = run(rig, start, [(1.0, np.zeros(2))], 2)
    assert np.max(np.abs(rows[:, 0] - strain)) < 1e-9
    assert np.ptp(rows[:, 1]) < 1e-2
    assert np.max(np.abs(rows[:, 2])) < 1e-2
    pressure = np.empty(2)
    seen = truth(rig, start, pressure)
    assert seen.force == pytest.approx(rig.mass * GRAVITY, abs=1e-6)
    assert (seen.source_pressure, seen.source_flow) == (rig.hydraulics.nominal_pressure, 0.0)
