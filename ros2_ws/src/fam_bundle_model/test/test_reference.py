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

"""Every kind of reference: where it begins and ends, its limits, its spectrum, what is smooth."""

import dataclasses
import itertools
import math

from fam_bundle_model.parameters import (
    check_reference,
    CYCLIC,
    KINDS,
    ReferenceParameters,
    step_time,
)
from fam_bundle_model.reference import (
    after,
    braked,
    quintic,
    rate_of,
    reference_law,
    slewed,
    smooth,
    still,
    strain_range,
    strain_reference,
)
from fam_bundle_model.schema import ConfigurationError
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.optimize import minimize_scalar
from scipy.signal import hilbert

STEP = 1e-3
SINE = ReferenceParameters('sine', 0.06, 0.1, 2)
POINTS = {'times': (0.0, 1.0, 3.0, 20.0), 'strains': (0.0, 0.03, 0.01, 0.1)}
positive = st.floats(0.01, 1.0)


def of(kind, **changes):
    parameters = dataclasses.replace(SINE, kind=kind, **changes)
    check_reference(parameters)
    return parameters


def curve(law, start, stop, step=STEP):
    """Return times and strains of ``law``."""
    times = np.arange(start, stop, step)
    return times, np.array([strain_reference(law, float(t)) for t in times])


def rate(law, times, step=1e-6):
    return np.array(
        [
            (strain_reference(law, t + step) - strain_reference(law, t - step)) / 2 / step
            for t in times
        ]
    )


# ---- All kinds ----


@pytest.mark.parametrize('kind', KINDS)
def test_every_kind_rests_before_it_begins_and_after_its_end(kind):
    parameters = of(kind, **POINTS)
    law, end = reference_law(parameters), parameters.duration()
    assert end == 20.0
    first, last = strain_reference(law, 0.0), strain_reference(law, end)
    assert first == 0.0
    assert all(strain_reference(law, t) == first for t in (-1e9, -3.0, -1e-12))
    assert all(strain_reference(law, end + t) == last for t in (1e-12, 0.1, 1e9))
    assert rate_of(law, -1.0) == rate_of(law, end + 1.0) == 0.0


@pytest.mark.parametrize('kind', KINDS)
def test_no_kind_jumps_nor_leaves_its_range(kind):
    law = reference_law(of(kind, **POINTS))
    _, strain = curve(law, -0.5, 20.5)
    assert np.abs(np.diff(strain)).max() <= 0.12 * STEP  # the fastest of these kinds
    low, high = strain_range(law)
    assert -1e-12 <= low <= strain.min() + 1e-12
    assert strain.max() - 1e-12 <= high <= 0.12 + 1e-12


@pytest.mark.parametrize('kind', KINDS)
def test_rate_is_the_slope(kind):
    law = reference_law(of(kind, **POINTS))
    times = np.random.default_rng(3).uniform(0.01, 19.99, 50)
    found = [rate_of(law, float(t)) for t in times]
    assert found == pytest.approx(rate(law, times), abs=1e-8)


@pytest.mark.parametrize('kind', [*CYCLIC, 'sum_of_sines'])
def test_cyclic_kinds_repeat_themselves(kind):
    parameters = of(kind, multiples=(1.0, 2.0, 5.0))
    assert parameters.is_cyclic()
    law = reference_law(parameters)
    assert curve(law, 0.0, 9.99)[1] == pytest.approx(curve(law, 10.0, 19.99)[1], abs=1e-12)


def test_other_kinds_are_not_cyclic():
    kinds = set(KINDS) - set(CYCLIC)
    assert not any(of(kind, **POINTS).is_cyclic() for kind in kinds)


@pytest.mark.parametrize('kind', ['sine', 'trapezoid', 'steps', 'minimum_jerk', 'ramp'])
def test_amplitude_is_half_of_the_peak(kind):
    _, strain = curve(reference_law(of(kind)), 0.0, 20.0)
    assert strain.max() == pytest.approx(0.12, abs=1e-9)


# ---- Harmonic kinds ----


def test_a_sine_is_its_formula_to_the_bit():
    law = reference_law(SINE)
    for t in np.arange(0.0, 20.0, 0.0137).tolist():
        assert strain_reference(law, t) == 0.06 * (1.0 - math.cos(2.0 * math.pi * 0.1 * t))


def test_the_spectrum_of_a_sum_of_sines_has_its_lines_and_no_others():
    parameters = of('sum_of_sines', multiples=(1.0, 3.0, 7.0), weights=(4.0, 2.0, 1.0))
    _, strain = curve(reference_law(parameters), 0.0, 20.0 - STEP / 2)
    lines = np.fft.rfft(strain).real / len(strain)
    expected = np.zeros_like(lines)  # the k-th is k / 20 Hz
    expected[0] = 0.06
    expected[[2, 6, 14]] = -0.5 * 0.06 * np.array([4.0, 2.0, 1.0]) / 7.0
    assert lines == pytest.approx(expected, abs=1e-12)


def test_one_weight_serves_all_sines():
    one = reference_law(of('sum_of_sines', weights=(3.0,)))
    all_equal = reference_law(of('sum_of_sines', weights=(1.0, 1.0, 1.0)))
    assert one.sines == pytest.approx(all_equal.sines)


@pytest.mark.parametrize('final', [0.05, 2.0])
def test_the_frequency_of_a_chirp_changes_evenly(final):
    """Its instantaneous frequency, from the analytic signal, is a straight line in time."""
    parameters = of('chirp', frequency=0.4, cycles=24, final_frequency=final)
    times, strain = curve(reference_law(parameters), 0.0, 60.0)
    phase = np.unwrap(np.angle(hilbert(0.06 - strain)))
    middle = (times > 10.0) & (times < 50.0)  # the ends of a finite signal are not analytic
    found = np.gradient(phase, STEP)[middle] / (2.0 * np.pi)
    expected = 0.4 + (final - 0.4) * times[middle] / 60.0
    # Averaged over two seconds: what is left of the negative frequencies ripples.
    even = np.convolve(found - expected, np.ones(2000) / 2000, 'valid')
    assert np.abs(even).max() < 0.02 * max(final, 0.4)


# ---- Kinds of levels ----


def test_steps_keep_to_both_limits_and_reach_each_level_as_fast_as_they_allow():
    limits = {'strain_rate': 0.05, 'strain_acceleration': 0.2}
    parameters = of('steps', levels=(1.0, 0.25, 0.3, 0.0), frequency=0.05, cycles=1, **limits)
    law = reference_law(parameters)
    _, strain = curve(law, 0.0, 20.0)
    speed, bend = np.diff(strain) / STEP, np.diff(strain, 2) / STEP**2
    assert np.abs(speed).max() == pytest.approx(0.05, rel=1e-6)
    assert np.abs(bend).max() == pytest.approx(0.2, rel=1e-6)
    start = 0.0
    for k, level in enumerate(parameters.levels):
        taken = step_time(abs(0.12 * level - start), 0.05, 0.2)
        assert strain_reference(law, 5.0 * k + taken) == pytest.approx(0.12 * level, abs=1e-12)
        assert abs(strain_reference(law, 5.0 * k + 0.99 * taken) - 0.12 * level) > 1e-7
        start = 0.12 * level


@given(positive, positive, positive)
def test_step_time_is_that_of_a_trapezoid_of_rate(distance, speed, acceleration):
    """The area below the strain rate, which rises, stays and falls, is the distance."""
    taken = step_time(distance, speed, acceleration)
    rise = min(speed / acceleration, 0.5 * taken)
    assert (taken - rise) * rise * acceleration == pytest.approx(distance)


def test_a_step_that_has_no_time_is_refused():
    with pytest.raises(ConfigurationError) as refused:
        of('steps', strain_rate=0.01)
    assert str(refused.value) == (
        'reference.levels: a step of 0.06 within reference.strain_rate = 0.01 1/s and '
        'reference.strain_acceleration = 1 1/s^2 takes 6.01 s: must be <= 2.5 s, '
        "a level's part of a cycle"
    )


def test_minimum_jerk_rests_at_every_level():
    law = reference_law(of('minimum_jerk', levels=(0.2, 0.9, 0.0)))
    part = 10.0 / 3.0
    for k, level in enumerate((0.2, 0.9, 0.0, 0.2, 0.9)):
        time = part * (k + 1)
        assert strain_reference(law, time) == pytest.approx(0.12 * level, abs=1e-12)
        near = 1e-3
        for side in (-near, near):  # neither rate nor acceleration: the way begins with its cube
            moved = strain_reference(law, time + side) - 0.12 * level
            assert abs(moved) <= 12.0 * 0.12 * (near / part) ** 3


@given(st.integers(1, 4), st.floats(-1.0, 1.0).filter(lambda x: abs(x) > 0.01))
def test_no_way_between_the_same_ends_has_less_jerk(mode, size):
    """Perturbed by what leaves strain, rate and acceleration at the ends alone."""

    def cost(coefficients):
        jerk = np.polynomial.Polynomial(coefficients).deriv(3)
        return (jerk**2).integ()(2.0) - (jerk**2).integ()(0.0)

    best = np.polynomial.Polynomial(quintic(0.02, 0.03, 0.1, -0.01, 2.0))
    time = np.polynomial.Polynomial([0.0, 1.0])
    bump = time**3 * (2.0 - time) ** 3 * time ** (mode - 1)
    assert cost((best + size * bump).coef) > cost(best.coef)
    assert best(0.0) == pytest.approx(0.02)
    assert best(2.0) == pytest.approx(0.1)
    ends = [best.deriv(n)(t) for n in (1, 2) for t in (0.0, 2.0)]
    assert ends == pytest.approx([0.03, -0.01, 0.0, 0.0])


def test_quarters_of_a_trapezoid():
    law = reference_law(of('trapezoid'))
    found = [strain_reference(law, t) for t in (0.0, 1.25, 2.5, 3.7, 5.0, 6.25, 7.5, 9.0, 10.0)]
    expected = [0.0, 0.06, 0.12, 0.12, 0.12, 0.06, 0.0, 0.0, 0.0]
    assert found == pytest.approx(expected)


def test_a_ramp_is_as_fast_as_the_sine_on_average():
    law = reference_law(of('ramp'))
    assert curve(law, 0.0, 5.0)[1] == pytest.approx(np.arange(0.0, 5.0, STEP) * 0.12 / 5.0)
    assert np.unique(curve(law, 5.0, 20.0)[1]) == pytest.approx([0.12])


# ---- Smooth kinds ----


@settings(max_examples=60)
@given(
    st.lists(st.floats(0.02, 5.0), min_size=1, max_size=8),
    st.lists(st.floats(-0.1, 0.3), min_size=9, max_size=9),
)
def test_what_is_smooth_passes_all_points_and_stays_between_neighbours(parts, strains):
    times = np.concatenate(([0.0], np.cumsum(parts)))
    strains = strains[: len(times)]
    law = smooth(times.tolist(), strains)
    for time, strain in zip(times, strains, strict=True):
        assert strain_reference(law, float(time)) == pytest.approx(strain, abs=1e-12)
    for (a, b), (low, high) in zip(
        itertools.pairwise(times), map(sorted, itertools.pairwise(strains)), strict=True
    ):
        inside = np.array([strain_reference(law, t) for t in np.linspace(a, b, 41).tolist()])
        assert low - 1e-12 <= inside.min() <= inside.max() <= high + 1e-12
        slope = np.diff(inside)
        assert (slope > -1e-12).all() or (slope < 1e-12).all()


@pytest.mark.parametrize('kind', ['random', 'samples', 'minimum_jerk'])
def test_strain_rate_and_acceleration_of_smooth_kinds_do_not_jump(kind):
    """Their steps from tick to tick shrink with the tick; a jump would not."""
    law = reference_law(of(kind, **POINTS))
    for order in (1, 2):
        largest = []
        for step in (4e-3, 2e-3, 1e-3):
            strain = curve(law, -0.1, 20.1, step)[1]
            derivative = np.diff(strain, order) / step**order
            largest.append(np.abs(np.diff(derivative)).max())
        assert largest[0] / largest[1] == pytest.approx(2.0, rel=0.1)
        assert largest[1] / largest[2] == pytest.approx(2.0, rel=0.1)


def test_random_waypoints_hang_on_the_seed_alone():
    def strains(seed):
        return curve(reference_law(of('random', seed=seed, cycles=20)), 0.0, 200.0, 0.05)[1]

    first = strains(1)
    assert (first == strains(1)).all()
    assert np.abs(first - strains(2)).max() > 0.03
    assert first.min() >= -1e-12
    assert 0.1 < first.max() <= 0.12  # 40 waypoints anywhere up to 0.12
    turns = np.count_nonzero(np.diff(np.sign(np.diff(first))[np.diff(first) != 0.0]))
    assert 10 < turns < 40  # two of three random points are extremes


def test_too_many_random_waypoints_are_refused():
    """All of them stand in the latched law."""
    assert len(reference_law(of('random', cycles=5000)).breaks) == 10_000
    with pytest.raises(ConfigurationError) as refused:
        of('random', cycles=5001)
    assert str(refused.value) == 'reference.cycles = 5001: must be <= 5000 of random waypoints'


def test_samples_may_begin_late():
    law = reference_law(of('samples', times=(2.0, 3.0), strains=(0.04, 0.05)))
    assert strain_reference(law, 0.0) == strain_reference(law, 2.0) == 0.04
    assert strain_reference(law, 2.5) == pytest.approx(0.045)


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'times': (0.0, 1.0)}, 'reference.strains: 4 values for 2 times; must be 2'),
        (
            {'times': (0.0,), 'strains': (0.0,)},
            'reference.times: 1 samples; must be >= 2 and <= 10000',
        ),
        (
            {'times': (0.0, 2.0, 2.0, 3.0)},
            'reference.times[2] = 2 s: must be > 2 s, the one before',
        ),
    ],
)
def test_samples_that_do_not_fit_together_are_refused(changes, message):
    with pytest.raises(ConfigurationError) as refused:
        of('samples', **{**POINTS, **changes})
    assert str(refused.value) == message


def test_weights_that_do_not_fit_are_refused():
    with pytest.raises(ConfigurationError) as refused:
        of('sum_of_sines', weights=(1.0, 2.0))
    assert str(refused.value) == 'reference.weights: 2 values for 3 multiples; must be 1 or 3'


# ---- From one to the next ----

moments = st.floats(0.0, 20.0)


@settings(deadline=None, max_examples=60)
@given(st.sampled_from(KINDS), st.sampled_from(KINDS), moments, positive, st.floats(0.5, 5.0))
def test_a_new_trajectory_sets_in_without_a_jump_and_within_the_limits(
    kind, next_kind, moment, limit, acceleration
):
    before = reference_law(of(kind, **POINTS))
    wanted = reference_law(of(next_kind, **POINTS))
    law = after(before, moment, wanted, limit, acceleration)
    start = strain_reference(before, moment)
    assert strain_reference(law, moment) == pytest.approx(start, abs=1e-12)
    assert law.start >= moment
    if law.start == moment:
        assert start == 0.0
        return
    times, strain = curve(law, moment, law.start, (law.start - moment) / 400)
    step = times[1] - times[0]
    present = rate_of(before, moment)
    assert (strain[1] - strain[0]) / step == pytest.approx(present, abs=acceleration * step)
    assert np.abs(np.diff(strain)).max() / step <= max(limit, abs(present)) * (1 + 1e-3) + 1e-9
    assert np.abs(np.diff(strain, 2)).max() / step**2 <= acceleration * (1 + 1e-3) + 1e-6
    own = [strain_reference(wanted, t) for t in (0.0, 1.3, 7.7)]
    later = [strain_reference(law, law.start + t) for t in (0.0, 1.3, 7.7)]
    assert later == pytest.approx(own, abs=1e-9)


REACH = (-0.02, 0.15)


@settings(deadline=None, max_examples=200)
@given(
    moments,
    st.floats(0.005, 0.075),
    st.floats(0.05, 2.0),
    st.floats(1e-4, 10.0),
    st.floats(1e-3, 1e3),
    st.floats(*REACH),
)
def test_no_way_leads_beyond_the_rest_after_braking_nor_out_of_reach(
    moment, amplitude, frequency, limit, acceleration, target
):
    """A mass point at the rate v comes to rest v^2/(2 a) further on."""
    before = reference_law(of('sine', amplitude=amplitude, frequency=frequency, cycles=1000))
    start, speed = strain_reference(before, moment), rate_of(before, moment)
    rest = start + math.copysign(0.5 * speed**2 / acceleration, speed)
    for law, ends in (
        (after(before, moment, still(target), limit, acceleration, REACH), (rest, start, target)),
        (braked(before, moment, acceleration, REACH), (rest, start)),
    ):
        times = np.linspace(moment, law.start, 1001)
        strain = np.array([strain_reference(law, t) for t in times.tolist()])
        assert max(REACH[0], min(ends)) - 1e-9 <= strain.min()
        assert strain.max() <= min(REACH[1], max(ends)) + 1e-9
        assert rate_of(law, law.start) == 0.0


def test_it_is_braked_at_the_acceleration_or_as_much_harder_as_the_reach_wants():
    before = reference_law(SINE)
    start, speed = strain_reference(before, 2.0), rate_of(before, 2.0)
    free = braked(before, 2.0, 0.1)
    assert free.start - 2.0 == pytest.approx(speed / 0.1)
    assert strain_reference(free, 99.0) == pytest.approx(start + 0.5 * speed**2 / 0.1)
    near = braked(before, 2.0, 0.1, (0.0, start + 0.002))
    assert strain_reference(near, 99.0) == pytest.approx(start + 0.002, abs=1e-12)
    assert near.start - 2.0 == pytest.approx(2.0 * 0.002 / speed)
    at_once = braked(before, 2.0, 0.1, (0.0, start))
    assert (at_once.start, strain_reference(at_once, 99.0)) == (2.0, start)


def test_the_way_to_a_new_trajectory_is_no_longer_than_it_must_be():
    """From rest to rest at least 15/8 of the mean rate is needed (Flash and Hogan)."""
    law = after(still(0.0), 3.0, still(0.1), 0.05, 1e6)
    assert law.start == pytest.approx(3.0 + 1.875 * 0.1 / 0.05)
    peak = minimize_scalar(lambda t: -rate_of(law, t), bounds=(3.0, law.start), method='bounded')
    assert -peak.fun == pytest.approx(0.05)
    law = after(still(0.0), 3.0, still(0.1), 10.0, 0.5)
    _, strain = curve(law, 3.0, law.start, 1e-4)
    assert np.diff(strain, 2).max() / 1e-8 == pytest.approx(0.5, rel=1e-4)


@given(moments, st.floats(-0.02, 0.15), positive)
def test_a_live_value_is_reached_straight_at_the_limited_rate(moment, target, limit):
    before = reference_law(SINE)
    start = strain_reference(before, moment)
    law = slewed(before, moment, target, limit)
    arrival = moment + abs(target - start) / limit
    assert strain_reference(law, moment) == pytest.approx(start, abs=1e-12)
    half = 0.5 * (moment + arrival)
    assert strain_reference(law, half) == pytest.approx(0.5 * (start + target), abs=1e-9)
    assert strain_reference(law, arrival + 1e-6) == pytest.approx(target, abs=1e-12)
    assert strain_reference(law, 1e6) == pytest.approx(target, abs=1e-12)


def test_steps_of_live_values_below_the_rate_are_followed_at_once():
    law = still(0.0)
    for tick in range(1, 500):
        value = 0.05 * tick * STEP
        law = slewed(law, tick * STEP, value, 0.1)
        assert strain_reference(law, (tick + 1) * STEP) == pytest.approx(value, abs=1e-12)
