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
Motor units in parallel: the bundle's force, its inverse in strain, and what it can reach.

The sum over units is the paper's (equation 11); inverse and reach are ours (docs/model.md).
"""

from typing import NamedTuple

from fam_bundle_model import fam
from fam_bundle_model.compile import compiled
from fam_bundle_model.fam import fam_law, FamLaw, value_of
from fam_bundle_model.parameters import Configuration, GRAVITY
from fam_bundle_model.reference import (
    Reference,
    reference_law,
    strain_range,
    strain_reference,
)
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import numpy.typing as npt

HIGHEST_STRAIN = 0.5  # the upper end of the search in strain
ROUNDING = 1e-12  # of a strain
START_MISMATCH = 1e-3  # strain by which a run may begin beside its reference
TABLE_PRESSURE_RATIO = 2.0  # tables reach to this multiple of the nominal pressure


class MotorUnit(NamedTuple):
    """Equal FAMs that share one valve: how many, and their law."""

    fams: float
    fam: FamLaw


def motor_units(configuration: Configuration) -> tuple[MotorUnit, ...]:
    """Return the motor units of ``configuration`` in recruitment order."""
    parameters = configuration.fam
    laws: dict[tuple[float, ...], FamLaw] = {}
    units = []
    for i, count in enumerate(parameters.count):
        key = tuple(
            float(value_of(v, i)) for name, v in vars(parameters).items() if name != 'count'
        )
        if key not in laws:  # equal FAMs share one law: its tables take a while to build
            limit = TABLE_PRESSURE_RATIO * configuration.source.nominal_pressure
            laws[key] = fam_law(parameters, i, limit, configuration.oil.bulk_modulus)
        units.append(MotorUnit(float(count), laws[key]))
    return tuple(units)


@compiled
def bundle_force(
    units: tuple[MotorUnit, ...], pressures: npt.NDArray[np.float64], strain: float
) -> float:
    """Return the bundle's force in N, each unit at its own pressure in Pa."""
    total = 0.0
    for i in range(len(units)):
        total += units[i].fams * fam.force(units[i].fam, pressures[i], strain)
    return total


@compiled
def state_force(
    units: tuple[MotorUnit, ...], recruited: int, pressure: float, strain: float
) -> float:
    """Return the force in N of ``recruited`` units at ``pressure`` and the others at zero."""
    total = 0.0
    for i in range(len(units)):
        applied = pressure if i < recruited else 0.0
        total += units[i].fams * fam.force(units[i].fam, applied, strain)
    return total


@compiled
def modelled_strain(
    units: tuple[MotorUnit, ...], recruited: int, pressure: float, load: float
) -> float:
    """
    Return the strain at which a recruitment state holds ``load`` N: e_mod of equations 15, 16.

    Inverse of ``state_force`` in strain by the Illinois variant of regula falsi; the ends of the
    bracket where the state is too strong or too weak anywhere.
    """
    low, high = -1.0, HIGHEST_STRAIN
    for i in range(len(units)):
        low = max(low, fam.lowest_strain(units[i].fam))
    at_low = state_force(units, recruited, pressure, low) - load
    at_high = state_force(units, recruited, pressure, high) - load
    if at_low <= 0.0:
        return low
    if at_high >= 0.0:
        return high
    side = 0
    strain = low
    for _ in range(100):
        strain = (low * at_high - high * at_low) / (at_high - at_low)
        value = state_force(units, recruited, pressure, strain) - load
        if value > 0.0:
            low, at_low = strain, value
            if side == 1:
                at_high *= 0.5
            side = 1
        else:
            high, at_high = strain, value
            if side == -1:
                at_low *= 0.5
            side = -1
        if abs(value) < 1e-9 or high - low < 1e-13:
            break
    return strain


@compiled
def balancing_pressure(
    units: tuple[MotorUnit, ...], recruited: int, strain: float, load: float, limit: float
) -> float:
    """
    Return the pressure in Pa at which a recruitment state holds ``load`` N at ``strain``.

    By bisection between 0 and ``limit``; one of these where the load is out of reach.
    """
    low, high = 0.0, limit
    for _ in range(60):
        middle = 0.5 * (low + high)
        if state_force(units, recruited, middle, strain) < load:
            low = middle
        else:
            high = middle
    return 0.5 * (low + high)


def reachable(configuration: Configuration, units: tuple[MotorUnit, ...]) -> tuple[float, float]:
    """
    Return the lowest and the highest strain at which the bundle can hold its load.

    All motor units open to the tank, and all at the nominal source pressure.
    """
    weight = configuration.load.mass * GRAVITY
    nominal = configuration.source.nominal_pressure
    low = modelled_strain(units, len(units), 0.0, weight)
    return low, modelled_strain(units, len(units), nominal, weight)


def check_within_reach(
    law: Reference, name: str, reach: tuple[float, float], pressure: float
) -> None:
    """
    Raise ConfigurationError where a trajectory ``name`` leaves what can be held.

    ``reach`` is as from ``reachable``, ``pressure`` in Pa that of all motor units for the highest.
    """
    lowest, highest = strain_range(law)
    if highest > reach[1] + ROUNDING:
        raise ConfigurationError(
            f'{name}: its peak strain {highest:g} must be <= {reach[1]:.4g}, what all motor '
            f'units at {pressure:g} Pa can hold'
        )
    if lowest < min(reach[0], 0.0) - ROUNDING:
        raise ConfigurationError(
            f'{name}: its lowest strain {lowest:g} must be >= {min(reach[0], 0.0):.4g}, where '
            'the load hangs on the empty bundle'
        )


def check_reachable(configuration: Configuration, units: tuple[MotorUnit, ...]) -> None:
    """Raise ConfigurationError where the load cannot be lifted or the reference not reached."""
    weight = configuration.load.mass * GRAVITY
    nominal = configuration.source.nominal_pressure
    strongest = state_force(units, len(units), nominal, 0.0)
    if strongest <= weight:
        raise ConfigurationError(
            f'load.mass = {configuration.load.mass:g} kg: can never be lifted; all motor units '
            f'at {nominal:g} Pa hold at most {strongest / GRAVITY:.4g} kg'
        )
    law, reference = reference_law(configuration.reference), configuration.reference
    name = f'reference.amplitude = {reference.amplitude:g}'
    if reference.kind in ('samples', 'topic'):
        name = 'reference.strains'
    check_within_reach(law, name, reachable(configuration, units), nominal)
    start = configuration.simulation.initial_strain
    if state_force(units, 1, nominal, start) < weight:
        limit = modelled_strain(units, 1, nominal, weight)
        raise ConfigurationError(
            f'simulation.initial_strain = {start:g}: must be <= {limit:.4g}, what the first '
            f'motor unit at {nominal:g} Pa can hold'
        )
    first = strain_reference(law, 0.0)
    if abs(first - start) > START_MISMATCH:
        raise ConfigurationError(
            f'simulation.initial_strain = {start:g}: must be within {START_MISMATCH:g} of '
            f'{first:g}, where the reference begins'
        )
