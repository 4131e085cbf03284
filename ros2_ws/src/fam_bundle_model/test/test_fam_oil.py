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

"""Oil content and pressure of one FAM: inverse of each other, and together equation 7."""

import math

from fam_bundle_model import fam
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import brentq

# The slack pressure is tabulated; the table's error, far below any sensor's.
TABLE_ERROR = 0.5  # Pa

pressures = st.floats(0.0, 1.3e6)
strains = st.floats(-0.1, 0.3)  # to the strain at which the braid locks
MODULUS = 80e6  # the one that conftest.py builds the tables with


@settings(deadline=None, max_examples=150)
@given(pressures, strains)
def test_pressure_of_is_the_inverse_of_oil_of(make_fam, pressure, strain):
    law, _ = make_fam()
    oil = fam.oil_of(law, pressure, strain, MODULUS)
    taut = strain < fam.buckling_strain(law, pressure)
    # A taut FAM needs no table: what is left is the rounding of E log(1 + P / E).
    allowed = MODULUS * 1e-15 if taut else TABLE_ERROR
    assert fam.pressure_of(law, oil, strain, MODULUS) == pytest.approx(pressure, abs=allowed)


@settings(deadline=None, max_examples=60)
@given(pressures, strains)
def test_pressure_solves_the_volume_balance_of_the_independent_law(make_fam, pressure, strain):
    law, exact = make_fam()
    strain = max(strain, 0.0)

    def oil(p):
        return exact.volume(min(strain, exact.buckling(p))) * math.exp(p / MODULUS)

    content = oil(pressure)
    found = fam.pressure_of(law, content, strain, MODULUS)
    assert found == pytest.approx(brentq(lambda p: oil(p) - content, 0.0, 1.39e6), abs=2.0)


@settings(deadline=None, max_examples=100)
@given(pressures, pressures, strains)
def test_more_oil_is_more_pressure(make_fam, first, second, strain):
    law, _ = make_fam()
    assume(abs(first - second) > 1.0)
    low, high = sorted((first, second))
    contents = [fam.oil_of(law, p, strain, MODULUS) for p in (low, high)]
    assert contents[0] < contents[1]
    found = [fam.pressure_of(law, c, strain, MODULUS) for c in contents]
    assert found[0] < found[1]


@settings(deadline=None, max_examples=100)
@given(pressures, strains, st.floats(1e-4, 0.02))
def test_contraction_at_the_same_oil_never_raises_the_pressure(make_fam, pressure, strain, more):
    law, _ = make_fam()
    oil = fam.oil_of(law, pressure, strain, MODULUS)
    before, after = (fam.pressure_of(law, oil, s, MODULUS) for s in (strain, strain + more))
    assert after <= before
    if strain > fam.buckling_strain(law, before):
        assert after == before  # slack: the arc length does not follow the strain


@pytest.mark.parametrize('pressure', [1e4, 1.3e5, 4.4e5, 1.1e6])
def test_pressure_is_continuous_where_a_fam_turns_taut(make_fam, pressure):
    law, _ = make_fam()
    border = fam.buckling_strain(law, pressure)
    oil = fam.oil_of(law, pressure, border, MODULUS)
    steepest = MODULUS * 10.0  # E V'(e) / V per unit strain, generously
    for gap in (1e-4, 1e-6, 1e-8):
        taut = fam.pressure_of(law, oil, border - gap, MODULUS)
        slack = fam.pressure_of(law, oil, border + gap, MODULUS)
        assert slack <= taut
        assert taut - slack <= gap * steepest + 2.0 * TABLE_ERROR


@pytest.mark.parametrize('strain', [0.0, 0.06, 0.12])
def test_a_taut_fam_follows_equation_7(make_fam, strain):
    """dP/dt = E (Q - dV/dt) / V, by central differences over a step of oil and strain."""
    law, exact = make_fam()
    pressure, flow, rate, dt = 6e5, 3e-5, 0.04, 1e-5
    assert strain < fam.buckling_strain(law, pressure)
    oil = fam.oil_of(law, pressure, strain, MODULUS)

    after, before = (
        fam.pressure_of(law, oil + s * flow * dt, strain + s * rate * dt, MODULUS)
        for s in (1.0, -1.0)
    )
    measured = (after - before) / (2.0 * dt)
    swept = (exact.volume(strain + 1e-6) - exact.volume(strain - 1e-6)) / 2e-6 * rate
    # ``flow`` counts oil as it is at zero pressure; Q is the volume that it takes in the FAM.
    actual = flow * math.exp(-pressure / MODULUS)
    expected = MODULUS * (actual - swept) / exact.volume(strain)
    assert measured == pytest.approx(expected, rel=1e-5)


@pytest.mark.parametrize('pressure', [2e4, 1e5, 3e5, 9e5])
def test_a_slack_fam_follows_equation_7_with_the_compliance_of_its_arc(make_fam, pressure):
    """dP/dt = Q / (V / E + V'(e_b) de_b/dP): the strain does not matter, its arc length does."""
    law, exact = make_fam()
    flow, dt = 3e-5, 1e-4
    strain = exact.buckling(pressure) + 0.02
    oil = fam.oil_of(law, pressure, strain, MODULUS)
    step = flow * math.exp(pressure / MODULUS) * dt
    after, before = (
        fam.pressure_of(law, oil + s * step, strain + s * 0.01, MODULUS) for s in (1.0, -1.0)
    )
    h = 50.0
    arc_volume = [exact.volume(exact.buckling(p)) for p in (pressure - h, pressure + h)]
    compliance = exact.volume(exact.buckling(pressure)) / MODULUS
    compliance += (arc_volume[1] - arc_volume[0]) / (2.0 * h)
    assert (after - before) / (2.0 * dt) == pytest.approx(flow / compliance, rel=2e-3)


def test_deslacking_takes_far_more_oil_than_compressing_it(make_fam):
    law, exact = make_fam()
    strain = 0.12
    pressure = fam.deslack_pressure(law, strain)
    filled = fam.oil_of(law, pressure, strain, MODULUS) - fam.oil_of(law, 0.0, strain, MODULUS)
    geometric = exact.volume(strain) - exact.volume(exact.buckling(0.0))
    compressed = exact.volume(strain) * (math.exp(pressure / MODULUS) - 1.0)
    assert filled == pytest.approx(geometric + compressed, rel=1e-6)
    assert geometric > 10.0 * compressed


def test_below_atmosphere_a_slack_fam_is_a_closed_volume(make_fam):
    law, exact = make_fam()
    rest = fam.oil_of(law, 0.0, 0.1, MODULUS)
    assert rest == pytest.approx(exact.volume(exact.buckling(0.0)), rel=1e-12)
    for share in np.linspace(0.99, 1.0, 5):
        found = fam.pressure_of(law, share * rest, 0.1, MODULUS)
        vacuum = -101325.0  # beyond which a vapour cavity opens instead
        assert found == pytest.approx(max(MODULUS * math.log(share), vacuum), abs=1e-6)
