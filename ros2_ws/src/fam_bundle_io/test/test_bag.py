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

"""Bags are written and read back by independent readers, whole and damaged."""

import json
from pathlib import Path
import random
import struct
from typing import Any

from fam_bundle_io import completeness
from fam_bundle_io.bag import read_bag
from fam_bundle_io.bag_files import read_parts
from fam_bundle_io.bag_writer import BagError, BagWriter, Item, Topic
from fam_bundle_io.message_definitions import complete_definition, types_in
import numpy as np
import pytest

DEFINITION = """\
std_msgs/Header header
uint64 tick
float64 strain
bool safe
float64[] pressure
================================================================================
MSG: std_msgs/Header
builtin_interfaces/Time stamp
string frame_id
================================================================================
MSG: builtin_interfaces/Time
int32 sec
uint32 nanosec
"""
TYPE = 'some_msgs/msg/Sample'
TICKS = 3000


def store() -> Any:
    from rosbags.typesys import get_types_from_msg, get_typestore, Stores

    types = get_typestore(Stores.EMPTY)
    types.register(get_types_from_msg(DEFINITION, TYPE))
    return types


def sample(types: Any, tick: int, units: int = 2) -> bytes:
    """Return a message as rosbags serializes it, which knows nothing of our decoder."""
    make = types.types
    stamp = make['builtin_interfaces/msg/Time'](sec=tick // 1000, nanosec=tick % 1000 * 1_000_000)
    header = make['std_msgs/msg/Header'](stamp=stamp, frame_id='bundle')
    message = make[TYPE](
        header=header,
        tick=tick,
        strain=0.1 * tick,
        safe=tick % 2 == 1,
        pressure=np.arange(units) + 1e5 * tick,
    )
    return bytes(types.serialize_cdr(message, TYPE))


def write(folder: Path, ticks: int = TICKS, **options: Any) -> None:
    types, writer = store(), BagWriter(folder, **options)
    writer.add_topic(Topic('/sample', TYPE, DEFINITION, 'RIHS01_0'))
    for tick in range(ticks):
        item = Item('/sample', 10**18 + tick, 10**18 + tick - 5, tick + 1, sample(types, tick))
        writer.write(item)
    writer.close(lambda: {'some.record': {'key': 'value'}})


@pytest.fixture(scope='module')
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('bags') / 'whole'
    write(folder)
    return folder


def assert_whole(bag: Path, ticks: int = TICKS) -> None:
    found = read_bag(bag)
    table = found.tables['/sample']
    number = np.arange(ticks)
    assert found.warnings == []
    assert found.records['some.record'] == {'key': 'value'}
    assert np.array_equal(table['tick'], number)
    assert np.array_equal(table['strain'], 0.1 * number)
    assert np.array_equal(table['safe'], number % 2 == 1)
    assert np.array_equal(table['pressure[1]'], 1 + 1e5 * number)
    assert np.array_equal(table['received'] - table['published'], np.full(ticks, 5))
    assert set(table['header.frame_id']) == {'bundle'}


def test_what_is_written_is_read(bag: Path) -> None:
    assert_whole(bag)


def test_rosbags_reads_it_message_by_message(bag: Path) -> None:
    from rosbags.rosbag2 import Reader

    types = store()
    with Reader(bag) as reader:
        assert reader.message_count == TICKS
        assert reader.ros_distro == 'jazzy'
        for tick, (connection, received, data) in enumerate(reader.messages()):
            assert (connection.topic, connection.msgtype) == ('/sample', TYPE)
            assert received == 10**18 + tick
            assert types.deserialize_cdr(data, TYPE).tick == tick


def test_mcap_reads_it_message_by_message(bag: Path) -> None:
    from mcap.reader import make_reader

    types = store()
    with (bag / 'whole_0.mcap').open('rb') as file:
        messages = list(make_reader(file).iter_messages())
    assert len(messages) == TICKS
    for tick, (schema, channel, message) in enumerate(messages):
        assert (channel.topic, schema.name, schema.encoding) == ('/sample', TYPE, 'ros2msg')
        assert message.data == sample(types, tick)
        assert (message.sequence, message.publish_time) == (tick + 1, 10**18 + tick - 5)


def test_a_bag_rotates_by_size_and_is_read_as_one(tmp_path: Path) -> None:
    write(tmp_path / 'bag', 20_000, split_size=100_000)
    assert len(list((tmp_path / 'bag').glob('*.mcap'))) > 1
    assert_whole(tmp_path / 'bag', 20_000)


def test_a_bag_rotates_by_time_and_is_read_as_one(tmp_path: Path) -> None:
    types, writer = store(), BagWriter(tmp_path / 'bag', split_duration=0.5)
    writer.add_topic(Topic('/sample', TYPE, DEFINITION, 'RIHS01_0'))
    for tick in range(2000):
        time = 10**18 + 1_000_000 * tick
        writer.write(Item('/sample', time, time - 5, tick + 1, sample(types, tick)))
    writer.close(lambda: {'some.record': {'key': 'value'}})
    assert_whole(tmp_path / 'bag', 2000)
    for number in range(4):
        ticks = read_bag(tmp_path / 'bag' / f'bag_{number}.mcap').tables['/sample']['tick']
        assert list(ticks) == list(range(500 * number, 500 * number + 500))


def test_what_shaped_a_run_stands_at_the_head_of_each_file(tmp_path: Path) -> None:
    types = store()
    writer = BagWriter(tmp_path / 'bag', split_size=1, head={'some.record': {'key': 'value'}})
    writer.add_topic(Topic('/sample', TYPE, DEFINITION))
    for tick in range(20):
        writer.write(Item('/sample', tick, tick, 0, sample(types, tick)))
    writer.close()
    files = list((tmp_path / 'bag').glob('*.mcap'))
    assert len(files) == 20
    for file in files:
        content = file.read_bytes()
        file.write_bytes(content[: content.index(b'value') + 100])  # a crash soon after
        with pytest.raises(BagError, match='cut short after 0 messages'):
            read_bag(file)
        assert {'some.record': {'key': 'value'}} in list(read_parts(file))


def test_sqlite_is_read_like_mcap(bag: Path, tmp_path: Path) -> None:
    from rosbags.rosbag2 import StoragePlugin, Writer

    types = store()
    with Writer(tmp_path / 'bag', version=9, storage_plugin=StoragePlugin.SQLITE3) as writer:
        connection = writer.add_connection('/sample', TYPE, typestore=types)
        for tick in range(TICKS):
            writer.write(connection, 10**18 + tick, sample(types, tick))
    one, other = read_bag(bag).tables['/sample'], read_bag(tmp_path / 'bag').tables['/sample']
    for name in set(one) - {'published'}:
        assert one[name].equals(other[name]), name


def test_messages_of_different_layouts_keep_their_order(tmp_path: Path) -> None:
    types, writer = store(), BagWriter(tmp_path / 'bag')
    writer.add_topic(Topic('/sample', TYPE, DEFINITION))
    for tick in range(100):
        writer.write(Item('/sample', tick, tick, 0, sample(types, tick, units=1 + tick % 3)))
    writer.close()
    table = read_bag(tmp_path / 'bag').tables['/sample']
    assert list(table['tick']) == list(range(100))
    assert table['pressure[2]'].notna().sum() == 33


def test_a_folder_that_exists_is_left_alone(bag: Path) -> None:
    before = {path: path.read_bytes() for path in bag.iterdir()}
    with pytest.raises(BagError, match='exists; a bag never overwrites'):
        BagWriter(bag)
    assert {path: path.read_bytes() for path in bag.iterdir()} == before


def test_what_the_disk_cannot_take_in_time_is_dropped_and_counted(tmp_path: Path) -> None:
    writer = BagWriter(tmp_path / 'bag', memory=1000)
    writer.add_topic(Topic('/sample', TYPE, DEFINITION))
    writer.write(Item('/sample', 1, 1, 1, bytes(2000)))
    writer.write(Item('/sample', 2, 2, 2, bytes(2000)))
    assert writer.dropped == 1
    writer.close()


def test_a_full_disk_is_an_error_that_says_how_far_it_came(tmp_path: Path) -> None:
    import resource

    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.raises(BagError, match=r'bag: .* after \d+ messages'):
        resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
        try:
            write(tmp_path / 'bag', 50_000)
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)


# ---- Damaged bags ----


def test_a_file_that_is_cut_short_gives_what_is_whole(tmp_path: Path) -> None:
    write(tmp_path / 'bag', 20_000)
    path = tmp_path / 'bag' / 'bag_0.mcap'
    path.write_bytes(path.read_bytes()[: path.stat().st_size // 2])
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    found = read_bag(tmp_path / 'bag')
    ticks = found.tables['/sample']['tick']
    assert 0 < len(ticks) < 20_000
    assert np.array_equal(ticks, np.arange(len(ticks)))
    assert any('cut short' in warning or 'damaged' in warning for warning in found.warnings)
    assert any('metadata.yaml' in warning for warning in found.warnings)


@pytest.mark.parametrize('seed', range(60))
def test_a_flipped_bit_is_an_error_or_a_warning_or_changes_nothing(
    bag: Path, tmp_path: Path, seed: int
) -> None:
    chance = random.Random(seed)
    content = bytearray((bag / 'whole_0.mcap').read_bytes())
    content[chance.randrange(len(content))] ^= 1 << chance.randrange(8)
    path = tmp_path / 'bag.mcap'
    path.write_bytes(content)
    whole = read_bag(bag / 'whole_0.mcap').tables['/sample']
    try:
        found = read_bag(path)
    except BagError:
        return
    if not found.warnings:
        assert found.tables['/sample'].equals(whole)


@pytest.mark.parametrize('content', [b'', b'no bag', b'\x89MCAP0\r\n'])
def test_what_is_no_bag_is_refused_in_words(tmp_path: Path, content: bytes) -> None:
    (tmp_path / 'x.mcap').write_bytes(content)
    with pytest.raises(BagError, match='no messages'):
        read_bag(tmp_path / 'x.mcap')
    with pytest.raises(BagError, match='no such bag'):
        read_bag(tmp_path / 'y')


# ---- Definitions and completeness ----


def test_a_definition_is_complete() -> None:
    texts = {
        'a/msg/Top': 'std_msgs/Header header\nInner[] inner # b/Comment x\nstring<=5 s\n',
        'std_msgs/msg/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
        'a/msg/Inner': 'float64[3] values\nuint8 CONSTANT=3\n',
        'builtin_interfaces/msg/Time': 'int32 sec\nuint32 nanosec\n',
    }
    from rosbags.typesys import get_types_from_msg

    whole = complete_definition('a/msg/Top', texts.__getitem__)
    assert set(get_types_from_msg(whole, 'a/msg/Top')) == set(texts)
    assert types_in(texts['a/msg/Top'], 'a') == ['std_msgs/msg/Header', 'a/msg/Inner']


def test_a_tick_is_read_behind_any_frame_id() -> None:
    types = store()
    for frame in ('', 'x', 'bundle', 'a longer name'):
        make = types.types
        stamp = make['builtin_interfaces/msg/Time'](sec=1, nanosec=2)
        header = make['std_msgs/msg/Header'](stamp=stamp, frame_id=frame)
        empty = np.empty(0)
        message = make[TYPE](header=header, tick=77, strain=0.0, safe=False, pressure=empty)
        assert completeness.tick_of(bytes(types.serialize_cdr(message, TYPE))) == 77
    with pytest.raises(struct.error):
        completeness.tick_of(b'\0\1\0\0')


def test_only_what_begins_with_header_and_tick_carries_one() -> None:
    assert completeness.carries_tick(DEFINITION)
    assert not completeness.carries_tick('uint64 tick\nstd_msgs/Header header\n')


def ledger_of(
    ticks: list[int], sequences: list[int] | None = None, *, answers: bool = False
) -> dict[str, Any]:
    types, ledger = store(), completeness.TopicLedger(ticks=True, answers=answers)
    for number, tick in enumerate(ticks):
        sequence = sequences[number] if sequences else number + 1
        ledger.note(sequence, sample(types, tick))
    return ledger.summary()


def missing(**summaries: dict[str, Any]) -> list[str]:
    named = {f'/{name}': summary for name, summary in summaries.items()}
    return list(completeness.shortcomings(named, 0, {}))


def test_the_ledger_counts_gaps_repeats_and_runs() -> None:
    gap = ledger_of([0, 1, 4, 5, 7])
    assert (gap['missing_ticks'], gap['gaps']) == (3, [(2, 3), (6, 6)])
    assert missing(x=gap) == ['/x: 3 ticks without a message (2-3, 6)']
    assert json.dumps(gap)
    assert ledger_of([0, 1, 1, 0, 1])['runs'] == 2
    assert ledger_of([0, 1, 1, 2])['repeated_ticks'] == 1
    assert ledger_of([0, 1, 2], [1, 2, 5])['lost'] == 2
    assert ledger_of([0, 1, 2], [8, 9, 1])['lost'] == 0


def test_a_record_that_begins_late_or_ends_early_is_not_whole() -> None:
    whole, early = ledger_of([0, 1, 2, 3]), ledger_of([0, 1])
    assert missing(x=whole) == []
    assert missing(x=whole, y=early) == ['/y: ends with tick 1, the others with 3']
    assert missing(x=whole, y=ledger_of([2, 3])) == ['/y: begins with tick 2']
    late = ledger_of([500, 501])
    assert missing(x=late, y=late) == ['/x: begins with tick 500', '/y: begins with tick 500']
    bundles = {'/a/x': whole, '/b/x': early}
    assert not list(completeness.shortcomings(bundles, 0, {}))


def test_what_was_dropped_or_never_recorded_is_missing() -> None:
    whole = {'/x': ledger_of([0, 1, 2])}
    assert json.loads(completeness.record_of(whole, 0, {})['whole']) is True
    (words,) = completeness.shortcomings(whole, 4, {})
    assert words.startswith('4 messages dropped')
    skipped = completeness.record_of(whole, 0, {'/y': 'not recorded: no type'})
    assert json.loads(skipped['whole']) is False
    assert json.loads(skipped['missing']) == ['/y: not recorded: no type']
    for nothing in ({}, {'/x': ledger_of([])}):
        record = completeness.record_of(nothing, 0, {})
        assert json.loads(record['whole']) is False
        assert json.loads(record['missing']) == ['no message was recorded']


def test_a_sample_that_nobody_answered_is_not_missing() -> None:
    ticks = [2, 3, 6, 7, 9, 11, 13]
    summary = ledger_of(ticks, answers=True)
    assert summary['first_tick'] == 2
    record = completeness.record_of({'/valve_command': summary}, 0, {})
    assert json.loads(record['whole']) is True
    assert json.loads(record['unanswered']) == [
        '/valve_command: 7 samples were not answered (0-1, 4-5, 8, ...)'
    ]


def test_without_proof_a_missing_answer_is_missing() -> None:
    """Sequence numbers are unknown, begin anew, or tell of a loss; or the plant itself skips."""
    ticks = [0, 1, 4]
    for sequences in ([0, 0, 0], [1, 2, 0], [0, 0, 1], [7, 8, 1], [1, 2, 4]):
        summary = ledger_of(ticks, sequences, answers=True)
        assert (summary['missing_ticks'], summary['unanswered']) == (2, 0)
        assert '/x: 2 ticks without a message (2-3)' in missing(x=summary)
    assert missing(x=ledger_of([3, 4], [9, 10], answers=True)) == ['/x: begins with tick 3']
    assert missing(x=ledger_of([3, 4], [0, 0], answers=True)) == ['/x: begins with tick 3']
    assert completeness.is_answer('/left/valve_command')
    assert not completeness.is_answer('/left/bundle_state')


def test_thousands_of_gaps_are_said_in_a_line() -> None:
    for answers in (False, True):
        summaries = {'/valve_command': ledger_of(list(range(0, 4000, 2)), answers=answers)}
        record = completeness.record_of(summaries, 0, {})
        assert len(record['missing'] + record['unanswered']) < 200
