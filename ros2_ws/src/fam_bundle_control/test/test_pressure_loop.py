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

"""The inner loops: who follows what, who is vented, and what is said of the limit."""

from pathlib import Path

from fam_bundle_control.allocation import BATCH, FORCE, is_compensated
from fam_bundle_control.pressure_loop import pressure_loop_step, PressureLoop
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.parameters import load_configuration
from fam_bundle_model.pressure_pi import PressureGains
import numpy as np
import pytest

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
DT = 0.001
GAINS = PressureGains(5e-6, 2e-6, 0.3)
UNIT = motor_units(load_configuration(CONFIGURATION))[0]


class Loops:
    """The inner loops of ``count`` units, their pressures given."""

    def __init__(self, count, gains=None, allocation=BATCH):
        self.law = PressureLoop(gains or (GAINS,) * count, allocation, 7e5)
        self.units = (UNIT,) * count
        self.integral = np.zeros(count)
        self.references, self.spool = np.full((2, count), np.nan)
        self.saturated = np.zeros(count, dtype=bool)

    def step(self, recruited, pressures, reference=4e5, compensation=0.0, source=6.5e5):
        pressure_loop_step(
            self.law,
            self.units,
            self.integral,
            recruited,
            reference,
            compensation,
            0.05,
            source,
            np.array(pressures, dtype=float),
            DT,
            self.references,
            self.spool,
            self.saturated,
        )
        return self


def test_recruited_units_follow_and_the_others_are_vented():
    loops = Loops(3).step(2, [3.5e5, 0.0, 1e5])
    assert loops.references.tolist() == [4e5, 4e5, 0.0]
    assert loops.spool == pytest.approx([0.25, 1.0, -0.5])
    assert loops.saturated.tolist() == [False, True, False]


@pytest.mark.parametrize(
    ('recruited', 'compensated'),
    [(1, [True, False, False]), (2, [True, False, False]), (3, [True, True, False])],
)
def test_only_units_before_the_newest_are_compensated(recruited, compensated):
    assert [is_compensated(i, recruited) for i in range(3)] == compensated
    loops = Loops(3).step(recruited, [0.0] * 3, compensation=5e4)
    expected = [(4.5e5 if c else 4e5) if i < recruited else 0.0 for i, c in enumerate(compensated)]
    assert loops.references.tolist() == expected


@pytest.mark.parametrize(
    ('reference', 'source', 'applied'),
    [(6e5, 6.2e5, 6.2e5), (9e5, 6.2e5, 6.2e5), (-2e5, 6e5, 0.0), (4e5, -1.0, 0.0)],
)
def test_references_are_clamped_between_zero_and_the_source(reference, source, applied):
    loops = Loops(2).step(2, [0.0, 0.0], reference, 5e4, source)
    assert loops.references[0] == applied


def test_the_spool_is_the_hand_computed_sum_of_errors():
    loops, pressures = Loops(2), 4e5 - 3e4 * np.cos(np.arange(300) / 40.0)
    total = 0.0
    for p in pressures:
        loops.step(1, [p, 0.0])
        assert loops.spool[0] == pytest.approx(5e-6 * (4e5 - p) + total, abs=1e-12)
        assert not loops.saturated[0]
        total += 2e-6 * (4e5 - p) * DT


@pytest.mark.parametrize(('pressure', 'limit'), [(0.0, 1.0), (6.2e5, -1.0)])
def test_a_limited_spool_says_so_and_does_not_wind_up(pressure, limit):
    loops = Loops(1)
    for _ in range(1000):
        loops.step(1, [pressure])
    assert loops.spool[0] == limit
    assert loops.saturated[0]
    assert loops.integral[0] == 0.0


def test_the_integral_share_is_limited():
    loops = Loops(1)
    for _ in range(20000):
        loops.step(1, [3.5e5])
    assert loops.integral[0] == GAINS.integral_limit
    assert loops.spool[0] == pytest.approx(0.25 + GAINS.integral_limit)


def test_a_unit_is_recruited_without_what_it_integrated_while_vented():
    loops = Loops(2)
    for _ in range(2000):
        loops.step(1, [4e5, 2e4])  # the vented unit keeps some pressure
    at_shift = loops.step(2, [4e5, 2e4], reference=1e5).spool[1]
    # 2 s at 2e4 Pa would have left 0.08; the last tick's share, 4e-5, may stay.
    assert at_shift == pytest.approx(0.4, abs=1e-4)


def test_units_do_not_see_each_other():
    together = Loops(2).step(2, [1e5, 3e5]).spool.copy()
    swapped = Loops(2).step(2, [3e5, 1e5]).spool
    assert together.tolist() == swapped[::-1].tolist()


def test_each_unit_has_its_own_gains():
    small, large = GAINS._replace(proportional=2e-6), GAINS._replace(integral_limit=0.1)
    together = Loops(2, (small, large))
    alone = Loops(1, (small,)), Loops(1, (large,))
    for _ in range(20000):
        together.step(2, [3.5e5, 3.7e5])
        for loop, pressure in zip(alone, (3.5e5, 3.7e5), strict=True):
            loop.step(1, [pressure])
    assert together.spool.tolist() == [loop.spool[0] for loop in alone]
    assert together.integral.tolist() == [GAINS.integral_limit, 0.1]


@pytest.mark.parametrize('pressure', [-2e4, 2e4])
def test_by_force_a_vented_unit_is_open_to_the_tank_whatever_its_pressure(pressure):
    """Below the tank's pressure the tank fills it: nothing is taken from the source."""
    loops = Loops(2, allocation=FORCE).step(1, (4e5, pressure))
    assert loops.spool[1] == pytest.approx(-GAINS.proportional * 2e4)


@pytest.mark.parametrize('allocation', [BATCH, FORCE])
def test_more_recruited_units_than_there_are_mean_all(allocation):
    all_of_them = Loops(2, allocation=allocation).step(2, (4e5, 4e5))
    too_many = Loops(2, allocation=allocation).step(4_000_000_000, (4e5, 4e5))
    assert too_many.references.tolist() == all_of_them.references.tolist()
