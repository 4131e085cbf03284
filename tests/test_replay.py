# SPDX-License-Identifier: Apache-2.0
"""A recorded run gives the same commands again; and they, through the plant, the same run."""

from collections.abc import Callable
import json
import math
from pathlib import Path
from signal import SIGCONT, SIGSTOP
import struct
import subprocess
import time
from typing import Any

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.graph import (
    close_bag,
    LOOP_LISTENERS,
    NODES,
    nodes_in,
    own_domain,
    run_graph,
    start_bag_recorder,
)
from fam_bundle_bringup.processes import executable
from fam_bundle_bringup.replay import run_replay
from fam_bundle_bringup.replay_controllers import (
    same_bits,
    Samples,
    samples_of,
    Stamp,
    steps_of,
)
from fam_bundle_bringup.replay_plant import measured, measured_state, strain_rate
from fam_bundle_io.bag import LOOP as NAMES
from fam_bundle_io.bag import read_bag, run_tables
from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.completeness import tick_of
from fam_bundle_model.parameters import (
    Configuration,
    GRAVITY,
    load_configuration,
    PAPER_SCHEMES,
    write_yaml,
)
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_sim.plant import plant, STRAIN_RATE, truth
import numpy as np
import pytest

SHORT = {'amplitude': 0.06, 'frequency': 0.5, 'cycles': 1}  # two seconds, a shift up and down
TICKS = 2000
LOOP = ('bundle_state', 'pressure_reference', 'recruitment_state', 'valve_command')
Fam = Callable[..., 'subprocess.CompletedProcess[str]']


def configured(scheme: str = 'lag_pressure', **changes: Any) -> Configuration:
    merged = {'recruitment': {'scheme': scheme}, 'reference': SHORT, **changes}
    return load_configuration(default_configuration(), merged)


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return the bag of a short run in lock-step."""
    folder = tmp_path_factory.mktemp('short')
    run_graph(configured(), folder, record=True)
    return folder / 'bag'


def run_in(bag: Path) -> dict[str, Any]:
    """Return the rows of the run in ``bag`` by tick, for each topic of the loop."""
    return {NAMES[name]: table for name, table in run_tables(read_bag(bag))[0].items()}


def edited(
    bag: Path,
    path: Path,
    *,
    keep: Callable[[str, int], bool] = lambda topic, tick: True,
    change: Callable[[str, int, bytes], bytes] = lambda topic, tick, data: data,
    prefix: str = '',
    records: bool = True,
) -> Path:
    """Write what is in ``bag`` to a file by the ``mcap`` package, but for what is asked for."""
    from mcap.reader import make_reader
    from mcap.writer import Writer

    (source,) = bag.glob('*.mcap')
    with source.open('rb') as found, path.open('xb') as made:
        reader, writer = make_reader(found), Writer(made)
        writer.start()
        channels: dict[int, int] = {}
        for schema, channel, message in reader.iter_messages():
            topic = channel.topic.lstrip('/')
            tick = tick_of(message.data) if topic in LOOP else -1
            if not keep(topic, tick):
                continue
            if channel.id not in channels:
                number = writer.register_schema(schema.name, schema.encoding, schema.data)
                channels[channel.id] = writer.register_channel(
                    prefix + channel.topic, channel.message_encoding, number
                )
            writer.add_message(
                channels[channel.id],
                message.log_time,
                change(topic, tick, message.data),
                message.publish_time,
                message.sequence,
            )
        if records:
            for record in reader.iter_metadata():
                writer.add_metadata(record.name, record.metadata)
        writer.finish()
    return path


def parameters(folder: Path, **changes: Any) -> Path:
    path = folder / 'changed.yaml'
    write_yaml(configured(**changes), path)
    return path


class Found:
    """What a replay has written: the controllers' signals, and the plant's."""

    def __init__(self, folder: Path) -> None:
        self.all = json.loads((folder / 'replay.json').read_text())
        self.signals = {(c['topic'], c['signal']): c for c in self.all['controllers']}
        self.plant = self.all['plant']
        self.notes = '\n'.join(self.all['notes'])

    def topics(self) -> list[str]:
        return list(dict.fromkeys(topic for topic, _ in self.signals))

    def different(self) -> set[tuple[str, str]]:
        return {name for name, c in self.signals.items() if c['equal'] < c['compared']}

    def tops(self, how: str) -> dict[str, float]:
        return {name: found[how]['largest'] for name, found in self.plant.items()}


# ---- Lock-step ----


@pytest.mark.parametrize('scheme', PAPER_SCHEMES)
def test_controllers_and_plant_repeat_a_run_to_the_last_bit(
    scheme: str, recorded_run: Callable[[str], Path], tmp_path: Path
) -> None:
    bag = recorded_run(scheme) / 'bag'
    assert run_replay(bag, None, tmp_path, '')
    found = Found(tmp_path)
    assert found.topics() == ['lag_table', *LOOP[1:]]
    for (topic, _), c in found.signals.items():
        assert c['compared'] == c['equal']
        assert c['compared'] == 4000 or topic == 'lag_table'
        assert c['unknown'] == 0
    table = read_bag(bag).tables['/recruitment_state']
    assert set(table['recruited']) == {1, 2}, 'the run must contain a shift'
    assert set(found.tops('from_the_start').values()) == {0.0}
    # All of the state but the strain rate is measured; without any rate this would be ten times
    # as much.
    samples = measured(samples_of(run_in(bag)['bundle_state']))
    for name, largest in found.tops('set_anew').items():
        assert 0.0 < largest < 0.005 * np.ptp(samples[name]), name


def test_a_run_of_three_units_with_noise_leaves_the_noise_as_the_difference(
    three_units: tuple[Configuration, Path], tmp_path: Path
) -> None:
    configuration, folder = three_units
    assert run_replay(folder / 'bag', None, tmp_path, '')
    found = Found(tmp_path)
    assert set(found.plant) == {
        *('strain', 'force', 'source_pressure'),
        *(f'mu_pressure[{i}]' for i in range(3)),
    }
    for name, one in found.plant.items():
        kind = 'pressure' if 'pressure' in name else name
        noise = getattr(configuration.sensors, f'{kind}_noise')
        # Five standard errors of the RMS of as many normal samples.
        bound = 5 / math.sqrt(2 * configuration.ticks())
        assert one['from_the_start']['rms'] == pytest.approx(noise, rel=bound)


def test_a_changed_gain_is_found_where_it_begins_to_act(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    gain = 1.01 * configured().strain_loop.integral_gain
    config = parameters(tmp_path, strain_loop={'integral_gain': gain})
    assert not run_replay(bag, config, tmp_path, '')
    found = Found(tmp_path)
    assert found.different() == {
        ('pressure_reference', 'pressure'),
        ('pressure_reference', 'pressure_unlimited'),
    }
    # The integral share of an error acts one tick later.
    error = run_in(bag)['pressure_reference']['strain_error']
    first = int(np.flatnonzero(error)[0]) + 1
    words = f'not equal: pressure_reference pressure differs first at tick {first}: '
    assert words in capsys.readouterr().out
    assert f'{config}, not those in the bag' in found.all['parameters']


def test_a_gain_of_the_inner_loop_changes_the_lags_too(bag: Path, tmp_path: Path) -> None:
    gain = 1.01 * configured().pressure_loop.proportional_gain[0]
    config = parameters(tmp_path, pressure_loop={'proportional_gain': gain})
    assert not run_replay(bag, config, tmp_path, '')
    found = Found(tmp_path)
    assert 'lag_table: recorded with other parameters; it is built anew' in found.notes
    assert ('recruitment_state', 'recruitment_lag') in found.different()
    assert ('valve_command', 'spool[0]') in found.different()
    assert {topic for topic, _ in found.different()} == {'recruitment_state', 'valve_command'}


def test_commands_that_were_not_recorded_are_counted(bag: Path, tmp_path: Path) -> None:
    lacking = edited(
        bag,
        tmp_path / 'x.mcap',
        keep=lambda topic, tick: topic != 'valve_command' or tick < TICKS - 100,
    )
    assert run_replay(lacking, None, tmp_path, '')
    found = Found(tmp_path)
    assert found.signals['valve_command', 'spool[0]']['compared'] == TICKS - 100
    assert 'valve_command: the answers to 100 samples are not in the bag' in found.notes
    assert found.tops('from_the_start')['mu_pressure[0]'] > 0.0


def test_one_bit_of_one_command_is_found(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    commands = run_in(bag)['valve_command']
    was = float(commands['spool[1]'][1234])
    one, other = (struct.pack('<d', value) for value in (was, np.nextafter(was, 2.0)))

    def change(topic: str, tick: int, data: bytes) -> bytes:
        return data.replace(one, other) if (topic, tick) == ('valve_command', 1234) else data

    assert not run_replay(edited(bag, tmp_path / 'one.mcap', change=change), None, tmp_path, '')
    found = Found(tmp_path)
    assert found.different() == {('valve_command', 'spool[1]')}
    spool = found.signals['valve_command', 'spool[1]']
    assert (spool['equal'], spool['tick']) == (TICKS - 1, 1234)
    assert spool['replayed'] == was < spool['recorded']
    assert 'valve_command spool[1] differs first at tick 1234' in capsys.readouterr().out


def test_bits_are_compared_not_values() -> None:
    one, other = np.array([0.0, np.inf, np.nan, 1.0]), np.array([-0.0, np.inf, np.nan, 1.0])
    assert same_bits(one, other).tolist() == [False, True, True, True]


def test_another_load_is_the_plants_affair_alone(bag: Path, tmp_path: Path) -> None:
    mass = configured().load.mass
    config = parameters(tmp_path, load={'mass': 1.05 * mass})
    assert run_replay(bag, config, tmp_path, '')
    # The bundle carries the weight that has been added, whatever else it does.
    off = Found(tmp_path).plant['force']['from_the_start']['rms']
    assert off == pytest.approx(0.05 * mass * GRAVITY, rel=0.2)


# ---- The state that fits a measurement ----


def samples_at(times: list[float], strain: list[float]) -> Samples:
    n, pressures = len(times), np.array([3e5, 2e4])
    stamps = [Stamp(0, round(1e9 * t)) for t in times]
    level = [6e5] * n
    ticks = list(range(n))
    return Samples(
        ticks, ticks, stamps, [False] * n, strain, level, level, np.tile(pressures, (n, 1))
    )


@pytest.mark.parametrize('row', [0, 4, 11])
def test_the_strain_rate_of_a_parabola_is_exact_though_samples_were_skipped(row: int) -> None:
    times = [0.001 * k for k in (0, 1, 2, 5, 6, 7, 8, 9, 10, 12, 13, 14)]
    samples = samples_at(times, [0.01 + 0.2 * t - 3.0 * t * t for t in times])
    assert strain_rate(samples, row) == pytest.approx(0.2 - 6.0 * times[row], rel=1e-9)


@pytest.mark.parametrize('strain', [0.0, 0.05, 0.12])
def test_the_state_that_fits_a_measurement_reads_as_it_was_measured(strain: float) -> None:
    samples = samples_at([0.0, 0.001, 0.002], [strain - 1e-4, strain, strain + 1e-4])
    rig = plant(configured())
    state = measured_state(rig, samples, 1, np.array([0.3, -0.2]))
    assert state[STRAIN_RATE] == pytest.approx(0.1)
    assert state[-2:].tolist() == [0.3, -0.2]
    pressure = np.zeros(2)
    read = truth(rig, state, pressure)
    assert (read.strain, read.source_pressure) == (strain, 6e5)
    # Far above what the tables of a slack FAM interpolate.
    assert pressure == pytest.approx(samples.mu_pressure[1], abs=1.0)


# ---- Bags that lack something ----


def test_the_rest_is_compared_without_commands(bag: Path, tmp_path: Path) -> None:
    lacking = edited(bag, tmp_path / 'x.mcap', keep=lambda topic, _: topic != 'valve_command')
    assert run_replay(lacking, None, tmp_path, '')
    found = Found(tmp_path)
    assert found.topics() == ['lag_table', 'pressure_reference', 'recruitment_state']
    assert 'valve_command: not in the bag' in found.notes
    assert found.plant == {}
    assert not (tmp_path / 'replay.png').exists()


def test_the_pressure_controller_is_not_compared_without_what_it_follows(
    bag: Path, tmp_path: Path
) -> None:
    lacking = edited(bag, tmp_path / 'x.mcap', keep=lambda topic, _: topic != 'recruitment_state')
    assert run_replay(lacking, None, tmp_path, '')
    found = Found(tmp_path)
    assert found.topics() == ['lag_table', 'pressure_reference']
    assert (
        'valve_command: not compared without pressure_reference and recruitment_state'
        in found.notes
    )
    assert set(found.tops('from_the_start').values()) == {0.0}


def test_samples_alone_are_no_passed_test(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    lacking = edited(bag, tmp_path / 'x.mcap', keep=lambda topic, _: topic == 'bundle_state')
    assert not run_replay(lacking, None, None, '')
    assert 'nothing of the controllers could be judged' in capsys.readouterr().out


def test_a_bag_without_parameters_asks_for_them(bag: Path, tmp_path: Path) -> None:
    bare = edited(bag, tmp_path / 'x.mcap', records=False)
    with pytest.raises(ConfigurationError, match=r'holds no parameters: give --config FILE$'):
        run_replay(bare, None, tmp_path / 'out', '')
    assert not (tmp_path / 'out').exists()
    assert run_replay(bare, parameters(tmp_path), tmp_path, '')


def test_a_bag_that_is_cut_short_is_replayed_as_far_as_it_goes(bag: Path, tmp_path: Path) -> None:
    (source,) = bag.glob('*.mcap')
    cut = tmp_path / 'cut.mcap'
    cut.write_bytes(source.read_bytes()[: source.stat().st_size * 6 // 10])
    assert run_replay(cut, parameters(tmp_path), tmp_path, '')
    found = Found(tmp_path)
    assert 0 < found.all['samples'] < TICKS
    assert 'cut short' in found.notes
    assert set(found.tops('from_the_start').values()) == {0.0}


def test_what_a_lost_sample_leaves_open_is_not_judged(bag: Path, tmp_path: Path) -> None:
    lost = 1500
    lacking = edited(
        bag, tmp_path / 'x.mcap', keep=lambda topic, tick: (topic, tick) != ('bundle_state', lost)
    )
    assert run_replay(lacking, None, tmp_path, '')
    found = Found(tmp_path)
    for (topic, _), one in found.signals.items():
        if topic != 'lag_table':
            assert (one['compared'], one['unknown']) == (lost, TICKS - lost - 1)
    assert f'pressure_reference: at {TICKS - lost - 1} ticks the law rests on' in found.notes
    # What the plant was told is known from the command of that tick.
    assert set(found.tops('from_the_start').values()) == {0.0}


def test_what_another_recorder_may_have_lost_is_not_judged(bag: Path, tmp_path: Path) -> None:
    """The law took the sample, though its answer is not there: only our recorder knows that."""
    lost = 1500
    file = parameters(tmp_path, run={'pace': 'realtime'})
    others = edited(
        bag,
        tmp_path / 'others.mcap',
        keep=lambda topic, tick: (topic, tick) != ('recruitment_state', lost),
        records=False,
    )
    assert run_replay(others, file, tmp_path, '')
    found = Found(tmp_path)
    for (topic, _), one in found.signals.items():
        if topic == 'recruitment_state':
            assert (one['compared'], one['unknown']) == (lost, TICKS - lost - 1)
    assert 'recruitment_state, valve_command: the recorder does not vouch' in found.notes
    samples = samples_of(run_in(others)['bundle_state'])
    taken = [tick for tick in samples.tick if tick != lost]
    for sure in (True, False):
        known = steps_of(samples, taken, set(taken), configured(), sure=sure).known
        assert known == [True] * lost + [sure] * (TICKS - lost - 1)
    # However many: a node that had seen such a gap would have started again after it.
    taken = [tick for tick in samples.tick if not lost <= tick < lost + 60]
    steps = steps_of(samples, taken, set(taken), configured(), sure=False)
    assert steps.known == [True] * lost + [False] * (TICKS - lost - 60)
    assert not any(steps.anew[1:])


def test_a_bag_that_begins_within_a_run_is_no_passed_test(
    bag: Path, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    late = edited(bag, tmp_path / 'x.mcap', keep=lambda topic, tick: not 0 <= tick < 700)
    assert not run_replay(late, None, tmp_path, '')
    found = Found(tmp_path)
    assert all(c['compared'] == 0 for c in found.signals.values() if c['topic'] != 'lag_table')
    assert 'could be judged' in capsys.readouterr().out
    assert 'begins at tick 700: the plant starts from what it measured' in found.notes
    # Less the spool, which nobody measured: it follows its command within milliseconds.
    assert found.tops('from_the_start')['strain'] < 1e-4


def test_another_bundle_is_named(bag: Path, tmp_path: Path) -> None:
    left = edited(bag, tmp_path / 'x.mcap', prefix='/left')
    with pytest.raises(BagError, match=r'^/bundle_state: not in the bag; its bundles are left$'):
        run_replay(left, None, None, '')
    assert run_replay(left, None, None, 'left')


def test_parameters_of_another_bundle_are_refused(bag: Path, tmp_path: Path) -> None:
    config = parameters(tmp_path, fam={'count': [1, 1, 2]})
    with pytest.raises(ConfigurationError, match=r'fam\.count .* 3 motor units; the bag holds 2'):
        run_replay(bag, config, tmp_path / 'out', '')
    assert not (tmp_path / 'out').exists()


def test_the_figure_is_written(bag: Path, tmp_path: Path) -> None:
    assert run_replay(bag, None, tmp_path / 'out', '')
    assert sorted(path.name for path in (tmp_path / 'out').iterdir()) == [
        *('replay.json', 'replay.pdf', 'replay.png')
    ]
    assert (tmp_path / 'out' / 'replay.png').read_bytes().startswith(b'\x89PNG')


def test_the_command_ends_with_its_verdict(bag: Path, fam: Fam, tmp_path: Path) -> None:
    same = fam('replay', bag, '--out', tmp_path / 'out')
    assert same.returncode == 0, same.stderr
    verdict = 'every controller commands what was recorded, to the last bit'
    assert same.stdout.splitlines()[-2:] == [verdict, f'written to {tmp_path / "out"}']
    gain = 1.01 * configured().strain_loop.integral_gain
    config = parameters(tmp_path, strain_loop={'integral_gain': gain})
    other = fam('replay', bag, '--config', config)
    assert other.returncode == 1
    assert other.stdout.splitlines()[-1].startswith('not equal: pressure_reference pressure ')
    bare = edited(bag, tmp_path / 'x.mcap', records=False)
    refused = fam('replay', bare)
    assert refused.returncode == 2
    assert refused.stderr == f'fam replay: {bare}: holds no parameters: give --config FILE\n'
    assert refused.stdout == ''


# ---- On a clock ----


def test_a_run_in_real_time_is_repeated_through_a_safe_state(tmp_path: Path) -> None:
    """Samples are skipped, one controller is held up, and the laws start again where it was."""
    reference = {'amplitude': 0.06, 'frequency': 0.25, 'cycles': 1}
    file = tmp_path / 'parameters.yaml'
    write_yaml(configured(reference=reference, run={'pace': 'realtime'}), file)
    with own_domain(), nodes_in(tmp_path) as group:
        recorder = start_bag_recorder(group, file, tmp_path / 'bag')
        nodes = {}
        for package, name in NODES:
            command = [executable(package, name), '--ros-args', '--params-file', str(file)]
            command += ['-p', f'run.listeners:={LOOP_LISTENERS + 1}']
            nodes[name] = group.start(name, command)
        log = tmp_path / 'log' / 'plant_simulator.log'
        while ' in real time' not in log.read_text():
            assert not group.finished('plant_simulator')
            time.sleep(0.05)
        time.sleep(1.0)
        nodes['strain_controller'].send_signal(SIGSTOP)
        time.sleep(0.3)
        nodes['strain_controller'].send_signal(SIGCONT)
        while not group.finished('plant_simulator'):
            time.sleep(0.05)
        close_bag(recorder, tmp_path)
    tables = read_bag(tmp_path / 'bag').tables
    assert tables['/bundle_state']['safe'].any()
    assert run_replay(tmp_path / 'bag', None, tmp_path, '')
    found = Found(tmp_path)
    for topic in LOOP[1:]:
        compared = {c['compared'] for c in found.signals.values() if c['topic'] == topic}
        assert compared == {len(tables[f'/{topic}'])}
    assert len(tables['/pressure_reference']) < len(tables['/bundle_state'])
