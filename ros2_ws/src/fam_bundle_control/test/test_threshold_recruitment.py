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

"""Threshold recruitment (Figure 4): up at 80 % of the first unit, down at 40 % of the newest."""

from fam_bundle_control.recruitment import recruitment, recruitment_start
from fam_bundle_model import fam
import numpy as np
import pytest

UP, DOWN = 500e3, 250e3  # the thresholds of conftest.py's law


@pytest.fixture
def supervisor(supervise, law, constant_table):
    return supervise(law('baseline'), constant_table(0.2))


def test_thresholds_are_shares_of_the_nominal_pressure(configuration):
    law, p = recruitment(configuration), configuration.recruitment
    nominal = configuration.source.nominal_pressure
    assert law.upshift_pressure == p.upshift_threshold * nominal
    assert law.downshift_pressure == p.downshift_threshold * nominal


def test_starts_with_one_unit(supervisor):
    assert supervisor.step().recruited == 1


def test_the_upshift_comes_exactly_at_its_threshold(supervisor):
    assert supervisor.step(10, pressures=(np.nextafter(UP, 0.0), 0.0)).recruited == 1
    assert supervisor.step(pressures=(UP, 0.0)).recruited == 2


def test_only_the_first_units_pressure_shifts_up(supervisor):
    supervisor.step()
    assert supervisor.step(10, pressures=(0.5 * UP, 2.0 * UP)).recruited == 1


def shifted_up(supervisor):
    supervisor.step(pressures=(UP, 0.0))
    assert supervisor.state.recruited == 2
    return supervisor


def test_the_downshift_waits_until_the_unit_has_been_filled(supervisor):
    """The second unit starts below the threshold: it must exceed it before that counts."""
    shifted_up(supervisor)
    for pressure in (0.0, 0.5 * DOWN, DOWN, DOWN):  # at the threshold is not above it
        assert supervisor.step(5, pressures=(UP, pressure)).recruited == 2
    assert not supervisor.state.armed
    supervisor.step(pressures=(0.8 * UP, np.nextafter(DOWN, 1e9)))
    assert supervisor.state.armed
    assert supervisor.step(pressures=(0.8 * UP, DOWN)).recruited == 1


def test_the_downshift_comes_exactly_at_its_threshold(supervisor):
    shifted_up(supervisor)
    above = np.nextafter(DOWN, 1e9)
    assert supervisor.step(20, pressures=(0.8 * UP, above)).recruited == 2
    assert supervisor.step(pressures=(0.8 * UP, DOWN)).recruited == 1


def test_every_upshift_disarms_the_downshift(supervisor):
    for _ in range(2):
        shifted_up(supervisor)
        assert supervisor.step(5, pressures=(0.8 * UP, 0.0)).recruited == 2
        supervisor.step(pressures=(0.8 * UP, 2.0 * DOWN))
        assert supervisor.step(pressures=(0.8 * UP, 0.5 * DOWN)).recruited == 1


def test_no_shift_beyond_the_last_unit_nor_below_the_first(supervisor):
    shifted_up(supervisor)
    assert supervisor.step(50, pressures=(2.0 * UP, 2.0 * UP)).recruited == 2
    assert supervisor.step(50, pressures=(0.0, 0.0)).recruited == 1


def test_neither_lag_nor_strain_rate_matters(supervise, law, constant_table):
    supervisor = supervise(law('baseline'), constant_table(np.inf))
    assert supervisor.move(0.5, 30, pressures=(0.9 * UP, 0.0)).recruited == 1
    assert supervisor.step(pressures=(UP, 0.0)).recruited == 2


def test_a_dwell_holds_the_downshift(supervise, law, constant_table):
    supervisor = supervise(law('baseline', minimum_dwell=0.1), constant_table(0.2))
    supervisor.step(101, pressures=(0.0, 0.0))
    shifted_up(supervisor)
    supervisor.step(pressures=(0.8 * UP, 2.0 * DOWN))
    assert supervisor.step(95, pressures=(0.8 * UP, 0.5 * DOWN)).recruited == 2
    assert supervisor.step(8).recruited == 1


def test_the_predictions_are_made_all_the_same(supervisor):
    output = supervisor.move(0.02, 200, pressures=(4e5, 0.0))
    assert 0.0 < output.time_to_saturation < np.inf
    assert output.recruitment_lag == pytest.approx(0.2)
    assert output.pressure_compensation == 0.0


def test_noise_of_a_pressure_sensor_is_no_tautness(supervisor):
    """
    Up to strain zero the de-slack pressure is at most zero: any noise is above it.

    Below, an empty FAM even carries by its bladder.
    """
    for strain in (0.0, -0.02):
        supervisor.state = recruitment_start()
        assert supervisor.step(strain=strain, pressures=(165e3, 2e3)).recruited == 1


@pytest.mark.parametrize('taut', [1, 2])
def test_a_start_in_mid_run_goes_on_with_the_units_that_are_taut(supervisor, taut):
    deslack = fam.deslack_pressure(supervisor.units[1].fam, 0.05)
    second = np.nextafter(deslack, 0.0 if taut == 1 else 1e6)
    assert supervisor.step(pressures=(400e3, second)).recruited == taut
