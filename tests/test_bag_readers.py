# SPDX-License-Identifier: Apache-2.0
"""Our reader and three others decode every message of a recorded run to the same values."""

from collections.abc import Callable, Iterator
import json
from pathlib import Path
import shutil
import struct
import subprocess
from typing import Any, NamedTuple

from fam_bundle_io.bag import read_bag
from fam_bundle_model.parameters import Configuration
from mcap.reader import make_reader
from mcap_ros2.decoder import DecoderFactory
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

NPM_READER = Path(__file__).parent / 'readers' / 'read.mjs'
EACH_TICK = ('/bundle_state', '/pressure_reference', '/recruitment_state', '/valve_command')
TOPICS = {*EACH_TICK, '/lag_table', '/reference', '/loop_statistics', '/diagnostics'}
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4  # kinds of fields in rosbags' type system
DTYPES = {'f': 'float64', 'b': 'bool', 'i': 'int64', 'u': 'uint64', 'O': 'string'}
INFINITY = '7ff0000000000000'

Values = dict[str, str]  # by name, as in 'header.stamp.sec' and 'spool[0]'


class Message(NamedTuple):
    """A message: when it was received and published, if that is known, and what is in it."""

    received: int
    published: int | None
    values: Values


Messages = dict[str, list[Message]]  # by topic


@pytest.fixture
def bag(recorded_runs: Path) -> Path:
    """Return the bag of a run through the graph."""
    return recorded_runs / 'lag_pressure' / 'bag'


# ---- Values as texts that differ when a bit does ----


def text(base: str, value: Any) -> str:
    if base in ('float32', 'float64'):
        value = float(value)
        return struct.pack('>d', value).hex() if value == value else 'nan'
    if base == 'bool':
        return 'true' if value else 'false'
    return str(value) if base == 'string' else str(int(value))


def values_of(name: str, kind: Any, value: Any, types: Any) -> Iterator[tuple[str, str]]:
    """All values in the field ``name``; ``types`` has the fields of every message type."""
    if kind[0] == BASE:
        yield name, text(kind[1][0], value)
    elif kind[0] == NAME:
        for field, inner in types[kind[1]][1]:
            yield from values_of(f'{name}.{field}', inner, getattr(value, field), types)
    else:
        for index, element in enumerate(value):
            yield from values_of(f'{name}[{index}]', kind[1][0], element, types)


def message_values(message: Any, name: str, types: Any) -> Values:
    fields = types[name][1]
    return {
        inner: value
        for field, kind in fields
        for inner, value in values_of(field, kind, getattr(message, field), types)
    }


# ---- The readers ----


def types_in(bag: Path) -> Any:
    """Return the types of Jazzy, and those that the bag defines."""
    store = get_typestore(Stores.ROS2_JAZZY)
    with Reader(bag) as reader:
        for connection in reader.connections:
            store.register(get_types_from_msg(connection.msgdef.data, connection.msgtype))
    return store


def with_rosbags(bag: Path) -> Messages:
    store, found = types_in(bag), Messages()
    with Reader(bag) as reader:
        for connection, received, data in reader.messages():
            message = store.deserialize_cdr(data, connection.msgtype)
            values = message_values(message, connection.msgtype, store.fielddefs)
            found.setdefault(connection.topic, []).append(Message(received, None, values))
    return found


def with_mcap(bag: Path) -> Messages:
    types, found = types_in(bag).fielddefs, Messages()
    for file in sorted(bag.glob('*.mcap')):
        with file.open('rb') as stream:
            reader = make_reader(stream, validate_crcs=True, decoder_factories=[DecoderFactory()])
            for schema, channel, message, decoded in reader.iter_decoded_messages():
                assert schema is not None
                values = message_values(decoded, schema.name, types)
                found.setdefault(channel.topic, []).append(
                    Message(message.log_time, message.publish_time, values)
                )
    return found


def with_npm(bag: Path) -> Messages:
    if not shutil.which('node'):
        pytest.skip('node is missing: install Node.js 20 or newer and npm, then ./fam test')
    if not (NPM_READER.parent / 'node_modules').is_dir():
        pytest.skip('the npm readers are missing: install npm, then ./fam test')
    found = Messages()
    for file in sorted(bag.glob('*.mcap')):
        lines = subprocess.run(
            ['node', NPM_READER, file], capture_output=True, text=True, timeout=120.0, check=True
        ).stdout.splitlines()
        for topic, received, published, values in map(json.loads, lines):
            found.setdefault(topic, []).append(Message(int(received), int(published), values))
    return found


def with_tables(bag: Path) -> Messages:
    types, found = types_in(bag).fielddefs, Messages()
    read = read_bag(bag)
    assert read.warnings == []
    for topic, table in read.tables.items():
        rows: list[Values] = [{} for _ in range(len(table))]
        kinds = dict(types[read.types[topic]][1])
        for name in table.columns.drop(['received', 'published']):
            base = DTYPES[table[name].dtype.kind]
            for row, value in zip(rows, table[name].tolist(), strict=True):
                if name in kinds and kinds[name][0] != BASE:
                    row.update(values_of(name, kinds[name], value, types))
                else:
                    row[name] = text(base, value)
        times = zip(table['received'].tolist(), table['published'].tolist(), strict=True)
        messages = [Message(*both, values) for both, values in zip(times, rows, strict=True)]
        # The rows are in the order of the file; the other readers go by the time.
        found[topic] = sorted(messages, key=lambda message: message.received)
    return found


# ---- They agree ----


def assert_same(some: Messages, others: Messages) -> None:
    assert set(some) == set(others) == TOPICS
    for topic, messages in some.items():
        assert len(messages) == len(others[topic]), topic
        for number, (one, other) in enumerate(zip(messages, others[topic], strict=True)):
            where = f'{topic}, message {number}'
            assert one.received == other.received, where
            assert one.values == other.values, where
            if None not in (one.published, other.published):
                assert one.published == other.published, where


def test_the_tables_are_what_rosbags_decodes(bag: Path) -> None:
    assert_same(with_tables(bag), with_rosbags(bag))


def test_the_tables_are_what_mcap_decodes(bag: Path) -> None:
    assert_same(with_tables(bag), with_mcap(bag))


def test_the_tables_are_what_the_npm_readers_decode(bag: Path) -> None:
    assert_same(with_tables(bag), with_npm(bag))


def test_the_bag_has_what_is_hard_to_decode(
    bag: Path, quick: Callable[..., Configuration]
) -> None:
    """Else the readers would agree on little: values that are not finite, nested arrays, texts."""
    found = with_tables(bag)
    assert {len(found[topic]) for topic in EACH_TICK} == {quick().ticks()}
    supervisor = [message.values for message in found['/recruitment_state']]
    assert {values['time_to_saturation'] == INFINITY for values in supervisor} == {True, False}
    assert any(m.values['latency_p50'] == 'nan' for m in found['/loop_statistics'])
    assert any(m.values['state'] == 'running' for m in found['/loop_statistics'])
    assert int(found['/bundle_state'][-1].values['steady_time']) > 2**32
    table = found['/lag_table'][0].values
    points = sum(name.startswith('units[1].recruitment_lag[') for name in table)
    axes = [sum(name.startswith(axis) for name in table) for axis in ('source_', 'deslack_')]
    assert points == axes[0] * axes[1] > 100
    assert any('status[0].values[3].key' in m.values for m in found['/diagnostics'])


def test_a_change_of_one_bit_is_seen(bag: Path) -> None:
    some, others = with_tables(bag), with_tables(bag)
    values = others['/valve_command'][-1].values
    values['spool[1]'] = f'{int(values["spool[1]"], 16) ^ 1:016x}'
    with pytest.raises(AssertionError, match=r'/valve_command, message'):
        assert_same(some, others)
