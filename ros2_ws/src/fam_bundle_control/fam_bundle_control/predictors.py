# SPDX-License-Identifier: Apache-2.0
"""The expected trajectory E(t) of equation 14, from what has been measured so far."""

import math
from typing import NamedTuple

from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import RecruitmentParameters


class Predictor(NamedTuple):
    """Settings: filter of the strain rate in s, and the rate in 1/s below which nothing moves."""

    strain_rate_time_constant: float
    minimum_strain_rate: float


class PredictorState(NamedTuple):
    """What is remembered: the last strain and its filtered rate in 1/s."""

    strain: float
    strain_rate: float
    started: bool


def predictor(parameters: RecruitmentParameters) -> Predictor:
    """Return the predictor of ``parameters``."""
    return Predictor(parameters.strain_rate_time_constant, parameters.minimum_strain_rate)


def predictor_start() -> PredictorState:
    """Return the state before the first tick."""
    return PredictorState(0.0, 0.0, False)


@compiled
def filtered(previous: float, value: float, time_constant: float, dt: float) -> float:
    """Return the next output of a first-order low-pass filter (backward Euler)."""
    return previous + (value - previous) * dt / (time_constant + dt)


@compiled
def predictor_step(
    law: Predictor, state: PredictorState, strain: float, dt: float
) -> PredictorState:
    """Return the next state from one tick's measured strain; ``dt`` in s."""
    rate = 0.0
    if state.started:
        rate = (strain - state.strain) / dt
        rate = filtered(state.strain_rate, rate, law.strain_rate_time_constant, dt)
    return PredictorState(strain, rate, True)


@compiled
def expected_strain(state: PredictorState, ahead: float) -> float:
    """Return the strain expected ``ahead`` s from now: equation 14."""
    return state.strain + state.strain_rate * ahead


@compiled
def time_to_rise(law: Predictor, state: PredictorState, target: float) -> float:
    """Return the time in s until the strain is expected to rise to ``target``: equation 15.

    Negative where it has passed it; infinite where it is not expected to rise.
    """
    if state.strain_rate <= law.minimum_strain_rate:
        return math.inf
    return (target - state.strain) / state.strain_rate


@compiled
def time_to_fall(law: Predictor, state: PredictorState, target: float) -> float:
    """Return the time in s until the strain is expected to fall to ``target``: equation 16.

    Negative where it has passed it; infinite where it is not expected to fall.
    """
    if state.strain_rate >= -law.minimum_strain_rate:
        return math.inf
    return (target - state.strain) / state.strain_rate
