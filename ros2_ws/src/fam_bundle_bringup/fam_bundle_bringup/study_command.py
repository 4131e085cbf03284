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

"""``./fam study``: its options, its files, and what it prints."""

import argparse
import collections
from collections.abc import Mapping, Sequence
import contextlib
import os
from pathlib import Path
import statistics
import sys
import time
from typing import Any, TYPE_CHECKING

from fam_bundle_bringup.experiment import prepare_folder
from fam_bundle_bringup.progress import progress_bar
from fam_bundle_model.schema import ConfigurationError

if TYPE_CHECKING:
    from fam_bundle_bringup.study import Study
    from fam_bundle_bringup.study_result import Result

Columns = Mapping[str, Sequence[Any]]

MOST_WORKERS = 1024
NAMED = 10  # cases of a kind that are listed
JOURNAL = 'rows.jsonl'
RESULTS = ('study.parquet', 'study.csv', 'study.json')


def add_study(commands: Any) -> None:
    """Add the parser of the command."""
    study = commands.add_parser(
        'study', help='schemes by references by parameters, offline on all cores'
    )
    study.add_argument('file', type=Path, metavar='FILE', help='study file')
    study.add_argument(
        '--out', type=Path, metavar='DIR', help='folder for results (runs/study/NAME)'
    )
    study.add_argument(
        '--workers', type=_workers, metavar='N', help='processes (default: one for each core)'
    )
    study.add_argument(
        '--dask',
        metavar='ADDRESS',
        help='run on the Dask cluster with this scheduler, such as tcp://127.0.0.1:8786',
    )
    study.add_argument('--csv', action='store_true', help='write CSV in place of Parquet')
    study.add_argument(
        '--figures-only',
        action='store_true',
        help='run nothing: draw and print once more what is in DIR',
    )


def _workers(text: str) -> int:
    number = int(text) if text.isdecimal() else 0
    if not 1 <= number <= MOST_WORKERS:
        raise argparse.ArgumentTypeError(f'{text!r}: must be an integer from 1 to {MOST_WORKERS}')
    return number


def cores() -> int:
    """Return how many cores this process may use."""
    return len(os.sched_getaffinity(0))


def run_study(options: argparse.Namespace) -> int:
    """
    Run, or go on with, the study in ``options.file`` and return the exit status.

    Raises ConfigurationError for a bad study, StudyStopped where it cannot go on.
    """
    from fam_bundle_bringup.study import read_study
    from fam_bundle_bringup.study_result import can_parquet, read_result

    if options.dask is not None and options.workers is not None:
        raise ConfigurationError('--workers: a Dask cluster has its own')
    study = read_study(options.file)
    out: Path = options.out or Path('runs/study') / options.file.stem
    if options.figures_only:
        result = read_result(out)
    else:
        if not (options.csv or can_parquet()):
            print('the Python package pyarrow is missing: CSV it is', file=sys.stderr)
        as_csv = options.csv or not can_parquet()
        result = run_cases(study, out, options.workers or cores(), options.dask, as_csv=as_csv)
    with progress_bar('figures', 1):
        figures = draw_figures(result.columns, result.provenance, out)
    print_summary(result.columns, result.provenance)
    print(f'{len(figures)} figures and all results in {out}')
    return 0


def run_cases(
    study: 'Study', out: Path, workers: int, dask: str | None = None, *, as_csv: bool = False
) -> 'Result':
    """
    Run what is not done of ``study``, write its result to the folder ``out`` and return it.

    In so many processes, or on the Dask cluster at the address ``dask``. Raises
    ConfigurationError where nothing of it can be run, StudyStopped where it cannot go on; rows
    that are done stay in ``out`` then.
    """
    from fam_bundle_bringup.study import cases_of
    from fam_bundle_bringup.study_result import result_of, write_result
    from fam_bundle_bringup.study_run import (
        dask_cluster,
        jobs_of,
        Journal,
        origin,
        processes,
        run_jobs,
        runs_of,
    )

    begin, cases, made_by = time.monotonic(), cases_of(study), origin()
    jobs = jobs_of(cases, study.rivals, made_by)
    if not jobs:
        raise ConfigurationError(f'{study.path}: no case can be run: {cases[0].reason}')
    prepare_folder(out, ())
    with contextlib.closing(Journal(out / JOURNAL)) as journal:
        prepare_folder(out, RESULTS)
        left = [key for key in jobs if key not in journal.rows]
        workers = min(workers, len(left))
        if left:
            title = f'{study.path.stem}, {len(cases)} cases'
            pool = dask_cluster(dask) if dask else processes(workers)
            try:
                with pool as executor, progress_bar(title, runs_of(jobs)) as progress:
                    run_jobs(jobs, journal, executor, progress)
            except BaseException:
                kept = sum(key in journal.rows for key in jobs)
                words = f'{kept} of {len(jobs)} rows are kept: the same command goes on from there'
                print(words, file=sys.stderr)
                raise
        run = {
            'workers': dask or workers,
            'rows': len(jobs),
            'rows_run_now': len(left),
            'elapsed_now': time.monotonic() - begin,
            'cpu_time': sum(journal.cpu_times[key] for key in jobs),
        }
        result = result_of(study, cases, journal.rows, made_by, run)
        write_result(result, out, as_csv)
    return result


# ---- Figures ----


def draw_figures(columns: Columns, provenance: Mapping[str, Any], folder: Path) -> list[Path]:
    """
    Write the figures of a study as PNG and PDF and return their paths.

    Those of an earlier call in ``folder`` are removed.
    """
    from fam_bundle_io import figures_study
    from fam_bundle_io.figures_style import save_figures

    for old in (*folder.glob('study_*.png'), *folder.glob('study_*.pdf')):
        old.unlink()
    schemes, rivals = provenance['schemes'], provenance['rivals']
    if all(value is None for value in columns['iae']):
        return []
    drawn = {'study_tradeoff': figures_study.tradeoff_figure(columns, schemes, rivals)}
    axes = heat_axes(columns, provenance)
    for quantity in figures_study.quantities(rivals) if axes else ():
        if any(value is not None for value in columns[quantity.column]):
            name = f'study_map_{quantity.column.replace(".", "_")}'
            drawn[name] = figures_study.heat_map_figure(columns, schemes, *axes, quantity)
    if provenance['sampled']:
        drawn['study_sensitivity'] = figures_study.sensitivity_figure(
            columns, schemes, provenance['sampled']
        )
    return save_figures(drawn, folder)


def heat_axes(columns: Columns, provenance: Mapping[str, Any]) -> tuple[str, ...]:
    """
    Return the two axes of the heat maps, across first; none where there are no two.

    Those that the study names; else frequency and amplitude; else the first two of the grid that
    differ, or the only one and the schemes.
    """
    if provenance['heat_map']:
        return tuple(provenance['heat_map'])
    differ = [axis for axis in provenance['axes'] if len(set(columns[axis])) > 1]
    usual = ('reference.frequency', 'reference.amplitude')
    if set(usual) <= set(differ):
        return usual
    if len(differ) == 1 and len(provenance['schemes']) > 1:
        return (differ[0], 'scheme')
    return tuple(differ[:2]) if len(differ) > 1 else ()


# ---- What is printed ----


def print_summary(columns: Columns, provenance: Mapping[str, Any]) -> None:
    """Print each scheme's medians, who wins, and by name what chatters or fails."""
    from rich.console import Console
    from rich.table import Table

    schemes, rivals = provenance['schemes'], provenance['rivals']
    table = Table(title=f'{provenance["study"]}: median, and lowest to highest, of all cases')
    table.add_column('')
    for scheme in schemes:
        table.add_column(scheme, justify='right')
    summaries = [summary_of(columns, scheme, schemes[0], rivals) for scheme in schemes]
    for words in summaries[0]:
        table.add_row(words, *(summary[words] for summary in summaries))
    console = Console()
    if not console.is_terminal:
        console.width = max(console.width, 30 + 24 * len(schemes))
    console.print(table)
    if rivals:
        print('A case is within a rival when neither its IAE nor its maximum error is larger;')
        print('ratio: the larger of the two, of the worst case.')
    chatter = [k for k, number in enumerate(columns['needless_shifts']) if number]
    _print_cases('chatter', columns, provenance, chatter)
    diverged = [k for k, status in enumerate(columns['status']) if status == 'diverged']
    _print_cases('diverged', columns, provenance, diverged)
    for status in ('unreachable', 'impossible'):
        found = [k for k, state in enumerate(columns['status']) if state == status]
        reasons = collections.Counter(columns['reason'][k] for k in found)
        if found:
            print(f'{status}: {len(found)} of {len(columns["status"])} cases')
        for reason, count in reasons.most_common(NAMED):
            print(f'  {count} x {reason}')


def _print_cases(
    words: str, columns: Columns, provenance: Mapping[str, Any], cases: Sequence[int]
) -> None:
    if cases:
        print(f'{words}: {len(cases)} of {len(columns["case"])} cases')
    for case in cases[:NAMED]:
        reason = columns['reason'][case] or f'{columns["needless_shifts"][case]} needless shifts'
        print(f'  {name_of(columns, provenance, case)}: {reason}')
    if len(cases) > NAMED:
        print(f'  and {len(cases) - NAMED} more')


def name_of(columns: Columns, provenance: Mapping[str, Any], case: int) -> str:
    """Return the name of a case: its number, its scheme, and what else is varied in it."""
    names = [*provenance['axes'], *provenance['sampled']]
    values = (f'{name} {_short(columns[name][case])}' for name in names)
    return ', '.join([f'case {case}', str(columns['scheme'][case]), *values])


def _short(value: Any) -> str:
    return format(value, '.4g') if isinstance(value, float) else str(value)


def summary_of(columns: Columns, scheme: str, first: str, rivals: Sequence[str]) -> dict[str, str]:
    """Return what is printed of one scheme, by what it is; ``first`` is the one to beat."""
    mine = [k for k, name in enumerate(columns['scheme']) if name == scheme]
    good = [k for k in mine if columns['status'][k] == 'ok']
    # Schemes are innermost: the n-th case of each has the same reference and parameters.
    theirs = [k for k, name in enumerate(columns['scheme']) if name == first]
    summary = {
        'runs': f'{len(good)} of {len(mine)}',
        'IAE (s)': _spread(columns, good, 'iae', 1.0, 4),
        'maximum error (% strain)': _spread(columns, good, 'max_error', 100.0, 2),
        'efficiency (%)': _spread(columns, good, 'efficiency', 100.0, 1),
    }
    for name, words in (('iae', 'IAE'), ('max_error', 'maximum error')):
        pairs = zip(mine, theirs, strict=True)
        both = [(columns[name][a], columns[name][b]) for a, b in pairs]
        both = [pair for pair in both if None not in pair]
        beaten = f'{sum(a < b for a, b in both)} of {len(both)}'
        summary[f'{words} less than {first}'] = '' if scheme == first else beaten
    for rival in rivals:
        names = [f'{rival}.{name}_ratio' for name in ('iae', 'max_error')]
        ratios = [[columns[name][k] for name in names] for k in good]
        worst = [max(pair) for pair in ratios if None not in pair]
        within = sum(ratio <= 1.0 for ratio in worst)
        share = f'{within} of {len(worst)}\nratio {max(worst):.2f}' if worst else '-'
        summary[f'within {rival}'] = share
    summary['chatter'] = str(sum(bool(columns['needless_shifts'][k]) for k in good))
    return summary


def _spread(columns: Columns, cases: Sequence[int], name: str, factor: float, digits: int) -> str:
    known = [factor * columns[name][k] for k in cases if columns[name][k] is not None]
    if not known:
        return '-'
    ends = f'{min(known):.{digits}f} to {max(known):.{digits}f}'
    return f'{statistics.median(known):.{digits}f}\n{ends}'
