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

"""ROS node that records the topics of a bundle as a rosbag2 bag."""

from collections.abc import Callable
import dataclasses
import fnmatch
import importlib
import importlib.metadata
import json
import math
import os
from pathlib import Path
import platform
import resource
import signal
import sys
import time
from types import FrameType
from typing import Any

from fam_bundle_io.bag_writer import BagError, BagWriter, Item, Topic
from fam_bundle_io.completeness import (
    ANSWERS,
    carries_tick,
    is_answer,
    record_of,
    shortcomings,
    TopicLedger,
)
from fam_bundle_io.message_definitions import complete_definition
from fam_bundle_model.parameters import Configuration, GROUPS, ProcessParameters, yaml_text
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.declare import declare_configuration, dynamic, LARGEST
from fam_bundle_node.network import chosen_network, NOT_CHOSEN
from fam_bundle_node.parent import end_with_parent
from fam_bundle_node.tuning import tune
from rcl_interfaces.msg import FloatingPointRange, IntegerRange
import rclpy
from rclpy.callback_groups import CallbackGroup
from rclpy.clock import Clock, ClockType
from rclpy.executors import SingleThreadedExecutor
from rclpy.node import Node
from rclpy.qos import (
    DurabilityPolicy,
    HistoryPolicy,
    qos_check_compatible,
    QoSCompatibility,
    QoSProfile,
    ReliabilityPolicy,
)
from rclpy.signals import SignalHandlerOptions
from rclpy.subscription import Subscription
from rclpy.topic_endpoint_info import TopicEndpointInfo

POLL_PERIOD = 0.01  # s between two times that messages are taken
LOOK_PERIOD = 0.05  # s between two looks at what topics there are
SILENCE = 0.2  # s without a message, after which all that was published has come
DRAIN_TIMEOUT = 5.0  # s
PRIORITY_BELOW = 10  # that of the nodes of the loop
DEPTH = 10_000  # messages of a topic that may wait for this node
# The plant waits for its listeners, so this node becomes one when it has the others.
STARTS_THE_RUN = 'bundle_state'
NOBODYS = ('/rosout', '/parameter_events')  # recorded only where they are named
ANY_QUALITY = QoSProfile(  # every offer satisfies it
    history=HistoryPolicy.KEEP_LAST,
    depth=DEPTH,
    reliability=ReliabilityPolicy.BEST_EFFORT,
    durability=DurabilityPolicy.VOLATILE,
)
PARAMETERS = {
    'folder': ('', 'folder of the bag; must not exist'),
    'topics': (['*', '/diagnostics'], 'topics or patterns, relative to the namespace or absolute'),
    'split_size': (0, 'bytes after which a new file begins [B], 0: never'),
    'split_duration': (0.0, 'time after which a new file begins [s], 0: never'),
}

RANGES: dict[str, dict[str, Any]] = {
    'split_size': {'integer_range': [IntegerRange(from_value=0, to_value=2**63 - 1)]},
    'split_duration': {
        'floating_point_range': [FloatingPointRange(from_value=0.0, to_value=LARGEST)]
    },
}


class Polled(CallbackGroup):
    """Keeps its subscriptions from the executor: waking for each message would cost ten times."""

    def can_execute(self, entity: Any) -> bool:
        """Return False: nothing is for the executor."""
        return False

    def beginning_execution(self, entity: Any) -> bool:
        """Return False: nothing is executed."""
        return False

    def ending_execution(self, entity: Any) -> None:
        """Nothing was executed."""


class BagRecorder(Node):
    """Takes messages as bytes, and knows their types only to name them."""

    def __init__(self, **options: Any) -> None:
        """
        Open the bag; raises ConfigurationError for a bad parameter, BagError for a bad bag.

        ``options`` are those of a node.
        """
        super().__init__('bag_recorder', **options)
        try:
            given = self._declare()
            self.configuration = self._configuration()
            self._ledgers: dict[str, TopicLedger] = {}
            self.skipped: dict[str, str] = {}
            self._waits: dict[str, str] = {}
            self._taps: dict[str, list[Subscription]] = {}
            self._seen: dict[str, dict[tuple[int, int], None]] = {}
            self._polled = Polled()
            self.writer = BagWriter(
                Path(given['folder']),
                split_size=given['split_size'],
                split_duration=given['split_duration'],
                head={'fam_bundle.provenance': provenance(self.configuration)},
                watch=self._note,
            )
        except (ConfigurationError, BagError):
            self.destroy_node()
            raise
        self._patterns = given['topics']
        self._began = time.monotonic(), time.process_time()
        steady = Clock(clock_type=ClockType.STEADY_TIME)
        self.create_timer(LOOK_PERIOD, self.look_for_topics, clock=steady)

    def _declare(self) -> dict[str, Any]:
        given: dict[str, Any] = {}
        for name, (default, text) in PARAMETERS.items():
            value = self.declare_parameter(f'bag.{name}', default, dynamic()).value
            given[name] = checked(f'bag.{name}', value, type(default))
            # Only once the value is known to be good: ROS refuses a bad one in other words.
            ranges = RANGES.get(name, {})
            self.set_descriptor(f'bag.{name}', dynamic(description=text, read_only=True, **ranges))
        if not given['folder']:
            raise ConfigurationError("bag.folder = '': must name a folder that does not exist")
        return given

    def _configuration(self) -> Configuration | None:
        """Return the configuration of the bundle where this node was given it."""
        names = {name.partition('.')[0] for name in self._parameter_overrides}
        return declare_configuration(self, GROUPS) if names & set(GROUPS) else None

    # ---- What to record ----

    def look_for_topics(self) -> None:
        """
        Subscribe to what is new and wanted; to the plant when the rest of the loop is there.

        Also look whether what is recorded has publishers of a lower quality now.
        """
        for name, taps in self._taps.items():
            self._satisfy_all(name, taps)
        found = dict(self.get_topic_names_and_types())
        wanted = [name for name in sorted(found) if self.is_wanted(name) and self.is_offered(name)]
        wanted.sort(key=lambda name: name.endswith(STARTS_THE_RUN))
        self._waits.clear()
        for name in wanted:
            if name in self._ledgers or name in self.skipped:
                continue
            if name.endswith(STARTS_THE_RUN) and not self._has_loop_of(name):
                self._waits[name] = 'not recorded: the other topics of the loop did not come'
            else:
                self.record(name, found[name][0])

    def is_wanted(self, name: str) -> bool:
        """Return whether a pattern fits the topic ``name``."""
        space = self.get_namespace().rstrip('/')
        for pattern in self._patterns:
            whole = pattern if pattern.startswith('/') else f'{space}/{pattern}'
            if name == whole:
                return True
            nobodys = name in NOBODYS or '/_' in name  # those of an action are hidden
            if fnmatch.fnmatchcase(name, whole) and not nobodys:
                return True
        return False

    def is_offered(self, name: str) -> bool:
        """Return whether anybody publishes the topic."""
        return self.count_publishers(name) > 0

    def _has_loop_of(self, state: str) -> bool:
        space = state.removesuffix(STARTS_THE_RUN)
        loop = (f'{space}{name}' for name in ANSWERS)
        return all(name in self._ledgers or not self.is_wanted(name) for name in loop)

    def record(self, name: str, message_type: str) -> None:
        """Subscribe to a topic and write what comes."""
        try:
            package, _, message = message_type.split('/')
            python_type = getattr(importlib.import_module(f'{package}.msg'), message)
            definition = complete_definition(message_type)
        except (ImportError, AttributeError, OSError) as error:
            self._skip(name, f'not recorded: {error}')
            return
        offered = self.get_publishers_info_by_topic(name)
        topic = Topic(
            name,
            message_type,
            definition,
            str(offered[0].topic_type_hash) if offered else '',
            tuple(qos_of(offer) for offer in offered),
        )
        self._ledgers[name] = TopicLedger(ticks=carries_tick(definition), answers=is_answer(name))
        self.writer.add_topic(topic)
        self._taps[name] = [self._tap(name, python_type, quality_for(offered))]

    def _tap(self, name: str, python_type: Any, quality: QoSProfile) -> Subscription:
        return self.create_subscription(
            python_type,
            name,
            lambda message: None,
            quality,
            callback_group=self._polled,
            raw=True,
        )

    def _satisfy_all(self, name: str, taps: list[Subscription]) -> None:
        """
        Subscribe a second time, to every quality, where the first one misses a publisher.

        The first one stays, so that nothing is lost between; what comes twice is written once.
        """
        offered = self.get_publishers_info_by_topic(name)
        if all(any(satisfies(offer, tap) for tap in taps) for offer in offered):
            return
        self._seen[name] = {}
        taps.append(self._tap(name, taps[0].msg_type, ANY_QUALITY))
        self.get_logger().warning(f'{name}: a publisher of lower quality came, and is recorded')

    def _skip(self, name: str, why: str) -> None:
        self.skipped[name] = why
        self.get_logger().warning(f'{name}: {why}')

    def take_all(self) -> bool:
        """Take what has come on all topics, and return whether anything has."""
        before = self.writer.taken
        for name, taps in self._taps.items():
            for tap in taps:
                self._take(name, tap)
        return self.writer.taken > before

    def _take(self, name: str, tap: Subscription) -> None:
        seen, handle = self._seen.get(name), tap.handle
        with handle:
            while (taken := handle.take_message(tap.msg_type, True)) is not None:
                data, info = taken
                item = Item(
                    name,
                    info['received_timestamp'] or time.time_ns(),
                    info['source_timestamp'],
                    info['publication_sequence_number'] or 0,
                    data,
                )
                if seen is None or is_new(item, seen):
                    self.writer.write(item)

    def is_behind(self) -> bool:
        """
        Return whether some topic of the loop has come to an earlier tick than another.

        What was lost on the way is sent again with the middleware's next heartbeat.
        """
        ticks = {ledger.newest_tick() for ledger in self._ledgers.values()} - {None}
        return len(ticks) > 1

    def _note(self, item: Item) -> None:
        self._ledgers[item.topic].note(item.sequence, item.data)

    # ---- What the bag says of itself ----

    def close(self) -> list[str]:
        """Close the bag, return what is missing; raises BagError if the disk did not take all."""
        self.writer.close(self.records)
        return list(shortcomings(self.summaries(), self.writer.dropped, self._lacking()))

    def _lacking(self) -> dict[str, str]:
        return self.skipped | self._waits

    def summaries(self) -> dict[str, dict[str, Any]]:
        """Return what came on each topic."""
        return {name: ledger.summary() for name, ledger in self._ledgers.items()}

    def records(self) -> dict[str, dict[str, str]]:
        """Return the records of metadata that end the bag, by name."""
        found = record_of(self.summaries(), self.writer.dropped, self._lacking())
        cost = {name: f'{value:.6g}' for name, value in self.cost().items()}
        return {'fam_bundle.completeness': found, 'fam_bundle.recorder': cost}

    def cost(self) -> dict[str, float]:
        """Return what recording took: elapsed and CPU time (s), and the most memory (B)."""
        elapsed, cpu_time = self._began
        return {
            'elapsed': time.monotonic() - elapsed,
            'cpu_time': time.process_time() - cpu_time,
            'peak_memory': 1024.0 * resource.getrusage(resource.RUSAGE_SELF).ru_maxrss,
        }


def checked(name: str, value: Any, kind: type) -> Any:
    """Return the value of a parameter as a ``kind``; raises ConfigurationError in one line."""
    if kind is list:
        if not isinstance(value, list) or not value or not all(isinstance(v, str) for v in value):
            # ROS gives None for an empty list.
            raise ConfigurationError(f'{name} = {value or []}: must name at least one topic')
    elif kind is str:
        if not isinstance(value, str):
            raise ConfigurationError(f'{name} = {value}: must be text')
    else:
        numbers = (int, float) if kind is float else (int,)
        if isinstance(value, bool) or not isinstance(value, numbers):
            words = 'a number' if kind is float else 'a whole number'
            raise ConfigurationError(f'{name} = {value}: must be {words}')
        if not 0 <= value < math.inf:
            raise ConfigurationError(f'{name} = {value}: must be >= 0 and finite')
    return value


def provenance(configuration: Configuration | None) -> dict[str, str]:
    """Return what shaped a run: its parameters, where they are known, and versions."""
    versions = {
        'python': platform.python_version(),
        'rmw': rclpy.get_rmw_implementation_identifier(),
    }
    for name in ('fam_bundle_io', 'fam_bundle_msgs', 'rclpy', 'numpy', 'mcap'):
        try:
            versions[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            versions[name] = 'none'
    found = {'versions': json.dumps(versions)}
    if configuration is not None:
        found |= {
            'parameters': yaml_text(configuration),
            'parameters_hash': configuration.hash(),
            'scheme': configuration.recruitment.scheme,
            'seed': str(configuration.sensors.seed),
            'period': repr(configuration.simulation.period),
            'filters': json.dumps(
                {
                    name: getattr(configuration.recruitment, name)
                    for name in ('strain_rate_time_constant', 'force_time_constant')
                }
            ),
        }
    return found


def is_new(item: Item, seen: dict[tuple[int, int], None]) -> bool:
    """Return whether a message is not among the newest ``seen``, and note it there."""
    key = item.published, item.sequence
    new = key not in seen
    seen[key] = None
    if len(seen) > DEPTH:
        del seen[next(iter(seen))]
    return new


def satisfies(offer: TopicEndpointInfo, tap: Subscription) -> bool:
    """Return whether a subscription gets what is published with the offered quality."""
    compatible, _ = qos_check_compatible(offer.qos_profile, tap.qos_profile)
    return bool(compatible != QoSCompatibility.ERROR)


def quality_for(offered: list[TopicEndpointInfo]) -> QoSProfile:
    """Return a quality of service that every offer satisfies."""
    reliable = all(o.qos_profile.reliability == ReliabilityPolicy.RELIABLE for o in offered)
    latched = all(o.qos_profile.durability == DurabilityPolicy.TRANSIENT_LOCAL for o in offered)
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=DEPTH,
        reliability=ReliabilityPolicy.RELIABLE if reliable else ReliabilityPolicy.BEST_EFFORT,
        durability=DurabilityPolicy.TRANSIENT_LOCAL if latched else DurabilityPolicy.VOLATILE,
    )


def qos_of(offer: TopicEndpointInfo) -> dict[str, Any]:
    """Return an offered quality of service in rosbag2's words."""
    profile = offer.qos_profile
    times = {
        name: dict(
            zip(('sec', 'nsec'), divmod(getattr(profile, name).nanoseconds, 10**9), strict=True)
        )
        for name in ('deadline', 'lifespan', 'liveliness_lease_duration')
    }
    return {
        'history': profile.history.name.lower(),
        'depth': profile.depth,
        'reliability': profile.reliability.name.lower(),
        'durability': profile.durability.name.lower(),
        'deadline': times['deadline'],
        'lifespan': times['lifespan'],
        'liveliness': profile.liveliness.name.lower(),
        'liveliness_lease_duration': times['liveliness_lease_duration'],
        'avoid_ros_namespace_conventions': False,
    }


# ---- The process ----


def record_until_told(recorder: BagRecorder, told: Callable[[], bool]) -> None:
    """Record until ``told`` and until nothing has come for a moment, or the disk fails."""
    executor = SingleThreadedExecutor()
    executor.add_node(recorder)

    def record() -> bool:
        executor.spin_once(timeout_sec=0.0)
        time.sleep(POLL_PERIOD)
        return recorder.take_all()

    try:
        while not told() and not recorder.writer.failure:
            record()
        end = time.monotonic() + DRAIN_TIMEOUT
        silent = time.monotonic() + SILENCE
        while (
            not recorder.writer.failure
            and time.monotonic() < end
            and (time.monotonic() < silent or recorder.is_behind())
        ):
            if record():
                silent = time.monotonic() + SILENCE
    finally:
        executor.shutdown()


def below_the_loop(process: ProcessParameters) -> ProcessParameters:
    """
    Return how a recorder runs beside nodes that run like ``process``.

    With a priority of theirs they would starve it; with the same it would hold them up.
    """
    priority = max(process.priority - PRIORITY_BELOW, 1) if process.priority else 0
    return dataclasses.replace(process, priority=priority)


def main() -> None:
    """Record until a signal ends it: status 0, 1 when the disk failed, 2 for a bad parameter."""
    # The signal must not take the middleware away: what is under way still has to be written.
    rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
    told: list[int] = []

    def tell(number: int, frame: FrameType | None) -> None:
        told.append(number)

    for number in (signal.SIGINT, signal.SIGTERM):
        signal.signal(number, tell)
    end_with_parent()
    sys.exit(run(lambda: bool(told)))


def run(told: Callable[[], bool]) -> int:
    """Record until ``told`` and return the exit status."""
    try:
        recorder = BagRecorder()
    except (ConfigurationError, BagError) as error:
        print(f'bag_recorder: {error}', file=sys.stderr)
        return 2
    log, folder = recorder.get_logger(), recorder.writer.folder
    log.info(f'recording to {folder}')
    if not chosen_network(os.environ):
        log.warning(NOT_CHOSEN)
    if recorder.configuration is not None:
        for warning in tune(below_the_loop(recorder.configuration.process), 'realtime'):
            log.warning(warning)
    try:
        record_until_told(recorder, told)
    finally:
        try:
            missing = recorder.close()
        except BagError as error:
            log.fatal(f'{error}')
            return 1
        finally:
            rclpy.try_shutdown()
    counts = [summary['count'] for summary in recorder.summaries().values()]
    for line in missing:
        print(f'bag_recorder: {line}', file=sys.stderr)
    print(f'bag_recorder: {sum(counts)} messages of {len(counts)} topics in {folder}')
    return 0
