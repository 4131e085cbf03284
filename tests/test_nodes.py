# SPDX-License-Identifier: Apache-2.0
"""Single nodes as a user starts them: parameters, services, refusal of bad data."""

from collections.abc import Callable, Iterator
import dataclasses
import math
from pathlib import Path
import subprocess
import time
from typing import Any

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.graph import NODES, own_domain
from fam_bundle_bringup.processes import executable
from fam_bundle_model.lag_table import build_lag_table, lag_table_hash, look_up
from fam_bundle_model.parameters import GROUPS, load_configuration
from fam_bundle_model.schema import declarations
from fam_bundle_msgs.msg import BundleState, LagTable, PressureReference
from fam_bundle_msgs.srv import GetLagTable, QueryLag, RebuildLagTable
from fam_bundle_node.lag_table_message import from_message, to_message
from fam_bundle_node.qos import LATCHED, LOOP_PUBLISHER, LOOP_SUBSCRIPTION
import numpy as np
import pytest
from rcl_interfaces.srv import DescribeParameters, ListParameters
import rclpy
from rclpy.node import Node

PATIENCE = 60.0  # s; only a hang takes that long
CONFIGURATION = default_configuration()
LIVE = {
    'strain_controller': ('strain_loop',),
    'recruitment_supervisor': ('recruitment',),
}


@pytest.fixture
def client() -> Iterator[Node]:
    """Return a node of this process in a domain of its own."""
    with own_domain():
        rclpy.init(args=[])
        try:
            yield Node('client')
        finally:
            rclpy.try_shutdown()


@pytest.fixture
def start(tmp_path: Path) -> Iterator[Callable[..., 'subprocess.Popen[str]']]:
    """Return a function that starts one node with the paper's configuration."""
    running: list[subprocess.Popen[str]] = []

    def run(package: str, name: str, *arguments: str) -> 'subprocess.Popen[str]':
        command = [executable(package, name), '--ros-args', '--params-file', str(CONFIGURATION)]
        process = subprocess.Popen([*command, *arguments], stderr=subprocess.PIPE, text=True)
        running.append(process)
        return process

    yield run
    for process in running:
        process.kill()
        process.wait()


def spin(client: Node, done: Callable[[], bool]) -> None:
    deadline = time.monotonic() + PATIENCE
    while not done():
        assert time.monotonic() < deadline, 'nothing came'
        rclpy.spin_once(client, timeout_sec=0.1)


def call(client: Node, service_type: type, name: str, request: Any) -> Any:
    service = client.create_client(service_type, name)
    assert service.wait_for_service(PATIENCE)
    future = service.call_async(request)
    spin(client, future.done)
    return future.result()


def test_lag_table_survives_its_message_to_the_bit() -> None:
    table = build_lag_table(load_configuration(CONFIGURATION))
    again = from_message(to_message(table, 'hash'))
    for name, value in table._asdict().items():
        assert getattr(again, name).tobytes() == value.tobytes()
        assert getattr(again, name).shape == value.shape


def test_lag_table_server(client: Node, start: Callable[..., Any]) -> None:
    configuration = load_configuration(CONFIGURATION)
    table = build_lag_table(configuration)
    start('fam_bundle_control', 'lag_table_server')
    latched: list[LagTable] = []
    client.create_subscription(LagTable, 'lag_table', latched.append, LATCHED)

    request = QueryLag.Request(motor_unit=1, source_pressure=6.1e5, deslack_pressure=2.2e5)
    answer = call(client, QueryLag, 'lag_table_server/query_lag', request)
    expected = look_up(table, 1, 6.1e5, 2.2e5)
    assert answer.success
    assert answer.recruitment_lag == expected.lag > 0.0
    assert answer.source_pressure_drop == expected.drop > 0.0

    request = QueryLag.Request(motor_unit=2, source_pressure=6.1e5, deslack_pressure=2.2e5)
    answer = call(client, QueryLag, 'lag_table_server/query_lag', request)
    assert not answer.success
    assert 'motor_unit = 2: must be < 2' in answer.message

    got = call(client, GetLagTable, 'lag_table_server/get_lag_table', GetLagTable.Request())
    assert got.table.parameters_hash == lag_table_hash(configuration)
    assert from_message(got.table).lag.tobytes() == table.lag.tobytes()

    spin(client, lambda: len(latched) == 1)
    request = RebuildLagTable.Request(source_points=1, deslack_points=9)
    refused = call(client, RebuildLagTable, 'lag_table_server/rebuild_lag_table', request)
    assert not refused.success
    assert 'lag_table.source_points = 1: must be >= 2' in refused.message

    request = RebuildLagTable.Request(source_points=7, deslack_points=9)
    rebuilt = call(client, RebuildLagTable, 'lag_table_server/rebuild_lag_table', request)
    assert rebuilt.success, rebuilt.message
    spin(client, lambda: len(latched) == 2)
    assert from_message(latched[1]).lag.shape == (2, 7, 9)
    grid = dataclasses.replace(configuration.lag_table, source_points=7, deslack_points=9)
    finer = build_lag_table(dataclasses.replace(configuration, lag_table=grid))
    assert from_message(latched[1]).lag.tobytes() == finer.lag.tobytes()


@pytest.mark.parametrize(('package', 'name'), NODES)
def test_parameters_are_described_from_the_schema(
    package: str, name: str, client: Node, start: Callable[..., Any]
) -> None:
    start(package, name)
    listed = call(client, ListParameters, f'{name}/list_parameters', ListParameters.Request())
    ours = [n for n in listed.result.names if n.split('.')[0] in GROUPS]
    assert ours
    request = DescribeParameters.Request(names=ours)
    described = call(client, DescribeParameters, f'{name}/describe_parameters', request)
    for parameter, descriptor in zip(ours, described.descriptors, strict=True):
        group, field = parameter.split('.')
        declaration = declarations(GROUPS[group])[field]
        assert declaration.text in descriptor.description
        assert descriptor.additional_constraints == declaration.bound()
        live = declaration.live and group in LIVE.get(name, ())
        assert descriptor.read_only == (not live)
        ranges = [*descriptor.floating_point_range, *descriptor.integer_range]
        bounded = math.isfinite(declaration.minimum) or math.isfinite(declaration.maximum)
        assert len(ranges) == (bounded and not declaration.array)
        assert all(r.from_value <= declaration.maximum for r in ranges)


@pytest.mark.parametrize(('package', 'name'), NODES)
def test_bad_parameter_is_refused_in_one_line(
    package: str, name: str, start: Callable[..., Any]
) -> None:
    bad = {
        'plant_simulator': 'load.mass:=-18.8',
        'lag_table_server': 'hose.radius:=-0.003',
        'recruitment_supervisor': 'recruitment.scheme:=lagg',
        'strain_controller': 'strain_loop.tracking_time:=0.0',
        'pressure_controller': 'pressure_loop.integral_limit:=1.5',
    }[name]
    process = start(package, name, '-p', bad)
    _, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert stderr.count('\n') == 1, stderr
    parameter, value = bad.split(':=')
    assert f'{parameter} = {value}' in stderr
    assert 'must be' in stderr


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('-p', 'strain_loop.tracking_tim:=0.1'), ('tracking_tim', 'strain_loop.tracking_time')),
        (('--params-file', '/does/not/exist.yaml'), ('/does/not/exist.yaml',)),
    ],
)
def test_node_refuses_what_it_does_not_know(
    arguments: tuple[str, ...], words: tuple[str, ...], start: Callable[..., Any]
) -> None:
    process = start('fam_bundle_control', 'strain_controller', *arguments)
    _, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == 2
    assert 'Traceback' not in stderr
    assert all(word in stderr.splitlines()[-1] for word in words), stderr


def test_controller_answers_and_refuses_bad_data(client: Node, start: Callable[..., Any]) -> None:
    process = start('fam_bundle_control', 'strain_controller')
    answers: list[PressureReference] = []
    client.create_subscription(
        PressureReference, 'pressure_reference', answers.append, LOOP_SUBSCRIPTION
    )
    publisher = client.create_publisher(BundleState, 'bundle_state', LOOP_PUBLISHER)
    state = BundleState(tick=5, source_pressure=6e5, mu_pressure=[2e5, 0.0])
    publisher.publish(state)
    spin(client, lambda: len(answers) == 1)
    assert answers[0].tick == 5
    assert answers[0].pressure == pytest.approx(2e5), 'the loop starts without a bump'
    state.tick, state.strain = 6, float('nan')
    state.header.stamp.nanosec = 1_000_000
    publisher.publish(state)
    _, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert 'bundle_state: tick 6 holds nan' in stderr
    assert np.isfinite([a.pressure for a in answers]).all()


def test_supervisor_refuses_a_table_of_other_parameters(
    client: Node, start: Callable[..., Any]
) -> None:
    table = build_lag_table(load_configuration(CONFIGURATION))
    publisher = client.create_publisher(LagTable, 'lag_table', LATCHED)
    publisher.publish(to_message(table, 'of another rig'))
    process = start('fam_bundle_control', 'recruitment_supervisor')
    _, stderr = process.communicate(timeout=PATIENCE)
    assert process.returncode == 1
    assert 'lag_table: built from parameters of another' in stderr
