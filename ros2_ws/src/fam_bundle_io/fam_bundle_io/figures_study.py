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
Figures of a study: tracking against efficiency, heat maps, sensitivity.

``columns`` holds one value for each case, None where there is none, by the names of the result:
``scheme``, the varied parameters, and what was measured.
"""

from collections.abc import Iterable, Mapping, Sequence
from typing import Any, NamedTuple

from fam_bundle_io.figures_style import Array, PERCENT, scheme_style, styled
from fam_bundle_model.parameters import GROUPS
from fam_bundle_model.schema import declarations
from matplotlib import colors, patches, ticker
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np

Columns = Mapping[str, Sequence[Any]]

TRACKING = {'iae': ('IAE (s)', 1.0), 'max_error': ('maximum error (% strain)', PERCENT)}
MARKERS = ('o', 's', 'D', '^', 'v', 'P', 'X', '*')
RIVAL_COLOUR = '#555555'
MISSING = {'facecolor': '#f2f2f2', 'edgecolor': '#bbbbbb', 'hatch': '////', 'linewidth': 0.0}
ANNOTATED = 11  # cells side by side that leave room for their values
LEVEL = 6  # characters below a panel that need no slope
ACROSS = 2  # heat maps side by side
CERTAIN = 1.96  # standard deviations: 95 % of rank correlations by chance are within


class Quantity(NamedTuple):
    """What a heat map shows: its column, words with unit, factor from SI, and how to print it."""

    column: str
    words: str
    factor: float
    text: str

    @property
    def is_ratio(self) -> bool:
        """Whether 1 is the value that matters."""
        return self.column.endswith('_ratio')


def quantities(rivals: Sequence[str]) -> tuple[Quantity, ...]:
    """Return what heat maps are drawn of: tracking, ratios to the rivals, shifts, efficiency."""
    ratios = [
        Quantity(
            f'{rival}.{name}_ratio', f'{words} over that of rival {_plain(rival)}', 1.0, '.2f'
        )
        for rival in rivals
        for name, words in (('iae', 'IAE'), ('max_error', 'maximum error'))
    ]
    return (
        Quantity('iae', 'IAE (s)', 1.0, '.3f'),
        Quantity('max_error', 'maximum error (% strain)', PERCENT, '.2f'),
        *ratios,
        Quantity('upshifts', 'shifts up in the whole run', 1.0, 'g'),
        Quantity('efficiency', 'efficiency (%)', PERCENT, '.1f'),
    )


def _plain(name: str) -> str:
    return name.replace('_', ' ')


def _numbers(columns: Columns, name: str) -> Array:
    return np.array([np.nan if value is None else value for value in columns[name]], dtype=float)


def _of_scheme(columns: Columns, scheme: str) -> Any:
    return np.array([name == scheme for name in columns['scheme']], dtype=bool)


def axis_words(name: str) -> str:
    """Return a parameter's name with its unit; another axis is called by its name."""
    group, _, parameter = name.partition('.')
    known = declarations(GROUPS[group]) if group in GROUPS else {}
    unit = known[parameter].unit if parameter in known else ''
    return f'{name} ({unit})' if unit else name


# ---- Tracking against efficiency ----


@styled
def tradeoff_figure(columns: Columns, schemes: Sequence[str], rivals: Sequence[str]) -> Figure:
    """
    Return IAE (s) and maximum error (% strain) of every case against its efficiency (%).

    A large mark is the median of a scheme or rival over its cases, its bars from the first to
    the third quartile.
    """
    figure = Figure(figsize=(7.2, 4.1))
    panels = figure.subplots(1, 2)
    names = [('', scheme) for scheme in schemes] + [(f'{rival}.', rival) for rival in rivals]
    for axes, (metric, (words, factor)) in zip(panels, TRACKING.items(), strict=True):
        for position, (prefix, name) in enumerate(names):
            x = PERCENT * _numbers(columns, f'{prefix}efficiency')
            y = factor * _numbers(columns, f'{prefix}{metric}')
            inside = np.isfinite(x) & np.isfinite(y) & (y > 0.0)
            colour, label = RIVAL_COLOUR, _plain(name)
            if not prefix:
                inside &= _of_scheme(columns, name)
                colour, label = scheme_style(position)['color'], name
            if inside.any():
                _draw_cloud(axes, x[inside], y[inside], label, colour, position)
        axes.set_yscale('log')
        _plain_ticks(axes.yaxis)
        axes.set_xlabel('efficiency (%)')
        axes.set_ylabel(words)
    figure.legend(
        *panels[0].get_legend_handles_labels(),
        loc='outside upper left',
        ncols=min(len(names), 4),
        title='small: one case; large: median and quartiles',
        alignment='left',
    )
    return figure


def _draw_cloud(axes: Axes, x: Array, y: Array, label: str, colour: str, position: int) -> None:
    marker = MARKERS[position % len(MARKERS)]
    faint = min(0.35, 25.0 / len(x))
    axes.scatter(x, y, s=8, color=colour, marker=marker, alpha=faint, linewidths=0)
    (x25, x50, x75), (y25, y50, y75) = (np.percentile(values, (25, 50, 75)) for values in (x, y))
    axes.plot([x25, x75], [y50, y50], color=colour, linewidth=1.0, zorder=3)
    axes.plot([x50, x50], [y25, y75], color=colour, linewidth=1.0, zorder=3)
    axes.scatter(
        [x50],
        [y50],
        # Later ones lie on top: what they would hide looks out.
        s=30 + 90 * 0.75**position,
        color=colour,
        marker=marker,
        edgecolors='white',
        linewidths=0.8,
        label=label,
        zorder=4,
    )


def _plain_ticks(axis: Any) -> None:
    """Write a logarithmic axis in plain numbers, where less than a decade leaves room too."""
    axis.set_major_locator(ticker.LogLocator(subs=(1.0, 1.5, 2.0, 3.0, 5.0, 7.0)))
    axis.set_major_formatter(ticker.FormatStrFormatter('%g'))
    axis.set_minor_formatter(ticker.NullFormatter())


# ---- Heat maps ----


@styled
def heat_map_figure(
    columns: Columns, schemes: Sequence[str], x: str, y: str, quantity: Quantity
) -> Figure:
    """
    Return ``quantity`` over two axes of the grid, a panel for each scheme.

    Where the study varies more than the two axes, a cell is the median of its cases. A cell
    without any number is hatched; one with a case that chatters is crossed.
    """
    if 'scheme' in (x, y):
        panels_of = {'': np.ones(len(columns['scheme']), dtype=bool)}
    else:
        panels_of = {scheme: _of_scheme(columns, scheme) for scheme in schemes}
    ticks = {axis: list(dict.fromkeys(columns[axis])) for axis in (x, y)}
    found = {
        name: _cells(columns, inside, (x, y), ticks, quantity)
        for name, inside in panels_of.items()
    }
    across = min(ACROSS, len(found))
    down = -(-len(found) // across)
    height = 0.8 + down * (0.75 + 0.26 * min(max(len(ticks[y]), 4), 14))
    figure = Figure(figsize=(7.2, height))
    panels = figure.subplots(down, across, squeeze=False, sharex=True, sharey=True)
    scale = _scale([values for values, _, _ in found.values()], quantity)
    most = max((count for _, _, count in found.values()), default=1)
    notes = [quantity.words]
    notes += [f'median of up to {most} cases'] if most > 1 else []
    notes += ['×: chatters'] if any(chatter.any() for _, chatter, _ in found.values()) else []
    notes += ['hatched: no numbers'] if _has_gaps(found.values()) else []
    figure.suptitle('; '.join(notes), x=0.01, horizontalalignment='left')
    image = None
    for axes, (name, (values, chatter, _)) in zip(panels.flat, found.items(), strict=False):
        image = axes.imshow(values, origin='lower', aspect='auto', **scale)
        _draw_cells(axes, values, chatter, quantity, image)
        axes.set_title(name)
        _draw_ticks(axes, ticks[x], ticks[y])
    for axes in list(panels.flat)[len(found) :]:  # noqa: E203
        axes.set_visible(False)
    for axes in panels[-1]:
        axes.set_xlabel(axis_words(x))
    if len(found) % across:  # a panel without one below it
        last = panels[-2][-1] if down > 1 else panels[-1][-1]
        last.set_xlabel(axis_words(x))
        last.tick_params(labelbottom=True)
    for axes in panels[:, 0]:
        axes.set_ylabel(axis_words(y))
    if max(len(_label(text)) for text in ticks[x]) > LEVEL:
        for axes in panels.flat:  # panels share their ticks: the last one drawn makes them anew
            for label in axes.get_xticklabels():
                label.set(rotation=30.0, horizontalalignment='right', rotation_mode='anchor')
    if image is not None:
        bar = figure.colorbar(image, ax=panels, pad=0.01, aspect=12 * down)
        if quantity.is_ratio:
            _plain_ticks(bar.ax.yaxis)
        elif quantity.text == 'g':
            bar.ax.yaxis.set_major_locator(ticker.MaxNLocator(integer=True))
    return figure


def _has_gaps(found: Iterable[tuple[Array, Any, int]]) -> bool:
    return not all(np.isfinite(values).all() for values, _, _ in found)


def _cells(
    columns: Columns,
    inside: Any,
    axes: tuple[str, str],
    ticks: Mapping[str, list[Any]],
    quantity: Quantity,
) -> tuple[Array, Any, int]:
    """Return the medians (y, x), where a case chatters, and the most cases in a cell."""
    x, y = axes
    values = quantity.factor * _numbers(columns, quantity.column)
    needless = np.nan_to_num(_numbers(columns, 'needless_shifts')) > 0
    cells = np.full((len(ticks[y]), len(ticks[x])), np.nan)
    chatter = np.zeros(cells.shape, dtype=bool)
    most = 1
    for i, at_y in enumerate(ticks[y]):
        for j, at_x in enumerate(ticks[x]):
            here = inside & [
                (a, b) == (at_x, at_y) for a, b in zip(columns[x], columns[y], strict=True)
            ]
            known = here & np.isfinite(values)
            chatter[i, j] = bool((here & needless).any())
            if known.any():
                cells[i, j] = np.median(values[known])
                most = max(most, int(known.sum()))
    return cells, chatter, most


def _scale(cells: Sequence[Array], quantity: Quantity) -> dict[str, Any]:
    """Return colour map and norm, the same for all panels; ratios are centred on 1."""
    values = np.concatenate([panel.ravel() for panel in cells])
    values = values[np.isfinite(values)]
    if not values.size:
        values = np.ones(1)
    if quantity.is_ratio:
        far = float(np.exp(np.abs(np.log(np.clip(values, 1e-3, 1e3))).max()))
        far = max(far, 1.1)
        return {'cmap': 'PuOr_r', 'norm': colors.LogNorm(1.0 / far, far)}
    low, high = float(values.min()), float(values.max())
    return {'cmap': 'cividis', 'norm': colors.Normalize(low, high if high > low else low + 1.0)}


def _draw_cells(axes: Axes, values: Array, chatter: Any, quantity: Quantity, image: Any) -> None:
    axes.grid(False)
    rows, across = values.shape
    for i in range(rows):
        for j in range(across):
            value = values[i, j]
            if not np.isfinite(value):
                axes.add_patch(patches.Rectangle((j - 0.5, i - 0.5), 1.0, 1.0, **MISSING))
                continue
            ink = 'white' if _is_dark(image.cmap(image.norm(value))) else 'black'
            if across <= ANNOTATED:
                text = format(value, quantity.text) + (' ×' if chatter[i, j] else '')
                axes.text(j, i, text, color=ink, fontsize=6.5, ha='center', va='center')
            elif chatter[i, j]:
                axes.text(j, i, '×', color=ink, fontsize=8, ha='center', va='center')


def _is_dark(colour: Sequence[float]) -> bool:
    red, green, blue = colour[:3]
    return 0.299 * red + 0.587 * green + 0.114 * blue < 0.5


def _draw_ticks(axes: Axes, x: list[Any], y: list[Any]) -> None:
    for axis, labels in ((axes.xaxis, x), (axes.yaxis, y)):
        step = -(-len(labels) // 14)
        axis.set_ticks(range(0, len(labels), step), [_label(text) for text in labels[::step]])


def _label(value: Any) -> str:
    return format(value, '.4g') if isinstance(value, float) else str(value)


# ---- Sensitivity ----


@styled
def sensitivity_figure(
    columns: Columns, schemes: Sequence[str], parameters: Sequence[str]
) -> Figure:
    """
    Return Spearman's rank correlation of each sampled parameter with what is measured.

    Bars for each scheme, the parameter that matters most on top; 95 % of what chance gives lies
    between the dashed lines.
    """
    shown = {'iae': 'IAE', 'max_error': 'maximum error', 'efficiency': 'efficiency'}
    found = {
        metric: np.array([rank_correlations(columns, s, parameters, metric) for s in schemes])
        for metric in shown
    }
    weight = np.nanmax(np.abs(np.nan_to_num(np.array(list(found.values())))), axis=(0, 1))
    order = np.argsort(weight)
    figure = Figure(figsize=(7.2, 1.2 + len(parameters) * (0.16 + 0.13 * len(schemes))))
    panels = figure.subplots(1, len(shown), sharey=True, sharex=True)
    cases = min(
        int(np.isfinite(_numbers(columns, 'iae')[_of_scheme(columns, s)]).sum()) for s in schemes
    )
    thick = 0.8 / len(schemes)
    for axes, (metric, words) in zip(panels, shown.items(), strict=True):
        for position, scheme in enumerate(schemes):
            rows = np.arange(len(order)) + thick * (0.5 * (len(schemes) - 1) - position)
            axes.barh(
                rows,
                found[metric][position][order],
                height=thick,
                color=scheme_style(position)['color'],
                label=scheme,
            )
        axes.axvline(0.0, color='#555555', linewidth=0.7)
        if cases > 2:
            for side in (-1.0, 1.0):
                chance = side * CERTAIN / np.sqrt(cases - 1.0)
                axes.axvline(chance, color='#999999', linewidth=0.7, linestyle=(0, (4, 3)))
        axes.set_title(words)
        axes.set_xlim(-1.05, 1.05)
    panels[0].set_yticks(range(len(order)), [parameters[k] for k in order])
    panels[1].set_xlabel(f'rank correlation over {cases} cases (Spearman)')
    handles, labels = panels[0].get_legend_handles_labels()
    figure.legend(handles, labels, loc='outside upper left', ncols=min(len(schemes), 4))
    return figure


def rank_correlations(
    columns: Columns, scheme: str, parameters: Sequence[str], metric: str
) -> list[float]:
    """
    Return Spearman's correlation of each of ``parameters`` with ``metric`` in a scheme.

    NaN where fewer than three cases have numbers, or where nothing differs.
    """
    from scipy.stats import rankdata

    values = _numbers(columns, metric)
    known = _of_scheme(columns, scheme) & np.isfinite(values)
    found = []
    for name in parameters:
        a, b = _numbers(columns, name)[known], values[known]
        if known.sum() < 3 or np.ptp(a) == 0.0 or np.ptp(b) == 0.0:
            found.append(float('nan'))
        else:
            found.append(float(np.corrcoef(rankdata(a), rankdata(b))[0, 1]))
    return found
