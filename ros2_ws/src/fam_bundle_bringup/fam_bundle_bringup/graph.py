# SPDX-License-Identifier: Apache-2.0
"""The loop as a graph: five nodes, each its own process, over Fast DDS in lock-step."""

import contextlib
import os
import time
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import TYPE_CHECKING

from fam_bundle_bringup.failure import RunFailed
from fam_bundle_bringup.processes import NodeDied, NodeGroup, executable
from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration, write_yaml

if TYPE_CHECKING:
    from fam_bundle_io.trace_recorder_node import TraceRecorder

NODES = (
    ('fam_bundle_control', 'lag_table_server'),
    ('fam_bundle_control', 'recruitment_supervisor'),
    ('fam_bundle_control', 'strain_controller'),
    ('fam_bundle_control', 'pressure_controller'),
    ('fam_bundle_sim', 'plant_simulator'),
)
LOOP_LISTENERS = 3  # strain controller, supervisor, pressure controller
SLICE = 0.05  # s of listening between two looks at the processes
DRAIN_TIMEOUT = 10.0  # s for the last messages after the plant has ended


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a DDS domain that no other run on this machine uses, and stay on the machine."""
    from domain_coordinator import domain_id

    # Entered by hand: as a context it would swallow an OSError of the run.
    reservation = domain_id()
    number = reservation.__enter__()
    os.environ['ROS_DOMAIN_ID'] = str(number)
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'LOCALHOST'
    try:
        yield int(number)
    finally:
        reservation.__exit__(None, None, None)


def start_nodes(group: NodeGroup, parameter_file: Path, listeners: int) -> None:
    """Start the five nodes with one parameter file."""
    for package, name in NODES:
        command = [executable(package, name), '--ros-args', '--params-file', str(parameter_file)]
        if name == 'plant_simulator':
            command += ['-p', f'run.listeners:={listeners}']
        group.start(name, command)


def run_graph(
    configuration: Configuration,
    folder: Path,
    progress: Callable[[int], None] | None = None,
) -> Trace:
    """Run ``configuration`` through the graph and return its trace.

    The nodes' parameter file and what they print go to ``folder``. ``progress`` is called with
    the ticks done so far. Raises RunFailed when a node ends early or messages stay missing.
    """
    parameter_file = folder / 'parameters.yaml'
    write_yaml(configuration, parameter_file)
    units, ticks = len(configuration.fam.count), configuration.ticks()
    failure = None
    with own_domain(), recording() as (recorder, listen):
        with nodes_in(folder) as group:
            start_nodes(group, parameter_file, LOOP_LISTENERS + 1)
            try:
                while not group.finished('plant_simulator'):
                    listen(SLICE)
                    if progress is not None:
                        progress(recorder.ticks())
                drained = time.monotonic() + DRAIN_TIMEOUT
                while recorder.complete_ticks() < ticks and time.monotonic() < drained:
                    listen(SLICE)
            except NodeDied as error:
                failure = str(error)
        trace = recorder.trace(units)
    recorded = len(trace['time'])
    if failure is None and recorded < ticks:
        failure = f'tick {recorded} of {ticks} did not reach the trace on every topic'
    if failure is not None:
        raise RunFailed(f'{failure} ({recorded} ticks are kept)', trace)
    return trace


def nodes_in(folder: Path) -> NodeGroup:
    """Return a group of nodes that print to files in ``folder``."""
    return NodeGroup(os.environ, folder / 'log')


@contextlib.contextmanager
def recording() -> Iterator[tuple['TraceRecorder', Callable[[float], None]]]:
    """Give a trace recorder in this process, and a function that listens for some seconds."""
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.task import Future

    from fam_bundle_io.trace_recorder_node import TraceRecorder
    from fam_bundle_node.loop_node import make_executor

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    with contextlib.ExitStack() as stack:
        stack.callback(rclpy.try_shutdown)
        recorder, never = TraceRecorder(), Future()
        # Else its subscriptions live on and hold the next run up.
        stack.callback(recorder.destroy_node)
        executor = make_executor()
        stack.callback(executor.shutdown)
        executor.add_node(recorder)
        yield recorder, lambda wait: executor.spin_until_future_complete(never, timeout_sec=wait)
