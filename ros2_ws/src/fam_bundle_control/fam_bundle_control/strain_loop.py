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
The outer loop: PI on strain, its output the pressure reference (Figure 3a).

Where the demand is allocated by force, the output is the pressure that all units of the bundle
would need in common, and what the model knows of it is fed forward: the pressure that balances the
load at the reference strain.
"""

from typing import NamedTuple

from fam_bundle_control.allocation import BATCH, common_pressure, measured_force
from fam_bundle_model.bundle import MotorUnit
from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import ALLOCATIONS, Configuration, GRAVITY
from fam_bundle_model.pressure_pi import clamp
import numpy as np
import numpy.typing as npt


class StrainLoop(NamedTuple):
    """
    Gains in Pa and Pa/s per unit strain, tracking time in s, nominal pressure in Pa.

    ``feedforward`` is the share of the balancing pressure under ``weight`` (N) that is fed
    forward, where ``by_force`` says that the demand is allocated by force.
    """

    proportional: float
    integral: float
    tracking_time: float
    nominal_pressure: float
    by_force: bool
    feedforward: float
    weight: float


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
        configuration.allocation.policy != ALLOCATIONS[BATCH],
        configuration.allocation.feedforward,
        configuration.load.mass * GRAVITY,
    )


def strain_loop_start() -> StrainLoopState:
    """Return the state before the first tick."""
    return StrainLoopState(0.0, False)


def strain_loop_retuned(
    state: StrainLoopState, error: float, before: StrainLoop, after: StrainLoop
) -> StrainLoopState:
    """
    Return ``state`` for the law ``after`` in place of ``before``, at the last strain ``error``.

    The integral share takes over what the proportional one loses (Pa), so that the output has no
    jump of its own: at the same error both laws ask for the same.
    """
    moved = (before.proportional - after.proportional) * error
    return StrainLoopState(state.integral + moved, state.started)


@compiled
def strain_loop_step(
    law: StrainLoop,
    units: tuple[MotorUnit, ...],
    state: StrainLoopState,
    reference: float,
    strain: float,
    source_pressure: float,
    mu_pressure: npt.NDArray[np.float64],
    dt: float,
) -> tuple[StrainLoopState, StrainLoopOutput]:
    """
    Return the next state and the output; pressures in Pa, ``dt`` in s.

    The output is limited to what the source can give. Anti-windup by back-calculation over the
    tracking time. The first call starts from the measured pressure of the first motor unit, or
    from that which the force of all of them amounts to, so that the loop closes without a bump.
    """
    error = reference - strain
    integral, present = state.integral, mu_pressure[0]
    asked = law.proportional * error
    if law.by_force:
        count = len(units)
        force = measured_force(units, 0, count, mu_pressure, strain)
        present = common_pressure(units, 0, count, force, strain)
        asked += law.feedforward * common_pressure(units, 0, count, law.weight, reference)
    if not state.started:
        integral = present - asked
    unlimited = asked + integral
    pressure = clamp(unlimited, 0.0, max(min(source_pressure, law.nominal_pressure), 0.0))
    integral += dt * (law.integral * error + (pressure - unlimited) / law.tracking_time)
    return StrainLoopState(integral, True), StrainLoopOutput(error, pressure, unlimited)
