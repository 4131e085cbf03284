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

"""
The expected trajectory E(t) of equation 14, by one of four predictors.

- constant rate: the measured strain goes on at its filtered rate (the paper's);
- constant acceleration: a parabola, its acceleration over the next ``REACH`` only;
- sinusoid: what the adaptive sinusoid of ``sinusoid.py`` does next;
- preview: what the reference does next, and the share of it that the strain goes along.

All but the first stand on a filter of the strain that moves along with the trajectory: it takes
noise away without a lag. Acceleration and sinusoid are weighed against the constant rate by how
well each has done lately, preview against standing still. ``docs/recruitment.md`` compares them.
"""

import math
from typing import NamedTuple

from fam_bundle_control.filters import (
    Cascade,
    cascade_derivatives,
    cascade_step,
    filtered,
    resting_cascade,
)
from fam_bundle_control.forecasts import (
    due,
    Forecasts,
    forecasts_start,
    forecasts_step,
    is_due,
    next_row,
)
from fam_bundle_control.sinusoid import (
    Sinusoid,
    sinusoid_ahead,
    sinusoid_start,
    sinusoid_step,
)
from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import Configuration, PREDICTORS
from fam_bundle_model.reference import Reference, strain_reference

CONSTANT_RATE, CONSTANT_ACCELERATION, SINUSOID, PREVIEW = range(len(PREDICTORS))
REACH = 0.4  # s for which an acceleration is expected to last
ACCELERATION_TIME_CONSTANT = 0.04  # s, of each of its four filters
POSITION_TIME_CONSTANT = 0.05  # s, of the filter that moves along
MEMORY = 1.5  # s, of the comparison with the constant rate
TRACKING_TIME_CONSTANT = 2.0  # s, with which the tracking error decays
PREVIEW_MEMORY = 5.0  # s, of how far the strain goes along with the reference
LEAST_PREVIEW = 0.5  # share: a strain that is held up must not hide what is wanted of it
DOUBT = 1e-10  # mean squared difference (strain) below which the comparison tells nothing
FAR, STEPS, HALVINGS = 2.0, 40, 30  # s that are searched for a crossing, in steps, then halved
EXPECTED, SIMPLY, MODELLED = range(3)  # columns of the forecasts


class Predictor(NamedTuple):
    """
    Settings: which one, filter of the strain rate in s, rate in 1/s below which nothing moves.

    ``horizon`` (s) is how far ahead its error is measured.
    """

    kind: int
    strain_rate_time_constant: float
    minimum_strain_rate: float
    horizon: float


class PredictorState(NamedTuple):
    """
    What is remembered: the last strain, its filtered rate in 1/s, and what the models know.

    ``time`` is that of the last tick in s, ``position`` the strain without noise, ``velocity``
    and ``acceleration`` its derivatives, ``weight`` that of the model against the constant rate
    and ``agreement`` over ``difference`` what it comes from, ``error`` the measured strain less
    what was expected for it a horizon ago (0 until then).
    """

    strain: float
    strain_rate: float
    started: bool
    time: float
    position: float
    velocity: float
    acceleration: float
    filters: Cascade
    sinusoid: Sinusoid
    weight: float
    agreement: float
    difference: float
    forecasts: Forecasts
    error: float


class Course(NamedTuple):
    """
    The way ahead: what of a state it follows from; numbers only, to be looked at often.

    ``reference`` is the reference strain now.
    """

    kind: int
    time: float
    reference: float
    strain: float
    rate: float
    position: float
    velocity: float
    acceleration: float
    angular_frequency: float
    weight: float


def predictor(configuration: Configuration, *, live: bool | None = None) -> Predictor:
    """
    Return the predictor of ``configuration``; a ``live`` reference has no preview.

    Unless it is told otherwise the reference is the configured one.
    """
    p = configuration.recruitment
    kind = PREDICTORS.index(p.predictor)
    if live is None:
        live = configuration.reference.kind == 'topic'
    return Predictor(
        CONSTANT_RATE if kind == PREVIEW and live else kind,
        p.strain_rate_time_constant,
        p.minimum_strain_rate,
        p.prediction_horizon,
    )


def predictor_start() -> PredictorState:
    """Return the state before the first tick; ``predictor_step`` writes in its forecasts."""
    still = (0.0, 0.0, 0.0, 0.0)
    return PredictorState(
        strain=0.0,
        strain_rate=0.0,
        started=False,
        time=0.0,
        position=0.0,
        velocity=0.0,
        acceleration=0.0,
        filters=Cascade(*still),
        sinusoid=Sinusoid(Cascade(*still), 0.0, 0.0, 0.0, 0.0, 1.0),
        weight=0.0,
        agreement=0.0,
        difference=0.0,
        forecasts=forecasts_start(3),
        error=0.0,
    )


@compiled
def predictor_step(
    law: Predictor,
    state: PredictorState,
    reference: Reference,
    time: float,
    strain: float,
    dt: float,
) -> PredictorState:
    """
    Return the next state from one tick's measured strain; ``time`` and ``dt`` in s.

    The forecasts are written in place.
    """
    rate = 0.0
    if state.started:
        rate = (strain - state.strain) / dt
        rate = filtered(state.strain_rate, rate, law.strain_rate_time_constant, dt)
    filters, sinusoid = state.filters, state.sinusoid
    velocity = acceleration = advance = 0.0
    if law.kind == CONSTANT_ACCELERATION:
        filters = resting_cascade(strain)
        if state.started:
            filters = cascade_step(state.filters, strain, ACCELERATION_TIME_CONSTANT, dt)
        slope, acceleration, _ = cascade_derivatives(filters, ACCELERATION_TIME_CONSTANT)
        # A parabola passes the filters 4 time constants late; dt / 2: differences look back.
        advance = (slope + 4.0 * ACCELERATION_TIME_CONSTANT * acceleration) * dt
        velocity = advance / dt + 0.5 * dt * acceleration
    elif law.kind == SINUSOID:
        sinusoid = sinusoid_start(strain)
        if state.started:
            sinusoid = sinusoid_step(state.sinusoid, strain, dt)
        velocity, acceleration = sinusoid.velocity, sinusoid.acceleration
        advance = (velocity - 0.5 * dt * acceleration) * dt
    elif law.kind == PREVIEW and state.started:
        advance = strain_reference(reference, time) - strain_reference(reference, state.time)
    position = strain
    if state.started:
        position = filtered(state.position + advance, strain, POSITION_TIME_CONSTANT, dt)

    forecasts = forecasts_step(state.forecasts, law.horizon, dt if state.started else 0.0)
    error, agreement, difference = 0.0, state.agreement, state.difference
    if is_due(forecasts, law.horizon):
        error = strain - due(forecasts, EXPECTED, law.horizon)
        simply = due(forecasts, SIMPLY, law.horizon)
        apart = due(forecasts, MODELLED, law.horizon) - simply
        memory = PREVIEW_MEMORY if law.kind == PREVIEW else MEMORY
        agreement = filtered(agreement, (strain - simply) * apart, memory, dt)
        difference = filtered(difference, apart * apart, memory, dt)
    # The best weight in the least-squares sense; the sinusoid has to show first what it can.
    at_first = 0.0 if law.kind == SINUSOID else DOUBT
    least = LEAST_PREVIEW if law.kind == PREVIEW else 0.0
    weight = min(max((agreement + at_first) / (difference + DOUBT), least), 1.0)
    forecasts, row = next_row(forecasts, law.horizon)
    new = PredictorState(
        strain,
        rate,
        True,
        time,
        position,
        velocity,
        acceleration,
        filters,
        sinusoid,
        weight,
        agreement,
        difference,
        forecasts,
        error,
    )
    if row >= 0:
        rows = forecasts.rows
        course = course_of(law, new, reference)
        then = strain_reference(reference, time + law.horizon)
        rows[row, 1 + EXPECTED] = weighed(course, then, law.horizon)
        rows[row, 1 + SIMPLY] = simply_expected(course, law.horizon)
        rows[row, 1 + MODELLED] = modelled(course, then, law.horizon)
    return new


@compiled
def course_of(law: Predictor, state: PredictorState, reference: Reference) -> Course:
    """Return what a state says of the way ahead."""
    return Course(
        law.kind,
        state.time,
        strain_reference(reference, state.time),
        state.strain,
        state.strain_rate,
        state.position,
        state.velocity,
        state.acceleration,
        state.sinusoid.angular_frequency,
        state.weight,
    )


@compiled
def simply_expected(course: Course, ahead: float) -> float:
    """
    Return the strain ``ahead`` s from now without a model, at constant rate.

    Where the reference is known it tells the rate: the strain stands still without it.
    """
    return course.position if course.kind == PREVIEW else course.strain + course.rate * ahead


@compiled
def modelled(course: Course, then: float, ahead: float) -> float:
    """
    Return the strain ``ahead`` s from now by the reference, the parabola or the sinusoid.

    ``then`` is the reference strain at that time. At constant rate there is nothing to learn of
    it: a preview that takes over begins without prejudice.
    """
    if course.kind == CONSTANT_RATE:
        return simply_expected(course, ahead)
    if course.kind == PREVIEW:
        caught_up = 1.0 - math.exp(-ahead / TRACKING_TIME_CONSTANT)
        left = course.reference - course.position
        return course.position + then - course.reference + caught_up * left
    if course.kind == SINUSOID:
        rise = sinusoid_ahead(
            course.velocity, course.acceleration, course.angular_frequency, ahead
        )
        return course.position + rise
    lasts = min(ahead, REACH)
    bend = course.acceleration * lasts * (ahead - 0.5 * lasts)
    return course.position + course.velocity * ahead + bend


@compiled
def weighed(course: Course, then: float, ahead: float) -> float:
    """Return the strain ``ahead`` s from now by both; ``then`` as in ``modelled``."""
    simply = simply_expected(course, ahead)
    if course.kind == CONSTANT_RATE:
        return simply
    return simply + course.weight * (modelled(course, then, ahead) - simply)


@compiled
def expected_strain(
    law: Predictor, state: PredictorState, reference: Reference, ahead: float
) -> float:
    """Return the strain expected ``ahead`` s from now: equation 14 at constant rate."""
    then = strain_reference(reference, state.time + ahead)
    return weighed(course_of(law, state, reference), then, ahead)


@compiled
def may_rise(law: Predictor, state: PredictorState) -> bool:
    """Return whether ``time_to_rise`` can be finite; else what it asks for need not be known."""
    return law.kind != CONSTANT_RATE or state.strain_rate > law.minimum_strain_rate


@compiled
def may_fall(law: Predictor, state: PredictorState) -> bool:
    """Return whether ``time_to_fall`` can be finite; else what it asks for need not be known."""
    return law.kind != CONSTANT_RATE or state.strain_rate < -law.minimum_strain_rate


@compiled
def time_to_rise(
    law: Predictor, state: PredictorState, reference: Reference, target: float
) -> float:
    """
    Return the time in s until the strain is expected to rise to ``target``: equation 15.

    The first time at which it is there or above, and rising. Negative where it is now: by its
    present rate, when it passed. Infinite where it is not expected to within ``FAR``.
    """
    if law.kind == CONSTANT_RATE:
        if state.strain_rate <= law.minimum_strain_rate:
            return math.inf
        return (target - state.strain) / state.strain_rate
    return _time_to_cross(law, state, reference, 1.0, target)


@compiled
def time_to_fall(
    law: Predictor, state: PredictorState, reference: Reference, target: float
) -> float:
    """
    Return the time in s until the strain is expected to fall to ``target``: equation 16.

    The mirror image of ``time_to_rise``.
    """
    if law.kind == CONSTANT_RATE:
        if state.strain_rate >= -law.minimum_strain_rate:
            return math.inf
        return (target - state.strain) / state.strain_rate
    return _time_to_cross(law, state, reference, -1.0, target)


@compiled
def stays_above(
    law: Predictor, state: PredictorState, reference: Reference, target: float, ahead: float
) -> bool:
    """
    Return whether the strain is above ``target`` still, ``ahead`` s from now.

    For a trajectory that has risen to it by then; one at constant rate does not come back.
    """
    if law.kind == CONSTANT_RATE:
        return True
    return expected_strain(law, state, reference, ahead) >= target


@compiled
def _time_to_cross(
    law: Predictor, state: PredictorState, reference: Reference, sign: float, target: float
) -> float:
    # Looked up whether it is needed or not: behind a condition numba counts the references to its
    # arrays each time, which takes three times as long as all the rest.
    course = course_of(law, state, reference)
    step, goal, then = FAR / STEPS, sign * target, course.reference
    here = sign * weighed(course, then, 0.0)
    for k in range(STEPS):
        low, high = k * step, (k + 1) * step
        then = strain_reference(reference, course.time + high)
        there = sign * weighed(course, then, high)
        rate = (there - here) / step
        if there >= goal and rate > law.minimum_strain_rate:
            if here >= goal:
                return (goal - here) / rate if k == 0 else low
            for _ in range(HALVINGS):
                middle = 0.5 * (low + high)
                then = strain_reference(reference, course.time + middle)
                if sign * weighed(course, then, middle) >= goal:
                    high = middle
                else:
                    low = middle
            return high
        here = there
    return math.inf
