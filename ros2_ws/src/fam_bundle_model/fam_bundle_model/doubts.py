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
What a configuration may ask and hardly means: a loop that rings, units in no order of size.

When a loop rings is our derivation, "Gains and the size of a unit" in docs/model.md.
"""

import math
from typing import NamedTuple

from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.hydraulics import hydraulic_law
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.pressure_pi import pressure_gains


class Ringing(NamedTuple):
    """The proportional gain (1/Pa) at which a unit's pressure loop begins to ring, and its Hz."""

    gain: float
    frequency: float


def ringing(configuration: Configuration) -> tuple[Ringing, ...]:
    """
    Return at which gain each motor unit's pressure loop begins to ring.

    The unit is taut at zero strain and half the nominal pressure: there it holds little oil and
    the valve passes most, in the mean of both lands. The integral gain is taken as too small to
    matter. ``docs/model.md``, "Inner loops", derives it.
    """
    law = hydraulic_law(configuration)
    highest, frequency = highest_loop_gain(
        law.spool_time_constant, configuration.simulation.period
    )
    flow = law.valve_conductance * math.sqrt(0.5 * law.nominal_pressure)  # per unit of spool
    return tuple(
        Ringing(
            highest * unit.fams * fam.volume(unit.fam, 0.0) / law.bulk_modulus / flow, frequency
        )
        for unit in motor_units(configuration)
    )


def highest_loop_gain(lag: float, period: float) -> tuple[float, float]:
    """
    Return the gain (1/s) of an integrator behind a lag (s) that rings, and at what frequency.

    Sampled and held, the loop has the characteristic polynomial
    (z - 1)(z - a) + gain (newest z + earlier); Jury's conditions on its roots.
    """
    lag = min(lag, 1e6 * period)  # beyond, the gain no longer depends on it, but rounding would
    settled = -math.expm1(-period / lag)
    a = 1.0 - settled
    newest, earlier = period - lag * settled, lag * settled - a * period
    around, over = settled / earlier, 2.0 * (1.0 + a) / (newest - earlier)
    if over < around:  # a root leaves through z = -1
        return over, 0.5 / period
    return around, math.acos(0.5 * (1.0 + a - around * newest)) / (2.0 * math.pi * period)


def doubts(configuration: Configuration) -> list[str]:
    """Return one line for each thing in ``configuration`` that is allowed and hardly meant."""
    loops: dict[tuple[float, Ringing], list[str]] = {}
    pairs = zip(pressure_gains(configuration), ringing(configuration), strict=True)
    for number, (gains, limit) in enumerate(pairs, 1):
        if gains.proportional >= limit.gain:
            loops.setdefault((gains.proportional, limit), []).append(str(number))
    lines = [
        f'pressure_loop.proportional_gain = {gain:g} 1/Pa: motor unit {", ".join(numbers)} will '
        f'ring at {limit.frequency:.0f} Hz when taut; should be well below {limit.gain:.3g} 1/Pa'
        for (gain, limit), numbers in loops.items()
    ]
    nominal, counts = configuration.source.nominal_pressure, list(configuration.fam.count)
    forces = [unit.fams * fam.force(unit.fam, nominal, 0.0) for unit in motor_units(configuration)]
    for number, (force, before) in enumerate(zip(forces[1:], forces, strict=False), 2):
        if force < before:
            lines.append(
                f'fam.count = {counts}: motor unit {number} is weaker than the one before it '
                f'({force:.0f} N and {before:.0f} N at the nominal pressure); the size principle '
                'recruits the smallest first'
            )
    return lines
