# SPDX-License-Identifier: Apache-2.0
"""The inner loops: one PI per motor unit, its output the spool command (Figures 3 and 5, b, c)."""

import numpy as np
import numpy.typing as npt

from fam_bundle_model.compile import compiled
from fam_bundle_model.pressure_pi import PressureGains, clamp, pressure_pi


@compiled
def is_compensated(unit: int, recruited: int) -> bool:
    """Return whether ``unit`` gets the pressure compensation: those before the newest recruit.

    A single recruited unit is compensated against the slack ones itself.
    """
    return unit < recruited and unit < max(recruited - 1, 1)


@compiled
def pressure_loop_step(
    gains: tuple[PressureGains, ...],
    integral: npt.NDArray[np.float64],
    recruited: int,
    pressure_reference: float,
    compensation: float,
    source_pressure: float,
    mu_pressure: npt.NDArray[np.float64],
    dt: float,
    references: npt.NDArray[np.float64],
    spool: npt.NDArray[np.float64],
    saturated: npt.NDArray[np.bool_],
) -> None:
    """Update ``integral`` and fill ``references`` (Pa), ``spool`` and ``saturated``, all (units,).

    Each unit has its own ``gains``: its loop is the faster, the less oil it holds.
    Recruited units follow the pressure reference, those before the newest with the compensation
    on top, none above the source pressure (Pa). The others are vented: reference zero and no
    integral share, so that a unit is recruited without a bump. ``dt`` in s.
    """
    for i in range(mu_pressure.shape[0]):
        references[i] = 0.0
        if i < recruited:
            added = compensation if is_compensated(i, recruited) else 0.0
            references[i] = clamp(pressure_reference + added, 0.0, max(source_pressure, 0.0))
        else:
            integral[i] = 0.0
        share, asked = pressure_pi(gains[i], integral[i], references[i], mu_pressure[i], dt)
        integral[i] = share
        spool[i] = clamp(asked, -1.0, 1.0)
        saturated[i] = spool[i] != asked
