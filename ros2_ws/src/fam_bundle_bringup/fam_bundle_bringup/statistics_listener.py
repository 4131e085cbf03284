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

"""Listens to the loop statistics of every node of a domain, whatever its namespace."""

from collections.abc import Callable, Iterator
import contextlib
import time
from typing import Any, NamedTuple

from fam_bundle_bringup.this_machine import stay_on_this_machine
from fam_bundle_model.parameters import seconds
from fam_bundle_node.stamps import nanoseconds

LOOK_PERIOD = 0.5  # s between two looks for new topics
TYPE = 'fam_bundle_msgs/msg/LoopStatistics'


class Report(NamedTuple):
    """One report of a node, in the units of the message."""

    received: float  # steady time (s)
    stamp: float  # system time (s)
    node: str
    state: str
    rate: float
    latency_p50: float
    latency_p99: float
    latency_max: float
    cpu_time_per_tick: float
    cpu_share: float
    ticks: int
    overruns: int
    skipped_periods: int
    missing: int
    duplicate: int
    out_of_order: int
    late: int
    refused: int


def report_of(message: Any, received: float) -> Report:
    """Return what a LoopStatistics that came at ``received`` says."""
    same = {name: getattr(message, name) for name in Report._fields[4:]}
    stamp = seconds(nanoseconds(message.header.stamp))
    return Report(received, stamp, _clean(message.node), _clean(message.state), **same)


def _clean(text: str) -> str:
    """Return ``text`` as one line that does nothing to a terminal."""
    return ' '.join(''.join(c if c.isprintable() else ' ' for c in text).split())


class StatisticsListener:
    """Subscribes once to each topic of loop statistics and keeps what comes."""

    def __init__(self) -> None:
        """Look for topics now and then twice a second."""
        from rclpy.clock import Clock, ClockType
        from rclpy.node import Node

        self._heard: list[Report] = []
        self._topics: set[str] = set()
        # It is no part of the graph that it looks at: no services, no log topic.
        self.node = Node('fam_top', enable_rosout=False, start_parameter_services=False)
        clock = Clock(clock_type=ClockType.STEADY_TIME)
        self.node.create_timer(LOOK_PERIOD, self.look, clock=clock)
        self.look()

    def look(self) -> None:
        """Subscribe to the topics that have come since the last look."""
        from fam_bundle_msgs.msg import LoopStatistics
        from fam_bundle_node.qos import REPORTS

        for topic, types in self.node.get_topic_names_and_types():
            if TYPE in types and topic not in self._topics:
                self._topics.add(topic)
                self.node.create_subscription(LoopStatistics, topic, self._received, REPORTS)

    def _received(self, message: Any) -> None:
        self._heard.append(report_of(message, time.monotonic()))

    def take(self) -> list[Report]:
        """Return the reports since the last call."""
        heard, self._heard = self._heard, []
        return heard


@contextlib.contextmanager
def listening(domain: int) -> Iterator[Callable[[float], list[Report]]]:
    """Give a function that listens in ``domain`` for some seconds and returns the reports."""
    from fam_bundle_node.run import make_executor
    import rclpy
    from rclpy.signals import SignalHandlerOptions
    from rclpy.task import Future

    stay_on_this_machine()
    rclpy.init(args=[], domain_id=domain, signal_handler_options=SignalHandlerOptions.NO)
    with contextlib.ExitStack() as stack:
        stack.callback(rclpy.try_shutdown)
        listener, never = StatisticsListener(), Future()
        stack.callback(listener.node.destroy_node)
        executor = make_executor()
        stack.callback(executor.shutdown)
        executor.add_node(listener.node)

        def listen(seconds: float) -> list[Report]:
            executor.spin_until_future_complete(never, timeout_sec=seconds)
            return listener.take()

        yield listen
