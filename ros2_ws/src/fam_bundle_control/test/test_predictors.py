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

"""What is expected of the strain, by each predictor, on motions whose future is known."""

import dataclasses
import math

from fam_bundle_control.predictors import (
    CONSTANT_ACCELERATION,
    CONSTANT_RATE,
    course_of,
    expected_strain,
    FAR,
    modelled,
    Predictor,
    predictor,
    predictor_start,
    predictor_step,
    PREVIEW,
    REACH,
    SINUSOID,
    stays_above,
    STEPS,
    time_to_fall,
    time_to_rise,
)
from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import PREDICTORS
from fam_bundle_model.reference import reference_law, still, strain_reference
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import brentq

DT, HORIZON, SLOW = 1e-3, 0.3, 1e-3
KINDS = range(len(PREDICTORS))
STILL = still()
AHEAD = np.linspace(0.0, FAR, STEPS + 1)


def law_of(kind, horizon=HORIZON):
    return Predictor(kind, 0.027, SLOW, horizon)


@compiled
def follow(law, state, reference, start, strains, steps):
    """Return the state after ``strains``, and at each the expectation and the error."""
    expected, errors = np.empty(len(strains)), np.empty(len(strains))
    time = start
    for k in range(len(strains)):
        time += steps[k]
        state = predictor_step(law, state, reference, time, strains[k], steps[k])
        expected[k] = expected_strain(law, state, reference, law.horizon)
        errors[k] = state.error
    return state, expected, errors


def after(kind, strains, reference=STILL, horizon=HORIZON):
    """Return state, expectations and errors after ``strains``, the first at 0 s."""
    strains = np.array(strains, dtype=float)
    steps = np.full(len(strains), DT)
    return follow(law_of(kind, horizon), predictor_start(), reference, -DT, strains, steps)


def rms(values):
    return math.sqrt(np.mean(np.square(values)))


def sine(configuration, frequency, amplitude=0.06, cycles=100):
    parameters = dataclasses.replace(
        configuration.reference, frequency=frequency, amplitude=amplitude, cycles=cycles
    )
    return reference_law(parameters)


def turning(velocity, acceleration, frequency, position=0.05):
    """Return the state of a sinusoid that is trusted fully; SI units, rad/s."""
    start = predictor_start()
    known = start.sinusoid._replace(
        velocity=velocity, acceleration=acceleration, angular_frequency=frequency
    )
    return start._replace(
        strain=position,
        strain_rate=velocity,
        position=position,
        velocity=velocity,
        acceleration=acceleration,
        sinusoid=known,
        weight=1.0,
        started=True,
    )


SINUSOIDS = st.builds(
    turning,
    st.floats(-0.1, 0.1),
    st.floats(-0.2, 0.2),
    st.floats(0.2, 3.0),
)


# ---- Motions that a predictor knows ----


def test_constant_rate_is_exact_on_a_line():
    strains = 0.02 + 0.01 * np.arange(3000) * DT
    _, expected, errors = after(CONSTANT_RATE, strains)
    assert expected[1000:] == pytest.approx(strains[1000:] + 0.01 * HORIZON, abs=1e-12)
    assert errors[1000:] == pytest.approx(0.0, abs=1e-12)


def test_constant_acceleration_is_exact_on_a_parabola():
    time = np.arange(20000) * DT
    strains = 0.02 + 0.01 * time - 5e-4 * time**2
    state, expected, _ = after(CONSTANT_ACCELERATION, strains)
    law, now = law_of(CONSTANT_ACCELERATION), time[-1]
    for ahead in (0.0, 0.1, HORIZON, REACH):
        then = 0.02 + 0.01 * (now + ahead) - 5e-4 * (now + ahead) ** 2
        assert modelled(course_of(law, state, STILL), 0.0, ahead) == pytest.approx(then, abs=1e-9)
    assert expected[-1] == pytest.approx(
        modelled(course_of(law, state, STILL), 0.0, HORIZON), abs=1e-6
    )


def test_a_parabola_goes_on_as_a_line_beyond_its_reach():
    state = predictor_start()._replace(position=0.05, velocity=0.02, acceleration=-0.3)
    law = law_of(CONSTANT_ACCELERATION)
    ahead = np.array([0.0, REACH, REACH + 0.5, REACH + 1.0])
    near, reach, far, farther = (modelled(course_of(law, state, STILL), 0.0, t) for t in ahead)
    assert near == 0.05
    assert reach == pytest.approx(0.05 + 0.02 * REACH - 0.15 * REACH**2)
    assert far - reach == pytest.approx((0.02 - 0.3 * REACH) * 0.5)
    assert farther - far == pytest.approx(far - reach)


@pytest.mark.parametrize('frequency', [0.03, 0.1, 0.3, 0.5])
@pytest.mark.parametrize('phase', [0.0, 2.0])
def test_the_sinusoid_is_found_within_a_cycle_and_a_quarter(frequency, phase):
    """Offset, amplitude, frequency and phase, from a start with a kink; none is given."""
    w, offset, amplitude = 2.0 * math.pi * frequency, 0.08, 0.05
    time = np.arange(round(1.25 / frequency / DT)) * DT
    strains = offset + amplitude * np.sin(w * time + phase)
    state, _, errors = after(SINUSOID, strains)
    found = state.sinusoid
    rise = -found.acceleration / found.angular_frequency**2
    assert found.angular_frequency == pytest.approx(w, rel=0.02)
    assert state.position - rise == pytest.approx(offset, abs=0.02 * amplitude)
    assert math.hypot(rise, found.velocity / w) == pytest.approx(amplitude, rel=0.02)
    angle = math.atan2(rise, found.velocity / found.angular_frequency)
    apart = (angle - w * time[-1] - phase + math.pi) % (2.0 * math.pi) - math.pi
    assert apart == pytest.approx(0.0, abs=0.02)
    _, _, by_rate = after(CONSTANT_RATE, strains)
    last = slice(-200, None)
    assert rms(errors[last]) < 0.5 * rms(by_rate[last])


def test_the_frequency_converges_to_the_true_one():
    for frequency in (0.05, 0.2, 0.45):
        strains = 0.06 * (1.0 - np.cos(2.0 * math.pi * frequency * np.arange(60000) * DT))
        state, _, errors = after(SINUSOID, strains)
        assert state.sinusoid.angular_frequency == pytest.approx(
            2.0 * math.pi * frequency, rel=1e-3
        )
        assert state.weight > 0.99
        _, _, by_rate = after(CONSTANT_RATE, strains)
        assert rms(errors[-5000:]) < 0.01 * rms(by_rate[-5000:])


def test_preview_is_exact_where_the_strain_is_the_reference(configuration):
    reference = sine(configuration, 0.2)
    strains = [strain_reference(reference, k * DT) for k in range(9000)]
    state, expected, _ = after(PREVIEW, strains, reference)
    assert expected[:-300] == pytest.approx(strains[300:], abs=1e-9)
    assert state.weight == pytest.approx(1.0)


def test_preview_learns_how_far_the_strain_goes_along(configuration):
    reference = sine(configuration, 0.2)
    strains = np.array([0.9 * strain_reference(reference, k * DT) for k in range(20000)])
    state, expected, _ = after(PREVIEW, strains, reference)
    assert state.weight == pytest.approx(0.9, abs=0.02)
    assert rms(expected[10000:-300] - strains[10300:]) < 1e-3
    stuck, _, _ = after(PREVIEW, np.full(20000, 0.03), reference)
    assert stuck.weight == 0.5


def test_a_live_reference_has_no_preview(configuration):
    recruitment = dataclasses.replace(configuration.recruitment, predictor='preview')
    for kind, chosen in (('sine', PREVIEW), ('topic', CONSTANT_RATE)):
        reference = dataclasses.replace(configuration.reference, kind=kind)
        changed = dataclasses.replace(configuration, recruitment=recruitment, reference=reference)
        assert predictor(changed).kind == chosen


# ---- Noise, and motions that nobody knows ----


@pytest.mark.parametrize('kind', [CONSTANT_ACCELERATION, SINUSOID, PREVIEW])
def test_noise_troubles_the_others_less_than_the_constant_rate(configuration, kind):
    """Bounds from the filters: a fifth of the rate's error, whose filter is the shortest."""
    reference = sine(configuration, 0.1)
    strains = np.array([strain_reference(reference, k * DT) for k in range(20000)])
    noisy = strains + 5e-4 * np.random.default_rng(3).standard_normal(20000)
    wrong = {}
    for predicted in (CONSTANT_RATE, kind):
        _, expected, _ = after(predicted, noisy, reference)
        wrong[predicted] = rms((expected[:-300] - strains[300:])[5000:])
    # White noise through a first-order filter of 27 ms, differenced, times the horizon.
    assert wrong[CONSTANT_RATE] == pytest.approx(5e-4 * HORIZON / 0.027, rel=0.15)
    assert wrong[kind] < 0.2 * wrong[CONSTANT_RATE]


def test_what_a_sinusoid_cannot_know_is_left_to_the_constant_rate():
    """Ramps with sharp ends: never worse by more than a twentieth, over all of them."""
    time = np.arange(40000) * DT
    strains = 0.12 * np.clip(2.0 * np.abs((0.1 * time) % 1.0 - 0.5) - 0.2, 0.0, 0.6)
    for kind in (SINUSOID, CONSTANT_ACCELERATION):
        _, _, errors = after(kind, strains)
        _, _, by_rate = after(CONSTANT_RATE, strains)
        assert rms(errors) < 1.05 * rms(by_rate)


@settings(max_examples=30, deadline=None)
@given(
    st.sampled_from(KINDS),
    st.lists(st.floats(-0.1, 0.3), min_size=1, max_size=12),
    st.lists(st.floats(1e-4, 0.5), min_size=12, max_size=12),
    st.floats(-0.1, 0.3),
)
def test_no_strain_and_no_step_makes_anything_but_numbers(kind, strains, steps, target):
    strains = np.repeat(np.array(strains), 40)
    steps = np.resize(np.array(steps), strains.size)
    law = law_of(kind)
    state, expected, errors = follow(law, predictor_start(), STILL, 0.0, strains, steps)
    assert np.isfinite(expected).all()
    assert np.isfinite(errors).all()
    assert np.isfinite(state.forecasts.rows).all()
    assert 0.0 <= state.weight <= 1.0
    assert not math.isnan(time_to_rise(law, state, STILL, target))
    assert not math.isnan(time_to_fall(law, state, STILL, target))


# ---- The predictor's own error ----


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('horizon', [0.02, 0.3])
def test_the_error_is_the_strain_less_what_was_expected_for_it(kind, horizon):
    strains = 0.05 + 0.03 * np.sin(np.arange(4000) * DT * 2.0)
    _, expected, errors = after(kind, strains, horizon=horizon)
    later = round(horizon / DT)
    # The clock adds up the steps, so that the first may come a tick late.
    checked = errors[later + 1 :]  # noqa: E203
    assert checked == pytest.approx((strains[later:] - expected[:-later])[1:])
    assert not errors[:later].any()


def test_a_horizon_of_many_ticks_is_thinned_out_and_filled_by_lines():
    strains = 0.05 + 0.03 * np.sin(np.arange(9000) * DT * 2.0)
    _, expected, errors = after(CONSTANT_RATE, strains, horizon=1.7)
    assert errors[3000:] == pytest.approx(strains[3000:] - expected[1300:-1700], abs=1e-6)


def test_the_error_stands_skipped_periods():
    """The time between two samples is what counts, not their number."""
    steps = np.where(np.arange(2000) % 7 == 0, 5 * DT, DT)
    time = np.cumsum(steps)
    strains = 0.05 + 0.02 * time**2
    law = law_of(CONSTANT_RATE)
    _, expected, errors = follow(law, predictor_start(), STILL, 0.0, strains, steps)
    ago = np.interp(time - HORIZON, time, expected)
    late = time > 2.0 * HORIZON
    assert errors[late] == pytest.approx((strains - ago)[late], abs=1e-12)


# ---- When a limit is crossed ----


@settings(max_examples=60, deadline=None)
@given(SINUSOIDS, st.floats(-0.02, 0.12), st.booleans())
def test_the_first_crossing_is_that_of_an_independent_root_finder(state, target, rising):
    law, sign = law_of(SINUSOID), 1.0 if rising else -1.0
    reach = time_to_rise if rising else time_to_fall
    found = reach(law, state, STILL, target)

    def above(ahead):
        w, s = state.sinusoid.angular_frequency, state.sinusoid
        strain = state.position + s.velocity * math.sin(w * ahead) / w
        strain += s.acceleration * (1.0 - math.cos(w * ahead)) / w**2
        return sign * (strain - target)

    levels = [above(t) for t in AHEAD]
    if levels[0] >= 0.0:
        if found < 0.0:  # passed, and moving on at the mean rate of the next 50 ms
            assert found == pytest.approx(-levels[0] * AHEAD[1] / (levels[1] - levels[0]))
        return
    crossed = [k for k in range(STEPS) if levels[k] < 0.0 <= levels[k + 1]]
    fast = [k for k in crossed if levels[k + 1] - levels[k] > 1.001 * SLOW * AHEAD[1]]
    if fast and fast[0] == crossed[0]:
        k = fast[0]
        assert found == pytest.approx(brentq(above, AHEAD[k], AHEAD[k + 1]), abs=1e-7)
    elif not crossed:
        assert found == math.inf


@settings(max_examples=60, deadline=None)
@given(SINUSOIDS, st.floats(-0.02, 0.12), st.floats(0.0, 0.05))
def test_a_higher_target_is_reached_no_sooner(state, target, more):
    law = law_of(SINUSOID)
    up = time_to_rise(law, state, STILL, target)
    assert up <= time_to_rise(law, state, STILL, target + more) + 1e-8
    down = time_to_fall(law, state, STILL, target + more)
    assert down <= time_to_fall(law, state, STILL, target) + 1e-8


@settings(max_examples=60, deadline=None)
@given(SINUSOIDS, st.floats(-0.02, 0.12))
def test_a_strain_mirrored_falls_when_it_rose(state, target):
    s = state.sinusoid
    mirrored = turning(-s.velocity, -s.acceleration, s.angular_frequency, -state.position)
    law = law_of(SINUSOID)
    fall = time_to_fall(law, mirrored, STILL, -target)
    assert time_to_rise(law, state, STILL, target) == fall


def test_a_strain_that_falls_now_and_turns_is_expected_to_rise():
    law, state = law_of(SINUSOID), turning(-0.01, 0.2, 1.0)
    assert state.strain_rate < 0.0
    assert time_to_rise(law_of(CONSTANT_RATE), state, STILL, 0.06) == math.inf
    up = time_to_rise(law, state, STILL, 0.06)
    assert 0.2 < up < 0.5
    assert expected_strain(law, state, STILL, up) == pytest.approx(0.06)


def test_a_peak_that_is_soon_over_is_told_from_one_that_lasts():
    law, state = law_of(SINUSOID), turning(0.05, -0.4, 2.0)
    peak = max(expected_strain(law, state, STILL, t) for t in AHEAD)
    up = time_to_rise(law, state, STILL, peak - 2e-4)
    assert 0.0 < up < 0.3
    assert stays_above(law, state, STILL, peak - 2e-4, up + 1e-3)
    assert not stays_above(law, state, STILL, peak - 2e-4, 0.3)
