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

"""The figure of a replay: measured against simulated, and their difference."""

from typing import Any

from fam_bundle_bringup.replay_controllers import Run
from fam_bundle_bringup.replay_plant import measured, RESTART_PERIOD, Simulated
from fam_bundle_io.figures_style import (
    Array,
    KILOPASCAL,
    legend_beside,
    MEASURED,
    PERCENT,
    SOURCE,
    styled,
    unit_style,
)
from fam_bundle_model.parameters import seconds
from fam_bundle_node.stamps import nanoseconds
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

ONCE = {'color': '#000000', 'linestyle': '--', 'linewidth': 1.0}
ANEW = {'color': '#882255', 'linewidth': 1.0}
BELOW = {**MEASURED, 'linewidth': 3.0}  # shows on both sides of what is simulated well


@styled
def replay_figure(run: Run, simulated: Simulated) -> Figure:
    """
    Return strain (%) and pressures (kPa), measured and simulated, and their differences.

    The strain is simulated from the start and set to the measured state each second; pressures
    are shown set anew.
    """
    figure = Figure(figsize=(7.2, 8.4))
    panels = figure.subplots(4, 1, sharex=True, gridspec_kw={'height_ratios': [2.4, 3, 1.8, 1.8]})
    time = np.array([seconds(nanoseconds(stamp)) for stamp in run.samples.stamp])
    seen = measured(run.samples)
    draw_strain(panels[0], time, seen['strain'], simulated)
    draw_pressures(panels[1], time, seen, simulated)
    draw_strain_difference(panels[2], time, seen['strain'], simulated)
    draw_pressure_difference(panels[3], time, seen, simulated)
    for letter, axes in zip('abcd', panels, strict=True):
        axes.set_title(f'({letter})', fontweight='bold', pad=2.0)
    panels[-1].set_xlabel('time (s)')
    panels[-1].set_xlim(time[0], time[-1])
    figure.align_ylabels(panels)
    return figure


def draw_strain(axes: Axes, time: Array, seen: Array, simulated: Simulated) -> None:
    """Draw the strain, measured and simulated both ways."""
    axes.plot(time, PERCENT * seen, label='measured', **BELOW)
    label = f'set anew each {RESTART_PERIOD:g} s'
    axes.plot(time, PERCENT * simulated.restarted['strain'], label=label, **ANEW)
    axes.plot(time, PERCENT * simulated.open_loop['strain'], label='from the start', **ONCE)
    axes.set_ylabel('strain (%)')
    legend_beside(axes)


def draw_pressures(axes: Axes, time: Array, seen: dict[str, Array], simulated: Simulated) -> None:
    """Draw the pressures, measured in colour and simulated in black."""
    for name, style, label in pressures_of(seen):
        axes.plot(time, KILOPASCAL * seen[name], label=f'{label}, measured', **style)
    for name, _, _ in pressures_of(seen):
        (line,) = axes.plot(time, KILOPASCAL * simulated.restarted[name], **ONCE)
    line.set_label('simulated, set anew')
    axes.set_ylabel('pressure (kPa)')
    legend_beside(axes)


def draw_strain_difference(axes: Axes, time: Array, seen: Array, simulated: Simulated) -> None:
    """Draw how far the simulated strain is off."""
    axes.axhline(0.0, color='#999999', linewidth=0.7)
    axes.plot(time, PERCENT * (simulated.restarted['strain'] - seen), **ANEW)
    axes.plot(time, PERCENT * (simulated.open_loop['strain'] - seen), **ONCE)
    axes.set_ylabel('simulated minus\nmeasured (% strain)')


def draw_pressure_difference(
    axes: Axes, time: Array, seen: dict[str, Array], simulated: Simulated
) -> None:
    """Draw how far the simulated pressures are off, set anew."""
    axes.axhline(0.0, color='#999999', linewidth=0.7)
    for name, style, label in pressures_of(seen):
        difference = simulated.restarted[name] - seen[name]
        axes.plot(time, KILOPASCAL * difference, label=label, **style)
    axes.set_ylabel('simulated minus\nmeasured (kPa)')
    legend_beside(axes)


def pressures_of(seen: dict[str, Array]) -> list[tuple[str, dict[str, Any], str]]:
    """Return name, line and label of the source's pressure and of each unit's."""
    units = sum(name.startswith('mu_pressure[') for name in seen)
    found = [('source_pressure', SOURCE, 'source')]
    return found + [(f'mu_pressure[{i}]', unit_style(i), f'unit {i + 1}') for i in range(units)]
