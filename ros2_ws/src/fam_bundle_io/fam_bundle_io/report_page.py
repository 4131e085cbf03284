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

"""The report as one interactive page: nothing in it is loaded from elsewhere."""

from collections.abc import Iterable, Mapping, Sequence
import html
from typing import Any, TYPE_CHECKING

from fam_bundle_io.figures_runs import same_curve
from fam_bundle_io.figures_style import (
    DOWNSHIFT,
    KILOPASCAL,
    LAG,
    PERCENT,
    SCHEME_COLOURS,
    UNIT_COLOURS,
    UPSHIFT,
)
from fam_bundle_io.metrics import ticks_in
from fam_bundle_io.report import last_cycle_of, plural, ReportedRun
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    from plotly.graph_objects import Figure

MOST_PHASES = 200  # in which the plant was safe, that are marked
DASHES = ('dash', 'dot', 'dashdot', 'longdash')  # of different references
POINTS = 50_000  # of a curve; longer ones are drawn by their extremes
BINS = 80  # of a histogram
MICROSECONDS = 1e6  # per s
NODE_HEADINGS = {
    'latency_p50': 'p50 (µs)',
    'latency_p99': 'p99 (µs)',
    'latency_max': 'max (µs)',
    'cpu_share': 'CPU',
}
STYLE = """
body { font: 15px/1.5 system-ui, sans-serif; color: #222; max-width: 72rem; margin: 2rem auto;
  padding: 0 1rem; }
h1 { font-size: 1.5rem; } h2 { font-size: 1.25rem; border-top: 1px solid #ccc;
  padding-top: 1.2rem; margin-top: 2.5rem; } h3 { font-size: 1.05rem; }
nav a { margin-right: 1.2rem; }
table { border-collapse: collapse; margin: 0.8rem 0; font-variant-numeric: tabular-nums; }
th, td { padding: 0.2rem 0.9rem 0.2rem 0; text-align: right; border-bottom: 1px solid #e5e5e5; }
th { font-weight: 600; vertical-align: bottom; }
th:first-child, td:first-child { text-align: left; }
.warnings { background: #fff4e0; border-left: 4px solid #e69f00; padding: 0.5rem 1rem; }
.scroll { overflow-x: auto; } .note { color: #666; }
"""


def report_page(runs: Sequence[ReportedRun], troubles: Sequence[str]) -> str:
    """Return the whole page; ``troubles`` are what is wrong with bags that hold no run."""
    from plotly.offline import get_plotlyjs

    parts = [_summary(runs), *_warnings(troubles)]
    if len(runs) > 1:
        parts += ['<h2 id="comparison">Last cycle of every run</h2>', _drawn(comparison(runs))]
    if any(run.numbers['energy'] for run in runs):
        parts += ['<h2 id="energy">Energy of the last cycle</h2>', _energy_section(runs)]
    if any(run.numbers['energy_in_state'] for run in runs):
        parts.append(_state_section(runs))
    for number, run in enumerate(runs):
        parts += _run_section(run, number)
    parts += ['<h2 id="timing">Timing of the loop</h2>', *_timing_section(runs)]
    return f"""<!DOCTYPE html>
<html lang="en"><head><meta charset="utf-8"><title>fam_bundle report</title>
<meta name="viewport" content="width=device-width, initial-scale=1">
<style>{STYLE}</style><script>{get_plotlyjs()}</script></head><body>
<h1>Report on {plural(len(runs), 'run')}</h1>
<nav>{_links(runs)}</nav>
{''.join(parts)}
</body></html>
"""


def _links(runs: Sequence[ReportedRun]) -> str:
    marks = [('comparison', 'Comparison')] if len(runs) > 1 else []
    marks += [('energy', 'Energy')] if any(run.numbers['energy'] for run in runs) else []
    marks += [(f'run{number}', run.name) for number, run in enumerate(runs)]
    marks.append(('timing', 'Timing'))
    return ''.join(f'<a href="#{mark}">{html.escape(name)}</a>' for mark, name in marks)


# ---- Texts and tables ----


def table(headings: Sequence[str], rows: Iterable[Sequence[str]]) -> str:
    """Return a table of texts."""

    def row(cells: Sequence[str], kind: str) -> str:
        return ''.join(f'<{kind}>{html.escape(cell)}</{kind}>' for cell in cells)

    body = ''.join(f'<tr>{row(cells, "td")}</tr>' for cells in rows)
    return (
        f'<div class="scroll"><table><thead><tr>{row(headings, "th")}</tr></thead>'
        f'<tbody>{body}</tbody></table></div>'
    )


def _number(value: float | None, form: str, scale: float = 1.0) -> str:
    return '-' if value is None or not np.isfinite(value) else format(scale * value, form)


def _times(times: Sequence[float] | None) -> str:
    return '-' if times is None else ', '.join(f'{t:.3f}' for t in times) or 'none'


def _warnings(words: Sequence[str]) -> list[str]:
    if not words:
        return []
    items = ''.join(f'<li>{html.escape(line)}</li>' for line in words)
    return [f'<div class="warnings"><b>Warnings</b><ul>{items}</ul></div>']


def _summary(runs: Sequence[ReportedRun]) -> str:
    headings = (
        'run',
        'scheme',
        'pace',
        'IAE (s)',
        'maximum error',
        'upshifts (s)',
        'downshifts (s)',
        'input (J)',
        'efficiency',
        'warnings',
    )
    rows = []
    for run in runs:
        n = run.numbers
        energy = n['energy'] or {}
        rows.append(
            (
                run.name,
                n['scheme'] or '-',
                n['pace'] or '-',
                _number(n['iae'], '.4f'),
                _number(n['max_error'], '.4f'),
                _times(n['upshift_times']),
                _times(n['downshift_times']),
                _number(energy.get('hydraulic_input'), '.2f'),
                _number(energy.get('efficiency'), '.1%'),
                str(len(n['warnings']) or ''),
            )
        )
    note = (
        '<p class="note">Over the last whole cycle of each run. Efficiency: work done on the load '
        'while the bundle contracts, over the hydraulic energy from the source.</p>'
    )
    return table(headings, rows) + note


def _run_section(run: ReportedRun, number: int) -> list[str]:
    n = run.numbers
    said = f'{n["bag"]}: {n["ticks"]} ticks from {n["start"]:g} to {n["stop"]:g} s'
    if n['parameters_hash']:
        said += f', parameters {n["parameters_hash"][:12]}'
    thinned = '' if n['ticks'] <= POINTS else f' Curves are drawn by {POINTS} extremes.'
    marked = ' Shaded: the plant was safe.' if run.timing.safe else ''
    return [
        f'<h2 id="run{number}">{html.escape(run.name)}</h2>',
        f'<p class="note">{html.escape(said)}. Drag in a panel to zoom all of them, double-click '
        f'to see the whole run again.{marked}{thinned}</p>',
        *_warnings(n['warnings']),
        _drawn(run_panels(run)),
        _cycle_table(run),
    ]


def _cycle_table(run: ReportedRun) -> str:
    units = run.trace['mu_pressure'].shape[1]
    states = sorted({s for c in run.numbers['cycles'] for s in c['time_in_state'] or {}})
    headings = [
        'cycle (s)',
        'IAE (s)',
        'maximum error',
        'up',
        'down',
        *(f'in state {state} (s)' for state in states),
        *(f'MU{unit + 1} at source (s)' for unit in range(units)),
        'input (J)',
        'output (J)',
        'efficiency',
    ]
    rows = []
    for c in run.numbers['cycles']:
        energy, in_state = c['energy'] or {}, c['time_in_state'] or {}
        rows.append(
            [
                f'{c["metrics_from"]:g} to {c["metrics_to"]:g}',
                _number(c['iae'], '.4f'),
                _number(c['max_error'], '.4f'),
                _count(c['upshift_times']),
                _count(c['downshift_times']),
                *(_number(in_state.get(state), '.3f') for state in states),
                *(_number(time, '.3f') for time in c['time_at_source']),
                _number(energy.get('hydraulic_input'), '.2f'),
                _number(energy.get('output'), '.2f'),
                _number(energy.get('efficiency'), '.1%'),
            ]
        )
    return table(headings, rows) if rows else ''


def _count(times: Sequence[float] | None) -> str:
    return '-' if times is None else str(len(times))


# ---- Figures ----


def _drawn(figure: 'Figure') -> str:
    # A fixed order of ids would clash between figures: plotly makes its own.
    return str(
        figure.to_html(full_html=False, include_plotlyjs=False, config={'displaylogo': False})
    )


def _panels(titles: Sequence[str], heights: Sequence[float]) -> 'Figure':
    from plotly.subplots import make_subplots

    figure = make_subplots(
        len(titles), 1, shared_xaxes=True, row_heights=list(heights), vertical_spacing=0.025
    )
    for row, title in enumerate(titles, 1):
        figure.update_yaxes(title_text=title, row=row, col=1)
    figure.update_layout(
        template='plotly_white',
        height=round(70 * sum(heights)),
        margin={'l': 70, 'r': 20, 't': 35, 'b': 45},
        legend={'groupclick': 'toggleitem'},
        hovermode='x unified',
    )
    return figure


def _x(time: npt.NDArray[np.float64]) -> dict[str, Any]:
    """Return the times of a curve; evenly spaced ones need no array."""
    step = np.diff(time)
    if step.size and np.all(np.abs(step - step[0]) < 1e-9):
        return {'x0': float(time[0]), 'dx': float(time[-1] - time[0]) / step.size}
    return {'x': time}


def extremes(values: npt.NDArray[np.float64], points: int) -> npt.NDArray[np.int64]:
    """
    Return the indices of at most ``points`` values that a drawing of all of them needs.

    Of each of ``points / 2`` equal parts: where it is least and where it is largest.
    """
    if len(values) <= points:
        return np.arange(len(values))
    size = -(-len(values) // (points // 2))
    padded = np.full(-(-len(values) // size) * size, values[-1])
    padded[: len(values)] = np.nan_to_num(values)
    parts = padded.reshape(-1, size)
    start = np.arange(len(parts)) * size
    found = np.concatenate([start + parts.argmin(axis=1), start + parts.argmax(axis=1)])
    return np.unique(np.minimum(found, len(values) - 1))


def _curve(
    figure: 'Figure',
    row: int,
    time: npt.NDArray[np.float64],
    values: npt.NDArray[Any],
    name: str,
    **line: Any,
) -> None:
    values = np.where(np.isfinite(values.astype(float)), values, np.nan).astype(np.float32)
    chosen = extremes(values, POINTS)
    if len(chosen) < len(values):
        time, values = time[chosen], values[chosen]
    figure.add_scatter(
        **_x(time),
        y=values,
        name=name,
        mode='lines',
        line={'width': 1.4, **line},
        legendgroup=f'{row}',
        row=row,
        col=1,
    )


def run_panels(run: ReportedRun) -> 'Figure':
    """Return the paper's panels of one run (Figures 11-13), linked in time, over the whole run."""
    trace, time = run.trace, run.trace['time']
    titles = ['strain (%)', 'time (s)', 'state', 'pressure (kPa)', 'error (%)', 'spool']
    figure = _panels(titles, (3.0, 2.2, 1.2, 3.0, 2.0, 2.0))
    units = range(trace['mu_pressure'].shape[1])

    def curve(row: int, signal: str, name: str, scale: float = 1.0, **line: Any) -> None:
        if signal not in run.missing:
            _curve(figure, row, time, scale * trace[signal], name, **line)

    curve(1, 'strain', 'strain', PERCENT, color='#0072B2')
    curve(1, 'strain_reference', 'reference', PERCENT, color='#000000', dash='dash')
    curve(2, 'recruitment_lag', 'recruitment lag', color=LAG)
    curve(2, 'time_to_saturation', 'to saturation', color=UPSHIFT)
    curve(2, 'time_to_desaturation', 'to desaturation', color=DOWNSHIFT)
    curve(3, 'recruitment_state', 'recruited units', color='#000000', shape='hv')
    curve(4, 'source_pressure', 'source', KILOPASCAL, color='#7a7a7a')
    for unit in units:
        colour = UNIT_COLOURS[unit % len(UNIT_COLOURS)]
        pressure = KILOPASCAL * trace['mu_pressure'][:, unit]
        _curve(figure, 4, time, pressure, f'MU{unit + 1}', color=colour)
        if 'spool' not in run.missing:
            spool = trace['spool'][:, unit]
            _curve(figure, 6, time, spool, f'spool {unit + 1}', color=colour)
    if 'strain_reference' not in run.missing:
        error = PERCENT * (trace['strain_reference'] - trace['strain'])
        _curve(figure, 5, time, error, 'error', color='#0072B2')
    lag = trace['recruitment_lag']
    longest = max(float(np.max(lag[np.isfinite(lag)], initial=0.0)), 0.1)
    # Far from a shift the times are long and say nothing: the scale is that of the lag.
    figure.update_yaxes(range=[-2.0 * longest, 4.0 * longest], row=2, col=1)
    figure.update_yaxes(dtick=1, range=[0.7, len(units) + 0.3], row=3, col=1)
    figure.update_xaxes(title_text='time (s)', row=len(titles), col=1)
    # All at once, over the height of all panels: one by one takes plotly minutes.
    shapes = [
        {
            'type': 'rect',
            'xref': 'x',
            'yref': 'paper',
            'x0': phase.start,
            'x1': phase.stop,
            'y0': 0.0,
            'y1': 1.0,
            'fillcolor': '#CC79A7',
            'opacity': 0.3,
            'line': {'width': 0},
        }
        for phase in (run.timing.safe or [])[:MOST_PHASES]
    ]
    figure.update_layout(shapes=shapes)
    return figure


def comparison(runs: Sequence[ReportedRun]) -> 'Figure':
    """Return how the runs track the last cycle, over the time from its start (Figure 14)."""
    figure = _panels(['strain (%)', 'error (%)'], (4.0, 3.0))
    references: list[npt.NDArray[np.float64]] = []
    for position, run in enumerate(runs):
        cycle = last_cycle_of(run)
        if cycle is None or 'strain_reference' in run.missing:
            continue
        inside = ticks_in(run.trace, cycle)
        time = run.trace['time'][inside] - cycle.start
        strain = PERCENT * run.trace['strain'][inside]
        reference = PERCENT * run.trace['strain_reference'][inside]
        colour = SCHEME_COLOURS[position % len(SCHEME_COLOURS)]
        if not any(same_curve(reference, known) for known in references):
            name = f'reference of {run.name}' if references else 'reference'
            dash = DASHES[len(references) % len(DASHES)]
            _curve(figure, 1, time, reference, name, color='#000000', dash=dash)
            references.append(reference)
        _curve(figure, 1, time, strain, run.name, color=colour)
        _curve(figure, 2, time, reference - strain, f'{run.name}: error', color=colour)
    figure.update_xaxes(title_text='time from the start of the cycle (s)', row=2, col=1)
    return figure


def _energy_section(runs: Sequence[ReportedRun]) -> str:
    known = {run.name: run.numbers['energy'] for run in runs if run.numbers['energy']}
    rows = (
        (
            name,
            _number(e['hydraulic_input'], '.3f'),
            _number(e['output'], '.3f'),
            _number(e['returned'], '.3f'),
            _number(sum(e['supply_loss']), '.3f'),
            _number(sum(e['return_loss']), '.3f'),
            _number(e['relieved'], '.3f'),
            _number(e['unexplained'], '.3f'),
            _number(e['efficiency'], '.1%'),
            _number(e['modelled_oil'], '.4f'),
        )
        for name, e in known.items()
    )
    headings = (
        'energy (J)',
        'input',
        'output',
        'returned',
        'lost in supply',
        'lost in return',
        'relieved',
        'unexplained',
        'efficiency',
        'modelled / measured oil',
    )
    note = (
        '<p class="note">Input, output and what the load gives back are measured. The losses in '
        'valves and hoses, and what units push back into the source, which relieves it, are '
        'modelled, for the flow of each unit is not measured; the last '
        'column says how well the modelled flow of all units agrees with the measured one. '
        'Unexplained is the rest, also what the force law of slack muscles makes or takes: it has '
        'no energy function there.</p>'
    )
    return _drawn(_energy_bars(known)) + table(headings, rows) + note


def _state_section(runs: Sequence[ReportedRun]) -> str:
    """Return a bar and a row for each recruitment state of each run."""
    known, times = dict[str, dict[str, Any]](), list[float]()
    for run in runs:
        for state, spent in (run.numbers['energy_in_state'] or {}).items():
            known[f'{run.name}, state {state}'] = spent
            times.append(run.numbers['time_in_state'][state])
    units = range(max(len(e['supply_loss']) for e in known.values()))
    headings = [
        'energy (J)',
        'time (s)',
        'input',
        'output',
        'returned',
        *(f'lost {word} MU{unit + 1}' for unit in units for word in ('into', 'out of')),
        'relieved',
        'stored and unexplained',
    ]
    rows = (
        [
            name,
            _number(time, '.3f'),
            *(_number(e[part], '.3f') for part in ('hydraulic_input', 'output', 'returned')),
            *(
                _number(_of_unit(e, kind, unit), '.3f')
                for unit in units
                for kind in ('supply_loss', 'return_loss')
            ),
            _number(e['relieved'], '.3f'),
            _number(e['unexplained'], '.3f'),
        ]
        for time, (name, e) in zip(times, known.items(), strict=True)
    )
    note = (
        '<p class="note">State 2: two motor units are recruited. The rows of a run add up to the '
        'energies above. What is stored in one state, in oil, bladders and slack muscles, and '
        'given back in another stands in the last column of both.</p>'
    )
    title = '<h3 id="states">By recruitment state</h3>'
    return title + _drawn(_energy_bars(known)) + table(headings, rows) + note


def _of_unit(energies: Mapping[str, Any], kind: str, unit: int) -> float:
    losses = energies[kind]
    return float(losses[unit]) if unit < len(losses) else 0.0


def _energy_bars(energies: Mapping[str, Mapping[str, Any]]) -> 'Figure':
    """Return where the input went, a bar for each name."""
    from plotly.graph_objects import Figure

    figure = Figure()
    spent = list(energies.values())

    def bar(name: str, values: list[float], colour: str, **marker: Any) -> None:
        figure.add_bar(
            y=list(energies),
            x=values,
            name=name,
            orientation='h',
            marker={'color': colour, **marker},
        )

    bar('net work on the load', [e['output'] - e['returned'] for e in spent], '#0072B2')
    for unit in range(max(len(e['supply_loss']) for e in spent)):
        colour = UNIT_COLOURS[unit % len(UNIT_COLOURS)]
        for kind, word, pattern in (('supply_loss', 'into', ''), ('return_loss', 'out of', '/')):
            losses = [_of_unit(e, kind, unit) for e in spent]
            bar(f'lost {word} MU{unit + 1}', losses, colour, pattern={'shape': pattern})
    if any(e['relieved'] for e in spent):
        bar('relieved', [e['relieved'] for e in spent], '#666666')
    bar('unexplained', [e['unexplained'] for e in spent], '#cccccc')
    figure.update_layout(
        template='plotly_white',
        barmode='relative',
        height=180 + 60 * len(energies),
        margin={'l': 20, 'r': 20, 't': 35, 'b': 45},
        xaxis_title='energy of the last cycle (J)',
        yaxis={'automargin': True, 'autorange': 'reversed'},
    )
    return figure


def _timing_section(runs: Sequence[ReportedRun]) -> Iterable[str]:
    headings = (
        'from a sample to',
        'answered',
        'unanswered',
        'median (µs)',
        '99 % (µs)',
        'largest (µs)',
    )
    for run in runs:
        numbers = run.numbers['timing']
        rows = []
        interval = numbers['interval'] or {}
        rows.append(('the next sample', str(numbers['samples'] - 1), '', *_spread(interval)))
        for topic, found in numbers['answers'].items():
            unanswered = numbers['unanswered'][topic]
            answered = str(numbers['samples'] - unanswered)
            rows.append((topic, answered, str(unanswered), *_spread(found or {})))
        yield f'<h3>{html.escape(run.name)}</h3>'
        if run.numbers['pace'] == 'lockstep':
            yield (
                '<p class="note">In lock-step there is no clock: these times say how fast the '
                'machine ran.</p>'
            )
        yield table(headings, rows)
        yield _drawn(latencies(run))
        if numbers['nodes']:
            names = list(numbers['nodes'][0])
            headings_of_nodes = [NODE_HEADINGS.get(name, name.replace('_', ' ')) for name in names]
            rows_of_nodes = [[_cell(n, node.get(n)) for n in names] for node in numbers['nodes']]
            yield table(headings_of_nodes, rows_of_nodes)


def _spread(found: dict[str, float]) -> list[str]:
    return [_number(found.get(k), '.0f', MICROSECONDS) for k in ('median', 'p99', 'largest')]


def _cell(name: str, value: Any) -> str:
    if name.startswith('latency'):
        return _number(value, '.0f', MICROSECONDS)
    return _number(value, '.0%') if name == 'cpu_share' else str(value)


def latencies(run: ReportedRun) -> 'Figure':
    """Return how often an answer took how long."""
    from plotly.graph_objects import Figure

    figure = Figure()
    answers = {name: times for name, times in run.timing.answers.items() if len(times)}
    # The few longest would squeeze all others into one bar: they are in the table.
    end = max((float(np.percentile(t, 99.9)) for t in answers.values()), default=1.0)
    for position, (name, times) in enumerate(answers.items()):
        counts, edges = np.histogram(times, BINS, (0.0, max(end, 1e-6)))
        figure.add_scatter(
            x=MICROSECONDS * edges[:-1],
            y=counts,
            name=name,
            mode='lines',
            line={'shape': 'hv', 'color': SCHEME_COLOURS[position % len(SCHEME_COLOURS)]},
        )
    figure.update_layout(
        template='plotly_white',
        height=300,
        margin={'l': 70, 'r': 20, 't': 35, 'b': 45},
        xaxis_title='time from the sample to its answer (µs)',
        yaxis_title='ticks',
    )
    return figure
