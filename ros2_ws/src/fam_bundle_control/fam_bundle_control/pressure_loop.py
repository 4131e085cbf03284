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

"""The inner loops: one PI per motor unit, its output the spool command (Figures 3 and 5, b, c)."""

from typing import NamedTuple

from fam_bundle_control.allocation import allocate, BATCH
from fam_bundle_model.bundle import MotorUnit
from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import ALLOCATIONS, Configuration
from fam_bundle_model.pressure_pi import clamp, pressure_gains, pressure_pi, PressureGains
import numpy as np
import numpy.typing as npt


class PressureLoop(NamedTuple):
    """
    Gains of each motor unit, how the demand is allocated (see ``allocation``), and its limit.

    Each unit has its own gains: its loop is the faster, the less oil it holds.
    """

    gains: tuple[PressureGains, ...]
    allocation: int
    nominal_pressure: float


def pressure_loop(configuration: Configuration) -> PressureLoop:
    """Return the law of ``configuration``."""
    return PressureLoop(
        pressure_gains(configuration),
        ALLOCATIONS.index(configuration.allocation.policy),
        configuration.source.nominal_pressure,
    )


@compiled
def pressure_loop_step(
    law: PressureLoop,
    units: tuple[MotorUnit, ...],
    integral: npt.NDArray[np.float64],
    recruited: int,
    pressure_reference: float,
    compensation: float,
    strain: float,
    source_pressure: float,
    mu_pressure: npt.NDArray[np.float64],
    dt: float,
    references: npt.NDArray[np.float64],
    spool: npt.NDArray[np.float64],
    saturated: npt.NDArray[np.bool_],
) -> None:
    """
    Update ``integral`` and fill ``references`` (Pa), ``spool`` and ``saturated``, all (units,).

    Recruited units follow what they are allocated of the pressure reference. The others are
    vented: reference zero and no integral share, so that a unit is recruited without a bump.
    Pressures in Pa, ``dt`` in s.
    """
    recruited = min(recruited, len(units))  # a message may say anything
    allocate(
        law.allocation,
        units,
        law.nominal_pressure,
        recruited,
        pressure_reference,
        compensation,
        strain,
        source_pressure,
        mu_pressure,
        references,
    )
    for i in range(mu_pressure.shape[0]):
        if i >= recruited:
            integral[i] = 0.0
        share, asked = pressure_pi(law.gains[i], integral[i], references[i], mu_pressure[i], dt)
        integral[i] = share
        # A vented unit below the tank's pressure is filled from the tank, not from the source; the
        # paper's allocation is left as it was published.
        if i >= recruited and law.allocation != BATCH:
            asked = -abs(asked)
        spool[i] = clamp(asked, -1.0, 1.0)
        saturated[i] = spool[i] != asked
