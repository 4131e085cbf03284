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

"""The paper's experiment under every scheme: Table 2, its figures, and how alike they are."""

from collections.abc import Mapping
import dataclasses
import importlib.util
from pathlib import Path
import shutil
from typing import TYPE_CHECKING

from fam_bundle_bringup.expectation import expectation
from fam_bundle_bringup.experiment import last_cycle, Result, run_experiment
from fam_bundle_bringup.hindsight import best_threshold, Rival, THRESHOLDS, with_threshold
from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.progress import progress_bar
from fam_bundle_io.metrics import slice_of, Tracking, Window
from fam_bundle_io.shapes import Claim, paper_claims
from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration, PAPER_SCHEMES
from fam_bundle_model.schema import ConfigurationError

if TYPE_CHECKING:
    from matplotlib.figure import Figure

PAPER = {
    'baseline': Tracking(0.0454, 0.0223),
    'lag': Tracking(0.0234, 0.0075),
    'lag_pressure': Tracking(0.0211, 0.0064),
}


def run_demo(configuration: Configuration, folder: Path) -> None:
    """
    Run every scheme through the graph, print Table 2 and write all results to ``folder``.

    Raises RunFailed when a run ends early.
    """
    for name in ('table2.json', 'shapes.json'):  # no numbers of an earlier call beside new ones
        (folder / name).unlink(missing_ok=True)
    results: dict[str, Result] = {}
    record = importlib.util.find_spec('mcap') is not None
    for scheme in PAPER_SCHEMES:
        one = with_scheme(configuration, scheme)
        with progress_bar(f'{scheme}, through the graph', one.ticks()) as progress:
            remove_bag(folder / scheme / 'bag')
            results[scheme] = run_experiment(
                one, 'lockstep', folder / scheme, progress, record=record
            )
    tracked = {scheme: _tracking(result) for scheme, result in results.items()}
    table = {scheme: tracked[scheme]._asdict() for scheme in PAPER}
    write_json(table, folder / 'table2.json')
    with progress_bar('threshold by hindsight, offline', len(THRESHOLDS)) as progress:
        rival = best_threshold(with_scheme(configuration, 'baseline'), progress)
    if rival is not None:
        tuned = with_threshold(with_scheme(configuration, 'baseline'), rival.threshold)
        run_experiment(tuned, 'offline', folder / 'baseline_hindsight')
    beyond = {
        name: run_experiment(one, 'offline', folder / name)
        for name, one in {
            'all': with_scheme(configuration, 'all'),
            'force': with_scheme(configuration, 'lag_pressure', allocation='force'),
        }.items()
    }
    traces = {scheme: result.trace for scheme, result in results.items()}
    claims = paper_claims(configuration, traces)
    write_json([claim._asdict() for claim in claims], folder / 'shapes.json')
    with progress_bar('figures', 1):
        figures = draw_figures(configuration, traces | {'force': beyond['force'].trace}, folder)
    print_table(tracked, rival, {name: _tracking(result) for name, result in beyond.items()})
    print_claims(claims)
    print(f'{len(figures)} figures and all results in {folder}')
    if record:
        print(f'explore the runs: ./fam report {folder}/*/bag --out {folder / "report"}')
    else:
        print('no bags were kept, for the Python package mcap is missing')


def with_scheme(
    configuration: Configuration, scheme: str, *, allocation: str = 'batch'
) -> Configuration:
    """Return ``configuration`` with another scheme and allocation."""
    return dataclasses.replace(
        configuration,
        recruitment=dataclasses.replace(configuration.recruitment, scheme=scheme),
        allocation=dataclasses.replace(configuration.allocation, policy=allocation),
    )


def remove_bag(bag: Path) -> None:
    """
    Remove the bag of an earlier demo, if there is one, whole or not.

    Raises ConfigurationError where there is anything else in its place.
    """
    if not bag.exists() and not bag.is_symlink():
        return
    if bag.is_symlink() or not bag.is_dir() or any(not is_of_a_bag(p) for p in bag.iterdir()):
        raise ConfigurationError(f'{bag}: holds more than the bag of a demo: name another --out')
    shutil.rmtree(bag)


def is_of_a_bag(path: Path) -> bool:
    """Return whether a recorder may have made ``path``."""
    return path.suffix == '.mcap' or path.stem == 'metadata'


def _tracking(result: Result) -> Tracking:
    return Tracking(result.metrics['iae'], result.metrics['max_error'])


def draw_figures(
    configuration: Configuration, traces: Mapping[str, Trace], folder: Path
) -> list[Path]:
    """Write the figures after the paper's, as PNG and PDF, and return their paths."""
    from fam_bundle_io import figures
    from fam_bundle_model.lag_table import cached_lag_table

    threshold = configuration.recruitment.upshift_threshold
    titles = {
        'baseline': f'Baseline, threshold {threshold:.0%}',
        'lag': 'Lag compensation',
        'pressure': f'Pressure compensation, threshold {threshold:.0%}',
        'lag_pressure': 'Lag and pressure compensation',
        'force': 'Ours: allocation by force',
    }
    window = Window(*last_cycle(configuration))
    windows = {name: slice_of(trace, window) for name, trace in traces.items()}

    def run_figure(name: str) -> 'Figure':
        return figures.run_figure(traces[name], titles[name], windows[name])

    drawn = {
        'figure_06_response': figures.response_figure(configuration),
        'figure_07_prediction': figures.prediction_figure(
            traces['lag'], configuration, expectation(configuration, traces['lag'])
        ),
        'figure_10_source': figures.source_figure(configuration, traces),
        'figure_11_baseline': run_figure('baseline'),
        'figure_12_lag': run_figure('lag'),
        'figure_13_lag_pressure': run_figure('lag_pressure'),
        'figure_14_comparison': figures.comparison_figure(
            {name: traces[name] for name in PAPER}, windows
        ),
        'figure_force': run_figure('force'),
        'force_surface': figures.surface_figure(configuration),
        'lag_table': figures.lag_table_figure(cached_lag_table(configuration)),
    }
    return figures.save_figures(drawn, folder)


def print_table(
    tracked: Mapping[str, Tracking], rival: Rival | None, beyond: Mapping[str, Tracking]
) -> None:
    """Print the paper's Table 2 beside ours, the rivals, and what is beyond the paper."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title='Table 2: strain IAE (s) and maximum strain error over the settled cycle')
    table.add_column('scheme')
    for heading in ('IAE', 'paper', 'off by', 'maximum', 'paper', 'off by'):
        table.add_column(heading, justify='right')
    for scheme, found in tracked.items():
        table.add_row(scheme, *_cells(found, PAPER.get(scheme)))
    table.add_section()
    if rival is not None:
        name = f'baseline at {rival.threshold:.0%}, by hindsight'
        table.add_row(name, *_cells(rival.tracking, None))
    table.add_row('all units, always', *_cells(beyond['all'], None))
    table.add_section()
    table.add_row('ours: lag_pressure, by force', *_cells(beyond['force'], None))
    console = Console()
    console.print(table)
    ours = _reductions(tracked)
    paper = _reductions(PAPER)
    console.print(
        f'lag_pressure against baseline: IAE {ours.iae:+.0%} (paper {paper.iae:+.0%}), '
        f'maximum {ours.max_error:+.0%} (paper {paper.max_error:+.0%}).'
    )
    if rival is None:
        console.print('No fixed threshold tracks this reference without chatter.')
    else:
        console.print(
            f'The threshold of {rival.threshold:.0%} is the best for this very reference, found '
            f'by trying {THRESHOLDS[0]:.0%} to {THRESHOLDS[-1]:.0%}; '
            'it has to be known in advance.'
        )
    console.print(
        'Ours feeds forward what the model knows, and the model is the plant here: a rig will '
        'show less (docs/recruitment.md, Allocation).'
    )


def _cells(found: Tracking, paper: Tracking | None) -> list[str]:
    if paper is None:
        return [f'{found.iae:.4f}', '-', '', f'{found.max_error:.4f}', '-', '']
    return [
        f'{found.iae:.4f}',
        f'{paper.iae:.4f}',
        f'{found.iae / paper.iae - 1.0:+.1%}',
        f'{found.max_error:.4f}',
        f'{paper.max_error:.4f}',
        f'{found.max_error / paper.max_error - 1.0:+.1%}',
    ]


def _reductions(tracked: Mapping[str, Tracking]) -> Tracking:
    best, base = tracked['lag_pressure'], tracked['baseline']
    return Tracking(best.iae / base.iae - 1.0, best.max_error / base.max_error - 1.0)


def print_claims(claims: list[Claim]) -> None:
    """Print what the paper says of its figures, and whether it holds here."""
    from rich.console import Console
    from rich.table import Table

    table = Table(title="What the paper's text says of its figures")
    for heading in ('figure', 'statement', 'here', 'measured'):
        table.add_column(heading)
    for claim in claims:
        table.add_row(
            claim.figure, claim.statement, 'holds' if claim.holds else 'does not', claim.measured
        )
    Console().print(table)
