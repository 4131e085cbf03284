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

"""Figures of the model: fill response (Figure 6), source (Figure 10), one FAM, lag table."""

from collections.abc import Mapping

from fam_bundle_io.figures_style import (
    Array,
    KILOPASCAL,
    LAG,
    legend_beside,
    LITRES_PER_MINUTE,
    PERCENT,
    signal,
    SOURCE,
    styled,
    unit_style,
)
from fam_bundle_io.trace import Trace
from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.fam import FamLaw
from fam_bundle_model.hydraulics import hydraulic_law
from fam_bundle_model.lag_table import fill_response, LagTable, REACHED
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.pressure_pi import pressure_gains
from matplotlib import colormaps
from matplotlib.axes import Axes
from matplotlib.colors import ListedColormap
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.ticker import MaxNLocator
import numpy as np

TARGET = 0.8  # of the nominal pressure: the paper's example of a de-slack pressure
POINTS = 5000  # of all traces together under the source's line
ISOBARS = 6
# Ends before its yellow, on which white contours would be lost.
MAP = ListedColormap(colormaps['cividis'](np.linspace(0.0, 0.85, 256)))


@styled
def response_figure(configuration: Configuration) -> Figure:
    """
    Return the filling of a slack unit from the nominal source pressure (Figure 6).

    Source and unit pressure (kPa) over time (s) after a step of the reference to a de-slack
    pressure of 80 % of the nominal one, with the recruitment lag and the source pressure drop.
    The unit is the first that is ever newly recruited, the second one.
    """
    nominal, period = configuration.source.nominal_pressure, configuration.simulation.period
    target, limit = TARGET * nominal, configuration.lag_table.maximum_lag
    units = motor_units(configuration)
    unit = min(1, len(units) - 1)
    law, gains = hydraulic_law(configuration), pressure_gains(configuration)[unit]
    substeps = configuration.simulation.substeps
    rows = np.empty((int(limit / period), 5))
    lag, drop = fill_response(law, gains, units[unit], target, limit, period, substeps, rows)

    figure = Figure(figsize=(7.2, 3.8))
    axes = figure.subplots()
    time, source, pressure = rows[:, 0], KILOPASCAL * rows[:, 1], KILOPASCAL * rows[:, 2]
    stop = min(2.0 * lag, limit)
    axes.plot(time, source, label='source', **SOURCE)
    axes.plot(time, pressure, label=f'MU{unit + 1}', color=unit_style(unit)['color'])
    axes.axhline(
        KILOPASCAL * target,
        color='#000000',
        linestyle='--',
        linewidth=1.0,
        label='de-slack pressure',
    )
    axes.axhline(
        KILOPASCAL * REACHED * target,
        color='#000000',
        linestyle=':',
        linewidth=1.0,
        label=f'{100.0 * REACHED:.0f} % of it',
    )
    axes.set_title(
        f'source {KILOPASCAL * nominal:.1f} kPa, de-slack pressure {KILOPASCAL * target:.1f} kPa'
    )
    if np.isfinite(lag):
        axes.axvline(lag, color=LAG, linewidth=0.9)
        _span(axes, (0.0, 0.06 * KILOPASCAL * nominal), (lag, 0.06 * KILOPASCAL * nominal))
        axes.text(
            0.5 * lag,
            0.075 * KILOPASCAL * nominal,
            rf'$t_\mathrm{{lag}}$ = {lag:.3f} s',
            color=LAG,
            ha='center',
            va='bottom',
        )
    else:
        axes.set_title(f'not reached within {limit:g} s', loc='right')
    lowest = float(time[np.argmin(np.where(time <= lag, source, np.inf))])
    bottom = KILOPASCAL * (nominal - drop)
    axes.axhline(KILOPASCAL * nominal, color=SOURCE['color'], linewidth=0.7, linestyle=':')
    _span(axes, (lowest, KILOPASCAL * nominal), (lowest, bottom))
    axes.annotate(
        rf'$P_\mathrm{{s,drop}}$ = {KILOPASCAL * drop:.1f} kPa',
        (lowest, 0.5 * (KILOPASCAL * nominal + bottom)),
        (5, 0),
        textcoords='offset points',
        va='center',
        color='#555555',
    )
    axes.set_xlim(0.0, stop)
    axes.set_ylim(0.0, 1.06 * KILOPASCAL * nominal)
    axes.set_xlabel('time (s)')
    axes.set_ylabel('pressure (kPa)')
    legend_beside(axes)
    return figure


def _span(axes: Axes, start: tuple[float, float], stop: tuple[float, float]) -> None:
    """Draw a double arrow between two points of ``axes``."""
    colour = LAG if start[1] == stop[1] else '#555555'
    axes.annotate(
        '',
        stop,
        start,
        arrowprops={'arrowstyle': '<->', 'color': colour, 'shrinkA': 0, 'shrinkB': 0},
    )


@styled
def source_figure(configuration: Configuration, traces: Mapping[str, Trace]) -> Figure:
    """
    Return the source's pressure (kPa) over its flow (L/min), settled: a line (Figure 10).

    Under it the ticks of ``traces``, which leave the line while the source lags behind its flow.
    """
    nominal, droop = configuration.source.nominal_pressure, configuration.source.droop
    figure = Figure(figsize=(7.2, 3.8))
    axes = figure.subplots()
    largest = 0.1 / LITRES_PER_MINUTE
    if traces:
        flow = np.concatenate([signal(t, 'source_flow') for t in traces.values()])
        pressure = np.concatenate([signal(t, 'source_pressure') for t in traces.values()])
        largest = max(largest, float(np.nanmax(flow)))
        every = max(1, len(flow) // POINTS)
        axes.plot(
            LITRES_PER_MINUTE * flow[::every],
            KILOPASCAL * pressure[::every],
            linestyle='none',
            marker='.',
            markersize=5,
            markeredgewidth=0,
            color='#0072B2',
            alpha=0.4,
            rasterized=True,
            label=f'runs, every {every}th tick' if every > 1 else 'runs, every tick',
        )
    ends = np.array([0.0, 1.05 * largest])
    axes.plot(
        LITRES_PER_MINUTE * ends,
        KILOPASCAL * (nominal - droop * ends),
        color='#000000',
        label='source, settled',
    )
    slope = KILOPASCAL * droop / LITRES_PER_MINUTE
    axes.set_title(f'nominal {KILOPASCAL * nominal:.1f} kPa, droop {slope:.1f} kPa per L/min')
    axes.set_xlim(-0.02 * LITRES_PER_MINUTE * largest, LITRES_PER_MINUTE * ends[1])
    axes.set_xlabel('source flow (L/min)')
    axes.set_ylabel('source pressure (kPa)')
    axes.legend(loc='lower left')
    return figure


@styled
def surface_figure(configuration: Configuration) -> Figure:
    """
    Return force (N) over strain (%) of one FAM of the first motor unit at several pressures.

    The law of equations 1-4; panels: the whole range, and compression enlarged. Solid: straight;
    dashed: buckled; dotted: collapsed.
    """
    nominal = configuration.source.nominal_pressure
    law = motor_units(configuration)[0].fam
    pressures = np.linspace(0.0, nominal, ISOBARS)
    farthest = min(_bounds(law, nominal)[1] + 0.02, fam.LARGEST_STRAIN)
    figure = Figure(figsize=(7.2, 3.9))
    whole, near = figure.subplots(1, 2)
    weakest = 0.0
    for share, pressure in zip(np.linspace(0.0, 0.88, ISOBARS), pressures.tolist(), strict=True):
        colour = colormaps['viridis'](share)
        for strain, linestyle in _regions(law, pressure, farthest):
            force = np.array([fam.force(law, pressure, e) for e in strain.tolist()])
            for axes in (whole, near):
                axes.plot(PERCENT * strain, force, color=colour, linestyle=linestyle)
            weakest = min(weakest, float(force.min()))
    for axes in (whole, near):
        axes.axhline(0.0, color='#555555', linewidth=0.7, zorder=1.0)
        axes.set_xlim(0.0, PERCENT * farthest)
        axes.set_xlabel('strain (%)')
        axes.set_ylabel('force (N)')
    near.set_ylim(1.1 * weakest, -0.35 * weakest)
    near.set_title('compression enlarged')
    whole.set_title('one FAM')
    lines = [
        Line2D([], [], color=colormaps['viridis'](s), label=f'{KILOPASCAL * p:.0f} kPa')
        for s, p in zip(np.linspace(0.0, 0.88, ISOBARS), pressures, strict=True)
    ] + [
        Line2D([], [], color='#000000', linestyle=style, label=name)
        for style, name in (('-', 'straight'), ('--', 'buckled'), (':', 'collapsed'))
    ]
    legend_beside(near, handles=lines)
    return figure


def _regions(law: FamLaw, pressure: float, farthest: float) -> list[tuple[Array, str]]:
    """Return the strains of each region at ``pressure`` Pa up to ``farthest``, and its line."""
    buckling, collapse = _bounds(law, pressure)
    bounds = np.clip([0.0, buckling, collapse, farthest], 0.0, farthest).tolist()
    return [
        (np.linspace(low, high, 200), linestyle)
        for low, high, linestyle in zip(bounds[:-1], bounds[1:], ('-', '--', ':'), strict=True)
        if high > low
    ]


def _bounds(law: FamLaw, pressure: float) -> tuple[float, float]:
    """Return the strains at which a FAM at ``pressure`` Pa buckles and collapses."""
    buckling, _ = fam.interpolate(law.compression, 0, law.pressure_step, pressure)
    collapse, _ = fam.interpolate(law.compression, 2, law.pressure_step, pressure)
    return buckling, collapse


@styled
def lag_table_figure(table: LagTable) -> Figure:
    """
    Return recruitment lag (s) and source pressure drop (kPa) over the grid (Figure 6).

    One row of panels for the motor units that share their values; grey: never reached.
    """
    rows: list[list[int]] = []
    for unit in range(table.lag.shape[0]):
        for row in rows:
            if np.array_equal(table.lag[row[0]], table.lag[unit]):
                row.append(unit)
                break
        else:
            rows.append([unit])
    figure = Figure(figsize=(7.2, 0.5 + 2.9 * len(rows)))
    panels = figure.subplots(len(rows), 2, squeeze=False, sharex=True, sharey=True)
    for row, (left, right) in zip(rows, panels, strict=True):
        names = ', '.join(f'MU{unit + 1}' for unit in row)
        never = ~np.isfinite(table.lag[row[0]])
        for axes, values, label in (
            (left, table.lag[row[0]], 'recruitment lag (s)'),
            (right, KILOPASCAL * table.drop[row[0]], 'source pressure drop (kPa)'),
        ):
            _draw_map(figure, axes, table, np.where(never, np.nan, values), label)
            if never.any():
                axes.text(0.97, 0.06, 'never', transform=axes.transAxes, ha='right')
            axes.set_xlabel('de-slack pressure (kPa)')
        left.set_ylabel(f'{names}: source pressure (kPa)')
    return figure


def _draw_map(figure: Figure, axes: Axes, table: LagTable, values: Array, label: str) -> None:
    x, y = KILOPASCAL * table.deslack_pressure, KILOPASCAL * table.source_pressure
    axes.set_facecolor('#c8c8c8')
    axes.grid(False)
    filled = axes.pcolormesh(x, y, values, cmap=MAP, shading='nearest', rasterized=True)
    levels = MaxNLocator(6).tick_values(0.0, float(np.nanmax(values)))[1:]
    lines = axes.contour(x, y, values, levels=levels, colors='#ffffff', linewidths=0.7)
    axes.clabel(lines, fontsize=7)
    figure.colorbar(filled, ax=axes, label=label, location='top', aspect=30)
