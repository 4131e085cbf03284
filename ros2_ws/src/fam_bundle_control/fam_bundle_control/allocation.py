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
What each recruited motor unit is asked for (``docs/recruitment.md``, Allocation).

``batch`` is the paper's: all recruited units follow one pressure reference. The other two are
ours. There the strain loop's output is the pressure that all units of the bundle *would* need in
common, which names a force whatever is recruited, and that force is shared out by the model.
"""

from fam_bundle_model import fam
from fam_bundle_model.bundle import MotorUnit
from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import ALLOCATIONS
from fam_bundle_model.pressure_pi import clamp
import numpy as np
import numpy.typing as npt

BATCH, FORCE, ORDERLY = range(len(ALLOCATIONS))
READY = 0.9  # of its pressure to be: a unit that fills is counted as measured up to there


@compiled
def is_compensated(unit: int, recruited: int) -> bool:
    """
    Return whether ``unit`` gets the pressure compensation: those before the newest recruit.

    A single recruited unit is compensated against the slack ones itself.
    """
    return unit < recruited and unit < max(recruited - 1, 1)


@compiled
def common_pressure(
    units: tuple[MotorUnit, ...], first: int, last: int, force: float, strain: float
) -> float:
    """
    Return the pressure in Pa at which units ``first`` to ``last - 1``, taut, hold ``force`` N.

    The inverse of equations 1 and 2, which are linear in pressure. Zero where their braids cannot
    pull at this strain.
    """
    passive = stiffness = 0.0
    for i in range(first, last):
        unit = units[i]
        passive += unit.fams * fam.bladder_force(unit.fam, strain)
        stiffness += unit.fams * fam.mesh_coefficient(unit.fam, strain)
    return (force - passive) / stiffness if stiffness > 0.0 else 0.0


@compiled
def taut_force(units: tuple[MotorUnit, ...], pressure: float, strain: float) -> float:
    """Return the force in N of all units, taut, at one ``pressure`` in Pa (equations 1 and 2)."""
    total = 0.0
    for i in range(len(units)):
        total += units[i].fams * fam.straight_force(units[i].fam, pressure, strain)
    return total


@compiled
def measured_force(
    units: tuple[MotorUnit, ...],
    first: int,
    last: int,
    mu_pressure: npt.NDArray[np.float64],
    strain: float,
) -> float:
    """Return the modelled force in N of units ``first`` to ``last - 1`` at measured pressures."""
    total = 0.0
    for i in range(first, last):
        pressure = max(mu_pressure[i], 0.0)
        total += units[i].fams * fam.force(units[i].fam, pressure, strain)
    return total


@compiled
def balance(
    units: tuple[MotorUnit, ...],
    older: int,
    ready: float,
    force: float,
    strain: float,
    mu_pressure: npt.NDArray[np.float64],
) -> float:
    """
    Return the pressure in Pa at which the full ones of the ``older`` units hold ``force`` N.

    Those that still fill, below ``ready`` (Pa) or slack, give what they are measured to give. The
    first is full.
    """
    passive = stiffness = filling = 0.0
    for i in range(older):
        unit, pressure = units[i], max(mu_pressure[i], 0.0)
        slack = pressure <= fam.deslack_pressure(unit.fam, strain)
        if i > 0 and (slack or pressure < ready):
            filling += unit.fams * fam.force(unit.fam, pressure, strain)
        else:
            passive += unit.fams * fam.bladder_force(unit.fam, strain)
            stiffness += unit.fams * fam.mesh_coefficient(unit.fam, strain)
    return (force - filling - passive) / stiffness if stiffness > 0.0 else 0.0


@compiled
def allocate(
    policy: int,
    units: tuple[MotorUnit, ...],
    nominal_pressure: float,
    recruited: int,
    pressure_reference: float,
    compensation: float,
    strain: float,
    source_pressure: float,
    mu_pressure: npt.NDArray[np.float64],
    references: npt.NDArray[np.float64],
) -> None:
    """
    Fill ``references`` (units,), the pressure in Pa that each unit shall have; vented ones 0.

    ``batch``: the pressure reference, for the units before the newest with the compensation
    (equation 10) on top, none above the source pressure.

    ``force``: one pressure for all recruited units at which the bundle, with the vented units as
    measured, has the force demanded. While units fill or a released one drains, those that are
    full make up for what these do not give yet, or still give.

    ``orderly``: the units before the newest carry what they can, up to the full source pressure;
    the newest carries the rest and is never let go slack.

    Both are limited to the nominal pressure, or to a source above it, not to a drooped source: a
    reference above what the source has opens the valve fully.
    """
    count = len(units)
    references[:] = 0.0
    if policy == BATCH:
        for i in range(recruited):
            added = compensation if is_compensated(i, recruited) else 0.0
            references[i] = clamp(pressure_reference + added, 0.0, max(source_pressure, 0.0))
        return
    newest, older = recruited - 1, max(recruited - 1, 1)
    vented = measured_force(units, recruited, count, mu_pressure, strain)
    share = taut_force(units, pressure_reference, strain) - vented
    given = measured_force(units, older, recruited, mu_pressure, strain)
    if policy == FORCE:
        last = common_pressure(units, 0, recruited, share, strain)
        ready = READY * last
        before = balance(units, older, ready, share - given, strain, mu_pressure)
    else:
        # What a slack unit resists is made up for; what a taut one gives is its own rest.
        ready = 0.0
        before = balance(units, older, ready, share - min(given, 0.0), strain, mu_pressure)
        carried = measured_force(units, 0, newest, mu_pressure, strain)
        last = common_pressure(units, newest, recruited, share - carried, strain)
        last = max(last, fam.deslack_pressure(units[newest].fam, strain))
    highest = max(source_pressure, nominal_pressure)
    for i in range(recruited):
        fills = policy == FORCE and i > 0 and mu_pressure[i] < ready
        wanted = last if i >= older or fills else before
        references[i] = clamp(wanted, 0.0, highest)
