# SPDX-License-Identifier: Apache-2.0
"""ROS node that keeps every message of the loop in memory and makes a trace of them."""

from collections.abc import Callable

import numpy as np
from rclpy.node import Node
from rclpy.serialization import deserialize_message

from fam_bundle_io.trace import Trace, empty_trace
from fam_bundle_model.parameters import seconds
from fam_bundle_msgs.msg import BundleState, PressureReference, RecruitmentState, ValveCommand
from fam_bundle_node.qos import RECORDER_SUBSCRIPTION

TOPICS = {
    'pressure_reference': PressureReference,
    'recruitment_state': RecruitmentState,
    'valve_command': ValveCommand,
    'bundle_state': BundleState,
}


class TraceRecorder(Node):
    """Takes the messages as bytes, for the loop runs while it listens; decodes them later."""

    def __init__(self) -> None:
        """Listen to the answers; to the plant, which starts the run, when these are matched."""
        super().__init__('trace_recorder')
        self.raw: dict[str, list[bytes]] = {topic: [] for topic in TOPICS}
        for topic in TOPICS:
            if topic != 'bundle_state':
                self.listen(topic)
        self._timer = self.create_timer(0.02, self.start)

    def start(self) -> None:
        """Listen to the plant once every other topic has its publisher."""
        if all(self.count_publishers(topic) for topic in TOPICS):
            self._timer.cancel()
            self.listen('bundle_state')

    def listen(self, topic: str) -> None:
        """Keep the messages of ``topic``."""
        keep: Callable[[bytes], None] = self.raw[topic].append
        self.create_subscription(TOPICS[topic], topic, keep, RECORDER_SUBSCRIPTION, raw=True)

    def ticks(self) -> int:
        """Return how many ticks of the plant have come."""
        return len(self.raw['bundle_state'])

    def complete_ticks(self) -> int:
        """Return how many ticks have come on every topic."""
        return min(len(messages) for messages in self.raw.values())

    def trace(self, units: int) -> Trace:
        """Return the trace of all ticks before the first one that is missing on some topic."""
        trace = empty_trace(self.complete_ticks(), units)
        for topic, message_type in TOPICS.items():
            ticks = len(trace['time'])
            for row, raw in enumerate(self.raw[topic][:ticks]):
                message = deserialize_message(raw, message_type)
                if message.tick != row:
                    trace = {name: values[:row] for name, values in trace.items()}
                    break
                _FILL[topic](trace, row, message)
        return trace


def _fill_state(trace: Trace, row: int, message: BundleState) -> None:
    stamp = message.header.stamp
    trace['time'][row] = seconds(stamp.sec * 1_000_000_000 + stamp.nanosec)
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
