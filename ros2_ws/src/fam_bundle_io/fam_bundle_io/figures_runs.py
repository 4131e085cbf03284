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

"""Figures of runs: one run (Figures 11-13), several (Figure 14), and a prediction (Figure 7)."""

from collections.abc import Callable, Mapping
from typing import NamedTuple

from fam_bundle_io.figures_style import (
    Array,
    DOWNSHIFT,
    KILOPASCAL,
    LAG,
    last_cycle,
    legend_above,
    legend_beside,
    mark,
    MEASURED,
    PERCENT,
    REFERENCE,
    scheme_style,
    signal,
    SOURCE,
    styled,
    unit_style,
    UPSHIFT,
)
from fam_bundle_io.metrics import shift_times
from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

LEAD = 0.05  # a prediction is shown this share of a cycle before its shift
POINTS = 100  # of an expected trajectory
# The strains expected at a tick, for times ahead of it in s.
Expectation = Callable[[int, Array], Array]


def _shifts_within(trace: Trace, window: slice) -> tuple[list[float], list[float]]:
    """Return the times in s of the upshifts and of the downshifts in ``window``."""
    time = signal(trace, 'time')[window]
    ups, downs = shift_times(trace)
    return (
        [t for t in ups if time[0] <= t <= time[-1]],
        [t for t in downs if time[0] <= t <= time[-1]],
    )


@styled
def run_figure(trace: Trace, title: str, window: slice | None = None) -> Figure:
    """
    Return the last cycle of a run of any scheme (Figures 11, 12 and 13), or ticks ``window``.

    Panels: strain (%); times to saturation and desaturation beside the recruitment lag (s),
    where the trace holds any; recruitment state; pressures (kPa); strain error (%). A vertical
    dashed line marks each shift.
    """
    window = last_cycle(trace) if window is None else window
    predicted = any(
        np.isfinite(trace[name][window].astype(float)).any()
        for name in ('time_to_saturation', 'time_to_desaturation')
    )
    heights = [3.0, 2.4, 1.1, 3.0, 1.8] if predicted else [3.0, 1.1, 3.0, 1.8]
    figure = Figure(figsize=(7.2, 0.7 * sum(heights)))
    panels = list(
        figure.subplots(len(heights), 1, sharex=True, gridspec_kw={'height_ratios': heights})
    )
    figure.suptitle(title, x=0.01, horizontalalignment='left')
    time = signal(trace, 'time')[window]
    _draw_tracking(panels[0], trace, window)
    if predicted:
        _draw_predictions(panels[1], trace, window)
    _draw_state(panels[-3], trace, window)
    _draw_pressures(panels[-2], trace, window)
    error = signal(trace, 'strain_reference') - signal(trace, 'strain')
    panels[-1].axhline(0.0, color='#999999', linewidth=0.7)
    panels[-1].plot(time, PERCENT * error[window], **MEASURED)
    panels[-1].set_ylabel('error\n(% strain)')
    panels[-1].set_xlabel('time (s)')
    panels[-1].set_xlim(time[0], time[-1])
    ups, downs = _shifts_within(trace, window)
    for letter, axes in zip('abcde', panels, strict=False):
        mark(axes, ups + downs)
        axes.set_title(f'({letter})', fontweight='bold', pad=2.0)
    figure.align_ylabels(panels)
    return figure


def _draw_tracking(axes: Axes, trace: Trace, window: slice) -> None:
    time = signal(trace, 'time')[window]
    axes.plot(time, PERCENT * signal(trace, 'strain')[window], label='measured', **MEASURED)
    axes.plot(
        time, PERCENT * signal(trace, 'strain_reference')[window], label='reference', **REFERENCE
    )
    axes.set_ylabel('strain (%)')
    legend_beside(axes)


def _draw_predictions(axes: Axes, trace: Trace, window: slice) -> None:
    time = signal(trace, 'time')[window]
    lag = signal(trace, 'recruitment_lag')[window]
    axes.plot(time, lag, color=LAG, label='recruitment lag')
    for name, colour, label in (
        ('time_to_saturation', UPSHIFT, 'to saturation'),
        ('time_to_desaturation', DOWNSHIFT, 'to desaturation'),
    ):
        axes.plot(time, signal(trace, name)[window], color=colour, label=label)
    # Far from a shift the times are long and say nothing: the scale is that of the lag.
    longest = float(np.nanmax(lag, initial=0.1))
    axes.set_ylim(-2.0 * longest, 4.0 * longest)
    axes.axhline(0.0, color='#999999', linewidth=0.7, zorder=1.0)
    axes.set_ylabel('time (s)')
    legend_beside(axes)


def _draw_state(axes: Axes, trace: Trace, window: slice) -> None:
    units = trace['mu_pressure'].shape[1]
    axes.step(
        signal(trace, 'time')[window],
        signal(trace, 'recruitment_state')[window],
        where='post',
        color='#000000',
    )
    axes.set_yticks(range(1, units + 1))
    axes.set_ylim(0.7, units + 0.3)
    axes.set_ylabel('recruitment\nstate')


def _draw_pressures(axes: Axes, trace: Trace, window: slice) -> None:
    time = signal(trace, 'time')[window]
    source = KILOPASCAL * signal(trace, 'source_pressure')[window]
    axes.plot(time, source, label='source', **SOURCE)
    pressures = KILOPASCAL * signal(trace, 'mu_pressure')[window].T
    for unit, pressure in enumerate(pressures):
        axes.plot(time, pressure, label=f'MU{unit + 1}', **unit_style(unit))
    axes.set_ylabel('pressure (kPa)')
    legend_beside(axes)


@styled
def comparison_figure(
    traces: Mapping[str, Trace], windows: Mapping[str, slice] | None = None
) -> Figure:
    """
    Return how the schemes in ``traces`` (by their names) track the last cycle (Figure 14).

    ``windows`` are the ticks of the cycles, where they are known.
    Panels: reference and strain (%) around the first upshifts, a triangle at each; strain errors
    (%) over the whole cycle. Times in s from the start of the cycle.
    """
    figure = Figure(figsize=(7.2, 5.6))
    near, whole = figure.subplots(2, 1, gridspec_kw={'height_ratios': [3.0, 2.0]})
    firsts: list[float] = []
    references: list[Array] = []
    shown: list[tuple[Array, Array]] = []
    for position, (name, trace) in enumerate(traces.items()):
        window = windows[name] if windows else last_cycle(trace)
        style = scheme_style(position)
        time = signal(trace, 'time')[window]
        start = time[0]
        strain = PERCENT * signal(trace, 'strain')[window]
        reference = PERCENT * signal(trace, 'strain_reference')[window]
        if not any(same_curve(reference, known) for known in references):
            label = f'reference of {name}' if references else 'reference'
            near.plot(time - start, reference, label=label, **REFERENCE)
            references.append(reference)
        near.plot(time - start, strain, label=name, **style)
        whole.plot(time - start, reference - strain, **style)
        shown += [(time - start, strain), (time - start, reference)]
        ups = _shifts_within(trace, window)[0]
        if ups:
            firsts.append(ups[0] - start)
            at_shift = np.interp(ups[0], time, strain)
            near.plot(ups[0] - start, at_shift, marker='^', markersize=6, color=style['color'])
    near.set_ylabel('strain (%)')
    near.set_xlabel('time from the start of the cycle (s)')
    length = max(time[-1] for time, _ in shown)
    if firsts:
        near.plot([], [], '^', markersize=6, color='#777777', label='upshift')
        _zoom(near, shown, min(firsts) - 0.03 * length, max(firsts) + 0.15 * length)
        near.set_title('around the upshift')
    else:
        near.set_xlim(0.0, length)
        near.set_title('no upshift in this cycle')
    whole.set_title('whole cycle')
    legend_beside(near)
    whole.axhline(0.0, color='#999999', linewidth=0.7, zorder=1.0)
    whole.set_xlim(0.0, length)
    whole.set_ylabel('error (% strain)')
    whole.set_xlabel('time from the start of the cycle (s)')
    return figure


def same_curve(one: Array, other: Array) -> bool:
    """Return whether two references over a cycle are the same but for skipped ticks."""
    points = np.linspace(0.0, 1.0, 200)

    def sampled(values: Array) -> Array:
        return np.interp(points, np.linspace(0.0, 1.0, len(values)), values)

    alike = abs(len(one) - len(other)) <= 0.1 * max(len(one), len(other))
    span = float(np.ptp(one))
    return alike and bool(np.allclose(sampled(one), sampled(other), atol=0.05 * span))


def _zoom(axes: Axes, curves: list[tuple[Array, Array]], start: float, stop: float) -> None:
    """Limit ``axes`` to ``start`` to ``stop`` and to the heights of ``curves`` in between."""
    inside = np.concatenate([y[(x >= start) & (x <= stop)] for x, y in curves])
    room = 0.04 * (np.nanmax(inside) - np.nanmin(inside))
    axes.set_xlim(start, stop)
    axes.set_ylim(np.nanmin(inside) - room, np.nanmax(inside) + room)


class Prediction(NamedTuple):
    """
    One tick's prediction: its number, time (s), strain, lag (s) and time to the limit (s).

    The lag is infinite where the next unit would never be filled.
    """

    tick: int
    time: float
    strain: float
    lag: float
    time_to_limit: float


def prediction_before(
    trace: Trace, configuration: Configuration, name: str, shift: float
) -> Prediction | None:
    """
    Return the prediction a twentieth of a cycle before the shift at ``shift`` s.

    ``name`` is ``time_to_saturation`` or ``time_to_desaturation``. Where it does not apply at
    that instant the first later one counts, up to the shift; None where there is none.
    """
    time = signal(trace, 'time')
    earliest = shift - LEAD / configuration.reference.frequency
    applies = np.isfinite(signal(trace, name)) & (time >= earliest) & (time <= shift)
    if not applies.any():
        return None
    at = int(np.argmax(applies))
    return Prediction(
        at,
        float(time[at]),
        float(signal(trace, 'strain')[at]),
        float(trace['recruitment_lag'][at]),
        float(signal(trace, name)[at]),
    )


@styled
def prediction_figure(
    trace: Trace, configuration: Configuration, expectation: Expectation
) -> Figure:
    """
    Return the prediction before the last upshift and before the last downshift (Figure 7).

    Each panel: strain (%), the expectation E(t) from one instant, the modelled strain limit,
    where E(t) stands then, and the times (s) to saturation or desaturation and of the recruitment
    lag.
    """
    figure = Figure(figsize=(7.2, 3.7))
    panels = figure.subplots(1, 2)
    ups, downs = shift_times(trace)
    for axes, word, times, name, symbol, colour in (
        (panels[0], 'upshift', ups, 'time_to_saturation', 'sat', UPSHIFT),
        (panels[1], 'downshift', downs, 'time_to_desaturation', 'desat', DOWNSHIFT),
    ):
        found = prediction_before(trace, configuration, name, times[-1]) if times else None
        if found is None:
            reason = f'no prediction before the {word}' if times else f'no {word} in this run'
            axes.text(0.5, 0.5, reason, transform=axes.transAxes, ha='center', va='center')
            axes.set_axis_off()
        else:
            axes.set_title(f'before the {word} at {times[-1]:.3f} s', pad=24.0)
            _draw_prediction(axes, trace, found, expectation, times[-1], symbol, colour)
    return figure


def _draw_prediction(
    axes: Axes,
    trace: Trace,
    found: Prediction,
    expectation: Expectation,
    shift: float,
    symbol: str,
    colour: str,
) -> None:
    reach = found.time + found.time_to_limit
    filled = found.time + found.lag if np.isfinite(found.lag) else found.time
    span = max(shift, reach, filled) - min(found.time, reach)
    start, stop = min(found.time, reach) - 0.35 * span, max(shift, reach) + 0.35 * span
    time, strain = signal(trace, 'time'), PERCENT * signal(trace, 'strain')
    window = (time >= start) & (time <= stop)
    axes.plot(time[window], strain[window], label='measured', **MEASURED)
    ahead = np.linspace(min(found.time, reach), max(filled, reach), POINTS) - found.time
    expected = PERCENT * expectation(found.tick, np.append(ahead, found.time_to_limit))
    curve = {'color': '#000000', 'linestyle': '-.', 'linewidth': 1.0, 'label': '$E(t)$'}
    axes.plot(found.time + ahead, expected[:-1], **curve)
    limit = float(expected[-1])
    axes.axhline(limit, color='#CC79A7', linewidth=1.3, label='strain limit')
    axes.plot(found.time, PERCENT * found.strain, 'o', color='#000000', markersize=4.5)
    axes.plot(reach, limit, 's', color=colour, markersize=5)
    mark(axes, [shift])
    axes.set_xlim(start, stop)
    low, high = axes.get_ylim()
    height = high - low
    # Two arrows below all curves; how long they are against each other decides the shift.
    axes.set_ylim(low - 0.42 * height, high)
    for level, end, length, name, shade in (
        (low - 0.16 * height, reach, found.time_to_limit, rf'$t_\mathrm{{{symbol}}}$', colour),
        (low - 0.36 * height, filled, found.lag, r'$t_\mathrm{lag}$', LAG),
    ):
        if np.isfinite(length):
            said = f'{name} = {length:.3f} s'.replace('-', '\N{MINUS SIGN}')
            arrow = {'arrowstyle': '->', 'color': shade, 'shrinkA': 0, 'shrinkB': 0}
            axes.annotate('', (end, level), (found.time, level), arrowprops=arrow, zorder=4.0)
        else:
            said = f'{name}: never'
        axes.annotate(
            said,
            (min(found.time, end), level),
            (3, 5),
            textcoords='offset points',
            color=shade,
            bbox={'facecolor': 'white', 'edgecolor': 'none', 'pad': 0.5},
        )
    axes.vlines(
        found.time, low - 0.42 * height, PERCENT * found.strain, colors='#999999', linewidths=0.7
    )
    axes.set_xlabel('time (s)')
    axes.set_ylabel('strain (%)')
    legend_above(axes, 3)
