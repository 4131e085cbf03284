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

"""Shifts where the strain is expected to turn: what constant rate cannot see."""

import math

from fam_bundle_control.predictors import CONSTANT_RATE, SINUSOID
from fam_bundle_model.bundle import modelled_strain
import numpy as np
import pytest

DT, LAG = 0.001, 0.5
SPEED = 2.0 * math.pi * 0.3  # rad/s
FORCE, SOURCE = 180.0, 650e3


@pytest.fixture
def swinging(supervise, law, constant_table, units):
    """
    Return a maker of a supervisor before the end of a swing of the strain about its limit.

    Of two units the first is recruited, or both; what the first can hold stands ``above`` the
    middle of the swing, over its amplitude. The swing ends at ``phase`` (rad; 0 on the way up),
    and no shift has been possible before.
    """

    def make(kind, above, phase, recruited=1):
        limit = modelled_strain(units, 1, SOURCE, FORCE)
        amplitude = 0.04
        supervisor = supervise(law('lag', kind=kind), constant_table(math.inf))
        pressures = (5e5, 6e5 if recruited == 2 else 0.0)
        turn = phase + 8.0 * math.pi
        for angle in np.arange(turn % (SPEED * DT), turn, SPEED * DT):
            strain = limit + amplitude * (math.sin(angle) - above)
            supervisor.step(strain=strain, force=FORCE, source=SOURCE, pressures=pressures)
        assert supervisor.state.recruited == recruited
        supervisor.table = constant_table(LAG)
        return supervisor

    return make


def shifted(supervisor):
    """Return the recruited units and the filtered strain rate after one more tick."""
    output = supervisor.step()
    return output.recruited, output.strain_rate


def test_a_peak_that_is_over_before_the_unit_is_taut_needs_none(swinging):
    """Above the limit for 0.45 s, 0.05 s of which have passed; the unit would take 0.5 s."""
    above = math.cos(0.225 * SPEED)
    phase = 0.5 * math.pi - 0.175 * SPEED
    assert shifted(swinging(CONSTANT_RATE, above, phase))[0] == 2
    recruited, rate = shifted(swinging(SINUSOID, above, phase))
    assert recruited == 1
    assert rate > 0.0
    # One that lasts for 1.2 s is met by both.
    above, phase = math.cos(0.6 * SPEED), 0.5 * math.pi - 0.55 * SPEED
    for kind in (CONSTANT_RATE, SINUSOID):
        assert shifted(swinging(kind, above, phase))[0] == 2


def test_a_strain_that_falls_yet_but_will_rise_over_the_limit_is_met(swinging):
    """The valley is 0.1 s away, and the limit is passed 0.2 s after it."""
    above, phase = -math.cos(0.2 * SPEED), 1.5 * math.pi - 0.1 * SPEED
    assert shifted(swinging(CONSTANT_RATE, above, phase))[0] == 1
    recruited, rate = shifted(swinging(SINUSOID, above, phase))
    assert recruited == 2
    assert rate < 0.0


def test_a_unit_that_is_soon_needed_again_is_not_released(swinging):
    """Falling slowly just before a valley, out of which the limit is passed within the lag."""
    above, phase = -math.cos(0.4 * SPEED), 1.5 * math.pi - 0.08 * SPEED
    released = swinging(CONSTANT_RATE, above, phase, recruited=2)
    assert released.state.armed
    assert shifted(released)[0] == 1
    assert shifted(swinging(SINUSOID, above, phase, recruited=2))[0] == 2
