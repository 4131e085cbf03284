# Copyright 2026 fam_bundle maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""The loop as a graph: five nodes, each its own process or all in one, over Fast DDS."""

from collections.abc import Callable, Iterator, Sequence
import contextlib
import os
from pathlib import Path
import signal
import subprocess
from typing import Any, TYPE_CHECKING

from fam_bundle_bringup.domain_marker import marked
from fam_bundle_bringup.failure import RunFailed
from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.processes import executable, NodeDied, NodeGroup
from fam_bundle_bringup.this_machine import stay_on_this_machine
from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.trace import empty_trace, Trace
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
COMPOSED = ('fam_bundle_bringup', 'composed_loop')
BRIDGE = ('fam_bundle_io', 'hardware_bridge')  # in place of the plant simulator
OWNERS = ('plant_simulator', 'hardware_bridge', 'composed_loop')  # whose end is the run's
LOOP_LISTENERS = 3  # strain controller, supervisor, pressure controller
SLICE = 0.05  # s of listening between two looks at the processes
BAG_TIMEOUT = 20.0  # s that the bag recorder gets to write what it has


@contextlib.contextmanager
def own_domain() -> Iterator[int]:
    """Reserve a DDS domain that no other run on this machine uses, and stay on the machine."""
    from domain_coordinator import domain_id

    stay_on_this_machine()
    # Entered by hand: as a context it would swallow an OSError of the run.
    reservation = domain_id()
    number = reservation.__enter__()
    os.environ['ROS_DOMAIN_ID'] = str(number)
    try:
        with marked(int(number)):
            yield int(number)
    finally:
        reservation.__exit__(None, None, None)


def nodes_of(*, composed: bool = False, bridge: bool = False) -> list[tuple[str, str]]:
    """
    Return package and executable of each process of a bundle; the last one owns the run.

    ``bridge`` asks for the hardware bridge in place of the plant simulator.
    """
    if composed:
        return [COMPOSED]
    return [*NODES[:-1], BRIDGE] if bridge else list(NODES)


def start_nodes(
    group: NodeGroup,
    parameter_file: Path,
    listeners: int,
    *,
    composed: bool = False,
    bridge: bool = False,
    bundle: str = '',
) -> str:
    """
    Start the nodes with one parameter file, each as a process or all in one.

    ``bridge`` asks for the hardware bridge in place of the plant simulator, ``bundle`` names the
    namespace of one of several. Returns the name of the process that ends with the run.
    """
    nodes = nodes_of(composed=composed, bridge=bridge)
    for package, name in nodes:
        command = [executable(package, name), '--ros-args', '--params-file', str(parameter_file)]
        if name in OWNERS:
            command += ['-p', f'run.listeners:={listeners}']
        if bundle:
            command += ['-r', f'__ns:=/{bundle}']
        group.start(f'{bundle}{name}', command)
    return f'{bundle}{nodes[-1][1]}'


def run_graph(
    configuration: Configuration,
    folder: Path,
    progress: Callable[[int], None] | None = None,
    *,
    composed: bool = False,
    bridge: bool = False,
    record: bool = False,
) -> Trace:
    """
    Run ``configuration`` through the graph and return its trace.

    With ``bridge`` the hardware bridge takes the place of the plant simulator.

    The nodes' parameter file, what they print and their loop statistics go to ``folder``, and to
    ``folder / 'bag'`` all topics if they are to be recorded; the trace is then made of the bag.
    ``progress`` is called with the ticks done so far. Raises RunFailed when a node ends early or
    messages stay missing; in real time, where samples may be skipped, when none came through.
    """
    parameter_file = folder / 'parameters.yaml'
    write_yaml(configuration, parameter_file)
    failure = None
    with own_domain(), recording(keep=not record) as ((recorder,), listen):
        with nodes_in(folder) as group:
            bag = start_bag_recorder(group, parameter_file, folder / 'bag') if record else None
            listeners = LOOP_LISTENERS + 1
            owner = start_nodes(group, parameter_file, listeners, composed=composed, bridge=bridge)
            try:
                while not group.finished(owner):
                    listen(SLICE)
                    if progress is not None:
                        progress(recorder.samples())
                drain(recorder, listen, drain_patience(configuration))
                if bag is not None:
                    close_bag(bag, folder)
            except NodeDied as error:
                failure = str(error)
        units = len(configuration.fam.count)
        trace = trace_in(folder / 'bag', units) if record else recorder.trace(units)
        write_json(recorder.reports(), folder / 'loop_statistics.json')
    recorded, wanted = len(trace['time']), configuration.ticks()
    if configuration.run.pace == 'realtime':
        wanted = min(wanted, 1)
    if failure is None and recorded < wanted:
        failure = f'tick {recorded} of {wanted} did not reach the trace on every topic'
    if failure is not None:
        raise RunFailed(f'{failure} ({recorded} ticks are kept)', trace)
    return trace


def trace_in(bag: Path, units: int) -> Trace:
    """Return the trace of the run in a bag, an empty one where there is none."""
    from fam_bundle_io.bag import read_bag, trace_of

    try:
        return trace_of(read_bag(bag)).trace
    except BagError:
        return empty_trace(0, units)


def start_bag_recorder(
    group: NodeGroup, parameter_file: Path, bag: Path
) -> 'subprocess.Popen[bytes]':
    """Start the recorder of all topics of the root namespace."""
    command = [executable('fam_bundle_io', 'bag_recorder'), '--ros-args']
    command += ['--params-file', str(parameter_file), '-p', f'bag.folder:={bag.resolve()}']
    return group.start('bag_recorder', command)


def close_bag(recorder: 'subprocess.Popen[bytes]', folder: Path) -> None:
    """Tell the recorder to write what it has and to end; raises NodeDied when it cannot."""
    recorder.send_signal(signal.SIGINT)
    try:
        status = recorder.wait(BAG_TIMEOUT)
    except subprocess.TimeoutExpired:
        raise NodeDied(f'bag_recorder did not end within {BAG_TIMEOUT:g} s') from None
    if status != 0:
        log = folder / 'log' / 'bag_recorder.log'
        raise NodeDied(f'bag_recorder ended with exit status {status}: see {log}')


def drain(recorder: 'TraceRecorder', listen: Callable[[float], None], patience: float) -> None:
    """Listen until every sample has its answers, or none has come for ``patience`` s."""
    waited, messages = 0.0, -1
    while recorder.is_behind() and waited < patience:
        waited = waited + SLICE if recorder.messages() == messages else 0.0
        messages = recorder.messages()
        listen(SLICE)


def drain_patience(configuration: Configuration) -> float:
    """
    Return how long (s) the last answers may take.

    In real time a sample may have none. In lock-step each has: a message that was lost on the way
    is sent again with the middleware's next heartbeat, three seconds later.
    """
    return 2.0 if configuration.run.pace == 'realtime' else 10.0


def nodes_in(folder: Path) -> NodeGroup:
    """Return a group of nodes that print to files in ``folder``."""
    return NodeGroup(os.environ, folder / 'log')


@contextlib.contextmanager
def recording(
    bundles: Sequence[str] = ('',), *, keep: bool = True
) -> Iterator[tuple[list['TraceRecorder'], Callable[[float], None]]]:
    """
    Give a trace recorder for each of ``bundles``, and a function that listens for some seconds.

    A bundle is named by its namespace; all recorders are in this process, and ``keep`` messages or
    only the loop statistics.
    """

    def make() -> list['TraceRecorder']:
        from fam_bundle_io.trace_recorder_node import TraceRecorder

        return [TraceRecorder(bundle, keep=keep) for bundle in bundles]

    with listening(make) as found:
        yield found


@contextlib.contextmanager
def listening(
    make: Callable[[], list[Any]],
) -> Iterator[tuple[list[Any], Callable[[float], None]]]:
    """
    Give the nodes that ``make`` returns, in this process, and a function that runs them.

    It takes for how long (s).
    """
    from fam_bundle_node.run import make_executor
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.task import Future

    rclpy.init(args=[], signal_handler_options=SignalHandlerOptions.NO)
    with contextlib.ExitStack() as stack:
        stack.callback(rclpy.try_shutdown)
        never, nodes = Future(), make()
        for node in nodes:
            # Else its subscriptions live on and hold the next run up.
            stack.callback(node.destroy_node)
        executor = make_executor()
        stack.callback(executor.shutdown)
        for node in nodes:
            executor.add_node(node)
        yield nodes, lambda wait: executor.spin_until_future_complete(never, timeout_sec=wait)
