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

"""What can be read of a damaged bag becomes a whole one, and nothing else is touched."""

from collections.abc import Callable
import json
from pathlib import Path
import random
import resource
import shutil
from typing import Any

import damage
from fam_bundle_io import recover
from fam_bundle_io.bag import read_bag, trace_of
from fam_bundle_io.bag_writer import BagError, Item
from fam_bundle_io.recover import look, recover_bag
from mcap.reader import make_reader
import pytest
from rosbags.rosbag2 import Reader

QOS: dict[str, Any] = {
    'history': 'keep_last',
    'depth': 2000,
    'reliability': 'reliable',
    'durability': 'transient_local',
    'deadline': {'sec': 9223372036, 'nsec': 854775807},
    'lifespan': {'sec': 9223372036, 'nsec': 854775807},
    'liveliness': 'automatic',
    'liveliness_lease_duration': {'sec': 1, 'nsec': 2},
    'avoid_ros_namespace_conventions': False,
}


@pytest.fixture
def crashed(tmp_path: Path) -> Path:
    """Return a bag as a crash leaves it: no end, no metadata.yaml."""
    topics = {name: topic._replace(qos=(QOS,)) for name, topic in damage.TOPICS.items()}
    bag = damage.write_bag(tmp_path / 'bag', topics=topics)
    (bag / 'metadata.yaml').unlink()
    file = bag / 'bag_0.mcap'
    content = file.read_bytes()
    file.write_bytes(content[: int(0.7 * len(content))])
    return bag


def contents(folder: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() for path in folder.rglob('*') if path.is_file()}


def messages_in(file: Path) -> list[Item]:
    """Return the messages of a file in its order, as the ``mcap`` package reads them."""
    with file.open('rb') as stream:
        return [
            Item(c.topic, m.log_time, m.publish_time, m.sequence, m.data)
            for _, c, m in make_reader(stream).iter_messages(log_time_order=False)
        ]


def test_what_is_whole_is_kept_to_the_last_bit_and_in_its_order(
    crashed: Path, tmp_path: Path
) -> None:
    recovery = recover_bag(crashed, tmp_path / 'out')
    messages = messages_in(tmp_path / 'out' / 'out_0.mcap')
    assert 0 < len(messages) < len(damage.ITEMS)
    assert messages == damage.ITEMS[: len(messages)]
    assert sum(topic['count'] for topic in recovery.topics.values()) == len(messages)


def test_topics_keep_type_definition_quality_and_hash(crashed: Path, tmp_path: Path) -> None:
    recover_bag(crashed, tmp_path / 'out')
    with Reader(tmp_path / 'out') as reader:
        found = {connection.topic: connection for connection in reader.connections}
    with (tmp_path / 'out' / 'out_0.mcap').open('rb') as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    channels = {channel.topic: channel for channel in summary.channels.values()}
    assert set(found) == set(channels) == set(damage.TOPICS)
    for name, topic in damage.TOPICS.items():
        assert found[name].msgtype == topic.type
        assert found[name].digest == topic.type_hash
        assert found[name].msgdef.data == topic.definition
        (quality,) = found[name].ext.offered_qos_profiles
        assert (quality.depth, quality.durability.name) == (2000, 'TRANSIENT_LOCAL')
        assert quality.liveliness_lease_duration == (1, 2)
        assert channels[name].metadata['topic_type_hash'] == topic.type_hash


def test_other_readers_find_an_index(crashed: Path, tmp_path: Path) -> None:
    recover_bag(crashed, tmp_path / 'out')
    count = len(messages_in(tmp_path / 'out' / 'out_0.mcap'))
    with Reader(tmp_path / 'out') as reader:
        assert reader.message_count == count
        assert sum(1 for _ in reader.messages()) == count
    with (tmp_path / 'out' / 'out_0.mcap').open('rb') as stream:
        summary = make_reader(stream, validate_crcs=True).get_summary()
    assert summary is not None
    assert summary.statistics is not None
    assert summary.statistics.message_count == count
    assert summary.chunk_indexes
    assert all(chunk.message_index_length for chunk in summary.chunk_indexes)


def test_the_new_bag_says_where_it_comes_from_and_what_is_lost(
    crashed: Path, tmp_path: Path
) -> None:
    before = read_bag(crashed)
    recover_bag(crashed, tmp_path / 'out')
    bag = read_bag(tmp_path / 'out')
    (warning,) = bag.warnings
    assert warning.startswith('recovered: from bag; metadata.yaml is missing')
    assert all(words in warning for words in before.warnings)
    for topic, table in before.tables.items():
        assert table.equals(bag.tables[topic])
    assert bag.records['fam_bundle.provenance'] == {'seed': '1'}
    assert json.loads(bag.records['fam_bundle.recovery']['damage']) == before.warnings
    completeness = bag.records['fam_bundle.completeness']
    assert json.loads(completeness['whole']) is False
    summary = json.loads(completeness['/bundle_state'])
    assert summary['first_tick'] == 0
    assert summary['last_tick'] == before.tables['/bundle_state']['tick'].max()
    assert summary['lost'] == summary['missing_ticks'] == 0


def test_the_damaged_bag_is_left_as_it_is(crashed: Path, tmp_path: Path) -> None:
    before = contents(crashed)
    recover_bag(crashed, tmp_path / 'out')
    assert contents(crashed) == before
    assert set(tmp_path.iterdir()) == {crashed, tmp_path / 'out'}


def test_a_chunk_that_is_lost_in_the_middle_shows_in_the_ledger(tmp_path: Path) -> None:
    bag = damage.write_bag(tmp_path / 'bag')
    file = bag / 'bag_0.mcap'
    content = bytearray(file.read_bytes())
    content[len(content) // 2 - 50 : len(content) // 2 + 50] = bytes(100)  # noqa: E203
    file.write_bytes(content)
    recovery = recover_bag(bag, tmp_path / 'out')
    state = recovery.topics['/bundle_state']
    # The numbers of the publishers tell that these ticks were published.
    assert state['missing_ticks'] == state['lost'] == damage.CHUNK
    assert state['count'] == damage.TICKS - damage.CHUNK


@pytest.mark.parametrize('kind', damage.WHOLE)
def test_a_whole_bag_has_nothing_to_recover(kind: str, tmp_path: Path) -> None:
    bag = damage.WHOLE[kind](tmp_path / 'bag')
    assert look(bag) == (len(damage.ITEMS), [])


@pytest.mark.parametrize('kind', damage.WHOLE)
def test_every_storage_is_recovered(kind: str, tmp_path: Path) -> None:
    bag = damage.WHOLE[kind](tmp_path / 'bag')
    (bag / 'metadata.yaml').unlink()
    recovery = recover_bag(bag, tmp_path / 'out')
    assert recovery.damage == ['metadata.yaml is missing or damaged']
    messages = messages_in(tmp_path / 'out' / 'out_0.mcap')
    assert [(m.topic, m.received, m.data) for m in messages] == [
        (item.topic, item.received, item.data) for item in damage.ITEMS
    ]
    whole = trace_of(read_bag(bag)).trace
    for name, values in trace_of(read_bag(tmp_path / 'out')).trace.items():
        assert values.tobytes() == whole[name].tobytes(), name


@pytest.mark.parametrize('name', [name for name in damage.CASES if ' 0' in name])
def test_no_damage_is_too_much_for_it(name: str, tmp_path: Path) -> None:
    """Either a bag that rosbags reads, or an error in one line and no folder."""
    case = damage.CASES[name]
    whole = damage.WHOLE[case.of](tmp_path / case.of)
    path = case.make(whole, tmp_path / 'bag', random.Random(name))
    try:
        recovery = recover_bag(path, tmp_path / 'out')
    except BagError as error:
        assert '\n' not in str(error)
        assert not (tmp_path / 'out').exists()
    else:
        count = sum(topic['count'] for topic in recovery.topics.values())
        with Reader(tmp_path / 'out') as reader:
            assert sum(1 for _ in reader.messages()) == count > 0
    assert not (tmp_path / 'out.part').exists()


# ---- What cannot be done leaves nothing behind ----


def assert_nothing_left(tmp_path: Path, bag: Path, before: dict[Path, bytes]) -> None:
    assert set(tmp_path.iterdir()) == {bag}
    assert contents(bag) == before


def test_a_bag_of_which_nothing_is_left(tmp_path: Path) -> None:
    bag = tmp_path / 'bag'
    bag.mkdir()
    (bag / 'bag_0.mcap').write_bytes(b'no bag')
    before = contents(bag)
    with pytest.raises(BagError, match='no messages'):
        recover_bag(bag, tmp_path / 'out')
    assert_nothing_left(tmp_path, bag, before)


def test_a_disk_that_is_full(crashed: Path, tmp_path: Path) -> None:
    before, limits = contents(crashed), resource.getrlimit(resource.RLIMIT_FSIZE)
    with pytest.raises(BagError, match=r'out: File too large'):
        resource.setrlimit(resource.RLIMIT_FSIZE, (50_000, limits[1]))
        try:
            recover_bag(crashed, tmp_path / 'out')
        finally:
            resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert_nothing_left(tmp_path, crashed, before)


def test_an_interruption(crashed: Path, tmp_path: Path, monkeypatch: Any) -> None:
    def interrupt(done: int) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr(recover, 'STEP', 1000)
    before = contents(crashed)
    with pytest.raises(KeyboardInterrupt):
        recover_bag(crashed, tmp_path / 'out', interrupt)
    assert_nothing_left(tmp_path, crashed, before)


def test_progress_rises(crashed: Path, tmp_path: Path, monkeypatch: Any) -> None:
    told: list[int] = []
    tell: Callable[[int], None] = told.append
    monkeypatch.setattr(recover, 'STEP', 100)
    recover_bag(crashed, tmp_path / 'out', tell)
    assert told == sorted(set(told))
    assert len(told) > 10


@pytest.mark.parametrize('name', ['out', 'out.part'])
def test_nothing_is_overwritten(crashed: Path, tmp_path: Path, name: str) -> None:
    (tmp_path / name).mkdir()
    (tmp_path / name / 'kept').write_text('kept')
    with pytest.raises(BagError, match=f'{name}: exists'):
        recover_bag(crashed, tmp_path / 'out')
    assert (tmp_path / name / 'kept').read_text() == 'kept'
    shutil.rmtree(tmp_path / name)
    assert_nothing_left(tmp_path, crashed, contents(crashed))
