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

"""Publishes a node's loop statistics, and the same on /diagnostics (REP-107)."""

import dataclasses

from diagnostic_msgs.msg import DiagnosticArray, DiagnosticStatus, KeyValue
from fam_bundle_msgs.msg import LoopStatistics
from fam_bundle_node.loop_meter import LoopMeter
from fam_bundle_node.qos import REPORTS
from fam_bundle_node.ticks import TickCounts
from rclpy.node import Node


class StatisticsPublisher:
    """One report per call, over the time since the call before."""

    def __init__(self, node: Node, meter: LoopMeter) -> None:
        """Report for ``node`` what ``meter`` has seen."""
        self._node, self._meter = node, meter
        self._before = TickCounts(), 0
        self._statistics = node.create_publisher(LoopStatistics, 'loop_statistics', REPORTS)
        self._diagnostics = node.create_publisher(DiagnosticArray, '/diagnostics', REPORTS)

    def publish(self, state: str) -> None:
        """Publish the report of a node that is in ``state``."""
        meter = self._meter
        message = LoopStatistics(
            node=self._node.get_fully_qualified_name(),
            state=state,
            overruns=meter.overruns,
            skipped_periods=meter.skipped_periods,
            **meter.report()._asdict(),
            **dataclasses.asdict(meter.counts),
        )
        message.header.stamp = self._node.get_clock().now().to_msg()
        self._statistics.publish(message)
        array = DiagnosticArray(status=[self._status(message)])
        array.header.stamp = message.header.stamp
        self._diagnostics.publish(array)

    def _status(self, message: LoopStatistics) -> DiagnosticStatus:
        now = dataclasses.replace(self._meter.counts), self._meter.overruns
        level = _level(message.state, changed=now != self._before)
        self._before = now
        skipped = ('_header', '_node', '_state')
        values = [
            KeyValue(key=name.removeprefix('_'), value=f'{getattr(message, name):.6g}')
            for name in message.__slots__
            if name not in skipped and name != '_check_fields'
        ]
        return DiagnosticStatus(
            level=level,
            name=f'{message.node.lstrip("/")}: loop',
            message=message.state,
            hardware_id=self._node.get_namespace(),
            values=values,
        )


def _level(state: str, *, changed: bool) -> bytes:
    if state.startswith('waiting'):
        return DiagnosticStatus.WARN
    if state != 'running':
        return DiagnosticStatus.ERROR
    return DiagnosticStatus.WARN if changed else DiagnosticStatus.OK
