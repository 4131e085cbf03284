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

"""Pressure compensation (equations 9-11): what the slack units cost, the taut ones add."""

import dataclasses
import math

from fam_bundle_control.recruitment import compensating_pressure
from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

strains = st.floats(0.01, 0.15)


def force(unit, pressure, strain):
    return unit.fams * fam.force(unit.fam, pressure, strain)


@settings(deadline=None, max_examples=100)
@given(strains, st.floats(1.01, 2.5), st.floats(0.0, 0.999), st.integers(1, 2))
def test_the_first_unit_makes_up_for_the_second(units, strain, surplus, share, recruited):
    """Equations 10 and 11: F_1(P_1 + P_comp) - F_1(P_1) = -F_2(P_2)."""
    first, second = units
    pressure = surplus * fam.deslack_pressure(first.fam, strain)
    slack = share * fam.deslack_pressure(second.fam, strain)
    added = compensating_pressure(units, recruited, np.array([pressure, slack]), strain)
    gained = force(first, pressure + added, strain) - force(first, pressure, strain)
    assert added > 0.0
    assert gained == pytest.approx(-force(second, slack, strain), rel=1e-9, abs=1e-9)


@settings(deadline=None, max_examples=60)
@given(strains, st.floats(1.0, 2.0))
def test_nothing_is_added_once_the_second_unit_is_taut(units, strain, share):
    taut = share * fam.deslack_pressure(units[1].fam, strain)
    assume(taut >= fam.deslack_pressure(units[1].fam, strain))
    assert compensating_pressure(units, 2, np.array([6e5, taut]), strain) == 0.0


def test_compensation_fades_out_without_a_jump(units):
    strain = 0.1
    taut = fam.deslack_pressure(units[1].fam, strain)
    gaps = [1e3, 1e1, 1e-1]
    added = [compensating_pressure(units, 2, np.array([6e5, taut - g]), strain) for g in gaps]
    assert added == pytest.approx([1e3, 1e1, 1e-1], rel=1e-3)  # equal units: pressure for pressure


def test_a_vented_unit_resists_as_at_zero_pressure(units):
    strain = 0.08
    at_zero = compensating_pressure(units, 1, np.array([6e5, 0.0]), strain)
    below = compensating_pressure(units, 1, np.array([6e5, -5e3]), strain)
    assert at_zero == below > 0.0


def test_no_taut_unit_means_no_compensation(units):
    assert compensating_pressure(units, 2, np.array([1e3, 0.0]), 0.1) == 0.0
    assert compensating_pressure(units, 2, np.zeros(2), 0.1) == 0.0


def test_a_unit_that_is_not_recruited_is_not_asked_to_help(units):
    """Trapped oil keeps it taut for a moment after the downshift."""
    assert compensating_pressure(units, 1, np.array([1e3, 6e5]), 0.1) == 0.0


def test_unequal_units_share_by_their_fams(configuration):
    mixed = dataclasses.replace(configuration.fam, count=(1, 4))
    first, second = pair = motor_units(dataclasses.replace(configuration, fam=mixed))
    added = compensating_pressure(pair, 1, np.array([6e5, 0.0]), 0.1)
    gained = force(first, 6e5 + added, 0.1) - force(first, 6e5, 0.1)
    assert gained == pytest.approx(-force(second, 0.0, 0.1), rel=1e-9)


def test_compensation_is_finite_at_every_strain_of_a_run(units):
    for strain in np.linspace(-0.02, 0.2, 45):
        added = compensating_pressure(units, 1, np.array([6.8e5, 0.0]), strain)
        assert math.isfinite(added)
        assert added >= 0.0


def test_only_the_pressure_schemes_compensate(supervise, law, constant_table):
    for scheme in ('baseline', 'lag', 'pressure', 'lag_pressure'):
        supervisor = supervise(law(scheme), constant_table(math.inf))
        added = supervisor.step(strain=0.08, pressures=(5e5, 0.0)).pressure_compensation
        assert (added > 0.0) == scheme.endswith('pressure')
