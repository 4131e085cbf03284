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

"""What each unit is asked for: force balances, limits, starts without a bump."""

import dataclasses

from fam_bundle_control.allocation import (
    allocate,
    BATCH,
    common_pressure,
    FORCE,
    ORDERLY,
    taut_force,
)
from fam_bundle_control.recruitment import attainable_pressure, recruitment
from fam_bundle_control.strain_loop import strain_loop, strain_loop_start, strain_loop_step
from fam_bundle_model import fam
from fam_bundle_model.bundle import bundle_force, motor_units
from fam_bundle_model.hydraulics import hydraulic_law, line_loss, unit_flow
from fam_bundle_model.parameters import AllocationParameters
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

NOMINAL = 689.5e3
STRAINS = st.floats(0.0, 0.13)
POLICIES = pytest.mark.parametrize('policy', [FORCE, ORDERLY])


@pytest.fixture(scope='session')
def bundle(configuration):
    """Return three units of unequal size."""
    fams = dataclasses.replace(configuration.fam, count=(1, 2, 3))
    return motor_units(dataclasses.replace(configuration, fam=fams))


def references(policy, units, recruited, demand, strain, pressures, source=NOMINAL, added=0.0):
    """Return the references for a demand given as pressure of all units."""
    asked = np.empty(len(units))
    measured = np.asarray(pressures, dtype=float)
    allocate(policy, units, NOMINAL, recruited, demand, added, strain, source, measured, asked)
    return asked


def settled(policy, units, recruited, demand, strain, pressures):
    """Return the references once the inner loops have followed them."""
    pressures = np.array(pressures, dtype=float)
    for _ in range(50):
        asked = references(policy, units, recruited, demand, strain, pressures)
        pressures[:recruited] = asked[:recruited]
    return asked


def test_batch_is_the_paper(bundle):
    asked = references(BATCH, bundle, 2, 4e5, 0.05, (4e5, 1e5, 0.0), 5.5e5, added=2e5)
    assert asked.tolist() == [5.5e5, 4e5, 0.0]


@POLICIES
@settings(deadline=None, max_examples=200)
@given(
    strain=STRAINS,
    share=st.floats(0.01, 0.99),
    recruited=st.integers(1, 3),
    left=st.floats(0.0, 2e5),
)
def test_the_recruited_units_give_the_force_demanded(
    bundle, policy, strain, share, recruited, left
):
    """
    Whatever is recruited, the bundle has the force of all units at the pressure demanded.

    The demand is a share of what the recruited units can do. A released unit that still holds
    pressure is reckoned with.
    """
    full = np.where(np.arange(3) < recruited, NOMINAL, left)
    most = taut_force(bundle[:recruited], NOMINAL, strain)
    wanted = share * most + bundle_force(bundle, full, strain) - most
    demand = common_pressure(bundle, 0, 3, wanted, strain)
    asked = settled(policy, bundle, recruited, demand, strain, full)
    reached = np.where(np.arange(3) < recruited, asked, left)
    assert bundle_force(bundle, reached, strain) == pytest.approx(wanted, abs=1e-6)


@settings(deadline=None, max_examples=200)
@given(strain=st.floats(0.02, 0.12), demand=st.floats(2e5, 4e5), fill=st.floats(0.0, 1.0))
def test_by_force_the_first_units_make_up_for_the_one_that_fills(bundle, strain, demand, fill):
    """While the newest is anywhere between empty and full, the sum is the force demanded."""
    end = settled(FORCE, bundle, 2, demand, strain, (3e5, 3e5, 0.0))
    filling = fill * end[1]
    asked = references(FORCE, bundle, 2, demand, strain, (3e5, filling, 0.0))
    assume(asked[0] < NOMINAL)
    assume(asked[0] > fam.deslack_pressure(bundle[0].fam, strain))
    force = bundle_force(bundle, np.array([asked[0], filling, 0.0]), strain)
    assert force == pytest.approx(taut_force(bundle, demand, strain), abs=1e-6)
    assert asked[1] == pytest.approx(end[1])


@pytest.mark.parametrize(('second', 'third'), [(2e4, 0.0), (1.5e5, 2e4), (2.2e5, 1e5)])
@POLICIES
def test_a_shift_may_begin_while_another_completes(bundle, policy, second, third):
    """Two units fill at once: the first one makes up for both."""
    strain, demand, source = 0.06, 1.9e5, 6.895e5
    pressures = (3e5, second, third)
    asked = references(policy, bundle, 3, demand, strain, pressures, source)
    assert asked[0] < source, 'what follows is no matter of the limit'
    given = bundle_force(bundle, np.array([asked[0], second, third]), strain)
    wanted = taut_force(bundle, demand, strain)
    full = 0.9 * demand if policy == FORCE else fam.deslack_pressure(bundle[1].fam, strain)
    if second < full:
        assert given == pytest.approx(wanted, abs=1e-6)
    if policy == FORCE:
        assert asked[2] == pytest.approx(demand)
        assert asked[1] == (asked[2] if second < full else asked[0])


def test_by_force_recruited_units_end_at_one_pressure(bundle):
    asked = settled(FORCE, bundle, 3, 3e5, 0.06, (0.0, 0.0, 0.0))
    assert asked == pytest.approx([3e5] * 3)


def test_orderly_holds_the_first_units_at_saturation_and_controls_the_newest(bundle):
    source = 6e5
    pressures = (source, 3e5, 0.0)
    asked = references(ORDERLY, bundle, 2, 3e5, 0.06, pressures, source)
    assert asked[0] == NOMINAL, 'above the source: its valve stays open'
    force = bundle_force(bundle, np.array([source, asked[1], 0.0]), 0.06)
    assert force == pytest.approx(taut_force(bundle, 3e5, 0.06))
    little = settled(ORDERLY, bundle, 2, 2e5, 0.06, (3e5, 3e5, 0.0))
    deslack = fam.deslack_pressure(bundle[1].fam, 0.06)
    assert little[1] == pytest.approx(deslack), 'never let go slack'
    assert little[0] < source


@settings(deadline=None, max_examples=50)
@given(strain=STRAINS, pressure=st.floats(0.0, 7e5))
def test_common_pressure_is_the_inverse_of_the_force(bundle, strain, pressure):
    force = taut_force(bundle, pressure, strain)
    assert common_pressure(bundle, 0, 3, force, strain) == pytest.approx(pressure, abs=1e-3)


def test_a_shift_leaves_the_force_demanded_as_it_was(bundle):
    """The first unit alone, then with an empty second one: it goes on with what it had."""
    strain, demand = 0.05, 1e5
    alone = settled(FORCE, bundle, 1, demand, strain, (0.0, 0.0, 0.0))
    shifted = references(FORCE, bundle, 2, demand, strain, alone)
    assert shifted[0] == pytest.approx(alone[0])


# ---- The strain loop beside it ----


def by_force(configuration, feedforward):
    allocation = AllocationParameters(policy='force', feedforward=feedforward)
    return strain_loop(dataclasses.replace(configuration, allocation=allocation))


@pytest.mark.parametrize('feedforward', [0.0, 1.0])
def test_the_loop_closes_at_the_measured_force(configuration, units, feedforward):
    law = by_force(configuration, feedforward)
    pressures = np.array([4e5, 0.0])
    _, output = strain_loop_step(
        law, units, strain_loop_start(), 0.06, 0.05, 6.5e5, pressures, 1e-3
    )
    held = taut_force(units, output.pressure, 0.05)
    assert held == pytest.approx(bundle_force(units, pressures, 0.05))


@settings(deadline=None, max_examples=40)
@given(strain=STRAINS)
def test_what_is_fed_forward_balances_the_load(configuration, units, strain):
    """At the reference, with the integral share at zero, nothing is left for the loop to do."""
    law = by_force(configuration, 1.0)
    at_rest = strain_loop_start()._replace(started=True)
    _, output = strain_loop_step(law, units, at_rest, strain, strain, 7e5, np.zeros(2), 1e-3)
    assert taut_force(units, output.pressure, strain) == pytest.approx(law.weight)


# ---- The prediction beside it ----


@settings(deadline=None, max_examples=60)
@given(flow=st.floats(1e-8, 3e-4))
def test_line_loss_is_the_inverse_of_the_flow_through_an_open_valve(configuration, flow):
    law = hydraulic_law(configuration)
    loss = line_loss(law, flow)
    assert unit_flow(law, 1.0, 2e5 + loss, 2e5) == pytest.approx(flow, rel=1e-9)
    assert line_loss(law, -flow) == -loss


def test_own_flow_and_reserve_lower_what_can_be_held(configuration, units):
    """The oil that a contraction takes in is the change of volume, by finite differences."""
    law = recruitment(
        dataclasses.replace(configuration, allocation=AllocationParameters(policy='force'))
    )
    strain, rate, step = 0.06, 0.05, 1e-6
    volumes = [fam.volume(units[0].fam, strain + s) for s in (-step, step)]
    flow = units[0].fams * rate * (volumes[1] - volumes[0]) / (2.0 * step)
    held = attainable_pressure(law, units, 1, 6.5e5, 1e5, 1e4, strain, rate)
    assert held == pytest.approx(5.4e5 - line_loss(law.supply, flow), rel=1e-6)
    careful = law._replace(reserve=3e4)
    assert attainable_pressure(careful, units, 1, 6.5e5, 1e5, 1e4, strain, rate) == held - 3e4
    paper = recruitment(configuration)
    assert attainable_pressure(paper, units, 1, 6.5e5, 1e5, 1e4, strain, rate) == 5.4e5
