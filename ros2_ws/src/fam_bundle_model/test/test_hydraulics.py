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

"""Valve and hose in series against equations 5 and 6 solved separately; the source's droop."""

import math

from fam_bundle_model.hydraulics import HydraulicLaw, source_pressure_rate, unit_flow
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import pytest
from scipy.optimize import brentq

LAW = HydraulicLaw(
    nominal_pressure=689.5e3,
    droop=3e9,
    source_time_constant=0.02,
    valve_conductance=3.4e-7,
    spool_time_constant=0.004,
    hose_resistance=7e9,
    bulk_modulus=80e6,
)

spools = st.floats(-1.0, 1.0)
pressures = st.floats(0.0, 1e6)
resistances = st.floats(1e7, 1e12)


def orifice(conductance, difference):
    """Equation 5: Q = c d sgn(dP) sqrt(|dP|)."""
    return conductance * math.copysign(math.sqrt(abs(difference)), difference)


@settings(deadline=None, max_examples=200)
@given(spools, pressures, pressures, resistances)
def test_valve_and_hose_pass_the_same_flow(spool, source, pressure, resistance):
    law = LAW._replace(hose_resistance=resistance)
    assume(abs(spool) > 1e-3)
    upstream = source if spool > 0.0 else 0.0
    assume(abs(upstream - pressure) > 1.0)
    conductance = abs(spool) * law.valve_conductance

    def mismatch(between):
        return orifice(conductance, upstream - between) - (between - pressure) / resistance

    low, high = sorted((upstream, pressure))
    between = brentq(mismatch, low, high, xtol=1e-12, rtol=1e-15)
    flow = unit_flow(law, spool, source, pressure)
    assert flow == pytest.approx((between - pressure) / resistance, rel=1e-6, abs=1e-16)
    # And, less sensitive to the root: the two drops that this flow causes add up.
    drop = math.copysign((flow / conductance) ** 2, flow) + resistance * flow
    assert drop == pytest.approx(upstream - pressure, rel=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.floats(0.01, 1.0), pressures, pressures)
def test_exchanging_the_two_pressures_reverses_the_flow(spool, source, pressure):
    there, back = unit_flow(LAW, spool, source, pressure), unit_flow(LAW, spool, pressure, source)
    assert there == -back
    # An open tank is a source at zero.
    assert unit_flow(LAW, -spool, source, pressure) == unit_flow(LAW, spool, 0.0, pressure)


@settings(deadline=None, max_examples=60)
@given(st.floats(0.01, 1.0), pressures, st.floats(1.0, 5e5))
def test_only_the_pressure_difference_counts_towards_the_source(spool, pressure, difference):
    shifted = unit_flow(LAW, spool, pressure + difference, pressure)
    assert shifted == pytest.approx(unit_flow(LAW, spool, difference, 0.0), rel=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.floats(0.01, 0.99), st.floats(0.0, 9e5), st.floats(1e3, 1e5))
def test_flow_grows_with_spool_and_with_pressure_difference(spool, pressure, difference):
    flow = unit_flow(LAW, spool, pressure + difference, pressure)
    assert flow > 0.0
    assert unit_flow(LAW, spool + 0.01, pressure + difference, pressure) > flow
    assert unit_flow(LAW, spool, pressure + 1.1 * difference, pressure) > flow


@pytest.mark.parametrize('difference', [-5e5, -1e3, 1e3, 6.895e5])
def test_without_hose_the_valve_is_an_orifice(difference):
    law = LAW._replace(hose_resistance=0.0)
    expected = orifice(0.4 * law.valve_conductance, difference)
    assert unit_flow(law, 0.4, 6e5, 6e5 - difference) == pytest.approx(expected, rel=1e-12)


@pytest.mark.parametrize('difference', [-5e5, -1e3, 1e3, 6.895e5])
def test_with_a_wide_valve_the_hose_follows_hagen_poiseuille(difference):
    law = LAW._replace(valve_conductance=1e3)
    expected = difference / law.hose_resistance
    assert unit_flow(law, 1.0, 6e5, 6e5 - difference) == pytest.approx(expected, rel=1e-9)


def test_nothing_flows_through_a_closed_valve_or_without_difference():
    assert unit_flow(LAW, 0.0, 6e5, 1e5) == 0.0
    assert unit_flow(LAW, 0.5, 3e5, 3e5) == 0.0
    assert unit_flow(LAW, -0.5, 3e5, 0.0) == 0.0
    assert unit_flow(LAW._replace(hose_resistance=0.0), 0.0, 6e5, 1e5) == 0.0


def test_the_tank_takes_oil_from_a_pressed_unit_and_gives_to_one_below_it():
    assert unit_flow(LAW, -0.5, 6e5, 1e5) < 0.0
    assert unit_flow(LAW, -0.5, 6e5, -1e3) > 0.0


def test_constants_follow_from_the_data_sheets(hydraulics, configuration):
    valve, hose = configuration.valve, configuration.hose
    rated = unit_flow(
        hydraulics._replace(hose_resistance=0.0), 1.0, valve.rated_pressure_drop, 0.0
    )
    assert rated == pytest.approx(valve.rated_flow, rel=1e-12)
    poiseuille = 8.0 * hose.viscosity * hose.length / math.pi / hose.radius**4
    wide = hydraulics._replace(valve_conductance=1e6)
    assert unit_flow(wide, 1.0, 1e5, 0.0) == pytest.approx(1e5 / poiseuille, rel=1e-9)


@pytest.mark.parametrize('flow', [0.0, 2e-5, 1e-4])
def test_source_settles_on_the_droop_line_exponentially(flow):
    pressure, dt, ticks = LAW.nominal_pressure, 1e-5, 4000
    for _ in range(ticks):
        pressure += dt * source_pressure_rate(LAW, pressure, flow)
    lost = LAW.droop * flow
    elapsed = dt * ticks / LAW.source_time_constant
    expected = LAW.nominal_pressure - lost * (1.0 - math.exp(-elapsed))
    assert pressure == pytest.approx(expected, abs=1e-3 * lost + 1e-6)
    assert source_pressure_rate(LAW, LAW.nominal_pressure - lost, flow) == pytest.approx(0.0)


def test_reverse_flow_does_not_raise_the_source():
    """The reducing valve relieves it to the tank."""
    rest = source_pressure_rate(LAW, LAW.nominal_pressure, 0.0)
    assert source_pressure_rate(LAW, LAW.nominal_pressure, -1e-4) == rest == 0.0
