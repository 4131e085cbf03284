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

"""``./fam top``: how every node keeps up, as a live view or, without a terminal, as lines."""

from collections.abc import Callable, Iterable, Iterator, Sequence
import contextlib
from datetime import datetime
import os
import sys
import time
from typing import NamedTuple

from fam_bundle_bringup.domain_marker import chosen_domain
from fam_bundle_bringup.processes import signals_held
from fam_bundle_bringup.statistics_listener import listening, Report
from rich.console import Console, ConsoleOptions, Group, RenderableType, RenderResult
from rich.live import Live
from rich.measure import Measurement
from rich.segment import Segment
from rich.table import Table
from rich.text import Text

SILENT = 3.0  # s without a report
REDRAW = 0.5  # s
SLICE = 0.2  # s that a line waits at most until it is printed
LONGEST_IN_TABLE = 11  # characters of a state
RUNNING, WAITING, ELSE = 'green', 'yellow', 'bold red'
FAULT = 'yellow'
BRIEF = ('waiting', 'safe')  # what a state that is too long for the table may begin with

Listen = Callable[[float], list[Report]]


class Column(NamedTuple):
    """A figure of a report: above its column, in a line, and as text."""

    title: str
    key: str
    text: Callable[[Report], str]


def _number(value: float, factor: float = 1.0, digits: int = 0) -> str:
    return '-' if value != value else f'{value * factor:.{digits}f}'


def _cpu_per_tick(report: Report) -> str:
    return _number(report.cpu_time_per_tick, 1e6) if report.rate > 0.0 else '-'


def _overruns(report: Report) -> str:
    return f'{report.overruns} ({report.skipped_periods})'


FIGURES = (
    Column('ticks\n/s', 'rate_hz', lambda r: _number(r.rate, digits=1)),
    Column('p50\nus', 'p50_us', lambda r: _number(r.latency_p50, 1e6)),
    Column('p99\nus', 'p99_us', lambda r: _number(r.latency_p99, 1e6)),
    Column('max\nus', 'max_us', lambda r: _number(r.latency_max, 1e6)),
    Column('CPU us\n/tick', 'cpu_us', _cpu_per_tick),
    Column('CPU\n%', 'cpu_percent', lambda r: _number(r.cpu_share, 1e2, 1)),
    Column('ticks', 'ticks', lambda r: str(r.ticks)),
)
# Since the start of the node.
FAULTS = (
    Column('overruns\n(skipped)', 'overruns', _overruns),
    Column('missing', 'missing', lambda r: str(r.missing)),
    Column('duplicate', 'duplicate', lambda r: str(r.duplicate)),
    Column('out of\norder', 'out_of_order', lambda r: str(r.out_of_order)),
    Column('late', 'late', lambda r: str(r.late)),
    Column('refused', 'refused', lambda r: str(r.refused)),
)
NO_FAULTS = 'no overrun, and no message missing, duplicate, out of order, late or refused'


def plain_line(report: Report) -> str:
    """Return a report as one line: time, node, KEY=VALUE ..., and last the whole state."""
    when = datetime.fromtimestamp(report.stamp).isoformat(timespec='milliseconds')
    figures = ' '.join(
        f'{column.key}={column.text(report).replace(" (", "/").rstrip(")")}'
        for column in (*FIGURES, *FAULTS)
    )
    return f'{when} {report.node} {figures} state={report.state}'


class View(NamedTuple):
    """What the screen shows, for the width at hand."""

    reports: Sequence[Report]
    now: float
    domain: int
    height: int | None  # lines of the screen; console options lose it on their way here

    def __rich_console__(self, console: Console, options: ConsoleOptions) -> RenderResult:
        """Render everything; on a screen that is too low, say how much it leaves out."""
        lines = console.render_lines(Group(*self._parts(console, options)), options, pad=False)
        if self.height is not None and len(lines) > self.height:
            hidden = len(lines) - self.height + 1
            note = Text(f'{hidden} more lines: the terminal is too low', style='reverse')
            lines = lines[:-hidden] + console.render_lines(note, options, pad=False)
        for line in lines:
            yield from line
            yield Segment.line()

    def _parts(self, console: Console, options: ConsoleOptions) -> Iterator[RenderableType]:
        nodes = f'{len(self.reports)} node{"" if len(self.reports) == 1 else "s"}'
        yield Text(f'domain {self.domain}, {nodes}', style='bold')
        if not self.reports:
            yield Text('no node has reported yet', style=WAITING)
            return
        yield Text('p50, p99, max: latency from the sample to its answer', style='dim')
        yield Text()
        wide = self._wide()
        unbounded = options.update(max_width=10_000)
        fits = Measurement.get(console, unbounded, wide).maximum <= options.max_width
        yield wide if fits else self._narrow()
        reasons = self._reasons()
        if reasons.row_count:
            yield Text()
            yield reasons
        if not fits:
            yield Text()
            yield self._faults()

    def _silent(self, report: Report) -> bool:
        return self.now - report.received > SILENT

    def _wide(self) -> Table:
        """Return one table of everything."""
        table = _table((*FIGURES, *FAULTS), gap=2, with_state=True)
        for report in self.reports:
            cells = [*_cells(FIGURES, report), *_cells(FAULTS, report, FAULT)]
            self._add(table, report, report.node, cells)
        return table

    def _narrow(self) -> Table:
        """Return the figures, and a row with the namespace before its nodes."""
        table = _table(FIGURES, gap=1, with_state=True)
        last = ''
        for report in self.reports:
            namespace, _, name = report.node.rpartition('/')
            if namespace != last:
                table.add_row(Text(namespace))
            last = namespace
            self._add(
                table, report, f' {name}' if namespace else f'/{name}', _cells(FIGURES, report)
            )
        return table

    def _add(self, table: Table, report: Report, node: str, cells: Sequence[Text]) -> None:
        silent = self._silent(report)
        state = _state(report, self.now - report.received if silent else None)
        table.add_row(Text(node), state, *cells, style='dim' if silent else '')

    def _faults(self) -> RenderableType:
        """Return the nodes that have counted a fault, or that none has."""
        table = _table(FAULTS, gap=1, with_state=False)
        for report in self.reports:
            cells = _cells(FAULTS, report, FAULT)
            if any(cell.style for cell in cells):
                table.add_row(Text(report.node), *cells)
        return table if table.row_count else Text(NO_FAULTS, style='dim')

    def _reasons(self) -> Table:
        """Return the states that are too long for the table, or hidden by a silence."""
        table = Table.grid(padding=(0, 1))
        table.add_column(overflow='fold')
        table.add_column(overflow='fold')
        for report in self.reports:
            silent = self._silent(report)
            if report.state != 'running' and (silent or len(report.state) > LONGEST_IN_TABLE):
                said = f'last said: {report.state}' if silent else report.state
                table.add_row(Text(f'{report.node}:'), Text(said, style=_style(report.state)))
        return table


def _table(columns: Sequence[Column], *, gap: int, with_state: bool) -> Table:
    table = Table(box=None, pad_edge=False, padding=(0, gap, 0, 0), header_style='bold')
    table.add_column('node', overflow='fold')
    if with_state:
        table.add_column('state', no_wrap=True)
    for column in columns:
        table.add_column(column.title, justify='right', no_wrap=True)
    return table


def _cells(columns: Sequence[Column], report: Report, unless_zero: str = '') -> list[Text]:
    texts = (column.text(report) for column in columns)
    return [Text(text, style='' if text.startswith('0') else unless_zero) for text in texts]


def view(reports: Iterable[Report], now: float, domain: int, height: int | None = None) -> View:
    """Return what to show of the last report of each node at the steady time ``now``."""
    return View(sorted(reports, key=lambda r: r.node.rpartition('/')), now, domain, height)


def _style(state: str) -> str:
    if state == 'running':
        return RUNNING
    return WAITING if state.startswith('waiting') else ELSE


def _state(report: Report, silence: float | None) -> Text:
    """Return the state in brief; below the table stands the rest."""
    if silence is not None:
        return Text(f'silent {silence:.0f} s', style=f'not dim {ELSE}')
    brief = next((word for word in BRIEF if report.state.startswith(word)), 'trouble')
    text = report.state if len(report.state) <= LONGEST_IN_TABLE else brief
    return Text(text, style=_style(report.state))


def run_top(asked: int | None, seconds: float) -> None:
    """
    Show the nodes of the domain ``asked``, or of the one found, for ``seconds``.

    Ctrl-C ends it before. Raises ConfigurationError when it cannot be known which domain.
    """
    with contextlib.suppress(KeyboardInterrupt):
        domain = chosen_domain(os.environ) if asked is None else asked
        if domain is None:
            print('fam top: no experiment is running, so this is domain 0', file=sys.stderr)
            domain = 0
        console = Console()
        # An exception in one of its callbacks would be an error of the executor's.
        with listening(domain) as listen, signals_held() as told:
            end = time.monotonic() + seconds
            if sys.stdout.isatty() and not console.is_dumb_terminal:
                show_live(console, listen, domain, end, told)
            else:
                print_lines(listen, end, told)


def show_live(
    console: Console, listen: Listen, domain: int, end: float, told: Sequence[int] = ()
) -> None:
    """Show the last report of each node until the steady time ``end`` or ``told`` to end."""
    last: dict[str, Report] = {}
    with Live(console=console, screen=True, auto_refresh=False) as live:
        while not told and (now := time.monotonic()) < end:
            live.update(view(last.values(), now, domain, console.height), refresh=True)
            last.update((report.node, report) for report in listen(min(REDRAW, end - now)))


def print_lines(listen: Listen, end: float, told: Sequence[int] = ()) -> None:
    """Print a line per report until the steady time ``end``, ``told`` to end, or not read on."""
    try:
        while not told and (now := time.monotonic()) < end:
            for report in listen(min(SLICE, end - now)):
                print(plain_line(report), flush=True)
    except BrokenPipeError:
        # Python would complain when it writes out what is left at its end.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
