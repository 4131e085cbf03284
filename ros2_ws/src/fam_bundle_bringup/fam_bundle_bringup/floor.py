# SPDX-License-Identifier: Apache-2.0
"""The floor of the lock-step: bare relays in the loop's topology, which compute nothing.

Same processes, topics, messages and qualities of service as the loop: what these relays need for
a tick, no controller in Python can save.
"""

import contextlib
import json
import math
import os
import sys
import tempfile
import time
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fam_bundle_bringup.graph import LOOP_LISTENERS, own_domain
from fam_bundle_bringup.processes import NodeGroup
from fam_bundle_model.parameters import ProcessParameters
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
    """Rate in ticks/s; times in s from just before a publication to the callback of its answer."""

    ticks_per_second: float
    p50: float
    p99: float
    maximum: float


def relay_loop(ticks: int, units: int) -> Measured:
    """Run ``ticks`` ticks of ``units`` motor units through the four relays.

    Raises RuntimeError, with the last line of a log, when one fails or the time runs out.
    """
    with own_domain():
        return measure_ticks(MODULE, LOOP_ROLES, ticks, units, os.environ)


def relay_ping(ticks: int, units: int) -> Measured:
    """Send ``ticks`` bundle states of ``units`` motor units to one process, which answers each.

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
    """Run ``module`` in one process per role until the first role has counted its ticks.

    Each gets its role, ``ticks``, ``units`` and ``more`` as arguments. Raises RuntimeError, with
    the last line of a log, when one fails or the time runs out.
    """
    timeout = START_TIMEOUT + TICK_TIMEOUT * ticks
    arguments = (str(ticks), str(units), *more)
    found = run_roles(module, roles, arguments, environment, timeout)
    latency = (found['latency_us'][name] * 1e-6 for name in ('p50', 'p99', 'max'))
    return Measured(found['ticks_per_second'], *latency)


def run_roles(
    module: str,
    roles: Sequence[str],
    arguments: Sequence[str],
    environment: Mapping[str, str],
    timeout: float,
) -> dict[str, Any]:
    """Run ``module`` in one process per role until the first has ended; return what it found.

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
    """Counts ticks and notes when each was sent and when its answer came."""

    def __init__(self, ticks: int) -> None:
        """Expect ``ticks`` ticks, at least 1, after those that warm up."""
        self.tick = 0
        self._ticks = ticks
        self._sent: list[int] = []
        self._answered: list[int] = []

    def send(self) -> None:
        """Note that the tick is sent now."""
        self._sent.append(time.monotonic_ns())

    def answer(self) -> bool:
        """Note that the answer has come, count the tick, and return whether another follows."""
        self._answered.append(time.monotonic_ns())
        self.tick += 1
        return self.tick < WARM_UP + self._ticks

    def report(self) -> str:
        """Return ticks/s and latencies in us as a line of JSON."""
        sent, answered = self._sent[WARM_UP:], self._answered[WARM_UP:]
        taken = sorted((end - begin) / 1e3 for begin, end in zip(sent, answered, strict=True))
        latency = {'p50': rank(taken, 0.5), 'p99': rank(taken, 0.99), 'max': taken[-1]}
        rate = self._ticks / (answered[-1] - sent[0]) * 1e9
        return json.dumps({'ticks_per_second': rate, 'latency_us': latency})


def tune_process(pace: str) -> None:
    """Give this process the settings that the loop's nodes have by default under ``pace``."""
    for warning in tune(ProcessParameters(), pace):
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

    def __init__(self, role: str, ticks: int, units: int) -> None:
        """Take part in the loop as ``role``; raises KeyError when there is no such role."""
        import rclpy
        from rclpy.task import Future

        self.done = Future()
        self.trips = RoundTrips(ticks)
        self._node = rclpy.create_node(role)
        self._units = units
        ROLES[role](self)

    def plant(self, listeners: int) -> None:
        """Publish a state once ``listeners`` listen, and the next on each answer."""
        state, trips = loop_message('bundle_state', self._units), self.trips
        publisher = self._publisher('bundle_state')

        def publish() -> None:
            state.tick = trips.tick
            trips.send()
            publisher.publish(state)

        def advance(_: Any) -> None:
            if trips.answer():
                publish()
            else:
                self.done.set_result(None)

        def start() -> None:
            if publisher.get_subscription_count() >= listeners:
                timer.cancel()
                publish()

        self._listen('valve_command', advance)
        timer = self._node.create_timer(MATCHING_PERIOD, start)

    def relay(self, topic: str) -> None:
        """Answer each state with a message on ``topic``."""
        self._listen('bundle_state', self._answer(topic))

    def join(self) -> None:
        """Answer with a valve command once all three messages of a tick have come."""
        answer, arrived = self._answer('valve_command'), 0

        def collect(message: Any) -> None:
            nonlocal arrived
            arrived += 1
            # Lock-step: no message of the next tick is sent before this one's answer.
            if arrived == len(JOINED):
                arrived = 0
                answer(message)

        for topic in JOINED:
            self._listen(topic, collect)

    def _publisher(self, topic: str) -> Any:
        from fam_bundle_node.qos import LOOP_PUBLISHER

        message_type = type(loop_message(topic, self._units))
        return self._node.create_publisher(message_type, topic, LOOP_PUBLISHER)

    def _listen(self, topic: str, callback: Callable[[Any], None]) -> None:
        from fam_bundle_node.qos import LOOP_SUBSCRIPTION

        message_type = type(loop_message(topic, self._units))
        self._node.create_subscription(message_type, topic, callback, LOOP_SUBSCRIPTION)

    def _answer(self, topic: str) -> Callable[[Any], None]:
        answer, publisher = loop_message(topic, self._units), self._publisher(topic)

        def publish(seen: Any) -> None:
            answer.header, answer.tick = seen.header, seen.tick
            publisher.publish(answer)

        return publish

    def spin(self) -> None:
        """Run until the last tick is answered, or until told to stop."""
        import rclpy

        from fam_bundle_node.run import make_executor

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

    role, ticks, units = sys.argv[1:]
    rclpy.init(args=[])
    node = BareNode(role, int(ticks), int(units))
    tune_process('lockstep')
    with contextlib.suppress(KeyboardInterrupt, ExternalShutdownException):
        node.spin()
    if node.done.done():
        print(node.trips.report(), flush=True)
    rclpy.try_shutdown()


if __name__ == '__main__':
    main()
