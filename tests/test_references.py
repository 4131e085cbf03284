# SPDX-License-Identifier: Apache-2.0
"""References that are no sine, through the whole loop offline: window, figures, files."""

from collections.abc import Callable
import json
from pathlib import Path

from fam_bundle_bringup.cli import main
from fam_bundle_bringup.expectation import expectation
from fam_bundle_bringup.experiment import (
    check_feasible,
    default_configuration,
    last_cycle,
    measure_tracking,
)
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.figures import comparison_figure, prediction_figure, run_figure
from fam_bundle_io.metrics import ticks_in, whole_cycles, Window
from fam_bundle_io.trace import load_trace, Trace
from fam_bundle_model.bundle import check_reachable, motor_units
from fam_bundle_model.parameters import (
    Configuration,
    CYCLIC,
    KINDS,
    load_configuration,
    PREDICTORS,
)
from fam_bundle_model.reference import reference_law, strain_reference
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import pytest

CURVE = {'times': [0.0, 1.0, 2.5, 4.0], 'strains': [0.0, 0.02, 0.12, 0.03]}
Run = Callable[[str], tuple[Configuration, Trace]]


@pytest.fixture(scope='module')
def run() -> Run:
    """Return a function that gives a short offline run that tracks a kind of reference."""
    known: dict[str, tuple[Configuration, Trace]] = {}

    def make(kind: str) -> tuple[Configuration, Trace]:
        if kind not in known:
            reference = {'kind': kind, 'frequency': 0.25, 'cycles': 2, 'strain_rate': 0.2, **CURVE}
            changes = {'reference': reference, 'recruitment': {'scheme': 'lag_pressure'}}
            configuration = load_configuration(default_configuration(), changes)
            check_reachable(configuration, motor_units(configuration))
            known[kind] = configuration, run_offline(configuration)
        return known[kind]

    return make


@pytest.mark.parametrize('kind', KINDS)
def test_loop_is_given_the_law_and_follows_it(kind: str, run: Run) -> None:
    configuration, trace = run(kind)
    law = reference_law(configuration.reference)
    wanted = [strain_reference(law, float(t)) for t in trace['time']]
    assert trace['strain_reference'].tolist() == wanted
    assert len(wanted) == configuration.ticks() == (4000 if kind == 'samples' else 8000)
    mean = np.abs(trace['strain_reference'] - trace['strain']).mean()
    assert mean < 0.1 * max(trace['strain_reference'].max(), 0.01)


@pytest.mark.parametrize('kind', KINDS)
def test_metrics_are_over_the_last_cycle_or_over_the_whole_run(kind: str, run: Run) -> None:
    configuration, trace = run(kind)
    end = configuration.duration()
    start, stop = last_cycle(configuration)
    assert (start, stop) == (4.0 if kind in CYCLIC else 0.0, end)
    assert whole_cycles(trace, configuration)[-1] == (start, stop)
    assert len(whole_cycles(trace, configuration)) == (2 if kind in CYCLIC else 1)
    inside = ticks_in(trace, Window(start, stop))
    error = np.abs(trace['strain_reference'] - trace['strain'])[inside]
    found = measure_tracking(configuration, trace)
    assert found.iae == pytest.approx(error.sum() * configuration.simulation.period, rel=1e-6)
    assert found.max_error == error.max()


def test_a_run_that_does_not_repeat_has_no_whole_cycle_when_it_is_cut_short(run: Run) -> None:
    configuration, trace = run('random')
    cut = {name: values[:-100] for name, values in trace.items()}
    assert whole_cycles(cut, configuration) == []


@pytest.mark.parametrize('kind', ['ramp', 'random', 'samples'])
def test_every_figure_of_a_run_can_be_drawn(kind: str, run: Run) -> None:
    configuration, trace = run(kind)
    for figure in (
        run_figure(trace, kind),
        prediction_figure(trace, configuration, expectation(configuration, trace)),
        comparison_figure({'one': trace, 'two': trace}),
    ):
        figure.draw_without_rendering()
        assert figure.axes


@pytest.mark.parametrize('predictor', PREDICTORS)
def test_the_expected_trajectory_of_a_run_is_that_of_its_predictor(predictor: str) -> None:
    """What was expected for a tick is what was measured there less the predictor's error."""
    changes = {
        'reference': {'kind': 'chirp', 'frequency': 0.5, 'final_frequency': 1.0, 'cycles': 1},
        'recruitment': {'scheme': 'lag', 'predictor': predictor},
        'sensors': {'strain_noise': 1e-5},
    }
    configuration = load_configuration(default_configuration(), changes)
    trace, horizon = run_offline(configuration), configuration.recruitment.prediction_horizon
    expected = expectation(configuration, trace)
    for tick in (400, 900):
        then = tick + round(horizon / configuration.simulation.period)
        wanted = trace['strain'][then] - trace['prediction_error'][then]
        assert expected(tick, np.array([horizon])) == pytest.approx([wanted], abs=1e-12)


def test_a_live_reference_is_refused_where_nothing_runs_that_could_send_it() -> None:
    configuration = load_configuration(default_configuration(), {'reference': {'kind': 'topic'}})
    check_feasible(configuration, offline=False)
    with pytest.raises(ConfigurationError, match='kind = topic: a run offline has no topics'):
        check_feasible(configuration)


# ---- On the command line ----


def experiment(out: Path, *options: str) -> int:
    return main(['experiment', '--pace', 'offline', '--out', str(out), *options])


def test_a_file_is_run_and_stands_in_the_parameters(tmp_path: Path) -> None:
    file = tmp_path / 'curve.csv'
    file.write_text('time,strain\n0,0.01\n1,0.02\n2.5,0.12\n4,0.03\n')
    assert experiment(tmp_path / 'one', '--reference', str(file)) == 0
    file.unlink()
    again = ('--config', str(tmp_path / 'one' / 'parameters.yaml'))
    assert experiment(tmp_path / 'two', *again) == 0
    one, two = (load_trace(tmp_path / name / 'trace.npz') for name in ('one', 'two'))
    assert all(one[name].tobytes() == two[name].tobytes() for name in one)
    reference = one['strain_reference']
    assert reference[[0, 1000, 2500]] == pytest.approx([0.01, 0.02, 0.12])
    assert abs(one['strain'][0] - 0.01) < 1e-6, 'the run begins where the file does'
    metrics = json.loads((tmp_path / 'one' / 'metrics.json').read_text())
    assert (metrics['metrics_from'], metrics['metrics_to']) == (0.0, 4.0)


@pytest.mark.parametrize(
    ('rows', 'message'),
    [
        ('0,0\n1,0.4\n', 'curve.csv: row 3: strain = 0.4: must be >= -0.1 and <= 0.3'),
        ('0,0\n1,0.2\n', 'reference.strains: its peak strain 0.2 must be <= 0.1505, what all'),
        ('0,0\n1,-0.05\n2,0\n', 'reference.strains: its lowest strain -0.05 must be >= -0.0'),
        ('0,0.13\n1,0.1\n', 'simulation.initial_strain = 0.13: must be <= 0.1168, what the first'),
    ],
)
def test_a_bad_file_is_refused_and_nothing_is_written(
    rows: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    file = tmp_path / 'curve.csv'
    file.write_text(f'time,strain\n{rows}')
    assert experiment(tmp_path / 'out', '--reference', str(file)) == 2
    said = capsys.readouterr().err
    assert said.count('\n') == 1
    assert message in said
    assert not (tmp_path / 'out').exists()


@pytest.mark.parametrize(
    ('kind', 'message'),
    [
        ('samples', 'reference.times: 1 samples; must be >= 2 and <= 10000'),
        ('topic', 'reference.kind = topic: a run offline has no topics'),
        ('none.csv', 'none.csv: cannot be read (No such file or directory)'),
    ],
)
def test_a_kind_that_cannot_be_run_is_refused(
    kind: str, message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert experiment(tmp_path / 'out', '--reference', kind) == 2
    assert capsys.readouterr().err == f'fam experiment: {message}\n'
