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

"""ROS node that keeps every message of the loop in memory and makes a trace of them."""

from collections.abc import Callable
import math
from typing import Any

from fam_bundle_io.trace import empty_trace, Trace
from fam_bundle_model.parameters import seconds
from fam_bundle_msgs.msg import (
    BundleState,
    LoopStatistics,
    PressureReference,
    RecruitmentState,
    ValveCommand,
)
from fam_bundle_node.qos import RECORDER_SUBSCRIPTION, REPORTS
from fam_bundle_node.stamps import nanoseconds
import numpy as np
from rclpy.clock import Clock, ClockType
from rclpy.node import Node
from rclpy.serialization import deserialize_message

TOPICS = {
    'pressure_reference': PressureReference,
    'recruitment_state': RecruitmentState,
    'valve_command': ValveCommand,
    'bundle_state': BundleState,
}


class TraceRecorder(Node):
    """Takes the messages as bytes, for the loop runs while it listens; decodes them later."""

    def __init__(self, namespace: str = '', *, keep: bool = True) -> None:
        """
        Listen to the answers; to the plant, which starts the run, when these are matched.

        Without ``keep`` only to the loop statistics: somebody else keeps the messages.
        """
        super().__init__('trace_recorder', namespace=namespace)
        self.raw: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
        self.statistics: list[LoopStatistics] = []
        self.create_subscription(
            LoopStatistics, 'loop_statistics', self.statistics.append, REPORTS
        )
        if not keep:
            return
        for topic in TOPICS:
            if topic != 'bundle_state':
                self.listen(topic)
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self._timer = self.create_timer(0.02, self.start, clock=steady)

    def start(self) -> None:
        """Listen to the plant once every other topic has its publisher."""
        if all(self.count_publishers(topic) for topic in TOPICS):
            self._timer.cancel()
            self.listen('bundle_state')

    def listen(self, topic: str) -> None:
        """Keep the messages of ``topic``."""
        keep: Callable[[bytes], None] = self.raw[topic].append
        self.create_subscription(TOPICS[topic], topic, keep, RECORDER_SUBSCRIPTION, raw=True)

    def samples(self) -> int:
        """Return how many samples of the plant have come, or been reported where none is kept."""
        reported = max((report.ticks for report in self.statistics), default=0)
        return len(self.raw['bundle_state']) or reported

    def messages(self) -> int:
        """Return how many messages of the loop have come."""
        return sum(len(raw) for raw in self.raw.values())

    def is_behind(self) -> bool:
        """Return whether answers to samples that have come are still missing."""
        return any(len(raw) < len(self.raw['bundle_state']) for raw in self.raw.values())

    def trace(self, units: int) -> Trace:
        """Return the trace of all ticks that came on every topic, each at its first coming."""
        found = {topic: self._by_tick(topic) for topic in TOPICS}
        ticks = sorted(set.intersection(*(set(messages) for messages in found.values())))
        trace = empty_trace(len(ticks), units)
        for topic, messages in found.items():
            for row, tick in enumerate(ticks):
                _FILL[topic](trace, row, messages[tick])
        return trace

    def _by_tick(self, topic: str) -> dict[int, Any]:
        messages: dict[int, Any] = {}
        for raw in self.raw[topic]:
            message = deserialize_message(raw, TOPICS[topic])
            messages.setdefault(message.tick, message)
        return messages

    def reports(self) -> list[dict[str, Any]]:
        """Return the loop statistics of all nodes, in the order in which they came."""
        return [_plain(message) for message in self.statistics]


def _plain(report: LoopStatistics) -> dict[str, Any]:
    """Return the fields of a report as JSON can hold them: what is not finite is None."""
    fields = {name: getattr(report, name) for name in report.get_fields_and_field_types()}
    fields['header'] = seconds(nanoseconds(report.header.stamp))
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in fields.items()
    }


def _fill_state(trace: Trace, row: int, message: BundleState) -> None:
    trace['time'][row] = seconds(nanoseconds(message.header.stamp))
    trace['strain'][row] = message.strain
    trace['force'][row] = message.force
    trace['source_pressure'][row] = message.source_pressure
    trace['source_flow'][row] = message.source_flow
    trace['mu_pressure'][row] = message.mu_pressure


def _fill_reference(trace: Trace, row: int, message: PressureReference) -> None:
    trace['strain_reference'][row] = message.strain_reference
    trace['pressure_reference'][row] = message.pressure


def _fill_recruitment(trace: Trace, row: int, message: RecruitmentState) -> None:
    trace['recruitment_state'][row] = message.recruited
    for name in (
        'time_to_saturation',
        'time_to_desaturation',
        'recruitment_lag',
        'pressure_compensation',
        'deslack_pressure',
        'prediction_error',
    ):
        trace[name][row] = getattr(message, name)


def _fill_command(trace: Trace, row: int, message: ValveCommand) -> None:
    trace['spool'][row] = np.asarray(message.spool)


_FILL = {
    'bundle_state': _fill_state,
    'pressure_reference': _fill_reference,
    'recruitment_state': _fill_recruitment,
    'valve_command': _fill_command,
}
