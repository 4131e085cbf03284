# SPDX-License-Identifier: Apache-2.0
"""The outer loop: PI on strain, its output the pressure reference (Figure 3a)."""

from typing import NamedTuple

from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.pressure_pi import clamp


class StrainLoop(NamedTuple):
    """Gains in Pa and Pa/s per unit strain, tracking time in s, nominal pressure in Pa."""

    proportional: float
    integral: float
    tracking_time: float
    nominal_pressure: float


class StrainLoopState(NamedTuple):
    """Integral share in Pa; before the first tick it is not known."""

    integral: float
    started: bool


class StrainLoopOutput(NamedTuple):
    """Strain error, pressure reference applied, and what the law asked for, both in Pa."""

    error: float
    pressure: float
    unlimited: float


def strain_loop(configuration: Configuration) -> StrainLoop:
    """Return the law of ``configuration``."""
    gains = configuration.strain_loop
    return StrainLoop(
        gains.proportional_gain,
        gains.integral_gain,
        gains.tracking_time,
        configuration.source.nominal_pressure,
    )


def strain_loop_start() -> StrainLoopState:
    """Return the state before the first tick."""
    return StrainLoopState(0.0, False)


@compiled
def strain_loop_step(
    law: StrainLoop,
    state: StrainLoopState,
    reference: float,
    strain: float,
    source_pressure: float,
    first_unit_pressure: float,
    dt: float,
) -> tuple[StrainLoopState, StrainLoopOutput]:
    """Return the next state and the output; pressures in Pa, ``dt`` in s.

    The output is limited to what the source can give. Anti-windup by back-calculation over the
    tracking time. The first call starts from the first motor unit's measured pressure, so that
    the loop closes without a bump.
    """
    error = reference - strain
    integral = state.integral
    if not state.started:
        integral = first_unit_pressure - law.proportional * error
    unlimited = law.proportional * error + integral
    pressure = clamp(unlimited, 0.0, max(min(source_pressure, law.nominal_pressure), 0.0))
    integral += dt * (law.integral * error + (pressure - unlimited) / law.tracking_time)
    return StrainLoopState(integral, True), StrainLoopOutput(error, pressure, unlimited)
