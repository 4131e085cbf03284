# SPDX-License-Identifier: Apache-2.0
"""A motor unit may be recruited while the one before it still fills."""

from pathlib import Path

from fam_bundle_bringup.experiment import checked_configuration
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.trace import Trace
from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.parameters import Configuration
import numpy as np
import pytest

CONFIG = Path(__file__).parents[1] / 'ros2_ws' / 'src' / 'fam_bundle_bringup' / 'config'
# Held where two units are enough, then in a fifth of a second to where all four are needed.
JUMP = {
    'kind': 'samples',
    'times': [0.0, 1.0, 1.5, 1.7, 3.0],
    'strains': [0, 0.04, 0.04, 0.12, 0.12],
}


def run(minimum_dwell: float) -> tuple[Configuration, Trace]:
    changes = {'reference': JUMP, 'recruitment': {'minimum_dwell': minimum_dwell}}
    configuration = checked_configuration(CONFIG / 'four_units.yaml', changes, offline=True)
    return configuration, run_offline(configuration)


def slack_at_upshifts(configuration: Configuration, trace: Trace) -> list[float]:
    """Return the newest unit's share of its de-slack pressure as the next one is recruited."""
    units, state = motor_units(configuration), trace['recruitment_state']
    shares = []
    for tick in np.flatnonzero(np.diff(state) > 0) + 1:
        newest = state[tick - 1] - 1
        if newest > 0:
            deslack = fam.deslack_pressure(units[newest].fam, trace['strain'][tick])
            shares.append(trace['mu_pressure'][tick, newest] / deslack)
    return shares


@pytest.fixture(scope='module')
def hasty() -> tuple[Configuration, Trace]:
    return run(minimum_dwell=0.02)


def test_a_unit_is_recruited_before_the_last_one_is_taut(
    hasty: tuple[Configuration, Trace],
) -> None:
    shares = slack_at_upshifts(*hasty)
    assert len(shares) == 2
    assert min(shares) < 0.5


def test_the_ladder_is_climbed_one_by_one_meanwhile_and_nothing_diverges(
    hasty: tuple[Configuration, Trace],
) -> None:
    configuration, trace = hasty
    state = trace['recruitment_state']
    assert state[[0, -1]].tolist() == [1, 4]
    assert set(np.diff(state).tolist()) == {0, 1}
    assert all(np.isfinite(trace[name]).all() for name in ('strain', 'mu_pressure', 'spool'))
    assert trace['mu_pressure'].max() <= configuration.source.nominal_pressure
    # Both units become taut, and all four share the load evenly.
    units, last = motor_units(configuration), trace['mu_pressure'][-1]
    deslack = [fam.deslack_pressure(unit.fam, trace['strain'][-1]) for unit in units]
    assert (last > deslack).all()
    assert last == pytest.approx(np.full(4, last.mean()), rel=0.02)
    # So fast a jump drives the strain loop into its limit, from which it comes back slowly.
    error = np.abs(trace['strain_reference'] - trace['strain'])
    assert error[-1] < error[-500] < error[-1000] < error.max() < 0.08


def test_the_shipped_dwell_keeps_shifts_apart() -> None:
    shares = slack_at_upshifts(*run(minimum_dwell=0.3))
    assert shares
    assert min(shares) > 1.0
