# SPDX-License-Identifier: Apache-2.0
"""What a recorder that is killed, or whose disk is full, leaves behind; and what it records."""

from collections.abc import Callable, Iterator
import contextlib
from itertools import pairwise
import json
import os
from pathlib import Path
import resource
import signal
import subprocess
import sys
import time
from typing import Any, NamedTuple

from fam_bundle_bringup.graph import LOOP_LISTENERS, nodes_in, own_domain, start_nodes
from fam_bundle_bringup.processes import executable
from fam_bundle_io.bag import loop_topics, read_bag, trace_of
from fam_bundle_io.recover import look
from fam_bundle_model.parameters import Configuration, write_yaml
from mcap.reader import make_reader
import numpy as np
import pytest

pytestmark = pytest.mark.alone

LOOP = ('bundle_state', 'pressure_reference', 'recruitment_state', 'valve_command')
PATIENCE = 60.0  # s; only a hang takes that long
COST = 2.0  # s of messages that a crash may cost; half a second where the machine keeps up


def wait_until(true: Callable[[], bool], what: str) -> None:
    deadline = time.monotonic() + PATIENCE
    while not true():
        assert time.monotonic() < deadline, f'waited in vain for {what}'
        time.sleep(0.02)


def size_of(bag: Path) -> int:
    return sum(path.stat().st_size for path in bag.glob('*.mcap'))


# ---- A recorder that is killed in the middle of a run ----


class Crash(NamedTuple):
    """A bag that a killed recorder left, and when it was killed (ns, system)."""

    bag: Path
    killed: int


@pytest.fixture
def crash(quick: Callable[..., Configuration], tmp_path: Path) -> Callable[..., Crash]:
    """Return what records a run in real time and kills the recorder; options are its own."""

    def record(*options: str, size: int = 1_000_000) -> Crash:
        parameters, bag = tmp_path / 'parameters.yaml', tmp_path / 'bag'
        write_yaml(quick(run={'pace': 'realtime'}, reference={'cycles': 100}), parameters)
        command = [executable('fam_bundle_io', 'bag_recorder'), '--ros-args']
        command += ['--params-file', str(parameters), '-p', f'bag.folder:={bag}']
        command += [word for option in options for word in ('-p', option)]
        with own_domain(), nodes_in(tmp_path) as group:
            recorder = group.start('bag_recorder', command)
            start_nodes(group, parameters, LOOP_LISTENERS + 1, composed=True)
            wait_until(lambda: size_of(bag) > size, 'a bag of some seconds')
            killed = time.time_ns()
            recorder.kill()
            recorder.wait()
        return Crash(bag, killed)

    return record


@pytest.fixture
def recover(tmp_path: Path) -> Callable[[Path], Path]:
    """Return what recovers a bag as the user does."""

    def run(bag: Path) -> Path:
        command = [sys.executable, '-m', 'fam_bundle_bringup.cli', 'recover', str(bag)]
        done = subprocess.run(
            command, capture_output=True, text=True, timeout=PATIENCE, check=False
        )
        assert done.returncode == 0, done.stderr
        assert 'Traceback' not in done.stderr
        assert 'messages, ticks 0 to ' in done.stdout
        return bag.with_name(f'{bag.name}_recovered')

    return run


def test_a_killed_recorder_costs_the_last_chunk_and_nothing_else(
    crash: Callable[..., Crash], recover: Callable[[Path], Path]
) -> None:
    bag, killed = crash()
    found = read_bag(bag)
    assert len(found.warnings) == 2, found.warnings
    assert 'metadata.yaml is missing' in found.warnings[0]
    assert 'bag_0.mcap: cut short' in found.warnings[1]
    ticks = found.tables['/bundle_state']['tick'].to_numpy()
    assert np.array_equal(ticks, np.arange(len(ticks)))
    assert len(ticks) > 1000
    last = max(int(table['received'].max()) for table in found.tables.values())
    assert (killed - last) * 1e-9 < COST
    assert 'parameters' in found.records['fam_bundle.provenance']
    recovered = read_bag(recover(bag))
    (warning,) = recovered.warnings
    assert warning.startswith('recovered: from bag; ')
    assert set(recovered.tables) == set(found.tables)
    for topic in LOOP:
        assert found.tables[f'/{topic}'].equals(recovered.tables[f'/{topic}']), topic
        summary = json.loads(recovered.records['fam_bundle.completeness'][f'/{topic}'])
        assert summary['lost'] == 0  # though a controller need not answer a stale sample
        assert summary['first_tick'] == 0


def test_of_several_files_a_crash_damages_only_the_last(crash: Callable[..., Crash]) -> None:
    bag, _ = crash('bag.split_duration:=0.7', size=1_500_000)
    files = sorted(bag.glob('*.mcap'), key=lambda path: int(path.stem.rpartition('_')[2]))
    assert len(files) > 2
    ends = []
    for file in files[:-1]:
        assert look(file).damage == []
        with file.open('rb') as stream:
            summary = make_reader(stream).get_summary()
        assert summary is not None
        assert summary.statistics is not None
        ends.append(summary.statistics.message_end_time)
    # A file is begun when the one before has ended, and ends with the first message behind its
    # time, however late the machine lets its first one come.
    assert all(after - before > 0.6e9 for before, after in pairwise(ends))
    assert all(files[-1].name in words for words in read_bag(bag).warnings[1:])
    ticks = read_bag(bag).tables['/bundle_state']['tick'].to_numpy()
    assert np.array_equal(ticks, np.arange(len(ticks)))


# ---- Recorders of publishers in this process ----


class Source:
    """Publishes the loop's messages of several bundles."""

    def __init__(self, node: Any, bundles: tuple[str, ...]) -> None:
        from fam_bundle_msgs.msg import (
            BundleState,
            PressureReference,
            RecruitmentState,
            ValveCommand,
        )
        from fam_bundle_node.qos import LOOP_PUBLISHER

        types = dict(
            zip(
                LOOP, (BundleState, PressureReference, RecruitmentState, ValveCommand), strict=True
            )
        )
        self.publishers = {
            f'{bundle}/{topic}': node.create_publisher(kind, f'{bundle}/{topic}', LOOP_PUBLISHER)
            for bundle in bundles
            for topic, kind in types.items()
        }
        self.types = types

    def heard(self, *topics: str) -> bool:
        return all(self.publishers[topic].get_subscription_count() for topic in topics)

    def publish(self, tick: int) -> None:
        """Publish one tick; the numbers tell the bundles apart."""
        for name, publisher in self.publishers.items():
            bundle, _, topic = name.rpartition('/')
            message = self.types[topic](tick=tick)
            message.header.stamp.nanosec = tick * 1_000_000 % 1_000_000_000
            message.header.stamp.sec = tick // 1000
            if topic == 'bundle_state':
                message.strain = float(tick + len(bundle))
                message.mu_pressure = [1.0, 2.0]
            elif topic == 'valve_command':
                message.spool = [float(len(bundle)), -0.0]
            publisher.publish(message)


@contextlib.contextmanager
def source(*bundles: str) -> Iterator[Source]:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    node = rclpy.create_node('source')
    try:
        yield Source(node, bundles)
    finally:
        node.destroy_node()
        rclpy.try_shutdown()


@contextlib.contextmanager
def recorder(*options: str) -> 'Iterator[subprocess.Popen[str]]':
    command = [executable('fam_bundle_io', 'bag_recorder'), '--ros-args']
    command += [word for option in options for word in ('-p', option)]
    process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)
    try:
        yield process
    finally:
        process.kill()
        process.communicate()


def ended(process: 'subprocess.Popen[str]', number: int = signal.SIGINT) -> str:
    """Tell a recorder to end, and return what it said."""
    process.send_signal(number)
    _, err = process.communicate(timeout=PATIENCE)
    assert 'Traceback' not in err
    return err


def test_two_bundles_in_one_bag_are_two_runs(tmp_path: Path) -> None:
    bag, ticks = tmp_path / 'bag', 300
    topics = [f'{bundle}/{topic}' for bundle in ('/left', '/right_side') for topic in LOOP]
    with (
        own_domain(),
        source('/left', '/right_side') as bundles,
        recorder(f'bag.folder:={bag}', "bag.topics:=['/left/*', '/right_side/*']") as process,
    ):
        wait_until(lambda: bundles.heard(*topics), 'the recorder')
        for tick in range(ticks):
            bundles.publish(tick)
        err = ended(process)
    assert process.returncode == 0, err
    found = read_bag(bag)
    assert found.warnings == []
    assert set(loop_topics(found)) == {'/left', '/right_side'}
    for bundle in ('/left', '/right_side'):
        run = trace_of(found, bundle)
        assert run.warnings == []
        assert np.array_equal(run.trace['strain'], np.arange(ticks) + len(bundle))
        assert np.all(run.trace['spool'][:, 0] == len(bundle))


ALL = {f'{bundle}/{topic}' for bundle in ('', '/left') for topic in LOOP}
STATES = {topic for topic in ALL if topic.endswith('_state')}


@pytest.mark.parametrize(
    ('wanted', 'recorded'),
    [
        ("['bundle_state']", {'/bundle_state'}),
        ("['/*/bundle_state']", {'/left/bundle_state'}),
        ("['*_state', '/left/valve_command']", STATES | {'/left/valve_command'}),
        ("['*']", ALL),
    ],
)
def test_only_what_was_asked_for_is_recorded(
    wanted: str, recorded: set[str], tmp_path: Path
) -> None:
    with (
        own_domain(),
        source('', '/left') as bundles,
        recorder(f'bag.folder:={tmp_path / "bag"}', f'bag.topics:={wanted}') as process,
    ):
        wait_until(lambda: bundles.heard(*recorded), 'the recorder')
        for tick in range(20):
            bundles.publish(tick)
        err = ended(process, signal.SIGTERM)
    assert process.returncode == 0, err
    found = read_bag(tmp_path / 'bag')
    assert set(found.tables) == recorded
    assert all(list(table['tick']) == list(range(20)) for table in found.tables.values())


def test_a_full_disk_ends_the_recorder_in_one_line(tmp_path: Path) -> None:
    """A limit on the size of files stands for the disk: the system refuses to write alike."""
    bag = tmp_path / 'bag'
    with (
        own_domain(),
        source('') as bundles,
        recorder(f'bag.folder:={bag}', "bag.topics:=['*']") as process,
    ):
        wait_until(lambda: bundles.heard(*bundles.publishers), 'the recorder')
        resource.prlimit(process.pid, resource.RLIMIT_FSIZE, (100_000, 100_000))
        tick = 0
        while process.poll() is None:
            bundles.publish(tick)
            tick += 1
            time.sleep(0.0005)
        _, err = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    lines = [line for line in err.splitlines() if 'recording to' not in line]
    assert len(lines) == 1, err
    assert f'{bag}: File too large after ' in lines[0]
    found = read_bag(bag)
    assert found.warnings
    ticks = found.tables['/bundle_state']['tick'].to_numpy()
    assert np.array_equal(ticks, np.arange(len(ticks)))
    assert 0 < len(ticks) < tick
