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

"""The outer PI: its sums, its limits, its start and its way out of saturation."""

from pathlib import Path

from fam_bundle_control.strain_loop import (
    strain_loop,
    strain_loop_retuned,
    strain_loop_start,
    strain_loop_step,
    StrainLoop,
    StrainLoopState,
)
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.parameters import GRAVITY, load_configuration
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
DT = 0.001
LAW = StrainLoop(
    proportional=4e7,
    integral=2e7,
    tracking_time=0.05,
    nominal_pressure=7e5,
    by_force=False,
    feedforward=0.0,
    weight=0.0,
)
UNITS = motor_units(load_configuration(CONFIGURATION))


def run(law, errors, source=7e5, start=2e5, state=None):
    """Return the outputs for a sequence of strain errors around a strain of 0.05."""
    state = strain_loop_start() if state is None else state
    outputs = []
    for error in errors:
        measured = (0.05, source, np.array([start, 0.0]))
        state, output = strain_loop_step(law, UNITS, state, 0.05 + error, *measured, DT)
        outputs.append(output)
    return outputs, state


def test_the_law_takes_its_gains_from_the_configuration(configuration):
    gains, law = configuration.strain_loop, strain_loop(configuration)
    assert law == (
        gains.proportional_gain,
        gains.integral_gain,
        gains.tracking_time,
        configuration.source.nominal_pressure,
        False,
        1.0,
        configuration.load.mass * GRAVITY,
    )


@settings(deadline=None, max_examples=60)
@given(st.floats(-0.02, 0.02), st.floats(0.0, 7e5), st.booleans())
def test_the_loop_closes_without_a_bump(error, measured, aggressive):
    law = LAW._replace(proportional=4e8) if aggressive else LAW
    (first,), _ = run(law, [error], start=measured)
    assert first.pressure == pytest.approx(measured, abs=1e-6)
    assert first.error == pytest.approx(error, abs=1e-15)


def test_output_is_the_hand_computed_sum_of_errors():
    errors = 1e-4 * np.sin(np.arange(200) / 17.0)
    outputs, _ = run(LAW, errors)
    bias = 2e5 - 4e7 * errors[0]
    for k, output in enumerate(outputs):
        expected = 4e7 * errors[k] + bias + 2e7 * DT * errors[:k].sum()
        assert output.unlimited == output.pressure == pytest.approx(expected, rel=1e-9)


def test_the_first_units_pressure_matters_at_the_start_only():
    _, state = run(LAW, [1e-4])
    first, second = (run(LAW, [1e-4], start=p, state=state)[0][0] for p in (0.0, 6e5))
    assert first == second


@pytest.mark.parametrize(('source', 'limit'), [(5e5, 5e5), (7e5, 7e5), (9e5, 7e5), (-1e4, 0.0)])
def test_output_stays_within_what_the_source_can_give(source, limit):
    (high,), _ = run(LAW, [1.0], source=source, state=StrainLoopState(0.0, True))
    (low,), _ = run(LAW, [-1.0], source=source, state=StrainLoopState(0.0, True))
    assert high.pressure == limit
    assert low.pressure == 0.0
    assert high.unlimited == pytest.approx(4e7)
    assert low.unlimited == pytest.approx(-4e7)


def test_in_saturation_the_integral_settles_where_the_tracking_holds_it():
    """dI/dt = Ki e + (P_max - Kp e - I) / T has its rest at I = P_max - Kp e + T Ki e."""
    error = 0.01
    _, state = run(LAW, [error] * 10000)
    assert state.integral == pytest.approx(7e5 - 4e7 * error + 0.05 * 2e7 * error, rel=1e-6)


@pytest.mark.parametrize('tracking_time', [0.02, 0.05, 0.2])
def test_the_loop_leaves_saturation_within_the_tracking_time(tracking_time):
    """However long it was saturated, the output comes off its limit when the error turns."""
    law = LAW._replace(tracking_time=tracking_time)
    for seconds in (6, 60):
        before, state = run(law, [0.005] * (1000 * seconds))
        assert before[-1].unlimited > before[-1].pressure
        back, _ = run(law, [-0.0005] * 500, state=state)
        on_limit = sum(o.unlimited > o.pressure for o in back)
        assert on_limit * DT <= tracking_time


def closed_loop(law, seconds=4.0):
    """Return a slow first-order strain under the law, through a reference out of reach for 2 s."""
    state, strain, strains = strain_loop_start(), 0.02, []
    for k in range(int(seconds / DT)):
        reference = 0.2 if k * DT < 2.0 else 0.05
        measured = (strain, 7e5, np.array([1.4e5, 0.0]))
        state, output = strain_loop_step(law, UNITS, state, reference, *measured, DT)
        strain += DT * (output.pressure / 7e6 - strain) / 0.1  # 0.1 at most
        strains.append(strain)
    return np.array(strains)


def test_anti_windup_returns_from_saturation_without_a_long_undershoot():
    law = LAW._replace(proportional=1e7, integral=1e8)
    strain = closed_loop(law)
    assert strain[1999] == pytest.approx(0.1, abs=1e-3)  # saturated: the reference is out of reach
    above = np.flatnonzero(strain[2000:] > 0.055)
    wound_up = np.flatnonzero(closed_loop(law._replace(tracking_time=1e9), 8.0)[2000:] > 0.055)
    assert above.max() * DT < 0.3 < 1.0 < wound_up.max() * DT
    assert strain[-1] == pytest.approx(0.05, abs=1e-3)


@given(
    gain=st.floats(0.0, 1e8),
    integral=st.floats(0.0, 1e9),
    tracking=st.floats(1e-3, 10.0),
    error=st.floats(-0.01, 0.01),
)
@settings(max_examples=50, deadline=None)
def test_new_gains_set_in_without_a_bump(gain, integral, tracking, error):
    errors = [error] * 50
    _, state = run(LAW, errors)
    before, _ = run(LAW, [error], state=state)
    law = LAW._replace(proportional=gain, integral=integral, tracking_time=tracking)
    after, _ = run(law, [error], state=strain_loop_retuned(state, error, LAW, law))
    assert after[0].unlimited == pytest.approx(before[0].unlimited, rel=1e-12, abs=1e-6)
    bumped, _ = run(law, [error], state=state)
    jump = (gain - LAW.proportional) * error
    assert bumped[0].unlimited - after[0].unlimited == pytest.approx(jump, rel=1e-9, abs=1e-6)
