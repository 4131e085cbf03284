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

"""The graph in real time under observation: nodes that can be hurt, and all that they said."""

from collections.abc import Callable, Mapping
import contextlib
import gc
import math
from pathlib import Path
import signal
import subprocess
import time
from types import TracebackType
from typing import Any, NamedTuple

from fam_bundle_bringup.graph import (
    listening,
    LOOP_LISTENERS,
    NODES,
    nodes_in,
    own_domain,
)
from fam_bundle_bringup.processes import executable
from fam_bundle_model.parameters import Configuration, write_yaml
from fam_bundle_node.stamps import nanoseconds

PACKAGES = {name: package for package, name in NODES}
PATIENCE = 60.0  # s; only a hang takes that long
SLICE = 0.02  # s
STEADY = 200  # samples in a row that make a running loop


class Seen(NamedTuple):
    """One message, and when it came (ns, steady)."""

    at: int
    message: Any


class Report(NamedTuple):
    """
    One status from /diagnostics.

    ``at`` (ns, steady) and ``at_system`` (s, system) tell when it came; ``stamp`` (s, system) is
    its own.
    """

    at: int
    at_system: float
    stamp: float
    node: str
    error: bool
    text: str
    values: Mapping[str, str]


class Rig:
    """Five nodes in real time, each a process of its own, and a listener in this process."""

    packages: Mapping[str, str] = PACKAGES
    listeners = LOOP_LISTENERS + 1  # of bundle_state
    topics = ('bundle_state', 'valve_command')  # all would cost the loop too much

    def __init__(self, configuration: Configuration, folder: Path) -> None:
        """Keep the parameters and what the nodes print in ``folder``; start nothing yet."""
        folder.mkdir(parents=True, exist_ok=True)
        self.configuration = configuration
        self.parameters = folder / 'parameters.yaml'
        write_yaml(configuration, self.parameters)
        self.nodes: dict[str, subprocess.Popen[bytes]] = {}
        self.seen: dict[str, list[Seen]] = {}
        self.reports: list[Report] = []
        self._folder = folder
        self._stack = contextlib.ExitStack()

    def __enter__(self) -> 'Rig':
        """Listen, and have no node yet."""
        try:
            self._stack.enter_context(own_domain())
            # A collection among all that was seen would hold the observer up for a tenth of a
            # second, and with it the loop, which sends again what it has not taken.
            gc.disable()
            self._stack.callback(gc.enable)
            (self.node,), self.listen = self._stack.enter_context(listening(self._observer))
            self.group = self._stack.enter_context(nodes_in(self._folder))
        except BaseException:
            self._stack.close()
            raise
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all processes."""
        self._stack.close()

    def _observer(self) -> list[Any]:
        from rclpy.node import Node

        node = Node('fault_observer')
        self._subscribe(node)
        return [node]

    def _subscribe(self, node: Any) -> None:
        from diagnostic_msgs.msg import DiagnosticArray
        from fam_bundle_node.qos import REPORTS

        self.node = node
        for topic in self.topics:
            self.watch(topic)
        node.create_subscription(DiagnosticArray, '/diagnostics', self._on_diagnostics, REPORTS)

    def watch(self, topic: str) -> None:
        """Keep what comes on ``topic`` from now on."""
        from fam_bundle_io.trace_recorder_node import TOPICS
        from fam_bundle_node.qos import RECORDER_SUBSCRIPTION

        if topic not in self.seen:
            self.node.create_subscription(
                TOPICS[topic], topic, self._keeper(topic), RECORDER_SUBSCRIPTION
            )

    def _keeper(self, topic: str) -> Callable[[Any], None]:
        kept = self.seen.setdefault(topic, [])

        def keep(message: Any) -> None:
            kept.append(Seen(time.monotonic_ns(), message))

        return keep

    def _on_diagnostics(self, array: Any) -> None:
        for status in array.status:
            node = status.name.partition(':')[0]
            values = {pair.key: pair.value for pair in status.values}
            error = status.level != status.OK and status.message != 'running'
            stamp = nanoseconds(array.header.stamp) * 1e-9
            self.reports.append(
                Report(
                    time.monotonic_ns(),
                    time.time(),
                    stamp,
                    node,
                    error,
                    status.message,
                    values,
                )
            )

    def start(
        self,
        name: str,
        environment: Mapping[str, str] | None = None,
        prefix: tuple[str, ...] = (),
        alias: str = '',
    ) -> None:
        """Start the node ``name``, behind the command ``prefix``; as ``alias`` a second one."""
        arguments = ['--ros-args', '--params-file', str(self.parameters)]
        arguments += ['-p', f'run.listeners:={self.listeners}']
        if alias:
            arguments += ['-r', f'__node:={alias}']
        command = [*prefix, executable(self.packages[name], name), *arguments]
        self.nodes[alias or name] = self.group.start(alias or name, command, environment)

    def start_all(self, environment: Mapping[str, str] | None = None) -> None:
        """Start every node and return when the loop runs in real time."""
        for name in self.packages:
            self.start(name, environment)
        self.wait_for(self.runs, 'the loop to run')

    def signal(self, name: str, number: int) -> int:
        """Send a signal to a node and return when (ns, steady)."""
        self.nodes[name].send_signal(number)
        at = time.monotonic_ns()
        if number == signal.SIGKILL:
            self.nodes[name].wait()
        return at

    def wait_for(self, true: Callable[[], bool], what: str, patience: float = PATIENCE) -> float:
        """Listen until ``true`` and return how long it took (s); raises RuntimeError if never."""
        begin = time.monotonic()
        while not true():
            if time.monotonic() - begin > patience or self.ended():
                ended = ''.join(f'; {name} ended: {self.last_line(name)}' for name in self.ended())
                waited = time.monotonic() - begin
                raise RuntimeError(f'waited {waited:.0f} s in vain for {what}{ended}')
            self.listen(SLICE)
        return time.monotonic() - begin

    def runs(self) -> bool:
        """Return whether commands have been coming and the newest samples are not safe."""
        states, commands = self.seen['bundle_state'], self.seen['valve_command']
        recent = time.monotonic_ns() - 500_000_000
        newest = [s.message for s in states[-STEADY:]]
        # Of one run: tick 0 begins another.
        one_run = len(newest) == STEADY and newest[-1].tick - newest[0].tick == STEADY - 1
        steady = one_run and not any(message.safe for message in newest)
        return bool(steady and commands and min(states[-1].at, commands[-1].at) > recent)

    def ended(self) -> list[str]:
        """Return the nodes that have ended without being killed by a signal of ours."""
        return [n for n, p in self.nodes.items() if p.poll() not in (None, -signal.SIGKILL)]

    def last_line(self, name: str) -> str:
        """Return the last line that a node printed."""
        lines = (self._folder / 'log' / f'{name}.log').read_text(errors='replace').splitlines()
        return lines[-1].strip() if lines else 'without a word'

    def vented_to(self, since: int) -> float:
        """Return the lowest that the fullest motor unit came to while safe (Pa), from then on."""
        safe = [s.message for s in self.seen['bundle_state'] if s.message.safe and s.at >= since]
        return min((max(message.mu_pressure) for message in safe), default=math.inf)

    def safe_after(self, since: int) -> float | None:
        """Return how long after ``since`` (ns, steady) the first safe sample was due (s)."""
        for sample in (s.message for s in self.seen['bundle_state']):
            if sample.safe and sample.steady_time >= since:
                return float(sample.steady_time - since) * 1e-9
        return None

    def was_safe_at(self, since: int) -> bool:
        """Return whether the last sample due before ``since`` (ns, steady) was safe."""
        states = (s.message for s in reversed(self.seen['bundle_state']))
        return next((bool(s.safe) for s in states if s.steady_time < since), False)

    def stale_but_not_safe(self, since: int, limit: float) -> int:
        """
        Return how many samples from ``since`` on (ns, steady) drove the valves on old commands.

        Those that are not safe although none of the samples of the last ``limit`` s before was
        ever answered.
        """
        answered = {s.message.tick for s in self.seen['valve_command']}
        allowed = round(limit / self.configuration.simulation.period)
        stale, newest = 0, None
        for sample in (s.message for s in self.seen['bundle_state']):
            old = newest is not None and sample.tick - newest > allowed
            stale += sample.steady_time >= since and not sample.safe and old
            if sample.tick in answered:
                newest = sample.tick
        return stale

    def first_tick_of_this_stretch(self) -> int:
        """Return the first tick since which the plant has followed commands."""
        first = int(self.seen['bundle_state'][-1].message.tick)
        for sample in reversed(self.seen['bundle_state']):
            if sample.message.safe or sample.message.tick > first:
                break
            first = int(sample.message.tick)
        return first

    def messages(self, topic: str, since: int) -> list[Any]:
        """Return what came on ``topic`` from ``since`` on (ns, steady)."""
        return [s.message for s in self.seen[topic] if since <= s.at]

    def reason(self, since: int, *words: str) -> str:
        """Return the first trouble on /diagnostics since then (ns) that holds one of ``words``."""
        for report in self.reports:
            found = any(word in report.text for word in words)
            if report.at >= since and report.error and found:
                return f'{report.node}: {report.text}'
        return ''

    def counted(self, node: str, names: tuple[str, ...]) -> int:
        """Return the newest sum of a node's counters ``names``."""
        for report in reversed(self.reports):
            if report.node == node:
                return sum(int(float(report.values[name])) for name in names)
        return 0
