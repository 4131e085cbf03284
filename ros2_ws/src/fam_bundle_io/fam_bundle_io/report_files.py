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

"""Writes the report on some bags: page, figures, tables and numbers."""

from collections.abc import Callable, Sequence
import json
from pathlib import Path
from typing import TYPE_CHECKING

from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.metrics import slice_of
from fam_bundle_io.report import (
    last_cycle_of,
    names_of,
    reported_runs,
    ReportedRun,
    without_nan,
)
from fam_bundle_io.report_page import report_page
from fam_bundle_io.trace import Trace
from fam_bundle_model.files import whole_file
from fam_bundle_model.parameters import Configuration
import numpy as np

if TYPE_CHECKING:
    from matplotlib.figure import Figure
    import pandas as pd


def steps_of(bags: Sequence[Path]) -> int:
    """Return how many steps ``write_report`` reports as progress."""
    return len(bags) + 3


def write_report(
    bags: Sequence[Path],
    folder: Path,
    configuration: Configuration | None = None,
    progress: Callable[[int], None] = lambda done: None,
) -> tuple[list[ReportedRun], list[str]]:
    """
    Write the report on the last run of every bundle in ``bags`` to ``folder``.

    ``configuration`` takes the place of those in the bags. Returns the runs and what is
    wrong with bags that cannot be read or hold no run. Raises BagError when no bag holds one;
    nothing is written then.
    """
    runs: list[ReportedRun] = []
    troubles: list[str] = []
    for done, (path, name) in enumerate(zip(bags, names_of(bags), strict=True), 1):
        try:
            found, warnings = reported_runs(path, name, configuration)
            runs += found
            troubles += [] if found else [f'{path}: {"; ".join(warnings)}']
        except BagError as error:
            troubles.append(f'{error}')
        progress(done)
    if not runs:
        raise BagError('; '.join(troubles))
    page, drawn = report_page(runs, troubles), draw_figures(runs)
    progress(len(bags) + 1)
    folder.mkdir(parents=True, exist_ok=True)
    remove_earlier(folder)
    _write(folder / 'report.html', page)
    content = {'runs': {run.name: run.numbers for run in runs}, 'unreadable': troubles}
    _write(folder / 'report.json', json.dumps(without_nan(content), indent=1, allow_nan=False))
    _save(drawn, folder)
    progress(len(bags) + 2)
    _write(folder / 'cycles.csv', cycle_table(runs).to_csv(index=False))
    for run in runs:
        _write(folder / f'{file_name(run.name)}.csv', tick_table(run.trace).to_csv(index=False))
    progress(steps_of(bags))
    return runs, troubles


def _write(path: Path, text: str) -> None:
    with whole_file(path) as file:
        file.write(f'{text.rstrip()}\n'.encode())


def _save(drawn: 'dict[str, Figure]', folder: Path) -> None:
    from fam_bundle_io.figures import save_figures

    save_figures(drawn, folder)


def file_name(name: str) -> str:
    """Return how the files of the run ``name`` are called."""
    return f'run_{name.replace("/", "_")}'


def remove_earlier(folder: Path) -> None:
    """Remove the report that is in ``folder``: no figure of it may stand beside a new one."""
    try:
        names = list(json.loads((folder / 'report.json').read_text())['runs'])
    except (OSError, ValueError, TypeError, KeyError):
        names = []
    figures = ('comparison', 'energy', 'timing', *map(file_name, names))
    files = [f'{name}.{suffix}' for name in figures for suffix in ('png', 'pdf')]
    files += [f'{file_name(name)}.csv' for name in names]
    for name in ('report.html', 'report.json', 'cycles.csv', *files):
        (folder / name).unlink(missing_ok=True)


def draw_figures(runs: Sequence[ReportedRun]) -> 'dict[str, Figure]':
    """Return each run as in Figures 11 to 13, all as in Figure 14, energy and timing, by name."""
    from fam_bundle_io import figures

    windows = {run.name: ticks_of(run) for run in runs}
    drawn = {
        file_name(run.name): figures.run_figure(run.trace, title_of(run), windows[run.name])
        for run in runs
    }
    tracked = {
        run.name: run.trace
        for run in runs
        if run.numbers['cycles'] and 'strain_reference' not in run.missing
    }
    if tracked:
        drawn['comparison'] = figures.comparison_figure(tracked, windows)
    energies = {run.name: run.numbers['energy'] for run in runs if run.numbers['energy']}
    if energies:
        drawn['energy'] = figures.energy_figure(energies)
    drawn['timing'] = figures.timing_figure({run.name: run.timing for run in runs})
    return drawn


def ticks_of(run: ReportedRun) -> slice:
    """Return the ticks of the cycle that the metrics are over, all where there is none."""
    cycle = last_cycle_of(run)
    if cycle is None:
        return slice(0, len(run.trace['time']))
    return slice_of(run.trace, cycle)


def title_of(run: ReportedRun) -> str:
    """Return the title of a run's figure."""
    return f'{run.name} ({run.numbers["scheme"]})' if run.numbers['scheme'] else run.name


def tick_table(trace: Trace) -> 'pd.DataFrame':
    """Return one row per tick; SI units, and a column for each motor unit, counted from 1."""
    import pandas as pd

    columns = {}
    for name, values in trace.items():
        if values.ndim == 1:
            columns[name] = values
        else:
            columns |= {f'{name}_{unit + 1}': values[:, unit] for unit in range(values.shape[1])}
    return pd.DataFrame(columns)


def cycle_table(runs: Sequence[ReportedRun]) -> 'pd.DataFrame':
    """Return one row per run and whole cycle."""
    import pandas as pd

    rows = []
    for run in runs:
        for number, cycle in enumerate(run.numbers['cycles'], 1):
            row = {'run': run.name, 'cycle': number}
            for name, value in cycle.items():
                row |= dict(_cells(name, value))
            rows.append(row)
    return pd.DataFrame(rows)


def _cells(name: str, value: object) -> Sequence[tuple[str, object]]:
    if name.endswith('shift_times'):
        count = np.nan if value is None else len(value)  # type: ignore[arg-type]
        return [(name.replace('_times', 's'), count)]
    if isinstance(value, dict):
        return [cell for k, v in value.items() for cell in _cells(f'{name}_{k}', v)]
    if isinstance(value, list):
        return [(f'{name}_{unit}', v) for unit, v in enumerate(value, 1)]
    return [(name, value)]
