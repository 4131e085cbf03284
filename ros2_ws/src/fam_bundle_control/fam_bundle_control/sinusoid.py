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
An unknown sinusoid with an offset, followed as it goes on: its frequency and its phase.

Ours. For ``x = c + A sin(w t + p)`` the third derivative is ``-w^2`` times the first, whatever c,
A and p are. Both are taken from a cascade of low-pass filters, and w^2 is their least-squares
quotient with exponential forgetting: no guess of the frequency is needed, and none can be stuck in
a wrong one. At a known w the cascade's gain and phase are known, so that its delay can be taken
back. On a straight line w goes to its lower bound, and the sinusoid is a line over any lag.
"""

import math
from typing import NamedTuple

from fam_bundle_control.filters import (
    Cascade,
    cascade_derivatives,
    cascade_step,
    resting_cascade,
)
from fam_bundle_model.compile import compiled

TIME_CONSTANT = 0.08  # s, of each filter of the cascade
MEMORY, SPAN = 1.5, 2.0  # of the least squares: at most so many s, and rad of the sinusoid
SLOWEST, FASTEST = 2.0 * math.pi * 0.01, 2.0 * math.pi * 1.0  # rad/s


class Sinusoid(NamedTuple):
    """
    What is known of it: filters, least squares, and now its derivatives and frequency.

    ``velocity`` (1/s) and ``acceleration`` (1/s^2) are those of the strain at the last tick,
    ``angular_frequency`` is in rad/s.
    """

    filters: Cascade
    covariance: float
    variance: float
    velocity: float
    acceleration: float
    angular_frequency: float


@compiled
def sinusoid_start(strain: float) -> Sinusoid:
    """Return what is known at the first tick: standing still at ``strain`` (dimensionless)."""
    return Sinusoid(resting_cascade(strain), 0.0, 0.0, 0.0, 0.0, SLOWEST)


@compiled
def sinusoid_step(state: Sinusoid, strain: float, dt: float) -> Sinusoid:
    """Return what is known after one tick's measured strain; ``dt`` in s."""
    filters = cascade_step(state.filters, strain, TIME_CONSTANT, dt)
    one, two, three = cascade_derivatives(filters, TIME_CONSTANT)
    share = dt / (min(MEMORY, SPAN / state.angular_frequency) + dt)
    covariance = state.covariance + (one * three - state.covariance) * share
    variance = state.variance + (one * one - state.variance) * share
    square = -covariance / variance if variance > 0.0 else 0.0
    w = math.sqrt(min(max(square, SLOWEST * SLOWEST), FASTEST * FASTEST))
    # The filtered derivatives turn with the phase; (1 + i w T)^4 takes the filters' share back.
    lag = w * TIME_CONSTANT
    real, imaginary = 1.0 - lag * lag, 2.0 * lag
    real, imaginary = real * real - imaginary * imaginary, 2.0 * real * imaginary
    side = two / w
    velocity = one * real + side * imaginary
    acceleration = (side * real - one * imaginary) * w
    return Sinusoid(filters, covariance, variance, velocity, acceleration, w)


@compiled
def sinusoid_ahead(
    velocity: float, acceleration: float, angular_frequency: float, ahead: float
) -> float:
    """Return how much a sinusoid will have risen ``ahead`` s from now."""
    angle = angular_frequency * ahead
    half = math.sin(0.5 * angle)
    bend = 2.0 * acceleration * half * half / (angular_frequency * angular_frequency)
    return velocity * math.sin(angle) / angular_frequency + bend
