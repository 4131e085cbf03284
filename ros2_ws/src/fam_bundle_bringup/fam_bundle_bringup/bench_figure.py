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

"""The figure of a benchmark: rates, latencies on a clock, and what more units and bundles cost."""

from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING

from fam_bundle_io.figures_style import legend_above, styled
from matplotlib.figure import Figure

if TYPE_CHECKING:
    from matplotlib.axes import Axes

Medians = Mapping[str, float]
Spread = Mapping[str, Sequence[float]]

RATES = {
    'composed_default_executor': 'one process, default executor',
    'lockstep_default_executor': 'graph, default executor',
    'lockstep_recorded': 'graph, recorded',
    'lockstep': 'graph',
    'cyclone': 'relays, Cyclone DDS in Python',
    'floor': 'relays, no computation',
    'composed_recorded': 'one process, recorded',
    'composed': 'one process',
    'ping': 'two-process ping',
    'unix_socket': 'relays, Unix sockets',
}
LONG_RUNS = ('machine', 'realtime_floor', 'realtime_composed', 'realtime')
ON_A_CLOCK = {
    'machine': 'machine alone',
    'realtime_floor': 'relays, no computation',
    'realtime_composed': 'one process',
    'realtime': 'five processes',
    'realtime_recorded': 'five, recorded',
    'realtime_default_executor': 'default executor',
}


@styled
def bench_figure(medians: Medians, spread: Spread) -> Figure:
    """Return the figure of ``medians`` with their ``spread``, by the names of ``bench.json``."""
    figure = Figure(figsize=(9.0, 6.6), layout='constrained')
    ((rates, latencies), (units, bundles)) = figure.subplots(2, 2)
    draw_rates(rates, medians, spread)
    draw_latencies(latencies, medians, spread)
    draw_units(units, medians, spread)
    draw_bundles(bundles, medians, spread)
    return figure


def draw_rates(axes: 'Axes', medians: Medians, spread: Spread) -> None:
    """Draw ticks per second in lock-step."""
    shown = {f'{name}_ticks_per_second': label for name, label in RATES.items()}
    names = [name for name in shown if name in medians]
    values = [medians[name] for name in names]
    labels = [shown[name] for name in names]
    axes.errorbar(values, labels, xerr=errors(names, medians, spread), fmt='o', capsize=3)
    axes.set_xscale('log')
    axes.set_xlabel('ticks per second in lock-step')


def draw_latencies(axes: 'Axes', medians: Medians, spread: Spread) -> None:
    """Draw the latencies on a clock."""
    rows = {name: row for row, name in enumerate(ON_A_CLOCK)}
    for part, label, marker in (('p50', 'median', 'o'), ('p99', '99 %', 's')):
        found = [medians[f'{name}_latency_{part}_us'] for name in rows]
        axes.plot(found, list(rows.values()), marker, label=label)
    # A longer run has a larger maximum: only those that last equally long, and of all rounds.
    longest = [spread[f'{name}_latency_max_us'][1] for name in LONG_RUNS]
    axes.plot(longest, [rows[name] for name in LONG_RUNS], 'x', label='largest')
    axes.axvline(1000.0, linestyle='--', color='0.4', linewidth=1.0)
    axes.set_yticks(list(rows.values()), list(ON_A_CLOCK.values()))
    axes.invert_yaxis()
    axes.set_xscale('log')
    axes.set_xlabel('latency at 1 kHz; machine: lateness (µs)')
    legend_above(axes, 3)


def draw_units(axes: 'Axes', medians: Medians, spread: Spread) -> None:
    """Draw the time per tick over the number of motor units."""
    draw_over(axes, '_units_tick_us', medians, spread)
    axes.set_xlabel('motor units')
    axes.set_ylabel('time per tick (µs)')


def draw_bundles(axes: 'Axes', medians: Medians, spread: Spread) -> None:
    """Draw the ticks per second of several bundles together."""
    draw_over(axes, '_bundles_ticks_per_second', medians, spread)
    axes.set_xlabel('bundles side by side')
    axes.set_ylabel('ticks per second, all together')


def draw_over(axes: 'Axes', ending: str, medians: Medians, spread: Spread) -> None:
    """Draw ``KIND_NUMBER`` + ``ending`` over its number, one line for each arrangement."""
    for kind, label in (('lockstep', 'five processes each'), ('composed', 'one process each')):
        names = [name for name in medians if name.startswith(f'{kind}_') and ending in name]
        numbers = [int(name.split('_')[1]) for name in names]
        values = [medians[name] for name in names]
        axes.errorbar(
            numbers, values, errors(names, medians, spread), marker='o', capsize=3, label=label
        )
    axes.set_xticks(numbers)
    axes.set_ylim(bottom=0.0)
    axes.legend()


def errors(names: Sequence[str], medians: Medians, spread: Spread) -> list[list[float]]:
    """Return how far the spread reaches below and above the medians."""
    return [
        [medians[name] - spread[name][0] for name in names],
        [spread[name][1] - medians[name] for name in names],
    ]
