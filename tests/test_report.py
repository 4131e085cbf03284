# SPDX-License-Identifier: Apache-2.0
"""The report tells what the runs were, also of bags that are cut short or miss topics."""

from collections.abc import Callable
import csv
import json
import math
from pathlib import Path
import subprocess
from typing import Any

from fam_bundle_io.bag import read_bag, trace_of
from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.metrics import shift_times
from fam_bundle_io.report import names_of, reported_runs
from fam_bundle_io.report_files import write_report
from fam_bundle_io.report_page import extremes
from fam_bundle_io.timing import applied_spool, phases, timing
from fam_bundle_io.trace import load_trace
from fam_bundle_model.parameters import Configuration
import numpy as np
import pytest

Make = Callable[..., Configuration]
Fam = Callable[..., 'subprocess.CompletedProcess[str]']


@pytest.fixture(scope='module')
def runs(recorded_runs: Path) -> Path:
    return recorded_runs


@pytest.fixture(scope='module')
def report(runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('report')
    found, troubles = write_report([runs / 'baseline/bag', runs / 'lag_pressure/bag'], folder)
    assert troubles == []
    assert [run.name for run in found] == ['baseline', 'lag_pressure']
    return folder


def numbers(report: Path) -> dict[str, Any]:
    return dict(json.loads((report / 'report.json').read_text())['runs'])


def test_the_report_has_the_numbers_of_the_runs(runs: Path, report: Path) -> None:
    for scheme, found in numbers(report).items():
        metrics = json.loads((runs / scheme / 'metrics.json').read_text())
        for name in (
            'scheme',
            'iae',
            'max_error',
            'ticks',
            'upshift_times',
            'downshift_times',
            'metrics_from',
            'metrics_to',
            'parameters_hash',
            'pace',
        ):
            assert found[name] == metrics[name], name
        assert found['warnings'] == []
        assert found['whole_run']['iae'] == found['cycles'][0]['iae'] == metrics['iae']


def test_every_tick_is_in_the_table(runs: Path, report: Path) -> None:
    trace = load_trace(runs / 'lag_pressure' / 'trace.npz')
    table = np.genfromtxt(report / 'run_lag_pressure.csv', delimiter=',', names=True)
    for name, values in trace.items():
        if values.ndim == 1:
            assert np.array_equal(table[name], values), name
        else:
            for unit in range(values.shape[1]):
                assert np.array_equal(table[f'{name}_{unit + 1}'], values[:, unit]), name


def test_every_cycle_is_a_row(report: Path) -> None:
    with (report / 'cycles.csv').open() as file:
        rows = list(csv.DictReader(file))
    assert [row['run'] for row in rows] == ['baseline', 'lag_pressure']
    for row in rows:
        found = numbers(report)[row['run']]
        assert float(row['iae']) == found['iae']
        assert int(row['upshifts']) == len(found['upshift_times'])
        assert float(row['energy_supply_loss_2']) == found['energy']['supply_loss'][1]
        in_state = found['energy_in_state']
        assert set(in_state) == set(found['time_in_state']) == {'1', '2'}
        assert float(row['energy_in_state_2_output']) == in_state['2']['output']


def test_all_figures_are_there(report: Path) -> None:
    for name in ('run_baseline', 'run_lag_pressure', 'comparison', 'energy', 'timing'):
        assert (report / f'{name}.png').read_bytes().startswith(b'\x89PNG')
        assert (report / f'{name}.pdf').read_bytes().startswith(b'%PDF')


def test_answers_come_after_their_samples_and_before_the_next(runs: Path) -> None:
    """In lock-step the valve command of each tick lies between two samples."""
    bag = read_bag(runs / 'baseline' / 'bag')
    run = trace_of(bag)
    assert np.array_equal(applied_spool(bag, run), run.trace['spool'])
    found = timing(bag, run)
    assert found.safe == []
    assert found.doubts == []
    command, interval = found.answers['valve_command'], found.interval
    assert len(command) == found.samples == len(interval) + 1
    assert (command > 0.0).all()
    assert (command[:-1] < interval).all()
    assert (found.answers['pressure_reference'] < command).all()
    assert {node['node'] for node in found.nodes} >= {'/plant_simulator', '/pressure_controller'}


# ---- Bags that lack something ----


def copied(
    bag: Path,
    folder: Path,
    keep: Callable[[str, int], bool],
    *,
    records: bool = True,
    ticks: int | None = None,
    shift: Callable[[int], int] = lambda number: 0,
) -> Path:
    """
    Copy the messages for which ``keep(topic, number)`` with the mcap package itself.

    At most ``ticks`` of each topic, each of its times moved by ``shift(number)`` ns.
    """
    taken: dict[str, int] = {}
    from mcap.reader import make_reader
    from mcap.writer import Writer

    folder.mkdir(parents=True)
    path = next(bag.glob('*.mcap'))
    with path.open('rb') as source, (folder / 'copy_0.mcap').open('wb') as target:
        reader, writer = make_reader(source), Writer(target)
        writer.start(profile='ros2')
        channels: dict[str, int] = {}
        for number, (schema, channel, message) in enumerate(reader.iter_messages()):
            taken[channel.topic] = taken.get(channel.topic, 0) + 1
            enough = ticks is not None and taken[channel.topic] > ticks
            if enough or not keep(channel.topic, number):
                continue
            if channel.topic not in channels:
                written = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.topic] = writer.register_channel(
                    channel.topic, channel.message_encoding, written
                )
            moved = shift(number)
            writer.add_message(
                channels[channel.topic],
                message.log_time + moved,
                message.data,
                message.publish_time + moved,
            )
        if records:
            for record in reader.iter_metadata():
                writer.add_metadata(record.name, record.metadata)
        writer.finish()
    return folder


LACKING = {
    '/pressure_reference': ('iae', None),
    '/recruitment_state': ('upshift_times', None),
    '/valve_command': ('energy', None),
}


@pytest.mark.parametrize('topic', LACKING)
def test_a_missing_topic_is_said_and_the_rest_is_told(
    runs: Path, tmp_path: Path, topic: str
) -> None:
    bag = copied(runs / 'baseline/bag', tmp_path / 'less', lambda name, _: name != topic)
    write_report([bag], tmp_path / 'report')
    (found,) = numbers(tmp_path / 'report').values()
    lacking, value = LACKING[topic]
    assert found[lacking] == value
    assert f'{topic}: not in the bag' in found['warnings']
    whole = json.loads((runs / 'baseline' / 'metrics.json').read_text())
    for name in {'iae', 'upshift_times'} - {lacking}:
        assert found[name] == whole[name]
    assert topic in (tmp_path / 'report' / 'report.html').read_text()


def test_without_samples_there_is_no_report(runs: Path, tmp_path: Path) -> None:
    bag = copied(runs / 'baseline/bag', tmp_path / 'less', lambda name, _: 'state' not in name)
    with pytest.raises(BagError, match='bundle_state: not in the bag'):
        write_report([bag], tmp_path / 'report')
    assert not (tmp_path / 'report').exists()


def test_a_run_that_is_cut_short_is_said_to_be(runs: Path, tmp_path: Path) -> None:
    bag = copied(runs / 'baseline/bag', tmp_path / 'short', lambda _, number: number < 8000)
    write_report([bag], tmp_path / 'report')
    (found,) = numbers(tmp_path / 'report').values()
    assert found['iae'] is None
    assert found['cycles'] == []
    assert any('of 4 s' in warning for warning in found['warnings'])
    assert found['whole_run']['iae'] > 0.0
    assert math.isclose(found['stop'], found['ticks'] * 1e-3)


def test_a_bag_without_parameters_takes_cycles_from_the_reference(
    runs: Path, tmp_path: Path, quick: Make
) -> None:
    bag = copied(runs / 'baseline/bag', tmp_path / 'bare', lambda *_: True, records=False)
    write_report([bag], tmp_path / 'report')
    (found,) = numbers(tmp_path / 'report').values()
    whole = json.loads((runs / 'baseline' / 'metrics.json').read_text())
    assert found['scheme'] is found['energy'] is None
    assert any('--config' in warning for warning in found['warnings'])
    assert math.isclose(found['iae'], whole['iae'], rel_tol=1e-12)
    write_report([bag], tmp_path / 'again', quick('baseline'))
    (given,) = numbers(tmp_path / 'again').values()
    assert given['iae'] == whole['iae']
    assert given['energy']['hydraulic_input'] > 0.0


def test_given_parameters_take_the_place_of_those_in_the_bag(
    runs: Path, tmp_path: Path, quick: Make
) -> None:
    other = quick('baseline', load={'mass': 20.0})
    write_report([runs / 'baseline/bag'], tmp_path / 'report', other)
    (found,) = numbers(tmp_path / 'report').values()
    assert found['parameters_hash'] == other.hash()
    assert any('those of --config' in warning for warning in found['warnings'])
    write_report([runs / 'baseline/bag'], tmp_path / 'same', quick('baseline'))
    (same,) = numbers(tmp_path / 'same').values()
    assert not any('--config' in warning for warning in same['warnings'])


def test_a_new_report_takes_the_place_of_an_earlier_one(runs: Path, tmp_path: Path) -> None:
    bags = [runs / scheme / 'bag' for scheme in ('baseline', 'lag_pressure')]
    write_report(bags, tmp_path)
    (tmp_path / 'run_mine.csv').touch()
    write_report(bags[:1], tmp_path)
    assert (tmp_path / 'run_baseline.png').exists()
    assert not list(tmp_path.glob('run_lag_pressure.*'))
    assert (tmp_path / 'run_mine.csv').exists()


def altered(bag: Path, folder: Path, change: Callable[[str, Any], None]) -> Path:
    """Write the messages anew by rosbags, each after ``change(topic, message)``."""
    from rosbags.rosbag2 import Reader, StoragePlugin, Writer
    from rosbags.typesys import get_types_from_msg, get_typestore, Stores

    types = get_typestore(Stores.EMPTY)
    with (
        Reader(bag) as reader,
        Writer(folder, version=9, storage_plugin=StoragePlugin.MCAP) as writer,
    ):
        channels = {}
        for known in reader.connections:
            if known.topic not in LOOP_TOPICS:
                continue
            types.register(get_types_from_msg(known.msgdef.data, known.msgtype))
            channels[known.id] = writer.add_connection(known.topic, known.msgtype, typestore=types)
        for known, received, data in reader.messages(
            connections=[c for c in reader.connections if c.id in channels]
        ):
            message = types.deserialize_cdr(data, known.msgtype)
            change(known.topic, message)
            written = types.serialize_cdr(message, known.msgtype)
            writer.write(channels[known.id], received, bytes(written))
    return folder


LOOP_TOPICS = (
    '/bundle_state',
    '/pressure_reference',
    '/recruitment_state',
    '/valve_command',
)


def reported(bag: Path, configuration: Configuration) -> dict[str, Any]:
    runs, _ = reported_runs(bag, 'x', configuration)
    return runs[0].numbers


def test_a_sample_that_is_no_number_is_said_and_gives_no_number(
    runs: Path, tmp_path: Path, quick: Make
) -> None:
    def change(topic: str, message: Any) -> None:
        if topic == '/bundle_state' and message.tick == 2100:
            message.strain = math.nan

    found = reported(altered(runs / 'baseline/bag', tmp_path / 'bag', change), quick('baseline'))
    assert any(w.startswith('strain: not finite at 1 tick') for w in found['warnings'])
    assert found['iae'] is found['energy'] is None
    assert found['upshift_times']


def test_all_of_the_safe_state_is_told_also_where_nobody_answered(
    runs: Path, tmp_path: Path, quick: Make
) -> None:
    def change(topic: str, message: Any) -> None:
        if topic == '/bundle_state':
            message.safe = 1515 <= message.tick < 1805
        elif 1500 <= message.tick < 1800:
            message.tick += 100_000  # of a sample that is not in the bag

    found = reported(altered(runs / 'baseline/bag', tmp_path / 'bag', change), quick('baseline'))
    assert found['safe'] == {'time': pytest.approx(0.290), 'phases': 1}
    assert any('for 0.290 s in 1 phase' in warning for warning in found['warnings'])


def test_stamps_that_jump_or_stand_still_are_said(runs: Path, tmp_path: Path, quick: Make) -> None:
    def jump(topic: str, message: Any) -> None:
        if message.tick >= 3000:
            message.header.stamp.sec = 1_000_000

    found = reported(altered(runs / 'baseline/bag', tmp_path / 'jump', jump), quick('baseline'))
    assert any(warning.startswith('nothing for 9999') for warning in found['warnings'])

    def stand(topic: str, message: Any) -> None:
        message.header.stamp.sec = message.header.stamp.nanosec = 0

    runs_found, warnings = reported_runs(
        altered(runs / 'baseline/bag', tmp_path / 'stand', stand), 'x', quick('baseline')
    )
    assert runs_found == []
    assert any('stamps do not rise' in warning for warning in warnings)


def test_a_bag_of_one_tick_does_not_end_the_report_of_others(runs: Path, tmp_path: Path) -> None:
    one = copied(runs / 'baseline/bag', tmp_path / 'one', lambda *_: True, ticks=1)
    found, troubles = write_report([runs / 'baseline/bag', one], tmp_path / 'report')
    assert [run.name for run in found] == ['baseline']
    assert 'one tick is no run' in troubles[0]


def test_a_clock_that_was_set_back_is_said_and_changes_no_loss(
    runs: Path, tmp_path: Path, quick: Make
) -> None:
    back = copied(
        runs / 'baseline/bag',
        tmp_path / 'back',
        lambda *_: True,
        shift=lambda number: -10_000_000_000 if number > 8000 else 0,
    )
    found = reported(back, quick('baseline'))
    whole = reported(runs / 'baseline/bag', quick('baseline'))
    assert found['energy'] == whole['energy']
    assert any('clock was set back' in warning for warning in found['warnings'])


def test_a_trace_that_begins_late_has_no_shift_at_its_beginning(runs: Path) -> None:
    trace = trace_of(read_bag(runs / 'baseline/bag')).trace
    up, down = shift_times(trace)
    between = trace['time'] > 0.5 * (up[0] + down[0])
    late = {name: values[between] for name, values in trace.items()}
    assert shift_times(late) == ([], down)


def test_parameters_of_another_bundle_are_not_used(
    runs: Path, tmp_path: Path, quick: Make
) -> None:
    bag = copied(runs / 'baseline/bag', tmp_path / 'bare', lambda *_: True, records=False)
    three = quick('baseline', fam={'count': [2, 2, 2]})
    write_report([bag], tmp_path / 'report', three)
    (found,) = numbers(tmp_path / 'report').values()
    assert found['energy'] is None
    assert any('of 3 motor units, the bag of 2' in warning for warning in found['warnings'])


# ---- The command ----


def test_the_command_reports_and_says_where(runs: Path, tmp_path: Path, fam: Fam) -> None:
    done = fam('report', runs / 'baseline/bag', runs / 'nothing', '--out', tmp_path / 'report')
    assert done.returncode == 1
    assert f'{runs / "nothing"}: no such bag' in done.stderr
    assert 'Traceback' not in done.stderr
    assert 'IAE' in done.stdout
    assert (tmp_path / 'report' / 'report.html').exists()


def test_the_command_refuses_in_one_line(runs: Path, tmp_path: Path, fam: Fam) -> None:
    bag = runs / 'baseline/bag'
    for words, arguments in {
        'no such bag': (tmp_path / 'nothing',),
        'named twice': (bag, bag),
        'cannot be read': (bag, '--config', tmp_path / 'no.yaml'),
        '/: ': (Path('/'),),
    }.items():
        done = fam('report', *arguments, '--out', tmp_path / 'report')
        assert done.returncode == 2
        assert words in done.stderr.splitlines()[-1]
        assert 'Traceback' not in done.stderr
        assert not (tmp_path / 'report').exists()


def test_an_output_that_cannot_be_is_refused_before_anything_is_read(
    runs: Path, tmp_path: Path, fam: Fam
) -> None:
    (tmp_path / 'file').touch()
    done = fam('report', runs / 'baseline/bag', '--out', tmp_path / 'file')
    assert done.returncode == 2
    assert done.stderr == f'fam report: --out {tmp_path / "file"}: cannot be written\n'


def test_names_tell_bags_apart(tmp_path: Path) -> None:
    paths = [tmp_path / name for name in ('a/x/bag', 'b/x/bag', 'b/y.mcap')]
    assert names_of(paths) == ['a/x', 'b/x', 'b/y.mcap']
    assert names_of([tmp_path / 'runs/one/bag', tmp_path / 'two']) == ['one', 'two']


def test_phases_are_told_by_their_ends() -> None:
    assert phases(np.array([True, False, True, True])) == [(0, 0), (2, 3)]
    assert phases(np.array([False, False])) == []


def test_extremes_keep_every_peak() -> None:
    values = np.zeros(100_000)
    values[31_415] = 1.0
    values[92_653] = -1.0
    chosen = extremes(values, 1000)
    assert len(chosen) <= 1000
    assert {31_415, 92_653} <= set(chosen.tolist())
    assert (np.diff(chosen) > 0).all()
    assert len(extremes(values[:500], 1000)) == 500
