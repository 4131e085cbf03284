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

"""Regions of the force law: where they begin, and that nothing jumps between them."""

import math

from fam_bundle_model import fam
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

BORDERS = ('free', 'buckling', 'collapse')


def border(law, name, pressure):
    if name == 'free':
        return fam.free_strain(law, pressure)
    column = {'buckling': 0, 'collapse': 2}[name]
    return fam.interpolate(law.compression, column, law.pressure_step, pressure)[0]


@pytest.mark.parametrize('name', BORDERS)
@pytest.mark.parametrize('pressure', [0.0, 0.7e5, 2.9e5, 6.6e5, 1.2e6])
def test_force_has_no_jump_in_strain(make_fam, name, pressure):
    law, _ = make_fam()
    at = border(law, name, pressure)
    # The steepest slope is the collapse's: beta times at most the buckled force.
    steepest = 100.0 * 60.0 + 2000.0
    for gap in (1e-4, 1e-6, 1e-8, 1e-10):
        difference = fam.force(law, pressure, at + gap) - fam.force(law, pressure, at - gap)
        assert abs(difference) <= 2.0 * gap * steepest + 1e-9


@pytest.mark.parametrize('name', BORDERS)
@pytest.mark.parametrize('pressure', [0.7e5, 2.9e5, 6.6e5, 1.2e6])
def test_force_has_no_jump_in_pressure(make_fam, name, pressure):
    law, _ = make_fam()
    strain = border(law, name, pressure)
    steepest = math.pi * 0.0063**2 * 20.0  # several times the mesh coefficient
    for gap in (10.0, 1.0, 1e-2, 1e-4):
        difference = fam.force(law, pressure + gap, strain) - fam.force(
            law, pressure - gap, strain
        )
        assert abs(difference) <= 2.0 * gap * steepest + 1e-9


@settings(deadline=None, max_examples=100)
@given(st.floats(0.0, 1.35e6), st.floats(-0.03, 0.45), st.floats(-1e-7, 1e-7))
def test_force_is_continuous_everywhere(make_fam, pressure, strain, gap):
    law, _ = make_fam()
    near = fam.force(law, max(pressure + 1e6 * gap, 0.0), strain + gap)
    assert abs(near - fam.force(law, pressure, strain)) <= abs(gap) * (8000.0 + 1e6 * 3e-3) + 1e-9


@settings(deadline=None, max_examples=60)
@given(st.floats(0.0, 1.3e6), st.floats(1e-4, 0.1))
def test_force_is_tensile_below_free_strain_and_compressive_above(make_fam, pressure, gap):
    law, _ = make_fam()
    free = fam.free_strain(law, pressure)
    assert fam.force(law, pressure, free) == pytest.approx(0.0, abs=1e-9)
    assert fam.force(law, pressure, free - gap) > 0.0
    assert fam.force(law, pressure, free + gap) < 0.0


@settings(deadline=None, max_examples=60)
@given(st.floats(0.0, 0.25))
def test_deslack_pressure_and_free_strain_are_inverse(make_fam, strain):
    law, exact = make_fam()
    pressure = fam.deslack_pressure(law, strain)
    assert fam.free_strain(law, pressure) == pytest.approx(strain, abs=1e-9)
    assert exact.straight(pressure, strain) == pytest.approx(0.0, abs=1e-8)


@pytest.mark.parametrize('strain', [-0.12, -0.1, -0.05, -0.03125, -0.01])
def test_free_strain_of_a_stretched_fam(make_fam, strain):
    law, _ = make_fam()
    pressure = fam.deslack_pressure(law, strain)
    assert pressure < 0.0
    assert fam.free_strain(law, pressure) == pytest.approx(strain, abs=1e-9)


@pytest.mark.parametrize('braid_angle', [0.1, 0.2, 0.3, 0.4, 0.45, 0.5, 0.6, 0.8, 0.95])
def test_free_strain_at_every_braid_angle_that_can_be_configured(make_fam, braid_angle):
    law, exact = make_fam(braid_angle=braid_angle)
    for pressure in (0.0, 1e4, 1e5, 6e5):
        expected = exact.free_strain(pressure)
        assert fam.free_strain(law, pressure) == pytest.approx(expected, abs=1e-9)


@settings(deadline=None, max_examples=60)
@given(st.floats(0.0, 1.3e6))
def test_free_strain_is_the_root_of_the_independent_law(make_fam, pressure):
    law, exact = make_fam()
    strain = fam.free_strain(law, pressure)
    assert strain == pytest.approx(exact.free_strain(pressure), abs=1e-9)
    assert fam.deslack_pressure(law, strain) == pytest.approx(pressure, rel=1e-9, abs=1e-6)


def test_deslack_pressure_is_infinite_where_the_braid_cannot_pull(make_fam):
    law, exact = make_fam()
    locked = 1.0 - 1.0 / (math.sqrt(3.0) * math.cos(exact.a0))  # braid angle 54.7 degrees
    assert fam.mesh_coefficient(law, locked) == pytest.approx(0.0, abs=1e-15)
    assert fam.deslack_pressure(law, locked + 1e-6) == math.inf
    assert 0.0 < fam.deslack_pressure(law, locked - 1e-3) < math.inf


@pytest.mark.parametrize('geometry', [{}, {'length': 0.35}, {'end_spring_span': 0.3}])
def test_tables_hold_the_exact_borders_at_their_nodes(make_fam, geometry):
    law, exact = make_fam(**geometry)
    for i in range(0, len(law.compression), 16):
        p = i * law.pressure_step
        row = law.compression[i]
        assert row[0] == pytest.approx(exact.buckling(p), abs=1e-12)
        assert row[2] == pytest.approx(exact.collapse(p), abs=1e-11)
        assert row[4] == pytest.approx(exact.folding_spring(p), rel=1e-11)


@settings(deadline=None, max_examples=40)
@given(st.floats(0.0, 1.39e6))
def test_tables_stay_exact_between_their_nodes(make_fam, pressure):
    law, exact = make_fam()
    # Cubic on 256 intervals; in the first, where the slope at the end is one-sided and pressure
    # stiffens most, an order worse. 1e-6 of strain is 2e-3 N of a taut FAM.
    assert border(law, 'buckling', pressure) == pytest.approx(exact.buckling(pressure), abs=3e-7)
    assert border(law, 'collapse', pressure) == pytest.approx(exact.collapse(pressure), abs=1e-6)
    spring = fam.interpolate(law.compression, 4, law.pressure_step, pressure)[0]
    assert spring == pytest.approx(exact.folding_spring(pressure), rel=3e-6)


@pytest.mark.parametrize('span', [1e-4, 0.3, 1.0, 1e5])
def test_buckling_load_lies_between_pinned_and_clamped_ends(make_fam, span):
    law, exact = make_fam(end_spring_span=span)
    for i in range(0, len(law.compression), 32):
        p = i * law.pressure_step
        e_b = fam.buckling_strain(law, p)
        pinned = (math.pi / (exact.l0 * (1.0 - e_b))) ** 2 * exact.rigidity(p, e_b)
        load = -fam.force(law, p, e_b)
        assert load == pytest.approx(exact.euler(p, e_b), rel=1e-9)
        assert pinned * (1.0 - 1e-9) <= load <= 4.0 * pinned * (1.0 + 1e-9)
        if span == 1e5:
            assert load == pytest.approx(pinned, rel=1e-3)
        if span == 1e-4:
            assert load == pytest.approx(4.0 * pinned, rel=1e-3)


def test_borders_are_in_order_and_grow_with_pressure(make_fam):
    for geometry in ({}, {'mooney_rivlin_share': 1.0}, {'braid_angle': 0.52}):
        law, _ = make_fam(**geometry)
        pressures = np.linspace(0.0, 1.39e6, 200)
        rows = np.array([[border(law, n, p) for n in BORDERS] for p in pressures])
        assert np.all(np.diff(rows, axis=1) > 0.0)
        assert np.all(np.diff(rows[:, :2], axis=0) > 0.0)


@settings(deadline=None, max_examples=60)
@given(st.lists(st.floats(-5.0, 5.0), min_size=4, max_size=4), st.floats(0.001, 0.999))
def test_interpolation_reproduces_any_cubic(coefficients, share):
    cubic = np.polynomial.Polynomial(coefficients)
    step = 0.5
    x = step * np.arange(4)
    table = np.column_stack([cubic(x), cubic.deriv()(x)])
    at = share * x[-1]
    value, slope = fam.interpolate(table, 0, step, at)
    assert value == pytest.approx(cubic(at), abs=1e-11)
    assert slope == pytest.approx(cubic.deriv()(at), abs=1e-11)


def test_interpolation_holds_its_ends():
    table = np.array([[1.0, 2.0], [5.0, 7.0]])
    assert fam.interpolate(table, 0, 2.0, -1.0) == (1.0, 0.0)
    assert fam.interpolate(table, 0, 2.0, 3.0) == (5.0, 0.0)
    assert fam.interpolate(table, 0, 2.0, 2.0) == (5.0, 0.0)
