# SPDX-License-Identifier: Apache-2.0
"""Parameters of running nodes: dumped and loaded, set between two ticks, and replayed."""

from collections.abc import Callable, Iterator
from pathlib import Path
import time
from typing import Any

from fam_bundle_bringup import replay
from fam_bundle_bringup.experiment import bag_of, default_configuration
from fam_bundle_bringup.graph import (
    close_bag,
    listening,
    LOOP_LISTENERS,
    nodes_in,
    own_domain,
    start_bag_recorder,
    start_nodes,
)
from fam_bundle_bringup.replay_changes import changes_of, Changing, rows_of
from fam_bundle_control.lag_table_server_node import LagTableServer
from fam_bundle_control.pressure_controller_node import PressureController
from fam_bundle_control.recruitment_supervisor_node import RecruitmentSupervisor
from fam_bundle_control.strain_controller_node import StrainController
from fam_bundle_io.bag import read_bag
from fam_bundle_io.bag_recorder_node import BagRecorder, PARAMETERS
from fam_bundle_io.hardware_bridge_node import HardwareBridge
from fam_bundle_io.report import reported_runs
from fam_bundle_model.parameters import Configuration, write_yaml
from fam_bundle_msgs.msg import BundleState
from fam_bundle_node.qos import RECORDER_SUBSCRIPTION
from fam_bundle_sim.plant_simulator_node import PlantSimulator
import pandas as pd
import pytest
from rcl_interfaces.srv import SetParametersAtomically
import rclpy
from rclpy.node import Node
from rclpy.parameter import Parameter
import yaml

KINDS = (
    LagTableServer,
    RecruitmentSupervisor,
    StrainController,
    PressureController,
    PlantSimulator,
    HardwareBridge,
)
PATIENCE = 60.0  # s; only a hang takes that long


@pytest.fixture
def alone() -> Iterator[None]:
    """Put this process into a domain of its own."""
    with own_domain():
        yield


def values_of(kind: Callable[[], Any], *arguments: str) -> tuple[Any, str, dict[str, Any]]:
    """Return configuration, full name and parameters of a node that is made with arguments."""
    rclpy.init(args=['--ros-args', *arguments])
    try:
        node = kind()
        names = [n for n in node.list_parameters([], 0).names if not n.startswith('qos')]
        values = {p.name: p.value for p in node.get_parameters(names)}
        plain = {n: list(v) if hasattr(v, 'tolist') else v for n, v in values.items()}
        name = node.get_fully_qualified_name()
        if hasattr(node, 'close'):
            node.close()
        node.destroy_node()
        return getattr(node, 'configuration', None), name, plain
    finally:
        rclpy.try_shutdown()


def dumped(name: str, values: dict[str, Any], file: Path) -> Path:
    """Write parameters in the form of `ros2 param dump`."""
    nested: dict[str, Any] = {}
    for parameter, value in values.items():
        inner = nested
        *groups, last = parameter.split('.')
        for group in groups:
            inner = inner.setdefault(group, {})
        inner[last] = value
    file.write_text(yaml.safe_dump({name: {'ros__parameters': nested}}))
    return file


@pytest.mark.parametrize('space', ['', '/left'])
@pytest.mark.parametrize('kind', KINDS, ids=lambda kind: kind.__name__)
def test_a_dump_gives_the_same_node_again(
    kind: Callable[[], Any], space: str, alone: None, tmp_path: Path
) -> None:
    volts = default_configuration().with_name('volts_calibration.yaml')
    where = ['-r', f'__ns:={space}'] if space else []
    given = ['--params-file', str(default_configuration()), '-p', f'bridge.hardware:={volts}']
    given += ['-p', 'strain_loop.tracking_time:=1'] if kind is StrainController else []
    first, name, values = values_of(kind, *given, *where)
    assert name.startswith(f'{space}/')
    assert None not in values.values(), 'a default that is in force is shown'
    file = dumped(name, values, tmp_path / 'dump.yaml')
    again, _, same = values_of(kind, '--params-file', str(file), *where)
    assert same == values
    assert again == first


def test_a_dump_of_the_recorder_gives_the_same_one_but_for_its_folder(
    alone: None, tmp_path: Path
) -> None:
    given = ['--params-file', str(default_configuration()), '-p', f'bag.folder:={tmp_path / "a"}']
    first, name, values = values_of(BagRecorder, *given)
    values['bag.folder'] = str(tmp_path / 'b')
    file = dumped(name, values, tmp_path / 'dump.yaml')
    again, _, same = values_of(BagRecorder, '--params-file', str(file))
    assert same == values
    assert again == first


def test_the_recorders_own_parameters_are_described(alone: None, tmp_path: Path) -> None:
    rclpy.init(args=['--ros-args', '-p', f'bag.folder:={tmp_path / "a"}'])
    try:
        node = BagRecorder()
        described = node.describe_parameters([f'bag.{name}' for name in PARAMETERS])
        node.destroy_node()
    finally:
        rclpy.try_shutdown()
    assert all(d.description and d.read_only for d in described)
    ranges = {d.name: [*d.integer_range, *d.floating_point_range] for d in described}
    assert {name for name, given in ranges.items() if given} == {
        'bag.split_size',
        'bag.split_duration',
    }
    assert all(given[0].from_value == 0 for given in ranges.values() if given)


def set_in(client: Node, node: str, values: dict[str, float], listen: Any) -> Any:
    service = client.create_client(SetParametersAtomically, f'{node}/set_parameters_atomically')
    parameters = [Parameter(name, value=v).to_parameter_msg() for name, v in values.items()]
    asked = service.call_async(SetParametersAtomically.Request(parameters=parameters))
    deadline = time.monotonic() + PATIENCE
    while not asked.done():
        assert time.monotonic() < deadline, f'{node} did not answer'
        listen(0.02)
    return asked.result().result


def test_a_run_with_changes_is_replayed_to_the_last_bit(
    quick: Callable[..., Configuration], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file, seen = tmp_path / 'parameters.yaml', list[int]()
    reference = {'amplitude': 0.06, 'frequency': 0.25, 'cycles': 3}
    write_yaml(quick(reference=reference), file)

    def make() -> list[Node]:
        return [Node('operator')]

    with own_domain(), listening(make) as ((client,), listen), nodes_in(tmp_path) as group:
        recorder = start_bag_recorder(group, file, tmp_path / 'bag')
        owner = start_nodes(group, file, LOOP_LISTENERS + 2)
        deadline = time.monotonic() + PATIENCE
        while len([n for n in client.get_node_names() if n != 'operator']) < 6:
            assert time.monotonic() < deadline
            listen(0.05)
        client.create_subscription(  # the plant waits for it
            BundleState, 'bundle_state', lambda m: seen.append(m.tick), RECORDER_SUBSCRIPTION
        )
        while not seen:
            assert not group.finished(owner)
            listen(0.02)
        changes = (
            ('strain_controller', {'strain_loop.proportional_gain': 3e7}),
            ('strain_controller', {'strain_loop.integral_gain': 2e7}),
            ('recruitment_supervisor', {'recruitment.reserve': 2e4}),
        )
        for node, values in changes:
            answer = set_in(client, node, values, listen)
            assert answer.successful, answer.reason
        bad = {'strain_loop.tracking_time': 1.0, 'strain_loop.integral_gain': -1.0}
        refused = set_in(client, 'strain_controller', bad, listen)
        assert not refused.successful
        assert refused.reason == 'strain_loop.integral_gain = -1.0 Pa/s: must be >= 0'
        while not group.finished(owner):
            listen(0.05)
        close_bag(recorder, tmp_path)
    bag = read_bag(tmp_path / 'bag')
    assert bag_of(tmp_path / 'bag')['missing'] == []
    found = bag.tables['/parameter_changes']
    rows = rows_of(found)  # two that come between the same samples act, and are said, together
    said = {(row['node'], name) for row in rows for name in row['names']}
    assert said == {(node, name) for node, values in changes for name in values}
    assert found['tick'].between(1, 11_998).all(), 'in mid-run'
    assert replay.run_replay(tmp_path / 'bag', None, None)
    (reported,), _ = reported_runs(tmp_path / 'bag', 'changed')
    assert any(f'{len(rows)} changes of' in words for words in reported.numbers['warnings'])
    whole = replay.changes_of
    for node in {node for node, _ in changes}:

        def without(*given: Any, node: str = node) -> Any:
            known, notes = whole(*given)
            return {name: found for name, found in known.items() if name != node}, notes

        monkeypatch.setattr(replay, 'changes_of', without)
        assert not replay.run_replay(tmp_path / 'bag', None, None), f'{node} made no difference'


def test_changes_hold_in_the_order_in_which_they_were_made(
    quick: Callable[..., Configuration],
) -> None:
    """Each is valid after those before it only, and two nodes do not mix."""
    rows = [
        ('recruitment_supervisor', 100, 'recruitment.downshift_threshold', 0.1),
        ('strain_controller', 150, 'strain_loop.proportional_gain', 3e7),
        ('recruitment_supervisor', 200, 'recruitment.upshift_threshold', 0.3),
    ]
    columns = ('published', 'node', 'tick', 'names[0]', 'values[0]')
    table = pd.DataFrame([(1000, *row) for row in rows], columns=columns)
    found, notes = changes_of(table, 0, quick())
    assert len(notes) == len(rows)
    at = Changing(quick(), found['recruitment_supervisor'])
    thresholds = []
    for tick in (99, 100, 199, 250):
        at.at(tick)
        given = at.now.recruitment
        thresholds.append((given.downshift_threshold, given.upshift_threshold))
    assert thresholds == [(0.4, 0.8), (0.1, 0.8), (0.1, 0.8), (0.1, 0.3)]
    damaged = changes_of(table.assign(**{'values[0]': -1.0}), 0, quick())
    assert damaged[0] == {}
    assert 'damaged' in damaged[1][0]
