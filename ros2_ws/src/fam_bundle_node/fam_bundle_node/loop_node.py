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

"""What every node of the loop shares: parameters, admission of messages, statistics, errors."""

from collections.abc import Callable, Iterable
import re
import time
from typing import Any

from fam_bundle_model.parameters import Configuration, with_values
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_msgs.msg import ParameterChange
from fam_bundle_node.checks import CHECKS
from fam_bundle_node.declare import declare_configuration
from fam_bundle_node.live import changes_of
from fam_bundle_node.loop_meter import LoopMeter
from fam_bundle_node.qos import (
    CHANGES,
    LOOP_PUBLISHER,
    LOOP_SUBSCRIPTION,
    REALTIME_PUBLISHER,
    REALTIME_SUBSCRIPTION,
)
from fam_bundle_node.stamps import begins_anew, StampClock
from fam_bundle_node.statistics_publisher import StatisticsPublisher
from fam_bundle_node.steady_timer import SteadyTimer
from fam_bundle_node.ticks import Strikes, TickCounts, TickError, TickFilter, TickOrder
from rcl_interfaces.msg import SetParametersResult
from rclpy.duration import Duration
from rclpy.impl.implementation_singleton import rclpy_implementation
from rclpy.node import Node
from rclpy.parameter import Parameter
from rclpy.publisher import Publisher
from rclpy.task import Future

RCLError = rclpy_implementation.RCLError
# Parameter groups that every node of the loop declares.
COMMON = ('run', 'process')
LAST_MESSAGES = Duration(seconds=10)
REPORT_PERIOD = 1.0  # s
LOOK_PERIOD = 0.05  # s between two looks at how the node does
SILENCE = 0.2  # s without a tick, after which a controller says what it waits for
STALE = 5.0  # command time-outs; nobody waits for the answer to an older sample
NUMBERS = re.compile(r'\d+')
FUTURE = -1_000_000  # ns; a sample that is stamped further ahead than this was not taken


class LoopNode(Node):
    """
    A node that publishes and consumes one message per tick.

    In lock-step a message that is missing, out of order or bad ends the node. In real time it is
    counted and dropped, and three close together are a trouble until they have ceased.
    """

    OWNS_RUN = False  # whether a run begins and ends with this node
    LIVE: tuple[str, ...] = ()  # groups whose live parameters can be set while it runs

    def __init__(self, name: str, groups: Iterable[str]) -> None:
        """Declare the parameters of ``groups``; raises ConfigurationError when one is bad."""
        super().__init__(name)
        self.done: Future = Future()
        self.trouble = ''
        self.changed: dict[str, float] = {}  # parameters since the last sample
        self.meter = LoopMeter()
        self._order = TickOrder()
        self._strikes = Strikes()
        self._newest = 0  # steady time of a sample (ns)
        self._publishers_of_loop: list[Publisher] = []
        try:
            self.configuration: Configuration = declare_configuration(
                self, (*groups, *COMMON), self.LIVE
            )
        except ConfigurationError:
            self.destroy_node()
            raise
        self.realtime = self.configuration.run.pace == 'realtime'
        self.statistics = StatisticsPublisher(self, self.meter)
        self._shown, self._reported_at = 'running', time.monotonic()
        self._look = SteadyTimer(self, LOOK_PERIOD, self.look_after, self.fail_on)

    def set_parameters_atomically(self, parameter_list: list[Parameter]) -> SetParametersResult:
        """
        Set parameters, all or none; what has changed acts from the next sample on.

        Refused in one line that names parameter, value and bound, or why it is fixed. What keeps
        its value is taken, so that a dump of this very node can be loaded.
        """
        try:
            new = [p for p in parameter_list if self.get_parameter_or(p.name).value != p.value]
            changed, others = changes_of(self.configuration, self.LIVE, new)
            configuration = with_values(self.configuration, changed)
        except ConfigurationError as error:
            return SetParametersResult(successful=False, reason=str(error))
        result = super().set_parameters_atomically(others)
        if result.successful and changed:
            self.configuration = configuration
            self.changed |= changed
            self.get_logger().info(f'set: {changed}')
        return result

    @property
    def counts(self) -> TickCounts:
        """Return what went wrong with the messages of this node."""
        return self.meter.counts

    def loop_publisher(self, message_type: type, topic: str) -> Publisher:
        """Return a publisher for a topic of the loop."""
        quality = REALTIME_PUBLISHER if self.realtime else LOOP_PUBLISHER
        publisher = self.create_publisher(message_type, topic, quality)
        self._publishers_of_loop.append(publisher)
        return publisher

    def deliver(self) -> None:
        """
        Wait until everybody has all that this node has published to the loop.

        A recorder may be behind.
        """
        for publisher in self._publishers_of_loop:
            publisher.wait_for_all_acked(LAST_MESSAGES)

    def loop_subscription(
        self, message_type: type, topic: str, callback: Callable[[Any], None]
    ) -> None:
        """Subscribe to a topic of the loop; ``callback`` gets what may be used."""
        admit = self._in_real_time(topic) if self.realtime else self._in_lockstep(topic)

        def received(message: Any) -> None:
            if self.done.done():
                return
            try:
                admit(message, callback)
            except RCLError:
                if self.context.ok():  # else a signal has ended the context meanwhile
                    raise

        quality = REALTIME_SUBSCRIPTION if self.realtime else LOOP_SUBSCRIPTION
        self.create_subscription(message_type, topic, received, quality)

    def _in_lockstep(self, topic: str) -> Callable[[Any, Callable[[Any], None]], None]:
        def admit(message: Any, callback: Callable[[Any], None]) -> None:
            try:
                self._order.check(topic, message.tick)
                CHECKS[topic](message, self.motor_units())
                callback(message)
            except TickError as error:
                self.fail(str(error))

        return admit

    def _in_real_time(self, topic: str) -> Callable[[Any, Callable[[Any], None]], None]:
        ticks = TickFilter(self.counts) if topic == 'bundle_state' else None

        def admit(message: Any, callback: Callable[[Any], None]) -> None:
            unusable = self._unusable()
            try:
                CHECKS[topic](message, self.motor_units())
                if ticks is None or (self._is_fresh(message) and ticks.admit(message.tick)):
                    if ticks is not None and message.tick == 0:
                        self.trouble, self._strikes = '', Strikes()  # of the run before
                    callback(message)
                reason = f'{topic}: tick {message.tick} came twice or out of order'
            except TickError as error:
                self.counts.refused += 1
                reason = str(error)
            if self._unusable() == unusable:
                self._strikes.good()
            elif self._strikes.strike():
                self.get_trouble(reason)
            if self.trouble and self._strikes.clear:
                self.trouble = ''

        return admit

    def _unusable(self) -> int:
        return self.counts.duplicate + self.counts.out_of_order + self.counts.refused

    def _is_fresh(self, sample: Any) -> bool:
        """Return whether a sample is of now, and count it if it is late."""
        if sample.tick == 0:  # waits for its answer, however long; a new run may have a new clock
            late = sample.steady_time == self._newest
            self.meter.forget_clock()
        else:
            age = self.meter.age(sample.steady_time)
            if age is None:
                return True
            if age < FUTURE:
                raise TickError(f'bundle_state: tick {sample.tick} is {-age} ns in the future')
            late = age > STALE * self.configuration.run.command_timeout * 1e9
        self.counts.late += late
        if not late:
            self._newest = sample.steady_time
        return not late

    def motor_units(self) -> int:
        """Return the number of motor units."""
        return len(self.configuration.fam.count)

    def get_trouble(self, reason: str) -> None:
        """Note a fault: three messages could not be used."""
        if not self.trouble:
            self.trouble = reason
            self.get_logger().error(reason)

    def state(self) -> str:
        """Return 'running', or why this node is not."""
        return self.trouble or 'running'

    def look_after(self) -> None:
        """Report once a second, and at once when the state changes."""
        state = self.news() or self.state()
        kind = NUMBERS.sub('', state)  # the tick it waits for may rise with each look
        if kind == self._shown and time.monotonic() - self._reported_at < REPORT_PERIOD:
            return
        if kind != self._shown:
            self.get_logger().warning(state)
        self._shown = kind
        self._reported_at = time.monotonic()
        self.statistics.publish(state)

    def news(self) -> str:
        """Return a state that has been since the last look and may be over again, or nothing."""
        return ''

    def report(self) -> None:
        """Publish how well this node keeps up."""
        self._reported_at = time.monotonic()
        self.statistics.publish(self.state())

    def succeed(self) -> None:
        """End the node with exit status 0."""
        if not self.done.done():
            self.done.set_result(0)

    def fail(self, message: str) -> None:
        """Say why and end the node with exit status 1."""
        if not self.done.done():
            self.get_logger().fatal(message)
            self.done.set_result(1)

    def fail_on(self, error: Exception) -> None:
        """End the node after an error that nobody expected."""
        if self.context.ok():  # else a signal has ended the context meanwhile
            self.fail(f'{type(error).__name__}: {error}')

    def close(self) -> None:
        """End what the node does beside its callbacks."""
        self._look.cancel()


class Controller(LoopNode):
    """A node of the loop that answers each ``bundle_state``."""

    def __init__(self, name: str, groups: Iterable[str]) -> None:
        """Know no sample yet."""
        super().__init__(name, groups)
        self.stamps = StampClock(self.configuration.period_ns())
        self._ticks, self._tick_at = 0, 0.0
        if self.LIVE:
            self._changes = self.create_publisher(ParameterChange, 'parameter_changes', CHANGES)

    def restart(self) -> None:
        """Bring the law to its start, from which it sets in without a bump."""
        raise NotImplementedError

    def retune(self) -> None:
        """Go on with the law of the configuration as it is now, without a bump."""
        raise NotImplementedError

    def _take_changes(self, sample: Any) -> None:
        """Let changed parameters act, and say from which sample on: a replay must know."""
        self.retune()
        names, values = list(self.changed), [float(value) for value in self.changed.values()]
        self.changed = {}
        change = ParameterChange(tick=sample.tick, node=self.get_name(), names=names)
        change.header, change.values = sample.header, values
        self._changes.publish(change)

    def time_step(self, sample: Any) -> float:
        """
        Return the time in s since the last sample; restart the law where that has no meaning.

        Raises TickError when time stands still.
        """
        if self.changed:
            self._take_changes(sample)
        gap = self.stamps.gap(sample.header.stamp)
        timeout = self.configuration.run.command_timeout
        if begins_anew(sample.tick, sample.safe, gap, timeout):
            self.stamps.restart()
            self.restart()
        return self.stamps.since_last(sample.header.stamp)

    def state(self) -> str:
        """Return 'running', or why this node is not."""
        if self.meter.ticks != self._ticks:
            self._ticks, self._tick_at = self.meter.ticks, time.monotonic()
        if not self.trouble and time.monotonic() - self._tick_at > SILENCE:
            return f'waiting for {self.missing()}'
        return super().state()

    def missing(self) -> str:
        """Return what this node waits for."""
        return 'bundle_state'
