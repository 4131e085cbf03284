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
Makes bags of the loop, and damages them in some two hundred ways, always the same ones.

``CASES`` holds all ways by name; each makes one damaged bag in a folder.
"""

from collections.abc import Callable, Iterable, Iterator
import math
from pathlib import Path
import random
import shutil
import sqlite3
from typing import Any, NamedTuple

from fam_bundle_io.bag_writer import BagFolder, Item, Topic
from fam_bundle_io.message_definitions import complete_definition
from mcap.writer import CompressionType
from mcap.writer import Writer as McapWriter
import numpy as np
from rosbags.rosbag2 import CompressionFormat, CompressionMode, StoragePlugin
from rosbags.rosbag2 import Writer as RosbagsWriter
from rosbags.typesys import get_types_from_msg, get_typestore, Stores
import yaml

MESSAGES = Path(__file__).parents[2] / 'fam_bundle_msgs' / 'msg'
TICKS, CHUNK = 600, 50  # ticks of a bag, and of each of its chunks
START, PERIOD = 1_700_000_000 * 10**9, 1_000_000  # ns
TYPES = {
    '/bundle_state': 'fam_bundle_msgs/msg/BundleState',
    '/pressure_reference': 'fam_bundle_msgs/msg/PressureReference',
    '/recruitment_state': 'fam_bundle_msgs/msg/RecruitmentState',
    '/valve_command': 'fam_bundle_msgs/msg/ValveCommand',
}
OTHERS = {
    'std_msgs/msg/Header': 'builtin_interfaces/Time stamp\nstring frame_id\n',
    'builtin_interfaces/msg/Time': 'int32 sec\nuint32 nanosec\n',
}


# ---- Bags that are whole ----


def _text_of(name: str) -> str:
    return OTHERS.get(name) or (MESSAGES / f'{name.rpartition("/")[2]}.msg').read_text()


def _topics() -> dict[str, Topic]:
    found = {}
    for topic, kind in TYPES.items():
        definition = complete_definition(kind, _text_of)
        store = get_typestore(Stores.EMPTY)
        store.register(get_types_from_msg(definition, kind))
        found[topic] = Topic(topic, kind, definition, store.hash_rihs01(kind))
    return found


TOPICS = _topics()
STORE = get_typestore(Stores.EMPTY)
for _topic in TOPICS.values():
    STORE.register(get_types_from_msg(_topic.definition, _topic.type))


def number(seed: int) -> float:
    """Return a number all bits of which are in use."""
    return math.sin(seed) * 10.0 ** (seed % 13 - 6)


def message(kind: str, tick: int) -> bytes:
    """Return a message as rosbags serializes it; its numbers follow from type and tick."""
    make = STORE.types
    stamp = make['builtin_interfaces/msg/Time'](sec=tick // 1000, nanosec=tick % 1000 * PERIOD)
    header = make['std_msgs/msg/Header'](stamp=stamp, frame_id='bundle')
    values: dict[str, Any] = {'header': header, 'tick': tick}
    for index, (field, (shape, base)) in enumerate(STORE.fielddefs[kind][1]):
        value = number(tick + 1000 * index + len(kind))
        if field in values:
            continue
        if shape == 4:
            flags = base[0][1][0] == 'bool'
            values[field] = np.array([value > 0, value < 0] if flags else [value, -value])
        elif base[0] == 'bool':
            values[field] = value > 0
        else:
            # Few states of recruitment: a report counts in each of them.
            most = 20 if field == 'recruited' else 1000
            values[field] = value if base[0] == 'float64' else tick * 7 % most
    return bytes(STORE.serialize_cdr(make[kind](**values), kind))


def loop(ticks: Iterable[int] = range(TICKS), begin: int = START) -> Iterator[Item]:
    """Yield the messages of a run; no two of a topic are published at the same time."""
    for row, tick in enumerate(ticks):
        for index, (topic, kind) in enumerate(TYPES.items()):
            published = begin + row * PERIOD + index * 100_000
            yield Item(topic, published + 50_000, published, row + 1, message(kind, tick))


def with_tick(item: Item, tick: int) -> Item:
    """Return the message with another tick; all its other numbers stay."""
    at = 4 + 24  # behind the header
    rest = item.data[at + 8 :]  # noqa: E203
    return item._replace(data=item.data[:at] + tick.to_bytes(8, 'little') + rest)


ITEMS = list(loop())
# Another run a minute later, with other numbers at the same ticks.
SECOND = [
    with_tick(item, row // len(TYPES))
    for row, item in enumerate(loop(range(5000, 5000 + TICKS), START + 60 * 10**9))
]


def write_bag(
    folder: Path,
    items: Iterable[Item] = ITEMS,
    topics: dict[str, Topic] | None = None,
    split: float = 0.0,
    chunk: int = CHUNK,
) -> Path:
    """Write a bag as the recorder does, with a chunk for each ``chunk`` ticks."""
    topics = topics or TOPICS
    bag = BagFolder(folder, head={'fam_bundle.provenance': {'seed': '1'}}, split_duration=split)
    for topic in topics.values():
        bag.add_topic(topic)
    for count, item in enumerate(items):
        bag.write(item)
        if chunk and count % (chunk * len(TYPES)) == 0:
            bag.sync()
    bag.close({'fam_bundle.completeness': {'whole': 'true'}})
    return folder


def write_as_rosbag2(folder: Path, **options: Any) -> Path:
    """Write a bag as the storage plugin of rosbag2 does by default: without checksums."""
    folder.mkdir()
    name = f'{folder.name}_0.mcap'
    with (folder / name).open('wb') as file:
        options = {'compression': CompressionType.NONE, 'enable_crcs': False, **options}
        writer = McapWriter(file, chunk_size=64 * 1024, **options)
        writer.start(profile='ros2', library='libmcap 1.3.1')
        channels = {}
        for topic in TOPICS.values():
            schema = writer.register_schema(topic.type, 'ros2msg', topic.definition.encode())
            about = {'offered_qos_profiles': '', 'topic_type_hash': topic.type_hash}
            channels[topic.name] = writer.register_channel(topic.name, 'cdr', schema, about)
        for item in ITEMS:
            writer.add_message(channels[item.topic], item.received, item.data, item.published, 0)
        writer.finish()
    about = [
        {'topic_metadata': {'name': name, 'type': kind}, 'message_count': TICKS}
        for name, kind in TYPES.items()
    ]
    information = {'relative_file_paths': [name], 'topics_with_message_count': about}
    text = yaml.safe_dump({'rosbag2_bagfile_information': information})
    (folder / 'metadata.yaml').write_text(text)
    return folder


def write_with_rosbags(folder: Path, storage: StoragePlugin, mode: CompressionMode) -> Path:
    writer = RosbagsWriter(folder, version=9, storage_plugin=storage)
    writer.set_compression(mode, CompressionFormat.ZSTD)
    with writer:
        connections = {
            topic.name: writer.add_connection(
                topic.name, topic.type, msgdef=topic.definition, rihs01=topic.type_hash
            )
            for topic in TOPICS.values()
        }
        for item in ITEMS:
            writer.write(connections[item.topic], item.received, item.data)
    return folder


SQLITE, NONE = StoragePlugin.SQLITE3, CompressionMode.NONE
WHOLE: dict[str, Callable[[Path], Path]] = {
    'ours': write_bag,
    'split': lambda folder: write_bag(folder, split=0.2),
    'rosbag2': write_as_rosbag2,
    'loose': lambda folder: write_as_rosbag2(folder, use_chunking=False),
    'zstd': lambda folder: write_as_rosbag2(folder, compression=CompressionType.ZSTD),
    'sqlite': lambda folder: write_with_rosbags(folder, SQLITE, NONE),
    'sqlite.zstd': lambda folder: write_with_rosbags(folder, SQLITE, CompressionMode.FILE),
    'message': lambda folder: write_with_rosbags(folder, SQLITE, CompressionMode.MESSAGE),
}


# ---- Damage ----


def whole_bags(root: Path) -> Callable[[str], Path]:
    """Return a maker of the bags of WHOLE in ``root``, each written once."""

    def make(kind: str) -> Path:
        if not (root / kind).exists():
            WHOLE[kind](root / kind)
        return root / kind

    return make


class Case(NamedTuple):
    """
    One damaged bag: of which whole one, and how.

    ``make`` gets the whole bag's folder, one that does not exist, and a source of chance; it
    returns the damaged bag. ``items`` are all messages that were in it before. ``checked``: it was
    damaged with its checksums in place, so that no message can be wrong.
    """

    of: str
    make: Callable[[Path, Path, random.Random], Path]
    items: list[Item]
    checked: bool


CASES: dict[str, Case] = {}


def _add(
    name: str,
    of: str,
    make: Callable[[Path, Path, random.Random], Any],
    items: list[Item] | None = None,
    *,
    lies: bool = False,
) -> None:
    def made(whole: Path, folder: Path, chance: random.Random) -> Path:
        return make(whole, folder, chance) or folder

    checked = of in ('ours', 'split') and not lies
    CASES[f'{of} {name}'] = Case(of, made, ITEMS if items is None else items, checked)


def storage_of(bag: Path) -> Path:
    """Return the largest file of a bag, and of those the first."""
    files = sorted(path for path in bag.iterdir() if path.name != 'metadata.yaml')
    return max(files, key=lambda path: path.stat().st_size // 1024)


Change = Callable[[bytearray, random.Random], bytes | bytearray]


def _change(change: Change, name: str = '') -> Callable[[Path, Path, random.Random], None]:
    """Return a maker that changes the bytes of the storage, or of the file ``name``."""

    def make(whole: Path, folder: Path, chance: random.Random) -> None:
        shutil.copytree(whole, folder)
        path = folder / name if name else storage_of(folder)
        path.write_bytes(change(bytearray(path.read_bytes()), chance))

    return make


def cut(data: bytearray, chance: random.Random) -> bytearray:
    return data[: chance.randrange(len(data))]


def flip(data: bytearray, chance: random.Random, count: int = 1) -> bytearray:
    for _ in range(count):
        data[chance.randrange(len(data))] ^= 1 << chance.randrange(8)
    return data


def flip_some(data: bytearray, chance: random.Random) -> bytearray:
    return flip(data, chance, chance.randrange(2, 50))


def _block(data: bytearray, chance: random.Random) -> tuple[int, int]:
    begin = chance.randrange(len(data))
    return begin, min(len(data), begin + int(2 ** chance.uniform(0, 15)))


def zero(data: bytearray, chance: random.Random) -> bytearray:
    begin, end = _block(data, chance)
    data[begin:end] = bytes(end - begin)
    return data


def remove(data: bytearray, chance: random.Random) -> bytearray:
    begin, end = _block(data, chance)
    return data[:begin] + data[end:]


def double(data: bytearray, chance: random.Random) -> bytearray:
    begin, end = _block(data, chance)
    return data[:end] + data[begin:]


def noise(data: bytearray, chance: random.Random) -> bytearray:
    begin, end = _block(data, chance)
    data[begin:end] = chance.randbytes(end - begin)
    return data


def flip_the_end(data: bytearray, chance: random.Random) -> bytearray:
    """Flip a bit of the index or the footer."""
    return data[:-1500] + flip(data[-1500:], chance)


def flip_the_head(data: bytearray, chance: random.Random) -> bytearray:
    return flip(data[:200], chance) + data[200:]


for _of, _times in {'ours': 12, 'rosbag2': 5, 'loose': 4, 'sqlite': 6}.items():
    for _how in (cut, flip, flip_some, zero, remove, double, noise):
        for _index in range(_times):
            _add(f'{_how.__name__} {_index}', _of, _change(_how))
for _of in ('zstd', 'split', 'sqlite.zstd', 'message'):
    for _how in (cut, flip, zero, remove):
        for _index in range(2):
            _add(f'{_how.__name__} {_index}', _of, _change(_how))
for _of in ('ours', 'rosbag2', 'loose'):
    for _how in (flip_the_end, flip_the_head):
        for _index in range(4):
            _add(f'{_how.__name__} {_index}', _of, _change(_how))


# ---- metadata.yaml and the folder ----


def _yaml(change: Callable[[dict[str, Any]], Any]) -> Callable[[Path, Path, random.Random], None]:
    """Return a maker of a bag whose metadata.yaml lies."""

    def make(whole: Path, folder: Path, chance: random.Random) -> None:
        shutil.copytree(whole, folder)
        path = folder / 'metadata.yaml'
        found = yaml.safe_load(path.read_text())
        change(found['rosbag2_bagfile_information'])
        path.write_text(yaml.safe_dump(found))

    return make


def _first_topic(information: dict[str, Any]) -> dict[str, Any]:
    found: dict[str, Any] = information['topics_with_message_count'][0]
    return found


LIES: dict[str, Callable[[dict[str, Any]], Any]] = {
    'wrong file name': lambda i: i.update(relative_file_paths=['other_0.mcap']),
    'file name is a path': lambda i: i.update(relative_file_paths=['../../etc/passwd']),
    'file names are a text': lambda i: i.update(relative_file_paths='bag'),
    'no file names': lambda i: i.update(relative_file_paths=[]),
    'files twice': lambda i: i.update(relative_file_paths=2 * i['relative_file_paths']),
    'too many messages': lambda i: _first_topic(i).update(message_count=TICKS + 1),
    'too few messages': lambda i: _first_topic(i).update(message_count=1),
    'a count that is none': lambda i: _first_topic(i).update(message_count='many'),
    'wrong type': lambda i: _first_topic(i)['topic_metadata'].update(type='std_msgs/msg/Bool'),
    'wrong topic': lambda i: _first_topic(i)['topic_metadata'].update(name='/elsewhere'),
    'no topics': lambda i: i.pop('topics_with_message_count'),
    'wrong compression': lambda i: i.update(compression_mode='FILE', compression_format='zstd'),
    'wrong storage': lambda i: i.update(storage_identifier='sqlite3'),
    'wrong version': lambda i: i.update(version=99),
}
for _name, _lie in LIES.items():
    _add(f'metadata.yaml: {_name}', 'ours', _yaml(_lie))
for _name, _text in {'empty': '', 'a list': '[1, 2]', 'no YAML': '{[', 'another': 'a: 1'}.items():
    _add(
        f'metadata.yaml: {_name}',
        'split',
        _change(lambda *_, t=_text: t.encode(), 'metadata.yaml'),
    )
for _how in (cut, flip_some, noise):
    for _index in range(3):
        _add(f'metadata.yaml: {_how.__name__} {_index}', 'ours', _change(_how, 'metadata.yaml'))


def _without(name: str) -> Callable[[Path, Path, random.Random], None]:
    def make(whole: Path, folder: Path, chance: random.Random) -> None:
        shutil.copytree(whole, folder)
        (folder / name.format(folder=whole.name)).unlink()

    return make


def _beside(name: str, content: bytes) -> Callable[[Path, Path, random.Random], None]:
    def make(whole: Path, folder: Path, chance: random.Random) -> None:
        shutil.copytree(whole, folder)
        (folder / name).write_bytes(content)

    return make


def _empty(whole: Path, folder: Path, chance: random.Random) -> None:
    folder.mkdir()


def _folder_as_file(whole: Path, folder: Path, chance: random.Random) -> None:
    shutil.copytree(whole, folder)
    storage_of(folder).unlink()
    (folder / f'{whole.name}_0.mcap').mkdir()


def _alone(whole: Path, folder: Path, chance: random.Random) -> Path:
    folder.mkdir()
    return Path(shutil.copy(whole / 'split_0.mcap', folder / 'alone.mcap'))


def _mixed(whole: Path, folder: Path, chance: random.Random) -> None:
    """Two bags in one folder, described by neither."""
    shutil.copytree(whole, folder)
    (folder / 'metadata.yaml').unlink()
    other = write_bag(folder.with_name('other'), SECOND)
    shutil.copy(storage_of(other), folder / 'zzz.mcap')


_add('no metadata.yaml', 'split', _without('metadata.yaml'))
_add('first file missing', 'split', _without('{folder}_0.mcap'))
_add('second file missing', 'split', _without('{folder}_1.mcap'))
_add('last file missing', 'split', _without('{folder}_2.mcap'))
_add('only file missing', 'ours', _without('{folder}_0.mcap'))
_add('file without a byte', 'split', _change(lambda *_: b'', 'split_1.mcap'))
_add('only file without a byte', 'ours', _change(lambda *_: b''))
_add('a note beside', 'ours', _beside('notes.txt', b'a note'))
_add('a foreign bag beside', 'ours', _beside('stranger.mcap', b'\x89MCAP0\r\n'))
_add('a foreign database beside', 'ours', _beside('stranger.db3', b'SQLite format 3\0'))
_add('empty folder', 'ours', _empty)
_add('a folder as file', 'ours', _folder_as_file)
_add('one file alone', 'split', _alone, [i for i in ITEMS if i.received - START < 200_050_000])
_add('two bags in one', 'ours', _mixed, [*ITEMS, *SECOND])
_add('log of a database beside', 'sqlite', _beside('sqlite.db3-wal', b'no log'))


# ---- Definitions and messages that lie; the checksums are right ----

STATE = TYPES['/bundle_state']


def _lie(**changes: Any) -> Callable[[Path, Path, random.Random], None]:
    def make(whole: Path, folder: Path, chance: random.Random) -> None:
        topics = {**TOPICS, '/bundle_state': TOPICS['/bundle_state']._replace(**changes)}
        write_bag(folder, topics=topics)

    return make


def _definition(old: str, new: str) -> Callable[[Path, Path, random.Random], None]:
    text = TOPICS['/bundle_state'].definition
    assert old in text
    return _lie(definition=text.replace(old, new))


DEFINITIONS = {
    'fields swapped': ('float64 strain\n', 'float64 forces\n'),
    'of a smaller width': ('float64 strain\n', 'float32 strain\n'),
    'of the same width': ('float64 strain\n', 'int64 strain\n'),
    'tick of a smaller width': ('uint64 tick\n', 'uint32 tick\n'),
    'tick as number': ('uint64 tick\n', 'float64 tick\n'),
    'text for a number': ('float64 strain\n', 'string strain\n'),
    'without a field': ('float64 strain\n', '\n'),
    'with one field more': ('float64 strain\n', 'float64 strain\nfloat64 more\n'),
    'with a fixed array': ('float64[] mu_pressure', 'float64[2] mu_pressure'),
    'with a huge array': ('float64[] mu_pressure', 'float64[1000000000] mu_pressure'),
    'with texts': ('float64[] mu_pressure', 'string[] mu_pressure'),
    'of a type that is not there': ('float64 strain\n', 'Nowhere strain\n'),
    'of a type that holds itself': ('float64 strain\n', 'BundleState strain\n'),
    'of texts without end': ('float64[] mu_pressure', 'BundleState[] mu_pressure'),
    'that is no definition': ('float64 strain\n', 'float64 strain (\n'),
    'without a header': ('std_msgs/Header header', 'std_msgs/Header other'),
    'without a tick': ('uint64 tick', 'uint64 tock'),
}
for _name, (_old, _new) in DEFINITIONS.items():
    _add(f'definition {_name}', 'ours', _definition(_old, _new), lies=True)
_SHORT = TOPICS['/bundle_state'].definition[:700]
_OTHER = TOPICS['/valve_command'].definition
_add('definition empty', 'ours', _lie(definition=''), lies=True)
_add('definition cut', 'ours', _lie(definition=_SHORT), lies=True)
_add('definition of another', 'ours', _lie(definition=_OTHER), lies=True)
_add('other type of the name', 'ours', _lie(type='other_msgs/msg/BundleState'), lies=True)
_add(
    'other type',
    'ours',
    _lie(type='std_msgs/msg/Header', definition=OTHERS['std_msgs/msg/Header'], type_hash=''),
    lies=True,
)


def _data(change: Callable[[bytes], bytes], every: int = 7) -> Callable[..., None]:
    """Return a maker of a bag in which every so many messages of the plant are others."""

    def changed(item: Item) -> Item:
        wanted = item.topic == '/bundle_state' and item.sequence % every == 0
        return item._replace(data=change(item.data)) if wanted else item

    def make(whole: Path, folder: Path, chance: random.Random) -> None:
        write_bag(folder, map(changed, ITEMS))

    return make


MESSAGES_THAT_LIE: dict[str, Callable[[bytes], bytes]] = {
    'shorter': lambda data: data[:-9],
    'longer': lambda data: data + bytes(9),
    'empty': lambda data: b'',
    'of one byte': lambda data: data[:1],
    'of another encoding': lambda data: b'\0\7' + data[2:],
    'with a huge text': lambda data: data[:12] + b'\xff\xff\xff\x7f' + data[16:],
    'with a huge array': lambda data: data[:-20] + b'\xff\xff\xff\x7f' + data[-16:],
    'of bytes without sense': lambda data: bytes(range(1, 256))[: len(data)],
}
for _name, _make in MESSAGES_THAT_LIE.items():
    _add(f'messages {_name}', 'ours', _data(_make), lies=True)
    _add(f'all messages {_name}', 'ours', _data(_make, 1), lies=True)


# ---- Ticks ----


def _add_items(name: str, items: list[Item]) -> None:
    _add(name, 'ours', lambda whole, folder, chance: write_bag(folder, items), items)


def _swapped() -> list[int]:
    ticks = list(range(TICKS))
    for place in range(5, TICKS - 5, 40):
        ticks[place], ticks[place + 1] = ticks[place + 1], ticks[place]
    return ticks


_add_items('ticks with holes', list(loop([t for t in range(TICKS) if t % 50 > 3])))
_add_items(
    'ticks doubled', list(loop([t for t in range(TICKS) for _ in range(1 + (t % 50 == 9))]))
)
_add_items('ticks in another order', list(loop(_swapped())))
_add_items('ticks from the middle', list(loop(range(TICKS // 2, TICKS))))
_add_items('ticks that restart', list(loop([*range(TICKS), *range(200, TICKS)])))
LOST: dict[str, Callable[[Item], bool]] = {
    'whole': lambda item: False,
    'the plant lost': lambda i: i.topic == '/bundle_state',
    'tick 0 of one topic lost': lambda i: i.topic == '/valve_command' and i.sequence < 30,
    'tick 0 of the plant lost': lambda i: i.topic == '/bundle_state' and i.sequence < 30,
    'all of one topic lost': lambda i: i.topic == '/valve_command',
}
for _name, _lost in LOST.items():
    _second = [item for item in SECOND if not _lost(item)]
    _first = [item for item in ITEMS if not _lost(item)]
    _add_items(f'two runs, {_name}', [*ITEMS, *_second])
    _add_items(f'one run, {_name}', _first)


# ---- Databases ----


def _sql(statement: str) -> Callable[[Path, Path, random.Random], None]:
    def make(whole: Path, folder: Path, chance: random.Random) -> None:
        shutil.copytree(whole, folder)
        with sqlite3.connect(storage_of(folder)) as database:
            database.execute(statement)
        database.close()

    return make


for _statement in (
    'DROP TABLE messages',
    'DROP TABLE topics',
    'DROP TABLE message_definitions',
    'DROP TABLE schema',
    'DELETE FROM messages WHERE id % 100 = 7',
    'DELETE FROM topics WHERE id = 2',
    'UPDATE messages SET data = NULL WHERE id % 100 = 7 AND 0',
    "UPDATE messages SET data = 'text' WHERE id % 100 = 7",
    "UPDATE messages SET data = x'00010000' WHERE id % 100 = 7",
    "UPDATE messages SET timestamp = 'noon' WHERE id % 100 = 7",
    'UPDATE messages SET topic_id = 77 WHERE id % 100 = 7',
    'UPDATE messages SET topic_id = 1 + topic_id % 4 WHERE id % 100 = 7',
    "UPDATE topics SET type = 'std_msgs/msg/Nothing' WHERE id = 1",
    "UPDATE message_definitions SET encoded_message_definition = 'uint8 x' WHERE id = 1",
):
    _add(_statement, 'sqlite', _sql(_statement))
