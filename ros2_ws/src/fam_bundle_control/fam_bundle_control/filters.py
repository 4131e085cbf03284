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
First-order low-pass filters, alone and four in a row.

Textbook (backward Euler); the paper filters none of its signals.
"""

from typing import NamedTuple

from fam_bundle_model.compile import compiled


class Cascade(NamedTuple):
    """The outputs of four equal first-order filters in a row, each fed with the one before."""

    first: float
    second: float
    third: float
    fourth: float


@compiled
def filtered(previous: float, value: float, time_constant: float, dt: float) -> float:
    """Return the next output of a first-order low-pass filter (backward Euler); times in s."""
    return previous + (value - previous) * dt / (time_constant + dt)


@compiled
def resting_cascade(value: float) -> Cascade:
    """Return four filters that have settled at ``value``."""
    return Cascade(value, value, value, value)


@compiled
def cascade_step(state: Cascade, value: float, time_constant: float, dt: float) -> Cascade:
    """Return the next outputs; ``time_constant`` of each filter and ``dt`` in s."""
    first = filtered(state.first, value, time_constant, dt)
    second = filtered(state.second, first, time_constant, dt)
    third = filtered(state.third, second, time_constant, dt)
    return Cascade(first, second, third, filtered(state.fourth, third, time_constant, dt))


@compiled
def cascade_derivatives(state: Cascade, time_constant: float) -> tuple[float, float, float]:
    """
    Return the first three derivatives of the last output, per s, s^2 and s^3.

    A backward Euler filter's input less its output, over its time constant, is the backward
    difference of its output: no difference of the noisy input is taken.
    """
    one = (state.third - state.fourth) / time_constant
    before = (state.second - state.third) / time_constant
    two = (before - one) / time_constant
    earlier = (state.first - state.second) / time_constant
    return one, two, ((earlier - before) / time_constant - two) / time_constant
