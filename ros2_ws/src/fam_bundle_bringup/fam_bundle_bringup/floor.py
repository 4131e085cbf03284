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

"""
The floor of the lock-step: bare relays in the loop's topology, which compute nothing.

Same processes, topics, messages and qualities of service as the loop: what these relays need for
a tick, no controller in Python can save.
"""

from collections.abc import Callable, Mapping, Sequence
import contextlib
import json
import math
import os
from pathlib import Path
import sys
import tempfile
import time
from typing import Any, NamedTuple

from fam_bundle_bringup.graph import LOOP_LISTENERS, own_domain
from fam_bundle_bringup.processes import NodeGroup
from fam_bundle_model.parameters import ProcessParameters
from fam_bundle_node.pacing import Periodic
from fam_bundle_node.tuning import tune

MODULE = 'fam_bundle_bringup.floor'
# The role that counts the ticks stands first.
LOOP_ROLES = (
    'plant_simulator',
    'strain_controller',
    'recruitment_supervisor',
    'pressure_controller',
)
PING_ROLES = ('ping', 'pong')
JOINED = ('bundle_state', 'pressure_reference', 'recruitment_state')
MESSAGE_TYPES = {
    'bundle_state': 'BundleState',
    'pressure_reference': 'PressureReference',
    'recruitment_state': 'RecruitmentState',
    'valve_command': 'ValveCommand',
}
WARM_UP = 100  # ticks before the counted ones: the first must wait for the last discovery
MATCHING_PERIOD = 0.02  # s between two looks at who listens
START_TIMEOUT = 60.0  # s for the start of the processes
TICK_TIMEOUT = 0.05  # s per tick, some hundred times what one takes
POLL = 0.05  # s between two looks at the processes


class Measured(NamedTuple):
    """
    Rate in ticks/s; times in s from just before a publication to the callback of its answer.

    On a clock from when it was due, and the share of periods with an answer in time.
    """

    ticks_per_second: float
    p50: float
    p99: float
    maximum: float
    in_time_share: float = 1.0


def relay_loop(ticks: int, units: int) -> Measured:
    """
    Run ``ticks`` ticks of ``units`` motor units through the four relays.

    Raises RuntimeError, with the last line of a log, when one fails or the time runs out.
    """
    with own_domain():
        return measure_ticks(MODULE, LOOP_ROLES, ticks, units, os.environ)


def relay_on_a_clock(seconds: float, units: int, period: float, priority: int) -> Measured:
    """
    Run the four relays on a clock of ``period`` (s), with the ``priority`` of SCHED_FIFO.

    Raises RuntimeError, with the last line of a log, when one fails or the time runs out.
    """
    timed = (str(round(period * 1e9)), str(priority))
    with own_domain():
        return measure_ticks(
            MODULE, LOOP_ROLES, round(seconds / period), units, os.environ, *timed
        )


def relay_ping(ticks: int, units: int) -> Measured:
    """
    Send ``ticks`` bundle states of ``units`` motor units to one process, which answers each.

    Raises RuntimeError, with the last line of a log, when one fails or the time runs out.
    """
    with own_domain():
        return measure_ticks(MODULE, PING_ROLES, ticks, units, os.environ)


def measure_ticks(
    module: str,
    roles: Sequence[str],
    ticks: int,
    units: int,
    environment: Mapping[str, str],
    *more: str,
) -> Measured:
    """
    Run ``module`` in one process per role until the first role has counted its ticks.

    Each gets its role, ``ticks``, ``units`` and ``more`` as arguments. Raises RuntimeError, with
    the last line of a log, when one fails or the time runs out.
    """
    timeout = START_TIMEOUT + TICK_TIMEOUT * ticks
    arguments = (str(ticks), str(units), *more)
    found = run_roles(module, roles, arguments, environment, timeout)
    latency = (found['latency_us'][name] * 1e-6 for name in ('p50', 'p99', 'max'))
    return Measured(found['ticks_per_second'], *latency, found.get('in_time_share', 1.0))


def run_roles(
    module: str,
    roles: Sequence[str],
    arguments: Sequence[str],
    environment: Mapping[str, str],
    timeout: float,
) -> dict[str, Any]:
    """
    Run ``module`` in one process per role until the first has ended; return what it found.

    What it found is the JSON object of the last line that it printed. The other roles are ended.
    Raises RuntimeError, with the last line of a log, when one fails or ``timeout`` (s) has passed.
    """
    with tempfile.TemporaryDirectory() as name, NodeGroup(environment, Path(name)) as group:
        for role in roles:
            group.start(role, [sys.executable, '-m', module, role, *arguments])
        deadline = time.monotonic() + timeout
        while not group.finished(roles[0]):
            if time.monotonic() > deadline:
                last = _last_line(Path(name), roles[0]) or 'it printed nothing'
                raise RuntimeError(f'{roles[0]} did not end within {timeout:g} s: {last}')
            time.sleep(POLL)
        last = _last_line(Path(name), roles[0])
    try:
        found: dict[str, Any] = json.loads(last)
    except ValueError:
        raise RuntimeError(f'{roles[0]} did not say what it measured: {last}') from None
    return found


def _last_line(logs: Path, role: str) -> str:
    lines = (logs / f'{role}.log').read_text(errors='replace').split('\n')
    return next((line.strip() for line in reversed(lines) if line.strip()), '')


def rank(ordered: Sequence[float], share: float) -> float:
    """Return the value of ``ordered``, not empty, that ``share`` of them do not exceed."""
    return ordered[max(math.ceil(share * len(ordered)), 1) - 1]


class RoundTrips:
    """Counts ticks and notes when each was sent, or due, and when its answer came (ns)."""

    def __init__(self, ticks: int, period: int = 0) -> None:
        """Expect ``ticks`` ticks, at least 1, after those that warm up; ``period`` in ns."""
        self.last = WARM_UP + ticks - 1
        self._period = period
        self._sent: list[int] = []
        self._answered: dict[int, int] = {}

    def send(self, due: int | None = None) -> int:
        """Note that a tick is sent now, or was due; return its number."""
        self._sent.append(time.monotonic_ns() if due is None else due)
        return len(self._sent) - 1

    def answer(self, tick: int) -> None:
        """Note that the answer to ``tick`` has come."""
        self._answered[tick] = time.monotonic_ns()

    def report(self) -> str:
        """Return ticks/s, latencies in us and the share in time as a line of JSON."""
        counted = [tick for tick in sorted(self._answered) if tick >= WARM_UP]
        taken = sorted((self._answered[tick] - self._sent[tick]) / 1e3 for tick in counted)
        latency = {'p50': rank(taken, 0.5), 'p99': rank(taken, 0.99), 'max': taken[-1]}
        elapsed = self._answered[counted[-1]] - self._sent[WARM_UP]
        in_time = sum(latency * 1e3 < self._period for latency in taken)
        periods = max((self._sent[-1] - self._sent[WARM_UP]) // max(self._period, 1) + 1, 1)
        return json.dumps(
            {
                'ticks_per_second': len(counted) / elapsed * 1e9,
                'latency_us': latency,
                'in_time_share': in_time / periods if self._period else 1.0,
            }
        )


def tune_process(pace: str, priority: int = 0) -> None:
    """Give this process the settings that the loop's nodes have by default under ``pace``."""
    for warning in tune(ProcessParameters(priority=priority), pace):
        print(warning, file=sys.stderr)


def loop_message(topic: str, units: int) -> Any:
    """Return a message of ``topic`` as large as the loop's one with ``units`` motor units."""
    from fam_bundle_msgs import msg

    message = getattr(msg, MESSAGE_TYPES[topic])()
    message.header.frame_id = 'bundle'
    empty = {'sequence<double>': 0.0, 'sequence<boolean>': False}
    for field, kind in message.get_fields_and_field_types().items():
        if kind in empty:
            setattr(message, field, [empty[kind]] * units)
    return message


class BareNode:
    """A node of rclpy with the loop's topics; nothing checks, nothing computes."""

    def __init__(self, role: str, ticks: int, units: int, period: int = 0) -> None:
        """
        Take part in the loop as ``role``, on a clock if ``period`` (ns) is not 0.

        Raises KeyError when there is no such role.
        """
        import rclpy
        from rclpy.task import Future

        self.done = Future()
        self.trips = RoundTrips(ticks, period)
        self._period = period
        self._node = rclpy.create_node(role)
        self._units = units
        ROLES[role](self)

    def plant(self, listeners: int) -> None:
        """Publish a state once ``listeners`` listen, and the next on each answer or by a clock."""
        state, trips = loop_message('bundle_state', self._units), self.trips
        publisher = self._publisher('bundle_state')
        pacing = Periodic(self._period) if self._period else None

        def publish(due: int | None = None) -> None:
            state.tick = trips.send(due)
            publisher.publish(state)

        def step(_: int) -> None:
            if state.tick < trips.last:
                publish(pacing.due)

        def answered(command: Any) -> None:
            trips.answer(command.tick)
            if command.tick >= trips.last:
                if pacing:
                    pacing.stop()
                self.done.set_result(None)
            elif pacing is None or command.tick < WARM_UP:
                publish()
            elif command.tick == WARM_UP:
                pacing.start(step, self.done.set_exception)

        def start() -> None:
            if publisher.get_subscription_count() >= listeners:
                timer.cancel()
                publish()

        self._listen('valve_command', answered)
        timer = self._node.create_timer(MATCHING_PERIOD, start)

    def relay(self, topic: str) -> None:
        """Answer each state with a message on ``topic``."""
        self._listen('bundle_state', self._answer(topic))

    def join(self) -> None:
        """Answer with a valve command once all three messages of a tick have come."""
        answer, arrived = self._answer('valve_command'), dict[int, int]()

        def collect(message: Any) -> None:
            tick = message.tick
            arrived[tick] = arrived.get(tick, 0) + 1
            if arrived[tick] == len(JOINED):
                del arrived[tick]
                answer(message)

        for topic in JOINED:
            self._listen(topic, collect)

    def _publisher(self, topic: str) -> Any:
        from fam_bundle_node.qos import LOOP_PUBLISHER, REALTIME_PUBLISHER

        message_type = type(loop_message(topic, self._units))
        quality = REALTIME_PUBLISHER if self._period else LOOP_PUBLISHER
        return self._node.create_publisher(message_type, topic, quality)

    def _listen(self, topic: str, callback: Callable[[Any], None]) -> None:
        from fam_bundle_node.qos import LOOP_SUBSCRIPTION, REALTIME_SUBSCRIPTION

        message_type = type(loop_message(topic, self._units))
        quality = REALTIME_SUBSCRIPTION if self._period else LOOP_SUBSCRIPTION
        self._node.create_subscription(message_type, topic, callback, quality)

    def _answer(self, topic: str) -> Callable[[Any], None]:
        answer, publisher = loop_message(topic, self._units), self._publisher(topic)

        def publish(seen: Any) -> None:
            answer.header, answer.tick = seen.header, seen.tick
            publisher.publish(answer)

        return publish

    def spin(self) -> None:
        """Run until the last tick is answered, or until told to stop."""
        from fam_bundle_node.run import make_executor
        import rclpy

        executor = make_executor()
        executor.add_node(self._node)
        while rclpy.ok() and not self.done.done():
            # A finite wait: an unbounded one answers no signal with the events executor.
            executor.spin_until_future_complete(self.done, timeout_sec=1.0)


ROLES: dict[str, Callable[[BareNode], None]] = {
    'plant_simulator': lambda node: node.plant(LOOP_LISTENERS),
    'strain_controller': lambda node: node.relay('pressure_reference'),
    'recruitment_supervisor': lambda node: node.relay('recruitment_state'),
    'pressure_controller': lambda node: node.join(),
    'ping': lambda node: node.plant(1),
    'pong': lambda node: node.relay('valve_command'),
}


def main() -> None:
    """Take part as one role, with the process settings of the loop's nodes."""
    import rclpy
    from rclpy.executors import ExternalShutdownException

    role, (ticks, units, *timed) = sys.argv[1], map(int, sys.argv[2:])
    period, priority = timed or (0, 0)
    rclpy.init(args=[])
    node = BareNode(role, ticks, units, period)
    tune_process('realtime' if period else 'lockstep', priority)
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        node.spin()
    if node.done.done():
        node.done.result()  # raises what went wrong on the clock
        print(node.trips.report(), flush=True)
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
