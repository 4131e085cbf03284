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

"""Runs nodes of the loop in this process until they are done: executor, tuning, exit status."""

from collections.abc import Callable, Sequence
import os
import signal
import sys
import time
from types import FrameType

from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.loop_node import LoopNode
from fam_bundle_node.network import chosen_network, NOT_CHOSEN
from fam_bundle_node.parent import end_with_parent
from fam_bundle_node.tuning import tune
import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.task import Future

INTERRUPTED = 130
SIGNAL_TIME = 0.2  # s between a callback that a signal cuts short and the end of the context
RCLError = rclpy_implementation.RCLError
CUT_SHORT = 'Unable to convert call argument'  # of the events executor


def make_executor(kind: str = 'events') -> Executor:
    """Return the executor ``kind``: ``events``, where rclpy has it, or ``single_threaded``."""
    from rclpy.executors import SingleThreadedExecutor

    if kind == 'single_threaded':
        return SingleThreadedExecutor()
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        return SingleThreadedExecutor()
    return EventsExecutor()


def run_node(make_node: Callable[[], LoopNode]) -> int:
    """Run one node until it is done or told to stop, and return its exit status."""
    return run_nodes([make_node])


def run_nodes(makers: Sequence[Callable[[], LoopNode]]) -> int:
    """
    Run nodes on one executor until the first is done or told to stop; return its exit status.

    0 when it has done its work, 1 after a failure, 2 for a bad configuration. When it was told to
    stop before, 130 if one of them owns the run, which then is not finished; else 0, for a
    controller runs until it is told.
    """
    ends = Interrupts()
    try:
        end_with_parent()
        rclpy.init()
        nodes = [make_node() for make_node in makers]
    except ConfigurationError as error:
        print(f'{error} (parameters: --ros-args --params-file FILE)', file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    except (KeyboardInterrupt, ExternalShutdownException):
        rclpy.try_shutdown()
        return INTERRUPTED
    except RCLError as error:
        if ends.told:
            return INTERRUPTED
        print(' '.join(str(error).split()), file=sys.stderr)  # a file that is missing or no YAML
        return 2
    if not chosen_network(os.environ):
        nodes[0].get_logger().warning(NOT_CHOSEN)
    done = first_done(nodes)
    ends.raised = False  # in a callback, the executor would make a fatal error of it
    try:
        spin(nodes, done)
        if done.done() and done.result() == 0:
            for node in nodes:
                node.deliver()
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    except RuntimeError as error:
        # A callback was under way when a signal ended the context: rcl and the executor say so.
        known = isinstance(error, RCLError) or CUT_SHORT in str(error)
        if not known or not context_ends():
            raise
    finally:
        for node in nodes:
            node.close()
    stopped = INTERRUPTED if any(node.OWNS_RUN for node in nodes) else 0
    status: int = done.result() if done.done() else stopped
    rclpy.try_shutdown()
    return status


class Interrupts:
    """
    Ctrl-C as an exception while nodes are made, and as the end of the context afterwards.

    Made before rclpy is set up, whose own signal handlers end the context and then call these.
    """

    def __init__(self) -> None:
        """Take SIGINT and SIGTERM."""
        self.raised, self.told = True, False
        for number in (signal.SIGINT, signal.SIGTERM):
            signal.signal(number, self._on_signal)

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.told = True
        if self.raised:
            raise KeyboardInterrupt


def context_ends() -> bool:
    """Return whether the context has ended, or does so in a moment: a signal takes one."""
    end = time.monotonic() + SIGNAL_TIME
    while rclpy.ok() and time.monotonic() < end:
        time.sleep(0.001)
    return not rclpy.ok()


def spin(nodes: Sequence[LoopNode], done: Future) -> None:
    """Tune the process as the first node's parameters say, and run all until ``done``."""
    process, pace = nodes[0].configuration.process, nodes[0].configuration.run.pace
    executor = make_executor(process.executor)
    for node in nodes:
        executor.add_node(node)
    for warning in tune(process, pace):
        nodes[0].get_logger().warning(warning)
    # A finite wait: an unbounded one answers no signal with the events executor.
    while rclpy.ok() and not done.done():
        executor.spin_until_future_complete(done, timeout_sec=1.0)


def first_done(nodes: Sequence[LoopNode]) -> Future:
    """Return a future of the exit status of the node that is done first."""
    first: Future = Future()

    def pass_on(ended: Future) -> None:
        if not first.done():
            first.set_result(ended.result())

    for node in nodes:
        node.done.add_done_callback(pass_on)
    return first
