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
The simulated rig: source, valves, hoses, bundle and hanging load.

The oil content of each unit is a state and its pressure follows from it, so that oil is conserved
to rounding. Integrated by the classical Runge-Kutta method at a fixed number of sub-steps.

Flow, pressure and forces are equations 1-8 of the paper as in docs/model.md, the source its
Figure 10; mass, damping and friction of the load and the lag of the spools are textbook.
"""

import math
from typing import NamedTuple

from fam_bundle_model import fam
from fam_bundle_model.bundle import balancing_pressure, motor_units, MotorUnit
from fam_bundle_model.compile import compiled
from fam_bundle_model.hydraulics import (
    hydraulic_law,
    HydraulicLaw,
    source_pressure_rate,
    unit_flow,
)
from fam_bundle_model.parameters import Configuration, GRAVITY
import numpy as np
import numpy.typing as npt

# Layout of the state vector; then the oil of one FAM (m^3) and the spool of each unit.
STRAIN, STRAIN_RATE, SOURCE_PRESSURE, UNITS = 0, 1, 2, 3


class Plant(NamedTuple):
    """Laws and load of the rig; SI units."""

    units: tuple[MotorUnit, ...]
    hydraulics: HydraulicLaw
    mass: float
    damping: float
    friction_force: float
    friction_rate: float


class Truth(NamedTuple):
    """What ideal sensors would read: strain, force (N), source pressure (Pa) and flow (m^3/s)."""

    strain: float
    force: float
    source_pressure: float
    source_flow: float


def plant(configuration: Configuration) -> Plant:
    """Return the plant of ``configuration``."""
    load = configuration.load
    return Plant(
        motor_units(configuration),
        hydraulic_law(configuration),
        load.mass,
        load.damping,
        load.friction_force,
        load.friction_rate,
    )


def resting_state(configuration: Configuration, rig: Plant) -> npt.NDArray[np.float64]:
    """Return the state at rest: the first unit holds the load, the others are vented."""
    count = len(rig.units)
    strain = configuration.simulation.initial_strain
    nominal = rig.hydraulics.nominal_pressure
    held = balancing_pressure(rig.units, 1, strain, rig.mass * GRAVITY, nominal)
    state = np.zeros(UNITS + 2 * count)
    state[STRAIN] = strain
    state[SOURCE_PRESSURE] = nominal
    for i, unit in enumerate(rig.units):
        pressure = held if i == 0 else 0.0
        state[UNITS + i] = fam.oil_of(unit.fam, pressure, strain, rig.hydraulics.bulk_modulus)
    return state


@compiled
def derivative(
    rig: Plant,
    state: npt.NDArray[np.float64],
    command: npt.NDArray[np.float64],
    rate: npt.NDArray[np.float64],
) -> None:
    """Fill ``rate`` with the change of ``state`` per s under the spool ``command`` (units,)."""
    count = len(rig.units)
    strain, speed, source = state[STRAIN], state[STRAIN_RATE], state[SOURCE_PRESSURE]
    drawn = force = 0.0
    for i in range(count):
        unit = rig.units[i]
        oil, spool = state[UNITS + i], state[UNITS + count + i]
        pressure = fam.pressure_of(unit.fam, oil, strain, rig.hydraulics.bulk_modulus)
        force += unit.fams * fam.force(unit.fam, pressure, strain)
        flow = unit_flow(rig.hydraulics, spool, source, pressure)
        if spool > 0.0:
            drawn += flow
        rate[UNITS + i] = flow / unit.fams
        rate[UNITS + count + i] = (command[i] - spool) / rig.hydraulics.spool_time_constant
    friction = rig.friction_force * math.tanh(speed / rig.friction_rate)
    length = rig.units[0].fam.length
    resisting = rig.mass * GRAVITY + rig.damping * length * speed + friction
    rate[STRAIN] = speed
    rate[STRAIN_RATE] = (force - resisting) / (rig.mass * length)
    rate[SOURCE_PRESSURE] = source_pressure_rate(rig.hydraulics, source, drawn)


@compiled
def plant_step(
    rig: Plant,
    state: npt.NDArray[np.float64],
    command: npt.NDArray[np.float64],
    dt: float,
    substeps: int,
) -> None:
    """Advance ``state`` in place by ``dt`` s under a held spool ``command`` (units,)."""
    size = state.shape[0]
    k1, k2, k3, k4 = np.empty(size), np.empty(size), np.empty(size), np.empty(size)
    inner = np.empty(size)
    h = dt / substeps
    for _ in range(substeps):
        derivative(rig, state, command, k1)
        for j in range(size):
            inner[j] = state[j] + 0.5 * h * k1[j]
        derivative(rig, inner, command, k2)
        for j in range(size):
            inner[j] = state[j] + 0.5 * h * k2[j]
        derivative(rig, inner, command, k3)
        for j in range(size):
            inner[j] = state[j] + h * k3[j]
        derivative(rig, inner, command, k4)
        for j in range(size):
            state[j] += h / 6.0 * (k1[j] + 2.0 * k2[j] + 2.0 * k3[j] + k4[j])


@compiled
def truth(
    rig: Plant, state: npt.NDArray[np.float64], mu_pressure: npt.NDArray[np.float64]
) -> Truth:
    """Return what ideal sensors read in ``state`` and fill ``mu_pressure`` (units,) in Pa."""
    count = len(rig.units)
    strain, source = state[STRAIN], state[SOURCE_PRESSURE]
    force = flow = 0.0
    for i in range(count):
        unit = rig.units[i]
        spool = state[UNITS + count + i]
        mu_pressure[i] = fam.pressure_of(
            unit.fam, state[UNITS + i], strain, rig.hydraulics.bulk_modulus
        )
        force += unit.fams * fam.force(unit.fam, mu_pressure[i], strain)
        if spool > 0.0:
            flow += unit_flow(rig.hydraulics, spool, source, mu_pressure[i])
    return Truth(strain, force, source, flow)
