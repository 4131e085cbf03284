# SPDX-License-Identifier: Apache-2.0
"""What every node of the loop shares: parameters, start-up, errors, executor and exit status."""

import contextlib
import gc
import os
import sys
from collections.abc import Callable, Iterable
from typing import Any

import rclpy
from rclpy.executors import Executor, ExternalShutdownException
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.publisher import Publisher
from rclpy.task import Future

from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.declare import declare_configuration
from fam_bundle_node.qos import LOOP_PUBLISHER, LOOP_SUBSCRIPTION
from fam_bundle_node.ticks import TickError, TickOrder

INTERRUPTED = 130


class LoopNode(Node):
    """A node that publishes and consumes one message per tick."""

    def __init__(self, name: str, groups: Iterable[str]) -> None:
        """Declare the parameters of ``groups``; raises ConfigurationError when one is bad."""
        super().__init__(name)
        self.done: Future = Future()
        self._order = TickOrder()
        self.configuration: Configuration = declare_configuration(self, groups)

    def loop_publisher(self, message_type: type, topic: str) -> Publisher:
        """Return a publisher for a topic of the loop."""
        return self.create_publisher(message_type, topic, LOOP_PUBLISHER)

    def loop_subscription(
        self, message_type: type, topic: str, callback: Callable[[Any], None]
    ) -> None:
        """Subscribe to a topic of the loop; ticks out of order and bad data end the node."""

        def checked(message: Any) -> None:
            if self.done.done():
                return
            try:
                self._order.check(topic, message.tick)
                callback(message)
            except TickError as error:
                self.fail(str(error))

        self.create_subscription(message_type, topic, checked, LOOP_SUBSCRIPTION)

    def succeed(self) -> None:
        """End the node with exit status 0."""
        if not self.done.done():
            self.done.set_result(0)

    def fail(self, message: str) -> None:
        """Say why and end the node with exit status 1."""
        if not self.done.done():
            self.get_logger().fatal(message)
            self.done.set_result(1)


def make_executor() -> Executor:
    """Return the events executor, or the default one where rclpy has none."""
    try:
        from rclpy.experimental.events_executor import EventsExecutor
    except ImportError:
        from rclpy.executors import SingleThreadedExecutor

        return SingleThreadedExecutor()
    return EventsExecutor()


def ask_for_batch_scheduling() -> None:
    """Let nobody that this process wakes pre-empt it: a fifth more ticks per second in lock-step.

    Else a publisher is put aside by its first reader before it has served the others. Threads
    made later inherit it; it needs no rights. Does nothing where the system has no such policy.
    """
    with contextlib.suppress(AttributeError, OSError):
        os.sched_setscheduler(0, os.SCHED_BATCH, os.sched_param(0))


def run_node(make_node: Callable[[], LoopNode]) -> int:
    """Run a node until it is done or told to stop, and return its exit status.

    0 when it has done its work, 1 after a failure, 2 for a bad configuration, 130 when it was told
    to stop before.
    """
    ask_for_batch_scheduling()
    try:
        rclpy.init()
    except rclpy_implementation.RCLError as error:  # a parameter file that is missing or no YAML
        print(' '.join(str(error).split()), file=sys.stderr)
        return 2
    try:
        node = make_node()
    except ConfigurationError as error:
        print(f'{error} (parameters: --ros-args --params-file FILE)', file=sys.stderr)
        rclpy.try_shutdown()
        return 2
    executor = make_executor()
    executor.add_node(node)
    gc.collect()
    gc.freeze()  # numba leaves half a million objects that no later collection need look at
    try:
        # A finite wait: an unbounded one answers no signal with the events executor.
        while rclpy.ok() and not node.done.done():
            executor.spin_until_future_complete(node.done, timeout_sec=1.0)
    except (KeyboardInterrupt, ExternalShutdownException):
        pass
    status = node.done.result() if node.done.done() else INTERRUPTED
    rclpy.try_shutdown()
    return status
