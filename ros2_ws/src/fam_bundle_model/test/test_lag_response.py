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
The filling of one slack motor unit (Figure 6) against an independent integration.

The reference integrates pressure, not oil: equation 7 with the compliance of the slack arc, by
scipy's solve_ivp from tick to tick, the PI sampled at the ticks.
"""

import math

from fam_bundle_model import fam
from fam_bundle_model.lag_table import fill_response, REACHED
from fam_bundle_model.pressure_pi import clamp, pressure_pi, PressureGains
import numpy as np
import pytest
from scipy.integrate import simpson, solve_ivp

PERIOD = 0.001
NO_TRACE = np.empty((0, 5))


def arc_derivatives(law, pressure, strain):
    """Return V(e_arc) and its derivative by pressure, in closed form from equation 8."""
    e_b, slope = fam.interpolate(law.compression, 0, law.pressure_step, pressure)
    if e_b >= strain:  # taut: the arc is the strain, and that is held
        return fam.volume(law, strain), 0.0
    return fam.volume(law, e_b), law.length * fam.mesh_coefficient(law, e_b) * slope


def independent_fill(hydraulics, gains, unit, target, ticks):
    """Return source and unit pressure at each tick (2, ticks)."""
    law, modulus = unit.fam, hydraulics.bulk_modulus
    strain = fam.free_strain(law, target)

    def flow(spool, source, pressure):
        up = source if spool > 0.0 else 0.0
        if spool == 0.0 or up == pressure:
            return 0.0
        # K^2 dP_v = Q^2 and R Q + dP_v = dP, by the quadratic formula.
        k2, r = (spool * hydraulics.valve_conductance) ** 2, hydraulics.hose_resistance
        d = up - pressure
        q = 0.5 * (math.sqrt((k2 * r) ** 2 + 4.0 * k2 * abs(d)) - k2 * r)
        return math.copysign(q, d)

    def rates(_, y, command):
        spool, source, pressure = y
        q = flow(spool, source, pressure)
        volume, arc = arc_derivatives(law, pressure, strain)
        inflow = q * math.exp(-pressure / modulus) / unit.fams
        settled = hydraulics.nominal_pressure - hydraulics.droop * max(q, 0.0)
        return [
            (command - spool) / hydraulics.spool_time_constant,
            (settled - source) / hydraulics.source_time_constant,
            inflow / (volume / modulus + arc),
        ]

    y, integral = [0.0, hydraulics.nominal_pressure, 0.0], 0.0
    history = []
    for _ in range(ticks):
        history.append(y[1:])
        error = target - y[2]
        asked = gains.proportional * error + integral
        if abs(asked) < 1.0 or asked * error < 0.0:
            limit = gains.integral_limit
            integral = min(max(integral + gains.integral * error * PERIOD, -limit), limit)
        command = min(max(asked, -1.0), 1.0)
        y = solve_ivp(
            rates, (0.0, PERIOD), y, 'LSODA', args=(command,), rtol=1e-8, atol=[1e-10, 1e-3, 1e-3]
        ).y[:, -1]
    return np.array(history).T


@pytest.fixture(scope='module')
def gains():
    return PressureGains(7e-6, 1.5e-6, 0.3)


@pytest.fixture(scope='module')
def supply(hydraulics):
    return hydraulics._replace(nominal_pressure=6e5)


def test_filling_agrees_with_an_independent_integration(supply, gains, units):
    target, ticks = 1.2e5, 300
    trace = np.empty((ticks, 5))
    lag, drop = fill_response(supply, gains, units[1], target, 2.0, PERIOD, 8, trace)
    source, pressure = independent_fill(supply, gains, units[1], target, ticks)
    assert np.max(np.abs(trace[:, 2] - pressure)) < 2e-3 * target
    assert np.max(np.abs(trace[:, 1] - source)) < 1e-3 * supply.nominal_pressure
    reached = np.flatnonzero(pressure >= REACHED * target)[0] * PERIOD
    assert lag == pytest.approx(reached, abs=PERIOD * 1.001)
    assert drop == pytest.approx(
        supply.nominal_pressure - source[: round(lag / PERIOD)].min(), rel=5e-3
    )


def test_halving_the_substep_moves_the_lag_by_no_more_than_a_tick(supply, gains, units):
    for target in (5e4, 2e5, 4e5):
        coarse = fill_response(supply, gains, units[1], target, 2.0, PERIOD, 8, NO_TRACE)
        fine = fill_response(supply, gains, units[1], target, 2.0, PERIOD, 16, NO_TRACE)
        assert coarse[0] == pytest.approx(fine[0], abs=PERIOD * 1.001)
        assert coarse[1] == pytest.approx(fine[1], rel=2e-3)


def test_the_trace_is_the_figure_6_of_the_lag(supply, gains, units):
    target, ticks = 3e5, 700
    trace = np.empty((ticks, 5))
    lag, drop = fill_response(supply, gains, units[1], target, 2.0, PERIOD, 4, trace)
    time, source, pressure, spool, flow = trace.T
    assert (lag, drop) == fill_response(supply, gains, units[1], target, 2.0, PERIOD, 4, NO_TRACE)
    assert np.array_equal(time, np.arange(ticks) * PERIOD)
    assert (source[0], pressure[0], spool[0]) == (supply.nominal_pressure, 0.0, 0.0)
    tick = round(lag / PERIOD)
    assert pressure[tick] >= REACHED * target > pressure[tick - 1]
    assert drop >= supply.nominal_pressure - source[: tick + 1].min() - 1e-6
    assert np.all(np.abs(spool) <= 1.0)
    # What flowed in filled the unit: from its slack content to that at the present pressure.
    strain = fam.free_strain(units[1].fam, target)
    content = [
        units[1].fams * fam.oil_of(units[1].fam, p, strain, supply.bulk_modulus)
        for p in (pressure[0], pressure[tick])
    ]
    inflow = simpson(flow[: tick + 1], dx=PERIOD)
    assert inflow == pytest.approx(content[1] - content[0], rel=5e-3)


def test_a_target_of_zero_is_reached_at_once(supply, gains, units):
    assert fill_response(supply, gains, units[1], 0.0, 2.0, PERIOD, 4, NO_TRACE) == (0.0, 0.0)


def test_what_takes_longer_than_the_maximum_is_never(supply, gains, units):
    lag, _ = fill_response(supply, gains, units[1], 3e5, 2.0, PERIOD, 4, NO_TRACE)
    assert 0.0 < lag < 2.0
    short = fill_response(supply, gains, units[1], 3e5, lag - 0.002, PERIOD, 4, NO_TRACE)
    assert short[0] == math.inf


def test_more_fams_on_one_valve_take_longer(supply, gains, units):
    lags = [
        fill_response(supply, gains, units[1]._replace(fams=n), 2e5, 4.0, PERIOD, 4, NO_TRACE)[0]
        for n in (1.0, 2.0, 4.0)
    ]
    assert lags[0] < lags[1] < lags[2]


def test_without_droop_and_hose_and_spool_lag_the_source_does_not_drop(supply, gains, units):
    ideal = supply._replace(droop=0.0)
    lag, drop = fill_response(ideal, gains, units[1], 2e5, 2.0, PERIOD, 4, NO_TRACE)
    assert drop == 0.0
    assert lag < fill_response(supply, gains, units[1], 2e5, 2.0, PERIOD, 4, NO_TRACE)[0]


@pytest.mark.parametrize('error', [3e4, -3e4])
def test_pi_integrates_by_the_tick(gains, error):
    integral, expected = 0.0, 0.0
    for _ in range(50):
        integral, spool = pressure_pi(gains, integral, 2e5 + error, 2e5, PERIOD)
        assert spool == pytest.approx(gains.proportional * error + expected)
        expected += gains.integral * error * PERIOD
        assert integral == pytest.approx(expected)


def test_pi_holds_its_integral_while_saturated_and_within_its_limit(gains):
    integral, spool = pressure_pi(gains, 0.1, 6e5, 0.0, PERIOD)
    assert spool > 1.0
    assert integral == 0.1
    integral, _ = pressure_pi(gains._replace(proportional=1e-5), -0.9, 0.0, 5e4, PERIOD)
    assert integral == -0.9
    for _ in range(2000):
        integral, _ = pressure_pi(gains._replace(integral=1e-2), integral, 1e5, 0.0, PERIOD)
    assert integral == gains.integral_limit


@pytest.mark.parametrize(('value', 'limited'), [(-2.0, -1.0), (0.3, 0.3), (5.0, 1.0), (1.0, 1.0)])
def test_clamp(value, limited):
    assert clamp(value, -1.0, 1.0) == limited
