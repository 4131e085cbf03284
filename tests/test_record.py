# SPDX-License-Identifier: Apache-2.0
"""A run through the graph is recorded whole, and its bag gives the same trace."""

from collections.abc import Callable, Iterator
import json
import os
from pathlib import Path
import signal
import subprocess
import time

from fam_bundle_bringup.cli import recorded_lines
from fam_bundle_bringup.graph import own_domain
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.processes import executable
from fam_bundle_io.bag import read_bag, trace_of
from fam_bundle_io.bag_recorder_node import BagRecorder
from fam_bundle_io.trace import load_trace
from fam_bundle_model.parameters import Configuration
import pytest
import rclpy
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.qos import DurabilityPolicy, QoSProfile, ReliabilityPolicy
from rclpy.signals import SignalHandlerOptions
from std_msgs.msg import UInt64

LOOP = ('/bundle_state', '/pressure_reference', '/recruitment_state', '/valve_command')


def test_a_recorded_run_gives_its_trace_to_the_last_bit(
    quick: Callable[..., Configuration], recorded_run: Callable[[str], Path]
) -> None:
    configuration = quick('lag_pressure')
    folder = recorded_run('lag_pressure')
    trace, bag = load_trace(folder / 'trace.npz'), read_bag(folder / 'bag')
    assert bag.warnings == []
    run = trace_of(bag)
    assert run.warnings == []
    offline = run_offline(configuration)  # without the graph, the recorder and the bag
    assert set(run.trace) == set(trace) == set(offline)
    for name, values in offline.items():
        assert run.trace[name].tobytes() == trace[name].tobytes() == values.tobytes(), name
    completeness = bag.records['fam_bundle.completeness']
    assert json.loads(completeness['whole']) is True
    assert json.loads(completeness['unanswered']) == []
    for topic in LOOP:
        summary = json.loads(completeness[topic])
        assert summary['count'] == configuration.ticks()
        assert (summary['first_tick'], summary['runs']) == (0, 1)
        assert summary['last_tick'] == configuration.ticks() - 1
        assert summary['lost'] == summary['missing_ticks'] == 0
    provenance = bag.records['fam_bundle.provenance']
    assert provenance['parameters_hash'] == configuration.hash()
    assert provenance['scheme'] == configuration.recruitment.scheme


def recorder(*options: str) -> subprocess.Popen[str]:
    command = [executable('fam_bundle_io', 'bag_recorder'), '--ros-args']
    command += [word for option in options for word in ('-p', option)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        ((), "bag.folder = '': must name a folder"),
        (('bag.folder:=/proc/no/bag',), '/proc/no/bag: '),
        (('bag.folder:=X', 'bag.split_size:=-1'), 'bag.split_size = -1: must be >= 0'),
        (('bag.folder:=X', 'bag.split_size:=1.5'), 'bag.split_size = 1.5: must be a whole'),
        (('bag.folder:=X', 'bag.split_duration:=-2'), 'bag.split_duration = -2: must be >= 0'),
        (('bag.folder:=X', 'bag.split_duration:=.nan'), 'bag.split_duration = nan: must be'),
        (('bag.folder:=X', 'bag.split_duration:=much'), 'bag.split_duration = much: must be'),
        (('bag.folder:=X', 'bag.topics:=[]'), 'bag.topics = []: must name at least one topic'),
        (('bag.folder:=X', 'bag.topics:=talk'), 'bag.topics = talk: must'),
        (('bag.folder:=7',), 'bag.folder = 7: must be text'),
    ],
)
def test_the_recorder_refuses_in_one_line(
    options: tuple[str, ...], words: str, tmp_path: Path
) -> None:
    folder = tmp_path / 'bag'
    with own_domain():
        process = recorder(*(option.replace('=X', f'={folder}') for option in options))
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert err.startswith(f'bag_recorder: {words}')
    assert err.count('\n') == 1
    assert err.count('bag.split_duration') <= 1
    assert not folder.exists()


def test_a_recorder_of_nothing_ends_well_when_told(tmp_path: Path) -> None:
    with own_domain():
        process = recorder(f'bag.folder:={tmp_path / "bag"}', 'bag.split_duration:=60')
        while not (tmp_path / 'bag').exists():
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert 'Traceback' not in err
    assert 'bag_recorder: no message was recorded\n' in err
    assert (tmp_path / 'bag' / 'metadata.yaml').exists()


def test_a_run_is_said_to_be_whole_though_samples_were_not_answered() -> None:
    bag = {'messages': 9, 'missing': [], 'unanswered': {}, 'cpu_share': 0.1, 'peak_memory': 9e7}
    cost = f'{"":16}recorder: 0.10 of a core, 90 MB'
    assert recorded_lines(bag) == ['  recorded      9 messages, whole;', cost]
    bag['unanswered'] = {'/pressure_reference': 12, '/recruitment_state': 0, '/valve_command': 3}
    words = 'samples not answered: 12 of pressure_reference, 3 of valve_command;'
    assert recorded_lines(bag)[1:] == [f'{"":16}{words}', cost]
    bag['missing'] = [f'/x{number}: gone' for number in range(5)]
    words = '/x0: gone; /x1: gone; /x2: gone; and 2 more, see metadata.yaml;'
    assert recorded_lines(bag)[0] == f'  recorded      9 messages, {words}'


# ---- Publishers of several qualities ----


@pytest.fixture
def source() -> Iterator[Node]:
    with own_domain():
        rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('source')
        yield node
        node.destroy_node()
        rclpy.try_shutdown()


@pytest.mark.parametrize(
    'second',
    [
        QoSProfile(depth=10, reliability=ReliabilityPolicy.BEST_EFFORT),
        QoSProfile(depth=10),
    ],
)
def test_a_publisher_of_lower_quality_that_comes_later_is_recorded_too(
    second: QoSProfile, source: Node, tmp_path: Path
) -> None:
    first = QoSProfile(depth=100, durability=DurabilityPolicy.TRANSIENT_LOCAL)
    one = source.create_publisher(UInt64, '/talk', first)
    one.publish(UInt64(data=0))
    bag = f'{tmp_path / "bag"}'
    recorder = BagRecorder(parameter_overrides=[Parameter('bag.folder', value=bag)])
    executor = SingleThreadedExecutor()
    executor.add_node(recorder)

    def listen(until: Callable[[], bool]) -> None:
        end = time.monotonic() + 20.0
        while not until():
            assert time.monotonic() < end
            executor.spin_once(timeout_sec=0.01)
            recorder.take_all()

    def recorded() -> int:
        return int(recorder.summaries().get('/talk', {}).get('count', 0))

    listen(lambda: recorded() == 1)
    other = source.create_publisher(UInt64, '/talk', second)
    sent = 1
    end = time.monotonic() + 20.0
    while other.get_subscription_count() == 0:
        assert time.monotonic() < end
        one.publish(UInt64(data=sent))  # while the recorder subscribes anew
        sent += 1
        executor.spin_once(timeout_sec=0.01)
        recorder.take_all()
    for number in range(5):
        one.publish(UInt64(data=sent + number))
        other.publish(UInt64(data=1000 + number))
    sent += 5
    listen(lambda: recorded() == sent + 5)
    for _ in range(20):  # so that what comes twice is there
        executor.spin_once(timeout_sec=0.01)
        recorder.take_all()
    executor.shutdown()
    assert recorder.close() == []
    recorder.destroy_node()
    found = read_bag(tmp_path / 'bag').tables['/talk']['data'].tolist()
    assert sorted(found) == [*range(sent), *range(1000, 1005)]
