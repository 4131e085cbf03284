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

"""The force law against virtual work, F = -dU/dx + P dV/dx at constant pressure, and scaling."""

import math

from fam_bundle_model import fam
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.integrate import quad

SCALE = 1e-6  # relative to the largest of the forces that cancel

pressures = st.floats(0.0, 1.3e6)
shares = st.floats(0.02, 0.98)
# The tables hold exact values at their nodes; test_fam_compression.py looks between them.
nodes = st.integers(0, 240)
geometries = st.fixed_dictionaries(
    {
        'inner_radius': st.sampled_from([0.004, 0.0063, 0.010]),
        'thickness': st.sampled_from([0.0008, 0.0016]),
        'braid_angle': st.sampled_from([0.52, 0.576, 0.7]),
        'length': st.sampled_from([0.18, 0.222, 0.3]),
        'mooney_rivlin_share': st.sampled_from([0.0, 0.4, 1.0]),
    }
)


def virtual_work(energy, volume, pressure, length, strain, h=1e-6):
    """Return the central difference of (P V - U) by the contraction x = length * strain."""
    work = [pressure * volume(e) - energy(e) for e in (strain + h, strain - h)]
    return (work[0] - work[1]) / (2.0 * h * length)


@settings(deadline=None, max_examples=60)
@given(geometries, pressures, shares)
def test_straight_region_is_virtual_work_of_mooney_rivlin_energy(make_fam, geometry, p, share):
    law, exact = make_fam(**geometry)
    strain = -0.05 + share * (fam.buckling_strain(law, p) + 0.05)
    assume(strain < fam.buckling_strain(law, p) - 2e-6)
    expected = virtual_work(exact.bladder_energy, exact.volume, p, exact.l0, strain)
    scale = p * exact.r0**2 * math.pi + exact.young * exact.r0 * exact.t0
    assert fam.force(law, p, strain) == pytest.approx(expected, abs=SCALE * scale)


@settings(deadline=None, max_examples=40)
@given(geometries, nodes, shares)
def test_buckled_region_is_virtual_work_of_a_linearly_growing_load(make_fam, geometry, i, share):
    law, exact = make_fam(**geometry)
    p = i * law.pressure_step
    e_b, e_c = exact.buckling(p), exact.collapse(p)
    strain = e_b + share * (e_c - e_b)
    load = exact.euler(p, e_b)

    def energy(e):
        past = e - e_b
        return exact.bladder_energy(e_b) + exact.l0 * load * (past + past**2 / (4.0 * (1.0 - e_b)))

    h = 0.01 * min(share, 1.0 - share) * (e_c - e_b)
    expected = virtual_work(energy, lambda e: exact.volume(e_b), p, exact.l0, strain, h)
    # The oil sees the arc length only, which does not change: no P dV.
    assert fam.force(law, p, strain) == pytest.approx(expected, rel=SCALE)


def collapsed_energy(exact, p):
    """
    Return the energy (J) of a collapsed FAM over strain, counted from its collapse.

    Two rigid links turning by phi against springs k store k phi^2 (equation 4's F_c); what is left
    of the buckled force decays over beta.
    """
    e_b, e_c, k = exact.buckling(p), exact.collapse(p), exact.folding_spring(p)
    arc, beta = exact.l0 * (1.0 - e_b), exact.p['transition_constant']
    at_collapse = exact.euler(p, e_b) * (1.0 + (e_c - e_b) / (2.0 * (1.0 - e_b)))

    def angle(e):
        return math.acos((1.0 - e) / (1.0 - e_b))

    def left_over(e):
        folded = 2.0 * k / arc * angle(e) / math.sin(angle(e))
        return (at_collapse - folded) * math.exp(-beta * (e - e_c))

    def energy(e):
        folded = k * (angle(e) ** 2 - angle(e_c) ** 2)
        return folded + exact.l0 * quad(left_over, e_c, e, epsabs=1e-15, epsrel=1e-13)[0]

    return energy


@settings(deadline=None, max_examples=40)
@given(geometries, nodes, st.floats(0.001, 0.15))
def test_collapsed_region_is_virtual_work_of_folding_links(make_fam, geometry, i, past):
    law, exact = make_fam(**geometry)
    p = i * law.pressure_step
    energy, e_b, strain = collapsed_energy(exact, p), exact.buckling(p), exact.collapse(p) + past
    # beta h = 1e-3: the central difference is good to (beta h)^2 / 6 = 2e-7.
    expected = virtual_work(energy, lambda e: exact.volume(e_b), p, exact.l0, strain, 1e-5)
    assert fam.force(law, p, strain) == pytest.approx(expected, rel=SCALE)


@settings(deadline=None, max_examples=60)
@given(geometries, st.floats(-0.1, 0.4))
def test_mesh_force_is_minus_pressure_times_volume_by_length(make_fam, geometry, strain):
    law, exact = make_fam(**geometry)
    by_length = -virtual_work(lambda e: 0.0, exact.volume, 1.0, -exact.l0, strain, 1e-5)
    assert fam.mesh_coefficient(law, strain) == pytest.approx(by_length, rel=1e-7, abs=1e-12)
    assert fam.volume(law, strain) == pytest.approx(exact.volume(strain), rel=1e-13)


@settings(deadline=None, max_examples=40)
@given(geometries, st.floats(0.0, 0.12), st.floats(0.0, 0.6e6), st.floats(0.0, 0.6e6))
def test_force_is_linear_in_pressure_while_straight(make_fam, geometry, strain, first, second):
    law, _ = make_fam(**geometry)
    base = fam.deslack_pressure(law, strain)
    assume(base < 0.6e6)
    base = max(base, 0.0)

    def rise(pressure):
        return fam.force(law, base + pressure, strain) - fam.force(law, base, strain)

    expected = rise(first) + rise(second)
    assert rise(first + second) == pytest.approx(expected, rel=1e-9, abs=1e-9)
    assert rise(first) == pytest.approx(first * fam.mesh_coefficient(law, strain), abs=1e-9)


def test_bladder_is_relaxed_at_rest_and_resists_both_ways(make_fam):
    for share in (0.0, 0.4, 1.0):
        law, _ = make_fam(mooney_rivlin_share=share)
        assert fam.bladder_force(law, 0.0) == pytest.approx(0.0, abs=1e-12)
        assert fam.bladder_force(law, 0.1) < -10.0
        assert fam.bladder_force(law, -0.1) > 10.0


def test_mooney_share_mixes_neo_hookean_and_pure_second_invariant(make_fam):
    laws = [make_fam(mooney_rivlin_share=s)[0] for s in (0.0, 0.25, 1.0)]
    for strain in np.linspace(-0.1, 0.25, 8):
        first, mixed, second = (fam.bladder_force(law, strain) for law in laws)
        assert mixed == pytest.approx(0.75 * first + 0.25 * second, rel=1e-12, abs=1e-12)
    # Both have the same modulus at rest and part with strain.
    slopes = [fam.bladder_force(law, 1e-6) / 1e-6 for law in laws]
    assert slopes == pytest.approx([slopes[0]] * 3, rel=1e-4)
    assert fam.bladder_force(laws[0], 0.2) != pytest.approx(
        fam.bladder_force(laws[2], 0.2), rel=0.01
    )


@pytest.mark.parametrize('pressure', [0.0, 1.1e5, 5.3e5])
def test_all_lengths_scaled_scale_the_force_with_area(make_fam, pressure):
    size = 1.5
    law, exact = make_fam()
    big, _ = make_fam(
        inner_radius=size * exact.r0, thickness=size * exact.t0, length=size * exact.l0
    )
    for strain in np.linspace(-0.05, 0.3, 30):
        small_force = fam.force(law, pressure, strain)
        assert fam.force(big, pressure, strain) == pytest.approx(size**2 * small_force, rel=1e-8)
        assert fam.volume(big, strain) == pytest.approx(
            size**3 * fam.volume(law, strain), rel=1e-12
        )


def test_pressure_and_moduli_scaled_scale_the_force(make_fam):
    factor = 1.25
    law, exact = make_fam()
    stiff, _ = make_fam(
        youngs_modulus=factor * exact.p['youngs_modulus'],
        end_spring_slope=exact.p['end_spring_slope'] / factor,
    )
    for p in (0.0, 1e5, 4e5):
        for strain in np.linspace(-0.05, 0.3, 30):
            expected = factor * fam.force(law, p, strain)
            assert fam.force(stiff, factor * p, strain) == pytest.approx(expected, rel=2e-5)
