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

"""Motor units in parallel: the sum of their FAMs, its inverse, and what it can reach."""

import dataclasses

from fam_bundle_model import bundle, fam
from fam_bundle_model.parameters import GRAVITY
from fam_bundle_model.schema import ConfigurationError
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

recruited_units = st.integers(1, 2)
pressures = st.floats(5e4, 7e5)


@settings(deadline=None, max_examples=60)
@given(st.tuples(st.floats(0.0, 1e6), st.floats(0.0, 1e6)), st.floats(-0.05, 0.3))
def test_the_bundle_pulls_with_the_sum_of_its_fams(units, applied, strain):
    expected = sum(
        u.fams * fam.force(u.fam, p, strain) for u, p in zip(units, applied, strict=True)
    )
    found = bundle.bundle_force(units, np.array(applied), strain)
    assert found == pytest.approx(expected, rel=1e-13, abs=1e-10)


@settings(deadline=None, max_examples=60)
@given(st.integers(0, 2), pressures, st.floats(-0.05, 0.3))
def test_a_recruitment_state_vents_the_units_that_are_not_recruited(
    units, recruited, pressure, strain
):
    applied = np.array([pressure if i < recruited else 0.0 for i in range(2)])
    expected = bundle.bundle_force(units, applied, strain)
    assert bundle.state_force(units, recruited, pressure, strain) == expected


def test_units_take_their_own_count_and_their_own_fams(configuration):
    mixed = dataclasses.replace(
        configuration.fam, count=(1, 3), inner_radius=(0.0063, 0.005), thickness=(0.0016,)
    )
    first, second = bundle.motor_units(dataclasses.replace(configuration, fam=mixed))
    assert (first.fams, second.fams) == (1.0, 3.0)
    area = fam.mesh_coefficient(second.fam, 0.1) / fam.mesh_coefficient(first.fam, 0.1)
    assert area == pytest.approx((0.005 / 0.0063) ** 2, rel=1e-12)


@settings(deadline=None, max_examples=100)
@given(recruited_units, pressures, st.floats(20.0, 900.0))
def test_modelled_strain_is_where_the_state_holds_the_load(units, recruited, pressure, load):
    strain = bundle.modelled_strain(units, recruited, pressure, load)
    assert fam.lowest_strain(units[0].fam) < strain < bundle.HIGHEST_STRAIN
    assert bundle.state_force(units, recruited, pressure, strain) == pytest.approx(load, abs=1e-6)


@settings(deadline=None, max_examples=100)
@given(recruited_units, st.floats(1.5e5, 7e5), st.floats(0.02, 0.15))
def test_modelled_strain_inverts_the_force_of_the_state(units, recruited, pressure, strain):
    load = bundle.state_force(units, recruited, pressure, strain)
    if load > 30.0:  # clear of the slack units' own fold, where two strains hold the same load
        found = bundle.modelled_strain(units, recruited, pressure, load)
        assert found == pytest.approx(strain, abs=1e-9)


@settings(deadline=None, max_examples=60)
@given(recruited_units, pressures, st.floats(50.0, 900.0), st.floats(1e3, 1e5))
def test_modelled_strain_grows_with_pressure_and_falls_with_load(
    units, recruited, pressure, load, more
):
    strain = bundle.modelled_strain(units, recruited, pressure, load)
    assert bundle.modelled_strain(units, recruited, pressure + more, load) > strain
    assert bundle.modelled_strain(units, recruited, pressure, load + 1e-3 * more) < strain


def test_recruiting_a_unit_helps_only_above_its_deslack_pressure(units):
    strain = 0.1
    taut = fam.deslack_pressure(units[1].fam, strain)
    for pressure, helps in ((0.6 * taut, False), (0.95 * taut, False), (1.1 * taut, True)):
        forces = [bundle.bundle_force(units, np.array([5e5, p]), strain) for p in (pressure, 0.0)]
        alone = units[0].fams * fam.force(units[0].fam, 5e5, strain)
        assert (forces[0] > alone) == helps
        assert forces[1] < alone


def test_modelled_strain_of_a_load_out_of_reach_is_the_end_of_the_bracket(units):
    assert bundle.modelled_strain(units, 1, 3e5, 1e9) == fam.lowest_strain(units[0].fam)
    assert bundle.modelled_strain(units, 2, 3e5, -1e9) == bundle.HIGHEST_STRAIN


def test_searches_stay_within_the_strains_that_a_braid_can_have(units):
    """Stretched until it lies along the axis, a braid has no hoop left: beyond is no FAM."""
    for unit in units:
        longest = 1.0 - 1.0 / unit.fam.cos_squared**0.5
        assert longest < fam.lowest_strain(unit.fam) < 0.0


@settings(deadline=None, max_examples=80)
@given(recruited_units, st.floats(0.0, 0.1), st.floats(10.0, 300.0))
def test_balancing_pressure_holds_the_load(units, recruited, strain, load):
    pressure = bundle.balancing_pressure(units, recruited, strain, load, 1.3e6)
    assert 0.0 < pressure < 1.3e6
    found = bundle.state_force(units, recruited, pressure, strain)
    assert found == pytest.approx(load, abs=1e-7)


def test_balancing_pressure_is_limited_where_the_load_is_out_of_reach(units):
    assert bundle.balancing_pressure(units, 1, 0.0, 1e5, 6e5) == pytest.approx(6e5)
    assert bundle.balancing_pressure(units, 1, 0.0, -1e3, 6e5) == pytest.approx(0.0, abs=1e-6)


def complaint(configuration, units):
    with pytest.raises(ConfigurationError) as refused:
        bundle.check_reachable(configuration, units)
    return str(refused.value)


def test_a_reachable_configuration_passes(configuration, units):
    bundle.check_reachable(configuration, units)


def test_a_load_that_is_never_lifted_is_refused(change, configuration, units):
    nominal = configuration.source.nominal_pressure
    holds = bundle.state_force(units, 2, nominal, 0.0) / GRAVITY
    message = complaint(change('load', mass=1.001 * holds), units)
    assert message.startswith('load.mass = ')
    assert f'{1.001 * holds:g} kg' in message
    assert f'{holds:.4g} kg' in message


def test_a_reference_beyond_reach_is_refused(change, configuration, units):
    weight = configuration.load.mass * GRAVITY
    reach = bundle.modelled_strain(units, 2, configuration.source.nominal_pressure, weight)
    bundle.check_reachable(change('reference', amplitude=0.499 * reach), units)
    message = complaint(change('reference', amplitude=0.501 * reach), units)
    assert message.startswith(f'reference.amplitude = {0.501 * reach:g}: ')
    assert f'must be <= {reach:.4g}' in message


def held_at(change, strain):
    """Return a configuration that begins at ``strain`` and stays there."""
    simulation = change('simulation', initial_strain=strain).simulation
    held = change('reference', kind='samples', times=(0.0, 1.0), strains=(strain, strain))
    return dataclasses.replace(held, simulation=simulation)


def test_a_start_that_the_first_unit_cannot_hold_is_refused(change, configuration, units):
    weight = configuration.load.mass * GRAVITY
    limit = bundle.modelled_strain(units, 1, configuration.source.nominal_pressure, weight)
    bundle.check_reachable(held_at(change, limit - 1e-4), units)
    message = complaint(held_at(change, limit + 1e-3), units)
    assert message.startswith(f'simulation.initial_strain = {limit + 1e-3:g}: ')
    assert f'must be <= {limit:.4g}' in message


def test_a_start_beside_the_reference_is_refused(change, units):
    """The reference would begin with a jump."""
    message = complaint(change('simulation', initial_strain=0.02), units)
    assert message == (
        'simulation.initial_strain = 0.02: must be within 0.001 of 0, where the reference begins'
    )


@pytest.mark.parametrize('kind', ['sine', 'trapezoid', 'steps', 'minimum_jerk', 'chirp', 'ramp'])
def test_every_kind_is_refused_when_its_peak_is_out_of_reach(kind, change, configuration, units):
    highest = bundle.reachable(configuration, units)[1]
    bundle.check_reachable(change('reference', kind=kind, amplitude=0.499 * highest), units)
    message = complaint(change('reference', kind=kind, amplitude=0.501 * highest), units)
    assert f'its peak strain {1.002 * highest:g} must be <= {highest:.4g}' in message


def test_a_load_hangs_at_the_lowest_strain(change, configuration, units):
    """Nothing pushes the bundle longer than it is under the load without any pressure."""
    lowest = bundle.reachable(configuration, units)[0]
    weight = configuration.load.mass * GRAVITY
    assert bundle.state_force(units, 2, 0.0, lowest) == pytest.approx(weight)
    samples = {'kind': 'samples', 'times': (0.0, 1.0, 2.0)}
    within = change('reference', **samples, strains=(0.0, 0.999 * lowest, 0.0))
    bundle.check_reachable(within, units)
    message = complaint(change('reference', **samples, strains=(0.0, 1.001 * lowest, 0.0)), units)
    assert message.startswith(f'reference.strains: its lowest strain {1.001 * lowest:g} ')
