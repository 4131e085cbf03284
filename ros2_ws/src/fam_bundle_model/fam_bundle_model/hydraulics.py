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

"""Source, servo valve and hose (Kim & Bryant 2025, equations 5 and 6, Figure 10)."""

import math
from typing import NamedTuple

from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import Configuration

# Spool command that opens a motor unit fully to the tank: the safe state.
TO_TANK = -1.0


class HydraulicLaw(NamedTuple):
    """
    Constants of the supply side; SI units.

    ``valve_conductance`` is ``Q_N / sqrt(p_N)`` of equation 5, ``hose_resistance`` is
    ``8 eta l / (pi r^4)`` of equation 6.
    """

    nominal_pressure: float
    droop: float
    source_time_constant: float
    valve_conductance: float
    spool_time_constant: float
    hose_resistance: float
    bulk_modulus: float


def hydraulic_law(configuration: Configuration) -> HydraulicLaw:
    """Return the constants of the supply side of ``configuration``."""
    valve, hose = configuration.valve, configuration.hose
    return HydraulicLaw(
        nominal_pressure=configuration.source.nominal_pressure,
        droop=configuration.source.droop,
        source_time_constant=configuration.source.time_constant,
        valve_conductance=valve.rated_flow / math.sqrt(valve.rated_pressure_drop),
        spool_time_constant=valve.spool_time_constant,
        hose_resistance=8.0 * hose.viscosity * hose.length / (math.pi * hose.radius**4),
        bulk_modulus=configuration.oil.bulk_modulus,
    )


@compiled
def unit_flow(law: HydraulicLaw, spool: float, source_pressure: float, pressure: float) -> float:
    """
    Return the flow in m^3/s into a motor unit through its valve and its hose in series.

    ``spool`` > 0 opens the unit to the source, < 0 to the tank (gauge 0, which gives oil back to
    a unit below it). Equations 5 and 6 share one flow; eliminating the pressure between them
    leaves a quadratic with this root.
    """
    difference = source_pressure - pressure if spool > 0.0 else -pressure
    conductance = abs(spool) * law.valve_conductance
    if conductance == 0.0 or difference == 0.0:
        return 0.0
    laminar = law.hose_resistance * conductance
    root = math.sqrt(laminar * laminar + 4.0 * abs(difference))
    return 2.0 * difference * conductance / (laminar + root)


@compiled
def line_loss(law: HydraulicLaw, flow: float) -> float:
    """
    Return the pressure in Pa that ``flow`` m^3/s loses in an open valve and its hose.

    Equations 5 and 6 in series, solved for the pressure difference.
    """
    ratio = flow / law.valve_conductance
    return law.hose_resistance * flow + ratio * abs(ratio)


@compiled
def source_pressure_rate(law: HydraulicLaw, source_pressure: float, flow: float) -> float:
    """
    Return the rate of the source pressure in Pa/s at ``flow`` m^3/s out of the source.

    Figure 10's straight line behind a first-order lag; reverse flow is relieved to the tank.
    """
    settled = law.nominal_pressure - law.droop * max(flow, 0.0)
    return (settled - source_pressure) / law.source_time_constant
