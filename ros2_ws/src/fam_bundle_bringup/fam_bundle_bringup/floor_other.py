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
The relays of ``floor`` without ROS: through Unix-domain sockets, and through Cyclone DDS.

The same processes, topology and payload: what is left of a tick when the middleware goes.
"""

from collections.abc import Callable
import contextlib
import functools
import importlib
import os
import socket
import sys
import tempfile
import time
from typing import Any, TYPE_CHECKING

from fam_bundle_bringup.floor import (
    JOINED,
    loop_message,
    LOOP_ROLES,
    MATCHING_PERIOD,
    measure_ticks,
    Measured,
    MESSAGE_TYPES,
    RoundTrips,
    tune_process,
)
from fam_bundle_bringup.graph import LOOP_LISTENERS, own_domain

if TYPE_CHECKING:
    from rclpy.qos import QoSProfile

MODULE = 'fam_bundle_bringup.floor_other'
# What each role waits for, and what it then sends to whom.
TAKES = {
    'plant_simulator': ('valve_command',),
    'strain_controller': ('bundle_state',),
    'recruitment_supervisor': ('bundle_state',),
    'pressure_controller': JOINED,
}
GIVES = {
    'plant_simulator': 'bundle_state',
    'strain_controller': 'pressure_reference',
    'recruitment_supervisor': 'recruitment_state',
    'pressure_controller': 'valve_command',
}
LARGEST = 65536  # bytes that a socket takes at once
CYCLONE_WAIT = 200_000_000  # ns; nothing interrupts a wait of Cyclone DDS
# Loopback only: nobody else on the network may see it, and it must see nobody else.
CYCLONE = """<CycloneDDS><Domain>
<General>
  <Interfaces><NetworkInterface name="lo" multicast="false"/></Interfaces>
  <AllowMulticast>false</AllowMulticast>
</General>
<Discovery>
  <ParticipantIndex>auto</ParticipantIndex>
  <Peers><Peer address="127.0.0.1"/></Peers>
</Discovery>
</Domain></CycloneDDS>"""


def socket_loop(ticks: int, units: int) -> Measured:
    """
    Run ``ticks`` ticks of ``units`` motor units through datagrams of Unix-domain sockets.

    Raises RuntimeError, with the last line of a log, when one fails or the time runs out.
    """
    with tempfile.TemporaryDirectory() as folder:
        return measure_ticks(MODULE, LOOP_ROLES, ticks, units, os.environ, 'socket', folder)


def cyclone_loop(ticks: int, units: int) -> Measured:
    """
    Run ``ticks`` ticks of ``units`` motor units through Cyclone DDS, which is optional.

    Raises RuntimeError, with the last line of a log, when it is missing, when one fails or the
    time runs out.
    """
    with own_domain() as domain:
        environment = {**os.environ, 'CYCLONEDDS_URI': CYCLONE}
        return measure_ticks(MODULE, LOOP_ROLES, ticks, units, environment, 'cyclone', str(domain))


def count(trips: RoundTrips, send: Callable[[], None], receive: Callable[[], None]) -> None:
    """Send tick after tick, each when the answer of the one before has come."""
    tick = -1
    while tick < trips.last:
        tick = trips.send()
        send()
        receive()
        trips.answer(tick)


def relay(send: Callable[[], None], receive: Callable[[], None]) -> None:
    """Answer until told to stop."""
    while True:
        receive()
        send()


def take_part(
    role: str, trips: RoundTrips, send: Callable[[], None], receive: Callable[[], None]
) -> None:
    """Be ``role``: the plant ends after its last tick, the others when told to stop."""
    tune_process('lockstep')
    if role == 'plant_simulator':
        count(trips, send, receive)
    else:
        relay(send, receive)


def run_socket(role: str, trips: RoundTrips, units: int, folder: str) -> None:
    """Take part in the loop as ``role`` through sockets in ``folder``."""
    from rclpy.serialization import serialize_message

    payload = serialize_message(loop_message(GIVES[role], units))
    os.chdir(folder)  # the path of a socket may not be long
    listeners = [other for other in LOOP_ROLES if GIVES[role] in TAKES[other]]
    with contextlib.ExitStack() as stack:
        inbox, *outboxes = (
            stack.enter_context(socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM))
            for _ in (role, *listeners)
        )
        inbox.bind(role)
        for outbox, listener in zip(outboxes, listeners, strict=True):
            _connect(outbox, listener)

        def send() -> None:
            for outbox in outboxes:
                outbox.send(payload)

        def receive() -> None:
            for _ in TAKES[role]:
                inbox.recv(LARGEST)

        take_part(role, trips, send, receive)


def _connect(outbox: socket.socket, listener: str) -> None:
    """Connect once ``listener`` is there; whoever started the processes watches the time."""
    while True:
        with contextlib.suppress(FileNotFoundError, ConnectionRefusedError):
            return outbox.connect(listener)
        time.sleep(MATCHING_PERIOD)


def run_cyclone(role: str, trips: RoundTrips, units: int, domain: str) -> None:
    """
    Take part in the loop as ``role`` through Cyclone DDS.

    With a wait set, not with listeners: these were no faster, and it warns of writing in them.
    """
    from cyclonedds.core import InstanceState, ReadCondition, SampleState, ViewState, WaitSet
    from cyclonedds.domain import DomainParticipant
    from cyclonedds.pub import DataWriter
    from cyclonedds.sub import DataReader
    from cyclonedds.topic import Topic
    from fam_bundle_node.qos import LOOP_PUBLISHER, LOOP_SUBSCRIPTION

    participant, waiting = DomainParticipant(int(domain)), []
    message = idl_message(loop_message(GIVES[role], units))
    topic = Topic(participant, GIVES[role], type(message))
    writer = DataWriter(participant, topic, qos=_cyclone_qos(LOOP_PUBLISHER))
    wait_set = WaitSet(participant)
    new = ViewState.Any | InstanceState.Alive | SampleState.NotRead
    for name in TAKES[role]:
        topic = Topic(participant, name, idl_type(f'fam_bundle_msgs/{MESSAGE_TYPES[name]}'))
        reader = DataReader(participant, topic, qos=_cyclone_qos(LOOP_SUBSCRIPTION))
        waiting.append((reader, ReadCondition(reader, new)))
        wait_set.attach(waiting[-1][1])

    def send() -> None:
        writer.write(message)

    def receive() -> None:
        missing = len(waiting)
        while missing > 0:
            wait_set.wait(CYCLONE_WAIT)
            for reader, condition in waiting:
                missing -= len(reader.take(condition=condition))

    while role == 'plant_simulator' and not _all_listen(writer):
        time.sleep(MATCHING_PERIOD)
    take_part(role, trips, send, receive)


def _all_listen(writer: Any) -> bool:
    return len(writer.get_matched_subscriptions()) >= LOOP_LISTENERS


def _cyclone_qos(profile: 'QoSProfile') -> Any:
    """Return the quality of service that ``profile`` has in ROS."""
    from cyclonedds.qos import Policy, Qos
    from cyclonedds.util import duration
    from rclpy.qos import DurabilityPolicy, ReliabilityPolicy

    history = Policy.History.KeepLast(profile.depth)
    if profile.reliability == ReliabilityPolicy.RELIABLE:
        reliability = Policy.Reliability.Reliable(duration(seconds=10))
    else:
        reliability = Policy.Reliability.BestEffort
    if profile.durability == DurabilityPolicy.TRANSIENT_LOCAL:
        durability = Policy.Durability.TransientLocal
    else:
        durability = Policy.Durability.Volatile
    kept = Policy.DurabilityService(0, history, -1, -1, -1)  # for who comes late; -1: no limit
    return Qos(reliability, durability, history, kept)


@functools.cache
def idl_type(kind: str) -> Any:
    """
    Return the type of Cyclone DDS for ``kind`` in ROS, as ``double`` or ``std_msgs/Header``.

    Raises ValueError for a kind that the loop's messages do not need.
    """
    from cyclonedds.idl import make_idl_struct, types

    if kind.startswith('sequence<'):
        return types.sequence[idl_type(kind[len('sequence<') : -1])]  # noqa: E203
    if '/' in kind:
        package, name = kind.split('/')
        message_type = getattr(importlib.import_module(f'{package}.msg'), name)
        fields = message_type.get_fields_and_field_types()
        content = {field: idl_type(kind) for field, kind in fields.items()}
        return make_idl_struct(name, f'{package}.msg.{name}', content)
    python = {'boolean': bool, 'string': str, 'double': types.float64}
    if kind in python:
        return python[kind]
    if kind in ('int32', 'uint32', 'uint64', 'int64'):
        return getattr(types, kind)
    raise ValueError(f'no type of Cyclone DDS is known for {kind}')


def idl_message(message: Any) -> Any:
    """Return ``message`` of ROS as a message of Cyclone DDS; raises ValueError as idl_type."""
    content = {}
    for field, kind in message.get_fields_and_field_types().items():
        value = getattr(message, field)
        if '/' in kind:
            value = idl_message(value)
        elif kind.startswith('sequence<'):
            value = list(value)
        content[field] = value
    package = type(message).__module__.split('.')[0]
    return idl_type(f'{package}/{type(message).__name__}')(**content)


def main() -> None:
    """Take part as one role, with the process settings of the loop's nodes."""
    role, ticks, units, transport, where = sys.argv[1:]
    trips = RoundTrips(int(ticks))
    run = {'socket': run_socket, 'cyclone': run_cyclone}[transport]
    try:
        run(role, trips, int(units), where)
    except ModuleNotFoundError as error:
        if error.name != 'cyclonedds':
            raise
        sys.exit('Cyclone DDS for Python is missing: pip install cyclonedds')
    except KeyboardInterrupt:
        return
    print(trips.report(), flush=True)


if __name__ == '__main__':
    main()
