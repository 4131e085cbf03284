# SPDX-License-Identifier: Apache-2.0
"""The demo and the benchmark write what they promise, on a short reference."""

from collections.abc import Callable
import json
from pathlib import Path
import shutil
from typing import Any

from fam_bundle_bringup import bench, demo, hindsight
from fam_bundle_bringup.experiment import Result, run_experiment
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.report_files import write_report
from fam_bundle_io.shapes import paper_claims
from fam_bundle_io.trace import load_trace, Trace
from fam_bundle_model.parameters import Configuration, load_configuration, PAPER_SCHEMES
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import pytest

FIGURES = {
    'figure_06_response',
    'figure_07_prediction',
    'figure_10_source',
    'figure_11_baseline',
    'figure_12_lag',
    'figure_13_lag_pressure',
    'figure_14_comparison',
    'force_surface',
    'lag_table',
}

PROMISED = (
    'offline_real_time_factor',
    'lockstep_ticks_per_second',
    'lag_table_seconds',
    'first_tick_seconds',
    'lockstep_vs_default_executor',
    'lockstep_latency_vs_floor',
    'composed_ticks_per_second',
    'realtime_arrived_share',
    'realtime_in_time_share',
    'machine_in_time_share',
    'recording_cost_share',
    'cost_per_motor_unit_us',
)


def test_demo_writes_all_its_results(
    quick: Callable[..., Configuration],
    recorded_run: Callable[[str], Path],
    tmp_path: Path,
    capfd: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """What it asks of the graph is what other tests have run already, and is taken from them."""

    def known(
        configuration: Configuration, pace: str, folder: Path, *progress: Any, record: bool = False
    ) -> Result:
        if pace == 'offline':
            return run_experiment(configuration, pace, folder)
        scheme = configuration.recruitment.scheme
        assert (configuration, pace, record) == (quick(scheme), 'lockstep', True)
        shutil.copytree(recorded_run(scheme), folder)
        metrics = json.loads((folder / 'metrics.json').read_text())
        return Result(load_trace(folder / 'trace.npz'), metrics)

    monkeypatch.setattr(demo, 'run_experiment', known)
    monkeypatch.setattr(hindsight, 'THRESHOLDS', (0.4, 0.6, 0.7))
    demo.run_demo(quick(allocation={'policy': 'force'}), tmp_path)
    table = json.loads((tmp_path / 'table2.json').read_text())
    assert set(table) == set(demo.PAPER)
    for scheme in PAPER_SCHEMES:
        metrics = json.loads((tmp_path / scheme / 'metrics.json').read_text())
        assert metrics['scheme'] == scheme
        if scheme in table:
            assert table[scheme] == {k: metrics[k] for k in ('iae', 'max_error')}
    rival = json.loads((tmp_path / 'baseline_hindsight' / 'metrics.json').read_text())
    assert rival['upshift_threshold'] in (0.6, 0.7)
    for baseline in ('baseline', 'baseline_hindsight'):  # the paper's, whatever is configured
        parameters = load_configuration(tmp_path / baseline / 'parameters.yaml')
        assert parameters.allocation.policy == 'batch'
    for name in FIGURES:
        assert (tmp_path / f'{name}.png').read_bytes().startswith(b'\x89PNG')
        assert (tmp_path / f'{name}.pdf').read_bytes().startswith(b'%PDF')
    bags = [tmp_path / scheme / 'bag' for scheme in table]
    write_report(bags, tmp_path / 'report')
    report = json.loads((tmp_path / 'report' / 'report.json').read_text())['runs']
    for scheme, values in table.items():  # to the last digit
        assert {name: report[scheme][name] for name in values} == values
    printed = capfd.readouterr().out
    for scheme in demo.PAPER:
        assert f'{table[scheme]["iae"]:.4f}' in printed
        assert f'{demo.PAPER[scheme].iae:.4f}' in printed


def test_another_scheme_keeps_all_else(quick: Callable[..., Configuration]) -> None:
    mine = quick(allocation={'policy': 'orderly', 'feedforward': 0.5})
    for policy in ('batch', 'force'):
        changed = demo.with_scheme(mine, 'lag', allocation=policy)
        assert changed == quick('lag', allocation={'policy': policy, 'feedforward': 0.5})


def test_a_demo_takes_only_its_own_bag_away(tmp_path: Path) -> None:
    bag = tmp_path / 'bag'
    demo.remove_bag(bag)
    bag.mkdir()
    (bag / 'bag_0.mcap').touch()  # of a demo that was killed
    demo.remove_bag(bag)
    assert not bag.exists()
    bag.mkdir()
    (bag / 'thesis.tex').touch()
    with pytest.raises(ConfigurationError, match='holds more than the bag of a demo'):
        demo.remove_bag(bag)
    assert (bag / 'thesis.tex').exists()


@pytest.mark.alone
def test_bench_measures_every_candidate(
    quick: Callable[..., Configuration], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name, value in {
        'TICKS': 200,
        'TURNS': 1,
        'SLOW_TICKS': 200,
        'SOCKET_TICKS': 1000,
        'BUNDLE_TICKS': 200,
        'COMPOSED_BUNDLE_TICKS': 200,
        'REAL_TIME': 1.0,
        'SHORT_REAL_TIME': 0.5,
        'UNITS': (2, 3),
        'BUNDLES': (2,),
    }.items():
        monkeypatch.setattr(bench, name, value)
    bench.run_bench(quick(), tmp_path, 1)
    content = json.loads((tmp_path / 'bench.json').read_text())
    assert set(PROMISED) <= set(content['values'])
    for name, values in content['values'].items():
        assert content[name] == values[0]
        assert content['spread'][name] == [values[0], values[0]]
        if name.endswith(('_per_second', '_us')) and 'cost' not in name:
            assert values[0] > 0.0, name
        if name.endswith(('in_time_share', 'arrived_share')):
            assert 0.0 <= values[0] <= 1.0, name
    assert (tmp_path / 'bench.png').read_bytes().startswith(b'\x89PNG')


@pytest.fixture(scope='module')
def traces(request: pytest.FixtureRequest) -> tuple[Configuration, dict[str, Trace]]:
    from fam_bundle_bringup.experiment import default_configuration

    configuration = load_configuration(default_configuration())
    found = {}
    for scheme in PAPER_SCHEMES:
        changes = {'recruitment': {'scheme': scheme}}
        found[scheme] = run_offline(load_configuration(default_configuration(), changes))
    return configuration, found


def holds(configuration: Configuration, traces: dict[str, Trace]) -> dict[str, bool]:
    return {claim.statement: claim.holds for claim in paper_claims(configuration, traces)}


def test_claims_follow_the_traces(traces: tuple[Configuration, dict[str, Trace]]) -> None:
    """Each claim below is turned round by changing just what it speaks of."""
    configuration, found = traces
    before = holds(configuration, found)
    assert len(before) == 15
    reference = found['baseline']['strain_reference']
    baseline = {**found['baseline'], 'strain': reference + 0.002}
    lag = {**found['lag'], 'strain': reference + 0.05}
    changed = {**found, 'baseline': baseline, 'lag': lag}
    after = holds(configuration, changed)
    for statement, expected in (
        ('this results in overshoot', True),
        ('the strain lags further behind right after the upshift', False),
        ('the lag after the shift is significantly reduced', False),
        ('right after the shift: baseline worst, then lag, then both', False),
    ):
        assert before[statement] is not expected, statement
        assert after[statement] is expected, statement


def test_nothing_holds_where_nothing_shifts(
    traces: tuple[Configuration, dict[str, Trace]],
) -> None:
    configuration, found = traces
    still = np.ones_like(found['lag']['recruitment_state'])
    changed = {**found, 'lag': {**found['lag'], 'recruitment_state': still}}
    assert set(holds(configuration, changed).values()) == {False}
