# SPDX-License-Identifier: Apache-2.0
"""Studies as they run: on processes, on Dask, killed and gone on with; and their results."""

from collections.abc import Callable, Iterator
import concurrent.futures
import contextlib
import csv
import dataclasses
import json
import os
from pathlib import Path
import signal
import subprocess
import sys
import time
from typing import Any

from fam_bundle_bringup import hindsight, study_case, study_command, study_run
from fam_bundle_bringup.cli import main
from fam_bundle_bringup.experiment import measure_tracking
from fam_bundle_bringup.hindsight import with_threshold
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.study import cases_of, read_study, Study
from fam_bundle_bringup.study_case import MEASURED, measured, Row, run_case, Setting
from fam_bundle_bringup.study_command import print_summary, run_cases
from fam_bundle_bringup.study_result import read_result, result_of, write_result
from fam_bundle_bringup.study_run import Done, Job, Journal
from fam_bundle_io.metrics import NotMeasurable, shift_times
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import pytest

SMALL = """
changes: {reference.cycles: 1, reference.frequency: 1.0}
schemes: [baseline, lag_pressure]
grid: {reference.amplitude: [0.05, 0.06, 0.09]}
rivals: [always_recruited]
"""


def written(folder: Path, text: str) -> Study:
    path = folder / 'mine.yaml'
    path.write_text(text)
    return read_study(path)


class Here(concurrent.futures.Executor):
    """Runs each call at once in this process, and counts the runs that give rows."""

    def __init__(self) -> None:
        self.performed: list[Job] = []

    def submit(self, function: Callable[..., Any], /, *words: Any) -> Any:  # type: ignore[override]
        future: concurrent.futures.Future[Any] = concurrent.futures.Future()
        if function is study_run.perform:
            self.performed.append(words[0])
        try:
            future.set_result(function(*words))
        except Exception as error:
            future.set_exception(error)
        return future


@pytest.fixture
def here(monkeypatch: pytest.MonkeyPatch) -> Here:
    """Let studies run in this process."""
    executor = Here()
    monkeypatch.setattr(study_run, 'processes', lambda workers: contextlib.nullcontext(executor))
    return executor


@pytest.fixture(scope='module')
def small(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[Study, Path]]:
    """Give the small study and the folder of its result, by two processes."""
    folder = tmp_path_factory.mktemp('study')
    study = written(folder, SMALL)
    run_cases(study, folder / 'out', workers=2)
    yield study, folder / 'out'


# ---- Rows ----


def test_rows_are_those_of_direct_runs(small: tuple[Study, Path]) -> None:
    study, out = small
    columns = read_result(out).columns
    cases = cases_of(study)
    assert columns['scheme'] == [case.scheme for case in cases]
    assert columns['status'] == ['ok'] * 4 + ['unreachable'] * 2
    for k, case in enumerate(cases[:4]):
        trace = run_offline(case.setting.believed)
        error = trace['strain_reference'] - trace['strain']
        assert columns['max_error'][k] == np.abs(error).max()
        assert columns['iae'][k] == pytest.approx(np.abs(error).sum() * 1e-3, rel=1e-12)
        assert columns['rms_error'][k] == pytest.approx(np.sqrt((error**2).mean()), rel=1e-12)
        up, down = shift_times(trace)
        assert (columns['upshifts'][k], columns['downshifts'][k]) == (len(up), len(down))
        given = (trace['source_pressure'] * trace['source_flow']).sum() * 1e-3
        assert columns['hydraulic_input'][k] == pytest.approx(given, rel=1e-9)
        share = columns['output'][k] / columns['hydraulic_input'][k]
        assert columns['efficiency'][k] == pytest.approx(share, rel=1e-12)
        # What comes in is done, given back and lost, or stored: less than a fifth here.
        spent = columns['output'][k] - columns['returned'][k] + columns['throttling_loss'][k]
        assert spent == pytest.approx(given, rel=0.2)
        assert columns['parameters_hash'][k] == case.setting.hash()


def test_what_the_rig_cannot_reach_is_kept_with_its_reason(small: tuple[Study, Path]) -> None:
    columns = read_result(small[1]).columns
    assert 'its peak strain 0.18 must be <=' in columns['reason'][4]
    assert all(columns[name][4] is None for name in MEASURED)


def test_dask_gives_the_same_rows(
    small: tuple[Study, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    from distributed import LocalCluster

    study, out = small
    with LocalCluster(
        n_workers=2, threads_per_worker=1, host='127.0.0.1', dashboard_address=None
    ) as cluster:
        assert cluster.scheduler_address.startswith('tcp://127.0.0.1:')
        found = run_cases(study, tmp_path, 1, cluster.scheduler_address)
    assert found.columns == read_result(out).columns
    assert found.provenance['rows_run_now'] == found.provenance['rows'] > 0


def test_dask_without_the_package_or_an_answer_is_refused_in_one_line(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path, out = written(tmp_path, SMALL).path, tmp_path / 'out'
    monkeypatch.setattr(study_run, 'ANSWER', 0.3)
    for address, words in {
        'tcp://127.0.0.1:9': 'does not answer (',
        'nonsense': 'does not answer (',
    }.items():
        assert main(['study', str(path), '--out', str(out), '--dask', address]) == 2
        assert f'fam study: --dask {address}: {words}' in capsys.readouterr().err
    monkeypatch.setitem(sys.modules, 'distributed', None)
    assert main(['study', str(path), '--out', str(out), '--dask', 'tcp://127.0.0.1:9']) == 2
    assert '--dask: needs the Python package distributed: pip install' in capsys.readouterr().err
    assert not list(out.glob('study.*'))


def test_diverging_case_is_a_row_and_no_end(here: Here, tmp_path: Path) -> None:
    study = written(
        tmp_path,
        'changes: {reference.cycles: 1, reference.frequency: 1.0}\n'
        'grid: {valve.spool_time_constant: [1.0e-5, 0.004]}',
    )
    columns = run_cases(study, tmp_path / 'out', workers=1).columns
    assert columns['status'] == ['diverged', 'ok']
    assert 'is not finite; the plant diverges' in columns['reason'][0]
    assert columns['iae'][0] is None and columns['iae'][1] > 0.0


def test_mistake_in_a_run_is_no_row(
    here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The journal would keep it, and the case would never be run again."""

    def mistaken(*_: Any, **__: Any) -> None:
        raise ValueError('operands could not be broadcast together')

    study, out = written(tmp_path, SMALL), tmp_path / 'out'
    with monkeypatch.context() as patched:
        patched.setattr(study_case, 'run_offline', mistaken)
        with pytest.raises(ValueError, match='broadcast'):
            run_cases(study, out, workers=1)
    assert 'diverged' not in (out / 'rows.jsonl').read_text()
    assert run_cases(study, out, workers=1).columns['status'].count('ok') == 4


def test_trace_that_is_too_short_or_not_finite_is_a_row_without_numbers(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    setting = quick('changes: {reference.cycles: 1, reference.frequency: 1.0}', tmp_path)
    trace = run_offline(setting.believed)
    short = {name: values[:1] for name, values in trace.items()}
    for spoilt, words in (
        (short, 'no ticks from'),
        ({**trace, 'force': np.full_like(trace['force'], np.nan)}, 'not finite'),
    ):
        with pytest.raises(NotMeasurable, match=words):
            measured(setting, spoilt)
        monkeypatch.setattr(study_case, 'run_offline', lambda *_, trace=spoilt, **__: trace)
        row = run_case(setting)
        assert row['status'] == 'diverged' and words in row['reason']
        assert all(row[name] is None for name in MEASURED)


def test_nothing_that_can_be_run_is_refused(here: Here, tmp_path: Path) -> None:
    study = written(
        tmp_path,
        'changes: {recruitment.upshift_threshold: 0.3, recruitment.downshift_threshold: 0.4}',
    )
    with pytest.raises(ConfigurationError, match=r'no case can be run: .*downshift_threshold'):
        run_cases(study, tmp_path / 'out', workers=1)
    assert not (tmp_path / 'out').exists()


# ---- A rig that is not what the laws believe in ----

HEAVY = """
changes: {reference.cycles: 1, reference.frequency: 0.5}
schemes: [lag]
grid: {rig.load.mass: [18.8, 20.0]}
rivals: [always_recruited]
"""


def test_a_row_of_another_rig_is_that_of_the_run_on_it(tmp_path: Path) -> None:
    found = cases_of(written(tmp_path, HEAVY))
    columns = run_cases(written(tmp_path, HEAVY), tmp_path / 'out', workers=1).columns
    assert columns['rig.load.mass'] == [18.8, 20.0]
    for k, case in enumerate(found):
        believed, actual = case.setting or (None, None)
        assert believed is not None and actual is not None
        assert (believed.load.mass, actual.load.mass) == (18.8, columns['rig.load.mass'][k])
        trace = run_offline(believed, actual=actual)
        assert columns['iae'][k] == measure_tracking(believed, trace).iae
        everyone = dataclasses.replace(
            believed, recruitment=dataclasses.replace(believed.recruitment, scheme='all')
        )
        trace = run_offline(everyone, actual=actual)
        assert columns['always_recruited.iae'][k] == measure_tracking(everyone, trace).iae


# ---- Rivals ----


def quick(study_text: str, folder: Path) -> Setting:
    (case, *_) = cases_of(written(folder, study_text))
    assert case.setting is not None
    return case.setting


def test_always_recruited_holds_all_units_at_one_pressure(tmp_path: Path) -> None:
    text = 'changes: {reference.cycles: 2, reference.frequency: 1.0}\nschemes: all'
    trace = run_offline(quick(text, tmp_path).believed)
    assert (trace['recruitment_state'] == 2).all()
    settled = trace['mu_pressure'][1000:]
    assert np.abs(settled[:, 0] - settled[:, 1]).max() < 0.03 * settled.max()


def test_best_threshold_is_the_best_of_those_that_do_not_chatter(
    here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hindsight, 'THRESHOLDS', (0.42, 0.55, 0.7))
    text = 'changes: {reference.cycles: 2, reference.frequency: 0.25}\nschemes: [lag, pressure]\n'
    believed = quick(text, tmp_path).believed
    tuned = {t: with_threshold(believed, t) for t in (0.42, 0.55, 0.7)}
    found = {t: run_case(Setting(configuration)) for t, configuration in tuned.items()}
    assert found[0.42]['needless_shifts'] > 0
    steady = {t: row for t, row in found.items() if not row['needless_shifts']}
    best = min(steady, key=lambda t: steady[t]['iae'])
    study = written(tmp_path, text + 'rivals: [best_threshold]')
    columns = run_cases(study, tmp_path / 'out', workers=1).columns
    assert columns['best_threshold.threshold'] == [best, best]
    assert columns['best_threshold.steady'] == [len(steady)] * 2
    for name in ('iae', 'max_error'):
        assert columns[f'best_threshold.{name}'] == [steady[best][name]] * 2
        ratios = [value / steady[best][name] for value in columns[name]]
        assert columns[f'best_threshold.{name}_ratio'] == ratios
    # Both schemes share one rival.
    assert [job.kind for job in here.performed].count('best_threshold') == 1


def test_where_every_threshold_chatters_there_is_no_rival(
    here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(hindsight, 'THRESHOLDS', (0.42,))
    text = 'changes: {reference.cycles: 2, reference.frequency: 0.25}\nrivals: [best_threshold]'
    columns = run_cases(written(tmp_path, text), tmp_path / 'out', workers=1).columns
    assert columns['status'] == ['ok']
    assert columns['best_threshold.reason'] == ['every threshold chatters']
    assert columns['best_threshold.iae_ratio'] == [None]


# ---- Going on ----


def test_killed_study_goes_on_and_leaves_no_process(tmp_path: Path) -> None:
    path = tmp_path / 'mine.yaml'
    path.write_text(
        'schemes: [baseline, lag]\nchanges: {reference.frequency: 0.5, reference.cycles: 8}\n'
        'sample: {number: 8, seed: 5, ranges: {reference.amplitude: [0.04, 0.06]}}'
    )
    out = tmp_path / 'out'
    command = [sys.executable, '-m', 'fam_bundle_bringup.cli', 'study', str(path)]
    command += ['--out', str(out), '--workers', '2']
    first = subprocess.Popen(command, stdout=subprocess.DEVNULL, stderr=subprocess.DEVNULL)
    journal = out / 'rows.jsonl'
    wait_for(lambda: journal.exists() and journal.read_text().count('\n') >= 3)
    workers = children_of(first.pid)
    first.send_signal(signal.SIGKILL)
    first.wait()
    assert workers
    wait_for(lambda: not any(is_running(pid) for pid in workers))
    kept = journal.read_text().splitlines()
    assert 3 <= len(kept) < 16
    assert not list(out.glob('study.*'))
    done = subprocess.run(command, capture_output=True, text=True, timeout=120, check=False)
    assert done.returncode == 0, done.stderr
    lines = journal.read_text().splitlines()
    assert lines[: len(kept) - 1] == kept[:-1]
    keys = [json.loads(line)['key'] for line in lines[:-1]]
    assert len(keys) == len(set(keys))
    provenance = read_result(out).provenance
    assert provenance['rows'] == 16
    assert 16 - len(kept) <= provenance['rows_run_now'] <= 17 - len(kept)
    assert 'IAE less than baseline' in done.stdout
    assert {f'study_{name}.png' for name in ('tradeoff', 'sensitivity')} <= {
        path.name for path in out.iterdir()
    }


def wait_for(condition: Callable[[], bool]) -> None:
    end = time.monotonic() + 60.0
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def children_of(parent: int) -> list[int]:
    listed = Path(f'/proc/{parent}/task/{parent}/children').read_text().split()
    return [int(pid) for pid in listed]


def is_running(pid: int) -> bool:
    try:
        state = Path(f'/proc/{pid}/stat').read_text().rpartition(')')[2].split()[0]
    except (FileNotFoundError, ProcessLookupError):
        return False
    return state != 'Z'


def test_interrupted_study_keeps_its_rows(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    class Interrupted(Here):
        def submit(self, function: Callable[..., Any], /, *words: Any) -> Any:
            if len(self.performed) == 3:
                raise KeyboardInterrupt
            return super().submit(function, *words)

    def use(executor: Here) -> None:
        monkeypatch.setattr(study_run, 'processes', lambda _: contextlib.nullcontext(executor))

    path, out = written(tmp_path, SMALL).path, tmp_path / 'out'
    use(Interrupted())
    assert main(['study', str(path), '--out', str(out)]) == 130
    message = capsys.readouterr().err
    assert 'of 9 rows are kept: the same command goes on from there' in message
    kept = len(Path(out / 'rows.jsonl').read_text().splitlines())
    assert not (out / 'study.parquet').exists()
    rest = Here()
    use(rest)
    run_cases(read_study(path), out, workers=1)
    assert kept > 0
    assert len(rest.performed) == 9 - kept
    again = Here()
    use(again)
    run_cases(read_study(path), out, workers=1)
    assert again.performed == []


def test_line_that_was_cut_short_is_run_again(here: Here, tmp_path: Path) -> None:
    study, out = written(tmp_path, SMALL), tmp_path / 'out'
    before = run_cases(study, out, workers=1)
    journal = out / 'rows.jsonl'
    journal.write_text(journal.read_text()[:-20])
    here.performed.clear()
    assert run_cases(study, out, workers=1).columns == before.columns
    assert len(here.performed) == 1
    assert len(journal.read_text().splitlines()) == 9 + 1


def test_rows_of_other_sources_or_parameters_are_not_used(
    here: Here, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / 'out'
    run_cases(written(tmp_path, SMALL), out, workers=1)
    here.performed.clear()
    # One more value: what was there is there.
    run_cases(written(tmp_path, SMALL.replace('0.09', '0.09, 0.055')), out, workers=1)
    assert {job.setting.believed.reference.amplitude for job in here.performed} == {0.055}
    here.performed.clear()
    # Any other parameter changes every row.
    run_cases(written(tmp_path, SMALL.replace('cycles: 1', 'cycles: 2')), out, workers=1)
    assert len(here.performed) == 9
    here.performed.clear()
    monkeypatch.setattr(study_run, 'origin', lambda: 'other sources')
    run_cases(written(tmp_path, SMALL), out, workers=1)
    assert len(here.performed) == 9


def test_worker_with_other_sources_is_refused(here: Here, tmp_path: Path) -> None:
    jobs = study_run.jobs_of(cases_of(written(tmp_path, SMALL)), (), 'other sources')
    journal = Journal(tmp_path / 'rows.jsonl')
    with pytest.raises(study_run.StudyStopped, match='other sources'):
        study_run.run_jobs(jobs, journal, here, lambda runs: None)
    assert journal.rows == {}
    journal.close()


def test_worker_that_dies_stops_the_study_in_one_line(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    path = written(tmp_path, SMALL).path
    real = study_run.Journal.add

    def add(self: Journal, key: str, done: Done) -> None:
        real(self, key, done)
        for pid in children_of(os.getpid()):
            if b'spawn_main' in Path(f'/proc/{pid}/cmdline').read_bytes():
                os.kill(pid, signal.SIGKILL)

    monkeypatch.setattr(study_run.Journal, 'add', add)
    assert main(['study', str(path), '--out', str(tmp_path / 'out'), '--workers', '1']) == 1
    assert 'fam study: workers died; the same command goes on' in capsys.readouterr().err


def test_two_studies_do_not_share_a_folder(tmp_path: Path) -> None:
    study = written(tmp_path, SMALL)
    (tmp_path / 'out').mkdir()
    with (
        contextlib.closing(Journal(tmp_path / 'out' / 'rows.jsonl')),
        pytest.raises(ConfigurationError, match='another study is running there'),
    ):
        run_cases(study, tmp_path / 'out', workers=1)


# ---- Results ----


def test_provenance_is_in_the_file_and_beside_it(small: tuple[Study, Path]) -> None:
    from fam_bundle_bringup.experiment import default_configuration
    from fam_bundle_model.parameters import load_configuration
    from pyarrow import parquet

    _, out = small
    metadata = parquet.read_schema(out / 'study.parquet').metadata
    inside = json.loads(metadata[b'fam_bundle.study'])
    assert inside == json.loads((out / 'study.json').read_text())
    assert inside['study_text'] == SMALL
    assert inside['parameters_hash'] == load_configuration(default_configuration()).hash()
    assert inside['origin'] == study_run.origin()
    assert inside['versions']['numpy'] == np.__version__
    (out.parent / 'base.yaml').write_text(inside['parameters'])
    assert load_configuration(out.parent / 'base.yaml').hash() == inside['parameters_hash']


def test_csv_holds_the_same_values(
    here: Here,
    small: tuple[Study, Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    from fam_bundle_bringup import study_result

    study, out = small
    monkeypatch.setattr(study_command, 'draw_figures', lambda *_: [])
    monkeypatch.setattr(study_result, 'can_parquet', lambda: False)
    assert main(['study', str(study.path), '--out', str(tmp_path)]) == 0
    assert 'pyarrow is missing' in capsys.readouterr().err
    whole = read_result(out).columns
    with (tmp_path / 'study.csv').open(newline='') as file:
        for k, row in enumerate(csv.DictReader(file)):
            assert list(row) == list(whole)
            for name, text in row.items():
                value = whole[name][k]
                if isinstance(value, float):
                    assert float(text) == value
                else:
                    assert text == ('' if value is None else str(value))
    assert read_result(tmp_path).columns['iae'] == whole['iae']
    assert json.loads((tmp_path / 'study.json').read_text())['study_text'] == study.text


LABELS = """
schemes: [baseline, lag]
grid:
  bundle:
    '4': {fam.count: [4], sensors.seed: 7}
    '2 2': {fam.count: [2, 2], load.mass: 17}
    'nan': {fam.count: [2, 2]}
    '1e5': {recruitment.upshift_threshold: 0.3, recruitment.downshift_threshold: 0.4}
    '': {fam.length: 0.25}
  sensors.strain_noise: [0.0, 1.0e-5]
rivals: [always_recruited]
"""


@pytest.mark.parametrize('as_csv', [True, False])
def test_result_reads_back_as_what_was_written(tmp_path: Path, as_csv: bool) -> None:
    study = written(tmp_path, LABELS)
    cases = cases_of(study)
    row: Row = {'status': 'ok', 'reason': '', **dict.fromkeys(MEASURED, 2.0)}
    row |= {'upshifts': 3, 'shortest_interval': None}
    rows = dict.fromkeys(study_run.jobs_of(cases, study.rivals, 'here'), row)
    result = result_of(study, cases, rows, 'here', {})
    assert result.columns['bundle'][::4] == ['4', '2 2', 'nan', '1e5', '']
    assert result.columns['status'].count('impossible') == 4
    write_result(result, tmp_path, as_csv)
    read = read_result(tmp_path)
    assert read == result
    for name, cells in result.columns.items():  # for 3 == 3.0
        assert list(map(type, read.columns[name])) == list(map(type, cells)), name


def test_figures_only_runs_nothing(
    small: tuple[Study, Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    study, out = small
    before = (out / 'study.parquet').read_bytes()
    (out / 'study_map_of_yesterday.png').touch()
    (out / 'mine.png').touch()
    assert main(['study', str(study.path), '--out', str(out), '--figures-only']) == 0
    assert (out / 'study.parquet').read_bytes() == before
    names = {path.stem for path in out.glob('*.png')}
    ratios = {f'study_map_always_recruited_{name}_ratio' for name in ('iae', 'max_error')}
    maps = {f'study_map_{name}' for name in ('iae', 'max_error', 'upshifts', 'efficiency')}
    assert names == {'mine', 'study_tradeoff'} | maps | ratios
    assert main(['study', str(study.path), '--out', str(tmp_path), '--figures-only']) == 2
    assert 'holds no result of a study' in capsys.readouterr().err


def test_summary_names_what_chatters_and_what_diverges(
    capsys: pytest.CaptureFixture[str],
) -> None:
    columns: dict[str, list[Any]] = {
        'case': [0, 1, 2, 3],
        'scheme': ['a', 'b', 'a', 'b'],
        'load.mass': [10.0, 10.0, 20.0, 20.0],
        'status': ['ok', 'ok', 'diverged', 'ok'],
        'reason': ['', '', 'strain: tick 7 is not finite', ''],
        'iae': [0.02, 0.01, None, 0.03],
        'max_error': [0.002, 0.003, None, 0.003],
        'efficiency': [0.2, 0.3, None, None],
        'needless_shifts': [0, 3, None, 0],
        'best_threshold.iae_ratio': [2.0, 1.0, None, 1.5],
        'best_threshold.max_error_ratio': [2.0, 0.9, None, 0.9],
    }
    provenance = {
        'study': 'mine.yaml',
        'schemes': ['a', 'b'],
        'rivals': ['best_threshold'],
        'axes': ['load.mass'],
        'sampled': [],
    }
    print_summary(columns, provenance)
    text = capsys.readouterr().out
    assert '  case 1, b, load.mass 10: 3 needless shifts' in text
    assert '  case 2, a, load.mass 20: strain: tick 7 is not finite' in text
    cells = [line.split('│')[1:-1] for line in text.splitlines() if '│' in line]
    table = {row[0].strip(): [cell.strip() for cell in row[1:]] for row in cells}
    assert table['runs'] == ['1 of 2', '2 of 2']
    assert table['IAE (s)'] == ['0.0200', '0.0200']
    assert table['IAE less than a'] == ['', '1 of 1']
    assert table['maximum error less than a'] == ['', '0 of 1']
    assert table['within best_threshold'] == ['0 of 1', '1 of 2']
    assert table['chatter'] == ['0', '1']
