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

"""Figures of a report beside those of the paper: energy, and timing of the loop."""

from collections.abc import Mapping
from typing import Any

from fam_bundle_io.figures_style import (
    legend_beside,
    scheme_style,
    styled,
    UNIT_COLOURS,
)
from fam_bundle_io.timing import Timing
from matplotlib.figure import Figure
import numpy as np

MICROSECONDS = 1e6  # per s
SHORTEST = 1.0  # us that the logarithmic axis shows


@styled
def energy_figure(energies: Mapping[str, Mapping[str, Any]]) -> Figure:
    """
    Return where the hydraulic input of the last cycle went (J), a bar for each run.

    ``energies`` holds the values of ``fam_bundle_io.energy.Energy`` by the names of the runs.
    """
    figure = Figure(figsize=(7.2, 1.4 + 0.45 * len(energies)))
    axes = figure.subplots()
    labels: set[str] = set()
    for row, found in enumerate(energies.values()):
        parts = [('net work on the load', found['output'] - found['returned'], '#0072B2', '')]
        for kind, word, hatch in (('supply_loss', 'into', ''), ('return_loss', 'out of', '///')):
            parts += [
                (f'lost {word} MU{unit + 1}', loss, UNIT_COLOURS[unit % len(UNIT_COLOURS)], hatch)
                for unit, loss in enumerate(found[kind])
            ]
        if found['relieved']:
            parts.append(('relieved', found['relieved'], '#666666', ''))
        parts.append(('unexplained', found['unexplained'], '#cccccc', ''))
        left = {True: 0.0, False: 0.0}  # above and below zero
        for label, value, colour, hatch in parts:
            axes.barh(
                row,
                value,
                left=left[value >= 0.0],
                height=0.6,
                color=colour,
                hatch=hatch,
                edgecolor='white',
                linewidth=0.0,
                label='' if label in labels else label,
            )
            left[value >= 0.0] += value
            labels.add(label)
        said = f' {found["efficiency"]:.0%}' if np.isfinite(found['efficiency']) else ''
        axes.text(left[True], row, said, verticalalignment='center')
    axes.set_yticks(range(len(energies)), list(energies))
    axes.invert_yaxis()
    axes.margins(x=0.1)
    axes.set_xlabel('energy of the last cycle (J); efficiency beside the bar')
    legend_beside(axes)
    return figure


@styled
def timing_figure(timings: Mapping[str, Timing]) -> Figure:
    """Return the share of samples answered within a time (microseconds), a panel for each run."""
    figure = Figure(figsize=(7.2, 0.5 + 2.1 * len(timings)))
    panels = figure.subplots(len(timings), 1, squeeze=False, sharex=True)[:, 0]
    for axes, (name, times) in zip(panels, timings.items(), strict=True):
        curves = {**times.answers, 'next sample': times.interval}
        for position, (topic, values) in enumerate(curves.items()):
            ordered = np.sort(np.maximum(MICROSECONDS * values, SHORTEST))
            # Of all samples: what was never answered keeps the curve below 1.
            share = np.arange(1, len(ordered) + 1) / times.samples
            axes.plot(ordered, share, label=topic, **scheme_style(position))
        axes.set_xscale('log')
        axes.set_ylabel('share of samples')
        axes.set_title(name, loc='left')
        legend_beside(axes)
    panels[-1].set_xlabel('time from a sample (µs)')
    return figure
