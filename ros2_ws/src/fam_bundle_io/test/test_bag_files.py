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

"""Bags of other writers, compressed or not, whole or damaged, give the same tables."""

from collections.abc import Callable, Iterator
import math
from pathlib import Path
import random
import shutil
import sqlite3
from typing import Any

from fam_bundle_io.bag import read_bag
from fam_bundle_io.bag_writer import BagError
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
import numpy as np
import pandas as pd
import pytest
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin, Writer
from rosbags.typesys import get_typestore, Stores
import yaml

STORE = get_typestore(Stores.ROS2_JAZZY)
WRENCH, TEXT = 'geometry_msgs/msg/WrenchStamped', 'std_msgs/msg/String'
TOPICS = {'/wrench': WRENCH, '/text': TEXT}
COUNT = 3000  # messages of each topic
START = 10**18  # ns


def number_at(index: int) -> float:
    """Return a number whose bits are all in use."""
    return math.sin(index) * 10.0 ** (index % 40 - 20)


def text_at(index: int) -> str:
    return 'x' * (index % 7)


def messages(count: int = COUNT) -> Iterator[tuple[str, int, bytes]]:
    """Topic, time and bytes of both topics in turn; texts are of different lengths."""
    make = STORE.types
    for index in range(count):
        stamp = make['builtin_interfaces/msg/Time'](sec=index, nanosec=7 * index)
        header = make['std_msgs/msg/Header'](stamp=stamp, frame_id='bundle')
        force = make['geometry_msgs/msg/Vector3'](x=number_at(index), y=-0.0, z=float('inf'))
        wrench = make['geometry_msgs/msg/Wrench'](force=force, torque=force)
        message = make[WRENCH](header=header, wrench=wrench)
        yield '/wrench', START + 2 * index, bytes(STORE.serialize_cdr(message, WRENCH))
        text = make[TEXT](data=text_at(index))
        yield '/text', START + 2 * index + 1, bytes(STORE.serialize_cdr(text, TEXT))


def assert_beginning(tables: dict[str, pd.DataFrame], least: int = 0) -> None:
    """Assert that the tables hold the first messages without a gap, to the last bit."""
    for topic, first in (('/wrench', START), ('/text', START + 1)):
        table = tables.get(topic, pd.DataFrame())
        count = len(table)
        assert count >= least
        if not count:
            continue
        index = np.arange(count)
        assert np.array_equal(table['received'], first + 2 * index)
        if topic == '/text':
            assert list(table['data']) == [text_at(i) for i in range(count)]
        else:
            assert np.array_equal(table['header.stamp.nanosec'], 7 * index)
            for name in ('wrench.force.x', 'wrench.torque.x'):
                wanted = np.array([number_at(i) for i in range(count)])
                assert table[name].to_numpy().tobytes() == wanted.tobytes()
            assert np.all(np.signbit(table['wrench.force.y']))
            assert np.all(table['wrench.force.z'] == np.inf)


def without_doubt(warnings: list[str]) -> list[str]:
    """Most of these bags carry no checksums, and reading says so."""
    return [words for words in warnings if 'carry no checksum' not in words]


def assert_whole(path: Path) -> None:
    bag = read_bag(path)
    assert without_doubt(bag.warnings) == []
    assert bag.types == TOPICS
    assert_beginning(bag.tables, least=COUNT)
    assert [len(table) for table in bag.tables.values()] == [COUNT, COUNT]


# ---- Bags as rosbags writes them ----

MCAP, SQLITE = StoragePlugin.MCAP, StoragePlugin.SQLITE3
NONE, FILE, MESSAGE = CompressionMode.NONE, CompressionMode.FILE, CompressionMode.MESSAGE
KINDS = {
    f'{storage.name}-{mode.name}'.lower(): (storage, mode)
    for storage in (MCAP, SQLITE)
    for mode in (NONE, FILE, MESSAGE)
}
KINDS['mcap-storage'] = (MCAP, CompressionMode.STORAGE)  # its chunks

Maker = Callable[[str], Path]


@pytest.fixture(scope='module')
def made(tmp_path_factory: pytest.TempPathFactory) -> Maker:
    """Return a maker of one bag of each kind, written once."""
    bags: dict[str, Path] = {}

    def make(kind: str) -> Path:
        if kind not in bags:
            folder = tmp_path_factory.mktemp('bags') / 'bag'
            storage, mode = KINDS[kind]
            writer = Writer(folder, version=9, storage_plugin=storage)
            writer.set_compression(mode, CompressionFormat.ZSTD)
            with writer:
                connections = {
                    topic: writer.add_connection(topic, name, typestore=STORE)
                    for topic, name in TOPICS.items()
                }
                for topic, time, data in messages():
                    writer.write(connections[topic], time, data)
            bags[kind] = folder
        return bags[kind]

    return make


@pytest.mark.parametrize('kind', KINDS)
def test_every_storage_and_compression_gives_the_same_tables(made: Maker, kind: str) -> None:
    assert_whole(made(kind))


@pytest.mark.parametrize('kind', KINDS)
def test_a_bag_needs_no_description_of_itself(made: Maker, tmp_path: Path, kind: str) -> None:
    (file,) = (path for path in made(kind).iterdir() if path.name != 'metadata.yaml')
    assert_whole(file)
    shutil.copy(file, tmp_path)
    bag = read_bag(tmp_path)
    assert without_doubt(bag.warnings) == ['metadata.yaml is missing or damaged']
    assert_beginning(bag.tables, least=COUNT)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('share', [0.3, 0.9])
def test_a_file_that_is_cut_short_gives_its_beginning(
    made: Maker, tmp_path: Path, kind: str, share: float
) -> None:
    bag = tmp_path / 'bag'
    shutil.copytree(made(kind), bag)
    (file,) = (path for path in bag.iterdir() if path.name != 'metadata.yaml')
    content = file.read_bytes()
    file.write_bytes(content[: int(share * len(content))])
    try:
        found = read_bag(bag)
    except BagError as error:  # the first chunk is larger than what is left
        assert 'cut short' in str(error) or 'damaged' in str(error)
        return
    assert any('cut short' in words for words in found.warnings)
    assert_beginning(found.tables)


@pytest.mark.parametrize('kind', KINDS)
@pytest.mark.parametrize('seed', range(20))
def test_damage_anywhere_is_said_in_words(
    made: Maker, tmp_path: Path, kind: str, seed: int
) -> None:
    chance = random.Random(seed)
    (file,) = (path for path in made(kind).iterdir() if path.name != 'metadata.yaml')
    content = bytearray(file.read_bytes())
    for _ in range(8):
        content[chance.randrange(len(content))] = chance.randrange(256)
    (tmp_path / file.name).write_bytes(content)
    try:
        warnings = read_bag(tmp_path / file.name).warnings
    except BagError as error:
        warnings = [str(error)]
    assert all('\n' not in words for words in warnings)


def test_one_file_of_several_is_read_alone(made: Maker, tmp_path: Path) -> None:
    (file,) = made('sqlite3-none').glob('*.db3')
    for number in range(3):
        shutil.copy(file, tmp_path / f'bag_{number}.db3')
    assert_whole(tmp_path / 'bag_1.db3')
    assert len(read_bag(tmp_path).tables['/text']) == 3 * COUNT


# ---- SQLite ----


def test_what_a_crash_left_beside_the_database_is_read(made: Maker, tmp_path: Path) -> None:
    """With rosbag2's preset ``resilient`` a write-ahead log has what is not in the file yet."""
    (file,) = made('sqlite3-none').glob('*.db3')
    running, crashed = tmp_path / 'running', tmp_path / 'crashed'
    running.mkdir()
    database = sqlite3.connect(running / 'bag_0.db3')
    database.execute('PRAGMA journal_mode=WAL')
    with sqlite3.connect(file) as source:
        for statement in source.iterdump():
            if 'sqlite_stat' not in statement:
                database.execute(statement)
    source.close()
    database.commit()
    shutil.copytree(running, crashed)
    database.close()
    assert (crashed / 'bag_0.db3-wal').stat().st_size > 0
    assert_whole(crashed / 'bag_0.db3')


def test_reading_a_database_leaves_nothing_beside_it(made: Maker, tmp_path: Path) -> None:
    (file,) = made('sqlite3-none').glob('*.db3')
    shutil.copy(file, tmp_path)
    with sqlite3.connect(tmp_path / file.name) as database:
        database.execute('PRAGMA journal_mode=WAL')
    database.close()
    before = {path: path.read_bytes() for path in tmp_path.iterdir()}
    assert_whole(tmp_path / file.name)
    assert {path: path.read_bytes() for path in tmp_path.iterdir()} == before


def test_a_serialization_that_is_not_known_is_named(made: Maker, tmp_path: Path) -> None:
    (file,) = made('sqlite3-none').glob('*.db3')
    shutil.copy(file, tmp_path)
    with sqlite3.connect(tmp_path / file.name) as database:
        database.execute("UPDATE topics SET serialization_format = 'json' WHERE name = '/text'")
    database.close()
    bag = read_bag(tmp_path / file.name)
    assert without_doubt(bag.warnings) == ['/text: messages in json are not read']
    assert list(bag.tables) == ['/wrench']


# ---- Bags as rosbag2's own writer makes them: rosbag2_storage_mcap, mcap_storage.cpp ----

QOS = [
    {'history': 'keep_last', 'depth': 2000, 'reliability': 'reliable', 'durability': 'volatile'}
]
PRESETS: dict[str, dict[str, Any]] = {
    'none': {'compression': CompressionType.NONE, 'enable_crcs': False},
    'fastwrite': {'use_chunking': False, 'enable_crcs': False},
    'zstd_fast': {'compression': CompressionType.ZSTD, 'enable_crcs': False},
    'zstd_small': {'compression': CompressionType.ZSTD, 'chunk_size': 4 * 1024 * 1024},
}


def write_as_rosbag2(folder: Path, preset: str, count: int = COUNT) -> None:
    """Write a bag of Jazzy: sequence 0, the definition of ROS 2, its metadata twice."""
    folder.mkdir()
    name = f'{folder.name}_0.mcap'
    with (folder / name).open('wb') as file:
        writer = McapWriter(file, **PRESETS[preset])
        writer.start(profile='ros2', library='libmcap 1.3.1')
        writer.add_metadata('rosbag2', {'serialized_metadata': yaml.safe_dump({})})
        channels = {}
        for topic, kind in TOPICS.items():
            definition, _ = STORE.generate_msgdef(kind, ros_version=2)
            schema = writer.register_schema(kind, 'ros2msg', definition.encode())
            about = {
                'offered_qos_profiles': yaml.safe_dump(QOS),
                'topic_type_hash': STORE.hash_rihs01(kind),
            }
            channels[topic] = writer.register_channel(topic, 'cdr', schema, about)
        for topic, time, data in messages(count):
            writer.add_message(channels[topic], time, data, time - 5, sequence=0)
        information = rosbag2_information(name, count)
        writer.add_metadata('rosbag2', {'serialized_metadata': yaml.safe_dump(information)})
        writer.finish()
    whole = {'rosbag2_bagfile_information': information}
    (folder / 'metadata.yaml').write_text(yaml.safe_dump(whole, sort_keys=False))


def rosbag2_information(name: str, count: int) -> dict[str, Any]:
    """Return what rosbag2_storage/yaml.hpp encodes in version 9."""
    extent = {
        'starting_time': {'nanoseconds_since_epoch': START},
        'duration': {'nanoseconds': 2 * count - 1},
        'message_count': 2 * count,
    }
    return {
        'version': 9,
        'storage_identifier': 'mcap',
        **extent,
        'topics_with_message_count': [
            {
                'topic_metadata': {
                    'name': topic,
                    'type': kind,
                    'serialization_format': 'cdr',
                    'offered_qos_profiles': QOS,
                    'type_description_hash': STORE.hash_rihs01(kind),
                },
                'message_count': count,
            }
            for topic, kind in TOPICS.items()
        ],
        'compression_format': '',
        'compression_mode': '',
        'relative_file_paths': [name],
        'files': [{'path': name, **extent}],
        'custom_data': {},
        'ros_distro': 'jazzy',
    }


@pytest.mark.parametrize('preset', PRESETS)
def test_every_preset_of_rosbag2_gives_the_same_tables(tmp_path: Path, preset: str) -> None:
    write_as_rosbag2(tmp_path / 'bag', preset)
    assert_whole(tmp_path / 'bag')
    bag = read_bag(tmp_path / 'bag')
    for table in bag.tables.values():
        assert np.all(table['received'] - table['published'] == 5)
    recorded = yaml.safe_load(bag.records['rosbag2']['serialized_metadata'])
    assert recorded['message_count'] == 2 * COUNT


def test_messages_outside_of_chunks_are_whole_up_to_where_the_file_ends(tmp_path: Path) -> None:
    write_as_rosbag2(tmp_path / 'bag', 'fastwrite', count=30)
    whole = (tmp_path / 'bag/bag_0.mcap').read_bytes()
    file = tmp_path / 'cut.mcap'
    counts = []
    for size in range(len(whole) // 2, len(whole), 31):
        file.write_bytes(whole[:size])
        bag = read_bag(file)
        assert_beginning(bag.tables)
        counts.append(sum(len(table) for table in bag.tables.values()))
        assert bag.warnings or counts[-1] == 60
    assert counts == sorted(counts)
    assert counts[0] < 60 == counts[-1]
