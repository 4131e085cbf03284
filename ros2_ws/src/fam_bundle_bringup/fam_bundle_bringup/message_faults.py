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

"""Bad messages beside the good ones."""

from collections.abc import Callable
import time
from typing import Any

from fam_bundle_bringup.rig import Rig
from fam_bundle_bringup.verdicts import (
    AFTER,
    both,
    Fault,
    HARMLESS,
    harmless_or_safe,
    IN_TIME,
    reset,
    safe_and_said,
)

FLOOD = 30  # bad messages in a row, one each millisecond
STRIKES = 3  # that are a fault


def not_finite(message: Any) -> None:
    """Make a value of a message NaN."""
    for name in ('strain', 'pressure', 'pressure_compensation'):
        if hasattr(message, name):
            setattr(message, name, float('nan'))
            return
    message.spool = [float('nan')] * len(message.spool)


def wrong_length(message: Any) -> None:
    """Give a message one motor unit too many."""
    for name in ('mu_pressure', 'spool'):
        if hasattr(message, name):
            setattr(message, name, [*getattr(message, name), 0.0])
            return
    message.recruited = 99


def replayed(message: Any) -> None:
    """Take a message back by half a second."""
    message.tick -= 500
    if hasattr(message, 'steady_time'):
        message.steady_time -= 500_000_000


def from_the_future(message: Any) -> None:
    """Put a message half a second ahead."""
    message.tick += 500


Damage = Callable[[Any], None]
DAMAGES: dict[str, Damage] = {
    'NaN': not_finite,
    'wrong length': wrong_length,
    'replayed tick': replayed,
    'future tick': from_the_future,
}


def counters(topic: str, kind: str) -> tuple[str, ...]:
    """Return the counters of the consumer that must rise, and that nothing else raises."""
    if kind in ('NaN', 'wrong length'):
        return ('refused',)
    if topic == 'valve_command':
        return ('out_of_order',) if kind == 'replayed tick' else ('refused',)
    if topic == 'bundle_state' and kind == 'future tick':
        return ('out_of_order',)
    return ('late',)


def injected(topic: str, kind: str, times: int) -> Fault:
    """Return the fault that bad messages come on ``topic`` beside the good ones."""

    def hurt(rig: Rig) -> tuple[str, bool]:
        names = counters(topic, kind)
        before = rig.counted(consumer(topic), names)
        since = inject(rig, topic, DAMAGES[kind], times)
        rig.listen(AFTER)
        counted = rig.counted(consumer(topic), names) - before
        number = f'{times} sent, {counted} counted by {consumer(topic)}'
        if times == 1:
            return both((number, counted >= 1), harmless_or_safe(rig, since, 0.5))
        reason = topic if topic != 'valve_command' else 'fault'
        if not rig.reason(since, reason):
            return both((number, counted >= times), harmless_or_safe(rig, since, 0.5))
        return both((number, True), safe_and_said(rig, since, reason), reset(rig))

    expected = f'counted; {HARMLESS}' if times == 1 else f'{HARMLESS}, or {IN_TIME} and latched'
    how = 'one' if times == 1 else f'{times} in a row'
    return Fault(f'{kind} on {topic}, {how}', expected, hurt)


def consumer(topic: str) -> str:
    """Return the node that must notice bad messages on ``topic``."""
    return 'plant_simulator' if topic == 'valve_command' else 'pressure_controller'


def inject(rig: Rig, topic: str, damage: Damage, times: int) -> int:
    """
    Publish damaged copies of the newest message; return when that was a fault (ns, steady).

    That is with the third, or with the only one.
    """
    from copy import deepcopy

    from fam_bundle_io.trace_recorder_node import TOPICS
    from fam_bundle_node.qos import LOOP_PUBLISHER

    rig.watch(topic)
    rig.wait_for(lambda: bool(rig.seen[topic]), topic)
    publisher = rig.node.create_publisher(TOPICS[topic], topic, LOOP_PUBLISHER)
    readers = rig.node.count_subscribers(topic)
    rig.wait_for(lambda: rig.seen[topic][-1].message.tick > 1000, 'ticks to replay')
    rig.wait_for(lambda: publisher.get_subscription_count() >= readers, f'readers of {topic}')
    rig.listen(0.2)
    since, base = 0, -1
    sent: set[int] = set()  # what is sent here is seen here, too
    for number in range(times):
        while (good := newest_but(rig, topic, sent)).tick == base:
            rig.listen(0.001)
        base = good.tick
        if number < STRIKES:
            since = time.monotonic_ns()
        message = deepcopy(good)
        damage(message)
        publisher.publish(message)
        sent.add(message.tick)
        rig.listen(0.001)
    return since


def newest_but(rig: Rig, topic: str, ticks: set[int]) -> Any:
    """Return the newest message whose tick is none of ``ticks``."""
    seen = reversed(rig.seen[topic])
    return next(s.message for s in seen if s.message.tick not in ticks)
