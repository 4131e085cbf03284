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
The recruitment lag and the source pressure drop of a shift, tabulated (Figure 6).

One slack motor unit at zero pressure, held at the strain whose de-slack pressure is P_d, follows
a step of its pressure reference to P_d. The lag is the time to 95 % of P_d; the drop is the
source's largest loss until then.
"""

import math
from pathlib import Path
from typing import NamedTuple
import zipfile

from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units, MotorUnit
from fam_bundle_model.compile import cache_directory, compiled, source_digest
from fam_bundle_model.files import whole_file
from fam_bundle_model.hydraulics import (
    hydraulic_law,
    HydraulicLaw,
    source_pressure_rate,
    unit_flow,
)
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.pressure_pi import clamp, pressure_gains, pressure_pi, PressureGains
import numpy as np
import numpy.typing as npt

REACHED = 0.95  # of the de-slack pressure: the paper's definition of the lag
PHYSICS = ('fam', 'source', 'valve', 'hose', 'oil', 'pressure_loop', 'simulation')


class LagTable(NamedTuple):
    """
    Uniform axes in Pa, and lag (s, infinity: never) and drop (Pa) of each motor unit.

    ``lag`` and ``drop`` have the shape (motor units, source points, de-slack points).
    """

    source_pressure: npt.NDArray[np.float64]
    deslack_pressure: npt.NDArray[np.float64]
    lag: npt.NDArray[np.float64]
    drop: npt.NDArray[np.float64]


class Lag(NamedTuple):
    """One look-up: lag in s, source pressure drop in Pa, and whether the grid was left."""

    lag: float
    drop: float
    outside: bool


@compiled
def fill_response(
    hydraulics: HydraulicLaw,
    gains: PressureGains,
    unit: MotorUnit,
    target: float,
    maximum_lag: float,
    period: float,
    substeps: int,
    trace: npt.NDArray[np.float64],
) -> tuple[float, float]:
    """
    Return lag (s) and source drop (Pa) of filling a slack unit to ``target`` Pa.

    The source starts settled at ``hydraulics.nominal_pressure``. The loop runs at ``period`` s,
    the plant at ``period / substeps`` (midpoint rule). As many rows of ``trace`` as it has get
    time, source pressure, unit pressure, spool and flow at each tick; it may have none.
    """
    strain = fam.free_strain(unit.fam, target)
    oil = fam.oil_of(unit.fam, 0.0, strain, hydraulics.bulk_modulus)
    source = hydraulics.nominal_pressure
    spool = integral = 0.0
    lowest = source
    lag = math.inf
    dt = period / substeps
    for tick in range(max(int(maximum_lag / period), trace.shape[0])):
        pressure = fam.pressure_of(unit.fam, oil, strain, hydraulics.bulk_modulus)
        if tick < trace.shape[0]:
            trace[tick, 0] = tick * period
            trace[tick, 1] = source
            trace[tick, 2] = pressure
            trace[tick, 3] = spool
            trace[tick, 4] = unit_flow(hydraulics, spool, source, pressure)
        if lag == math.inf and pressure >= REACHED * target:
            lag = tick * period
        if lag < math.inf and tick >= trace.shape[0]:
            break
        integral, asked = pressure_pi(gains, integral, target, pressure, period)
        command = clamp(asked, -1.0, 1.0)
        for _ in range(substeps):
            flow = unit_flow(hydraulics, spool, source, pressure)
            half_oil = oil + 0.5 * dt * flow / unit.fams
            half_source = source + 0.5 * dt * source_pressure_rate(hydraulics, source, flow)
            half_spool = spool + 0.5 * dt * (command - spool) / hydraulics.spool_time_constant
            pressure = fam.pressure_of(unit.fam, half_oil, strain, hydraulics.bulk_modulus)
            flow = unit_flow(hydraulics, half_spool, half_source, pressure)
            oil += dt * flow / unit.fams
            source += dt * source_pressure_rate(hydraulics, half_source, flow)
            spool += dt * (command - half_spool) / hydraulics.spool_time_constant
            pressure = fam.pressure_of(unit.fam, oil, strain, hydraulics.bulk_modulus)
            if lag == math.inf:
                lowest = min(lowest, source)
    return lag, hydraulics.nominal_pressure - lowest


@compiled
def _fill_table(
    hydraulics: HydraulicLaw,
    gains: PressureGains,
    unit: MotorUnit,
    maximum_lag: float,
    period: float,
    substeps: int,
    sources: npt.NDArray[np.float64],
    targets: npt.NDArray[np.float64],
    lag: npt.NDArray[np.float64],
    drop: npt.NDArray[np.float64],
) -> None:
    """Fill one motor unit's ``lag`` and ``drop``, both (sources, targets)."""
    no_trace = np.empty((0, 5))
    for i in range(sources.shape[0]):
        supply = HydraulicLaw(
            sources[i],
            hydraulics.droop,
            hydraulics.source_time_constant,
            hydraulics.valve_conductance,
            hydraulics.spool_time_constant,
            hydraulics.hose_resistance,
            hydraulics.bulk_modulus,
        )
        for j in range(targets.shape[0]):
            # Never reached: above the source even without flow.
            longest = maximum_lag if REACHED * targets[j] < sources[i] else 0.0
            lag[i, j], drop[i, j] = fill_response(
                supply, gains, unit, targets[j], longest, period, substeps, no_trace
            )


def build_lag_table(configuration: Configuration) -> LagTable:
    """
    Return the table of ``configuration``: source from its minimum, de-slack pressure from 0.

    Motor units with equal FAMs, count and gains are computed once.
    """
    grid, nominal = configuration.lag_table, configuration.source.nominal_pressure
    units = motor_units(configuration)
    sources = _axis(grid.minimum_source * nominal, nominal, grid.source_points)
    targets = _axis(0.0, nominal, grid.deslack_points)
    shape = (len(units), grid.source_points, grid.deslack_points)
    lag, drop = np.empty(shape), np.empty(shape)
    first: dict[tuple[float, int, PressureGains], int] = {}
    for i, (unit, gains) in enumerate(zip(units, pressure_gains(configuration), strict=True)):
        same = first.setdefault((unit.fams, id(unit.fam), gains), i)
        if same == i:
            _fill_table(
                hydraulic_law(configuration),
                gains,
                unit,
                grid.maximum_lag,
                configuration.simulation.period,
                configuration.simulation.substeps,
                sources,
                targets,
                lag[i],
                drop[i],
            )
        else:
            lag[i], drop[i] = lag[same], drop[same]
    return LagTable(sources, targets, lag, drop)


def _axis(low: float, high: float, points: int) -> npt.NDArray[np.float64]:
    return np.asarray(np.linspace(low, high, points), dtype=np.float64)


@compiled
def look_up(table: LagTable, unit: int, source_pressure: float, deslack_pressure: float) -> Lag:
    """
    Return the bilinear look-up for motor unit ``unit``; pressures in Pa.

    Outside of the grid the nearest edge counts and ``outside`` is set. A cell with a corner that
    is never reached is never reached.
    """
    i, u, left = _cell(table.source_pressure, source_pressure)
    j, v, up = _cell(table.deslack_pressure, deslack_pressure)
    lag, drop = table.lag[unit], table.drop[unit]
    w00, w01 = (1.0 - u) * (1.0 - v), (1.0 - u) * v
    w10, w11 = u * (1.0 - v), u * v
    time = loss = 0.0
    for weight, a, b in ((w00, i, j), (w01, i, j + 1), (w10, i + 1, j), (w11, i + 1, j + 1)):
        # Rounding must not let a neighbour that is never reached into a node of its own.
        if weight > 1e-12 or lag[a, b] < math.inf:
            time += weight * lag[a, b]
            loss += weight * drop[a, b]
    return Lag(time, loss, left or up)


@compiled
def _cell(axis: npt.NDArray[np.float64], x: float) -> tuple[int, float, bool]:
    """Return the index and the share of the cell of a uniform axis that holds ``x``."""
    last = axis.shape[0] - 1
    position = (x - axis[0]) / (axis[last] - axis[0]) * last
    inside = min(max(position, 0.0), float(last))
    i = min(int(inside), last - 1)
    return i, inside - i, position != inside


def save_lag_table(table: LagTable, parameters_hash: str, path: Path) -> None:
    """Write ``table`` with the hash of the parameters it was built from; whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    with whole_file(path) as file:
        np.savez(file, parameters_hash=np.array(parameters_hash), **table._asdict())


def load_lag_table(path: Path, parameters_hash: str) -> LagTable:
    """
    Return the table in ``path``.

    Raises ValueError when it was built from other parameters, OSError when it cannot be read.
    """
    with np.load(path, allow_pickle=False) as data:
        found = str(data['parameters_hash'])
        if found != parameters_hash:
            raise ValueError(f'{path}: built from parameters {found}, not {parameters_hash}')
        return LagTable(**{name: data[name] for name in LagTable._fields})


def lag_table_hash(configuration: Configuration) -> str:
    """Return the hash of all parameters that the lags depend on, whatever the grid."""
    return configuration.hash(*PHYSICS)


def cached_lag_table(configuration: Configuration) -> LagTable:
    """Return the table of ``configuration``, kept on disk for these sources between calls."""
    parameters_hash = configuration.hash(*PHYSICS, 'lag_table')
    path = cache_directory() / f'lag_tables-{source_digest()}' / f'{parameters_hash}.npz'
    try:
        return load_lag_table(path, parameters_hash)
    except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
        table = build_lag_table(configuration)
        save_lag_table(table, parameters_hash, path)
        return table
