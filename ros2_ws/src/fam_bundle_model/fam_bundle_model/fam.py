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
One fluidic artificial muscle: force and volume at a pressure and a strain.

Kim & Bryant 2025, equations 1-4 and 8. Strain is positive in contraction, force positive in
tension, pressure gauge. The compressive regions are our closed forms with the paper's structure;
``docs/model.md`` derives them.
"""

import math
from typing import Any, NamedTuple

from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import FamParameters
import numpy as np
import numpy.typing as npt

TABLE_POINTS = 257
VACUUM = -101325.0  # Pa gauge
BISECTIONS = 56  # halves any bracket here to the last bits of a double
LARGEST_STRAIN = 0.6  # beyond any strain at which a FAM still has a buckled shape


class FamLaw(NamedTuple):
    """
    A FAM ready for evaluation: coefficients, and what depends on pressure alone as tables.

    ``compression`` has one row per pressure (uniform, from 0, ``pressure_step`` Pa apart) and the
    columns buckling strain, its slope, collapse strain, its slope, folding spring (N m), its
    slope; slopes per Pa. ``slack`` has one row per oil content of a slack FAM (uniform, from
    ``slack_volume``, ``slack_step`` m^3 apart): its pressure (Pa) and slope (Pa/m^3).
    """

    length: float
    mesh_area_tan: float
    mesh_area_sin: float
    bladder_c1: float
    bladder_c2: float
    sin_squared: float
    cos_squared: float
    transition_constant: float
    pressure_step: float
    compression: npt.NDArray[np.float64]
    slack_volume: float
    slack_step: float
    slack: npt.NDArray[np.float64]


@compiled
def mesh_coefficient(law: FamLaw, strain: float) -> float:
    """Return the braid's force per pressure in m^2 (equation 1)."""
    axial = 1.0 - strain
    return 3.0 * law.mesh_area_tan * axial * axial - law.mesh_area_sin


@compiled
def bladder_force(law: FamLaw, strain: float) -> float:
    """
    Return the bladder's axial force in N (equation 2, Mooney-Rivlin).

    The stretches are axial ``1 - e``, hoop ``h`` from the braid's kinematics and radial
    ``1 / ((1 - e) h)``; the force is the stored energy's derivative by length.
    """
    axial2 = (1.0 - strain) * (1.0 - strain)
    hoop2 = (1.0 - axial2 * law.cos_squared) / law.sin_squared
    axial2_slope = -2.0 * (1.0 - strain)
    hoop2_slope = -axial2_slope * law.cos_squared / law.sin_squared
    product = axial2 * hoop2
    product_slope = axial2_slope * hoop2 + axial2 * hoop2_slope
    i1_slope = axial2_slope + hoop2_slope - product_slope / (product * product)
    i2_slope = -axial2_slope / (axial2 * axial2) - hoop2_slope / (hoop2 * hoop2) + product_slope
    return -(law.bladder_c1 * i1_slope + law.bladder_c2 * i2_slope)


@compiled
def straight_force(law: FamLaw, pressure: float, strain: float) -> float:
    """Return the force in N of a FAM that stays straight: linear in pressure."""
    return pressure * mesh_coefficient(law, strain) + bladder_force(law, strain)


@compiled
def volume(law: FamLaw, strain: float) -> float:
    """Return the enclosed volume in m^3 of one straight FAM (equation 8, one FAM)."""
    axial = 1.0 - strain
    return law.length * axial * (law.mesh_area_sin - law.mesh_area_tan * axial * axial)


@compiled
def deslack_pressure(law: FamLaw, strain: float) -> float:
    """
    Return the pressure in Pa at which a FAM at ``strain`` just carries no force (equation 9).

    Infinite where no pressure makes the braid pull.
    """
    coefficient = mesh_coefficient(law, strain)
    if coefficient <= 0.0:
        return math.inf
    return -bladder_force(law, strain) / coefficient


@compiled
def lowest_strain(law: FamLaw) -> float:
    """Return the strain of a FAM stretched to 95 % of what its braid allows (hoop stretch 0)."""
    return -0.95 * (1.0 / math.sqrt(law.cos_squared) - 1.0)


@compiled
def free_strain(law: FamLaw, pressure: float) -> float:
    """Return the strain at which a FAM at ``pressure`` Pa has no force: equation 9 inverted."""
    low, high = lowest_strain(law), LARGEST_STRAIN
    strain = 0.1
    for _ in range(100):
        value = straight_force(law, pressure, strain)
        if value > 0.0:
            low = strain
        else:
            high = strain
        step = 1e-6
        slope = (straight_force(law, pressure, strain + step) - value) / step
        newton = strain - value / slope if slope < 0.0 else low
        following = newton if low < newton < high else 0.5 * (low + high)
        if abs(following - strain) < 1e-15:
            return following
        strain = following
    return strain


@compiled
def interpolate(
    table: npt.NDArray[np.float64], column: int, step: float, x: float
) -> tuple[float, float]:
    """
    Return the cubic Hermite value and slope at ``x`` of a table with uniform spacing.

    ``table[:, column]`` holds the values, the next column their slopes. Outside of the table the
    value is that of the nearest end and the slope is zero.
    """
    last = table.shape[0] - 1
    position = x / step
    if position < 0.0:
        return table[0, column], 0.0
    if position >= last:
        return table[last, column], 0.0
    i = int(position)
    s = position - i
    y0, y1 = table[i, column], table[i + 1, column]
    d0, d1 = table[i, column + 1] * step, table[i + 1, column + 1] * step
    rise = y1 - y0
    c2 = 3.0 * rise - 2.0 * d0 - d1
    c3 = d0 + d1 - 2.0 * rise
    return y0 + s * (d0 + s * (c2 + s * c3)), (d0 + s * (2.0 * c2 + 3.0 * s * c3)) / step


@compiled
def buckling_strain(law: FamLaw, pressure: float) -> float:
    """Return the strain e_b beyond which a FAM at ``pressure`` Pa is slack, its arc fixed."""
    return interpolate(law.compression, 0, law.pressure_step, pressure)[0]


@compiled
def force(law: FamLaw, pressure: float, strain: float) -> float:
    """Return the axial force in N of one FAM in any region (equations 2-4)."""
    buckling = interpolate(law.compression, 0, law.pressure_step, pressure)[0]
    if strain <= buckling:
        return straight_force(law, pressure, strain)
    critical = straight_force(law, pressure, buckling)
    growth = 0.5 / (1.0 - buckling)
    collapse = interpolate(law.compression, 2, law.pressure_step, pressure)[0]
    if strain <= collapse:
        return critical * (1.0 + growth * (strain - buckling))
    at_collapse = critical * (1.0 + growth * (collapse - buckling))
    folded = folding_force(law, pressure, strain, buckling)
    decay = math.exp(-law.transition_constant * (strain - collapse))
    return folded + (at_collapse - folded) * decay


@compiled
def folding_force(law: FamLaw, pressure: float, strain: float, buckling: float) -> float:
    """Return the force in N of two links that fold against their end springs (F_c, equation 4)."""
    spring = interpolate(law.compression, 4, law.pressure_step, pressure)[0]
    angle = math.acos((1.0 - strain) / (1.0 - buckling))
    return -2.0 * spring * angle / (law.length * (1.0 - buckling) * math.sin(angle))


@compiled
def pressure_of(law: FamLaw, oil: float, strain: float, bulk_modulus: float) -> float:
    """
    Return the pressure in Pa of one FAM that holds ``oil`` m^3 (counted at zero pressure).

    Equation 7 in its conservative form ``oil = V(e_arc) exp(P / E)``. The larger of the taut
    pressure (``e_arc = e``) and the slack one (``e_arc = e_b(P)``) is the true one, since both
    volumes grow with strain; so no region has to be chosen. Where both are below a vacuum, a
    vapour cavity fills the rest.
    """
    taut = bulk_modulus * math.log(oil / volume(law, strain))
    if oil <= law.slack_volume:
        slack = bulk_modulus * math.log(oil / law.slack_volume)
    else:
        slack = interpolate(law.slack, 0, law.slack_step, oil - law.slack_volume)[0]
    return max(taut, slack, VACUUM)


@compiled
def oil_of(law: FamLaw, pressure: float, strain: float, bulk_modulus: float) -> float:
    """Return the oil content in m^3 of one FAM at ``pressure``: inverse of ``pressure_of``."""
    arc = min(strain, interpolate(law.compression, 0, law.pressure_step, pressure)[0])
    return volume(law, arc) * math.exp(pressure / bulk_modulus)


class _Column(NamedTuple):
    """The bladder as a column with end springs; SI units."""

    bladder_rigidity: float
    outer_radius: float
    base_spring: float
    spring_slope: float
    spring_offset: float
    collapse_moment_at_rest: float
    collapse_moment_slope: float


def fam_law(fam: FamParameters, unit: int, maximum_pressure: float, bulk_modulus: float) -> FamLaw:
    """
    Return the law of the FAMs of motor unit ``unit`` (0 is the first recruited).

    The tables reach from 0 to ``maximum_pressure`` (Pa).
    """
    p = {name: float(value_of(values, unit)) for name, values in vars(fam).items()}
    sin2, tan2 = math.sin(p['braid_angle']) ** 2, math.tan(p['braid_angle']) ** 2
    area = math.pi * p['inner_radius'] ** 2
    outer = p['inner_radius'] + p['thickness']
    modulus = p['youngs_modulus'] * p['youngs_modulus_factor']
    wall_area = math.pi * (outer**2 - p['inner_radius'] ** 2)
    stiffness = wall_area * modulus / 6.0  # V_b / L0 times C1 + C2 = E / 6
    law = FamLaw(
        length=p['length'],
        mesh_area_tan=area / tan2,
        mesh_area_sin=area / sin2,
        bladder_c1=stiffness * (1.0 - p['mooney_rivlin_share']),
        bladder_c2=stiffness * p['mooney_rivlin_share'],
        sin_squared=sin2,
        cos_squared=1.0 - sin2,
        transition_constant=p['transition_constant'],
        pressure_step=maximum_pressure / (TABLE_POINTS - 1),
        compression=np.zeros((1, 6)),
        slack_volume=1.0,
        slack_step=1.0,
        slack=np.zeros((1, 2)),
    )
    law = law._replace(compression=_compression_table(law, _column(p, modulus, outer)))
    return _with_slack_table(law, maximum_pressure, bulk_modulus)


def value_of(values: tuple[float, ...], unit: int) -> float:
    """Return the value for ``unit`` of a parameter with one value, or one per motor unit."""
    return values[unit] if len(values) > 1 else values[0]


def _column(p: dict[str, float], modulus: float, outer: float) -> _Column:
    rigidity = modulus * math.pi / 4.0 * (outer**4 - p['inner_radius'] ** 4)
    mean_radius = 0.5 * (outer + p['inner_radius'])
    factor = p['collapse_moment_factor']
    brazier = 2.0 * math.sqrt(2.0) / 9.0 * math.pi * modulus * p['thickness'] ** 2 * mean_radius
    return _Column(
        bladder_rigidity=rigidity,
        outer_radius=outer,
        base_spring=rigidity / (p['end_spring_span'] * outer),
        spring_slope=p['end_spring_slope'],
        spring_offset=p['end_spring_offset'],
        collapse_moment_at_rest=factor * brazier / math.sqrt(1.0 - p['poisson_ratio'] ** 2),
        collapse_moment_slope=factor * math.pi * p['inner_radius'] ** 3,
    )


@compiled
def _end_rotation(kappa: float) -> float:
    """Return psi in (pi/2, pi) with sin psi + (2 / kappa) psi cos psi = 0, by bisection."""
    low, high = 0.5 * math.pi, math.pi
    for _ in range(BISECTIONS):
        psi = 0.5 * (low + high)
        if kappa * math.sin(psi) + 2.0 * psi * math.cos(psi) > 0.0:
            low = psi
        else:
            high = psi
    return 0.5 * (low + high)


@compiled
def _column_at(
    law: FamLaw, column: _Column, spring: float, pressure: float, strain: float
) -> tuple[float, float, float]:
    """Return bending rigidity (N m^2), psi and critical load (N) of a straight FAM."""
    arc = law.length * (1.0 - strain)
    braid = 3.0 * column.outer_radius * column.outer_radius * law.mesh_area_tan
    rigidity = column.bladder_rigidity + braid * (1.0 - strain) * pressure
    psi = _end_rotation(spring * arc / rigidity)
    return rigidity, psi, 4.0 * psi * psi * rigidity / (arc * arc)


@compiled
def _compression_at(
    law: FamLaw, column: _Column, pressure: float, values: npt.NDArray[np.float64]
) -> None:
    """Fill ``values`` with buckling strain, collapse strain and folding spring at ``pressure``."""
    spring = column.base_spring * (column.spring_slope * pressure + column.spring_offset)
    low, high = free_strain(law, pressure), LARGEST_STRAIN
    for _ in range(BISECTIONS):
        strain = 0.5 * (low + high)
        critical = _column_at(law, column, spring, pressure, strain)[2]
        if straight_force(law, pressure, strain) + critical > 0.0:
            low = strain
        else:
            high = strain
    buckling = 0.5 * (low + high)
    rigidity, psi, _ = _column_at(law, column, spring, pressure, buckling)
    arc = law.length * (1.0 - buckling)
    moment = column.collapse_moment_at_rest + column.collapse_moment_slope * pressure
    # First mode y = a cos(2 psi (x / l - 1/2)): its moment at mid-span, and how much it shortens.
    amplitude = moment * arc * arc / (4.0 * psi * psi * rigidity)
    bent = amplitude * psi
    shortening = bent * bent / arc * (1.0 - math.sin(2.0 * psi) / (2.0 * psi))
    values[0] = buckling
    values[1] = buckling + shortening / law.length
    values[2] = 1.0 / (1.0 / spring + arc / (6.0 * rigidity))


@compiled
def _slack_pressure(law: FamLaw, oil: float, highest: float, bulk_modulus: float) -> float:
    """Return the pressure in Pa, up to ``highest``, of a slack FAM that holds ``oil`` m^3."""
    low, high = 0.0, highest
    for _ in range(BISECTIONS):
        pressure = 0.5 * (low + high)
        if oil_of(law, pressure, LARGEST_STRAIN, bulk_modulus) < oil:
            low = pressure
        else:
            high = pressure
    return 0.5 * (low + high)


def _compression_table(law: FamLaw, column: _Column) -> npt.NDArray[np.float64]:
    pressures = law.pressure_step * np.arange(TABLE_POINTS)
    values = np.empty((TABLE_POINTS, 3))
    for row, pressure in zip(values, pressures.tolist(), strict=True):
        _compression_at(law, column, pressure, row)
    return _with_slopes(pressures, values)


def _with_slopes(x: npt.NDArray[Any], values: npt.NDArray[Any]) -> npt.NDArray[np.float64]:
    """Return ``values`` (points, columns) with the slope of each column beside it."""
    table = np.empty((len(x), 2 * values.shape[1]))
    table[:, 0::2] = values
    table[:, 1::2] = np.gradient(values, x, axis=0, edge_order=2)
    return table


def _with_slack_table(law: FamLaw, maximum_pressure: float, bulk_modulus: float) -> FamLaw:
    """Return ``law`` with the pressure of a slack FAM tabulated over its oil content."""
    least = oil_of(law, 0.0, LARGEST_STRAIN, bulk_modulus)
    most = oil_of(law, maximum_pressure, LARGEST_STRAIN, bulk_modulus)
    contents = np.linspace(least, most, 4 * TABLE_POINTS)
    pressures = [
        _slack_pressure(law, c, maximum_pressure, bulk_modulus) for c in contents.tolist()
    ]
    return law._replace(
        slack_volume=least,
        slack_step=(most - least) / (len(contents) - 1),
        slack=_with_slopes(contents, np.array([pressures]).T),
    )
