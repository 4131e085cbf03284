# SPDX-License-Identifier: Apache-2.0
"""The files of a bag, and the serialized messages in them as far as they can be read.

MCAP is read chunk by chunk with the ``mcap`` package, so that a file without its end gives all
that is whole; SQLite and compressed files through ``rosbags``.
"""

import sqlite3
import struct
from collections.abc import Iterator, Mapping
from io import BytesIO
from pathlib import Path
from typing import Any, BinaryIO, NamedTuple

import numpy as np
import yaml

from fam_bundle_io.bag_writer import BagError

Records = dict[str, dict[str, str]]
LARGEST_RECORD = 1 << 30  # bytes; a damaged length would ask for more than there is memory

# In a chunk every record begins with its opcode and length; then a message has the number of its
# channel, its own number, both its times, and its data.
HEAD = struct.Struct('<BQ')
MESSAGE_HEAD = np.dtype(
    [
        ('opcode', 'u1'),
        ('length', '<u8'),
        ('channel', '<u2'),
        ('sequence', '<u4'),
        ('received', '<u8'),
        ('published', '<u8'),
    ]
)
CHANNEL_NUMBER = struct.Struct('<H')
BATCH = 50_000  # messages


class Messages(NamedTuple):
    """Messages of one topic and one size.

    ``numbers`` (n) is their order in the bag, ``received`` and ``published`` (n) are times of the
    system clock (ns), ``data`` (n, size) their bytes.
    """

    topic: str
    type: str
    definition: str
    numbers: np.ndarray
    received: np.ndarray
    published: np.ndarray
    data: np.ndarray


class Damage(NamedTuple):
    """What could not be read, in words."""

    words: str


def read_parts(path: Path) -> Iterator[Messages | Records | Damage]:
    """Yield what is in the bag at ``path``, a folder or one file: messages, records, damage.

    Raises BagError when there is no bag.
    """
    information, files = _found(path)
    if not information and path.is_dir():
        yield Damage('metadata.yaml is missing or damaged')
    for file in files:
        if not file.is_file():
            yield Damage(f'{file.name} is missing')
    files = [file for file in files if file.is_file()]
    compressed = str(information.get('compression_mode') or 'none').lower() != 'none'
    if compressed or any(file.suffix != '.mcap' for file in files):
        yield from _read_with_rosbags(path if path.is_dir() else path.parent)
        return
    count = 0
    for file in files:
        mcap = _Mcap(file, count)
        yield from mcap.read()
        count = mcap.count


def _found(path: Path) -> tuple[dict[str, Any], list[Path]]:
    """Return what metadata.yaml says, nothing if it cannot be read, and the files of the bag."""
    if path.is_file():
        return {}, [path]
    if not path.is_dir():
        raise BagError(f'{path}: no such bag')
    try:
        found = yaml.safe_load((path / 'metadata.yaml').read_text())
        information = dict(found['rosbag2_bagfile_information'])
        files = [path / Path(str(name)).name for name in information['relative_file_paths']]
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        information, files = {}, []
    files = files or sorted(p for p in path.iterdir() if {'.mcap', '.db3'} & set(p.suffixes))
    if not files:
        raise BagError(f'{path}: holds no .mcap and no .db3 file')
    return information, files


# ---- MCAP ----


class _Mcap:
    """Schemas and channels of a file as they come, and the messages in its chunks."""

    def __init__(self, path: Path, count: int) -> None:
        self.path, self.count = path, count
        self.schemas: dict[int, Any] = {}
        self.channels: dict[int, Any] = {}

    def read(self) -> Iterator[Messages | Records | Damage]:
        """Yield what is in the file until its end, or until it cannot be read any further."""
        from mcap.exceptions import McapError
        from mcap.records import Channel, Chunk, Message, Metadata, Schema

        begin = self.count
        with self.path.open('rb') as file:
            try:
                for record in _records(file):
                    if isinstance(record, Schema | Channel):
                        self.note(record)
                    elif isinstance(record, Metadata):
                        yield {record.name: dict(record.metadata)}
                    elif isinstance(record, Chunk):
                        yield from self.whole_parts(record)
                    elif isinstance(record, Message):
                        yield Damage(f'{self.path.name}: a message outside a chunk is not read')
            except (McapError, ValueError, OSError, EOFError, struct.error) as error:
                after = f'after {self.count - begin} messages'
                yield Damage(f'{self.path.name}: cut short {after}: {_short(error)}')

    def whole_parts(self, chunk: Any) -> list[Messages | Damage]:
        """Return the messages in a chunk, none of them if it is damaged."""
        count = self.count
        try:
            return list(self.parts(_data_of(chunk)))
        except Exception as error:  # of whatever decompresses damaged data
            self.count = count
            return [Damage(f'{self.path.name}: a chunk is damaged: {_short(error)}')]

    def parts(self, data: bytes) -> Iterator[Messages | Damage]:
        """Yield the messages in the data of a chunk, by topic and size."""
        from mcap.data_stream import ReadDataStream
        from mcap.opcode import Opcode
        from mcap.records import Channel, Schema

        offsets: dict[tuple[int, int], list[int]] = {}
        numbers: dict[tuple[int, int], list[int]] = {}
        at, head, channel_number = 0, HEAD.unpack_from, CHANNEL_NUMBER.unpack_from
        while at < len(data):
            opcode, length = head(data, at)
            if at + HEAD.size + length > len(data):
                raise ValueError('a record is longer than its chunk')
            if opcode == Opcode.MESSAGE:
                key = (channel_number(data, at + HEAD.size)[0], length)
                offsets.setdefault(key, []).append(at)
                numbers.setdefault(key, []).append(self.count)
                self.count += 1
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                stream = ReadDataStream(BytesIO(data[at + HEAD.size :]))
                self.note(Schema.read(stream) if opcode == Opcode.SCHEMA else Channel.read(stream))
            at += HEAD.size + length
        raw = np.frombuffer(data, 'u1')
        for (channel, length), starts in offsets.items():
            yield self.messages(
                channel, raw, np.array(starts), length, np.array(numbers[channel, length])
            )

    def note(self, record: Any) -> None:
        """Note a schema or a channel."""
        from mcap.records import Schema

        (self.schemas if isinstance(record, Schema) else self.channels)[record.id] = record

    def messages(
        self, number: int, raw: np.ndarray, starts: np.ndarray, length: int, numbers: np.ndarray
    ) -> Messages | Damage:
        """Return the messages of a channel that lie at ``starts`` in ``raw``."""
        channel = self.channels.get(number)
        schema = self.schemas.get(channel.schema_id) if channel else None
        if channel is None or schema is None:
            return Damage(f'{self.path.name}: {len(starts)} messages of an unknown channel')
        if channel.message_encoding != 'cdr' or schema.encoding != 'ros2msg':
            encoding = f'{channel.message_encoding}, {schema.encoding}'
            return Damage(f'{channel.topic}: {len(starts)} messages in {encoding}: not read')
        whole = raw[starts[:, None] + np.arange(HEAD.size + length)]
        heads = np.ascontiguousarray(whole[:, : MESSAGE_HEAD.itemsize]).view(MESSAGE_HEAD)[:, 0]
        return Messages(
            channel.topic,
            schema.name,
            schema.data.decode(errors='replace'),
            numbers,
            heads['received'].astype(np.int64),
            heads['published'].astype(np.int64),
            whole[:, MESSAGE_HEAD.itemsize :],
        )


def _short(error: Exception) -> str:
    return f'{type(error).__name__} {error}'.strip()[:120]


def _data_of(chunk: Any) -> bytes:
    from mcap.stream_reader import get_chunk_data_stream

    if chunk.uncompressed_size > LARGEST_RECORD:
        raise ValueError(f'it says that it holds {chunk.uncompressed_size} bytes')
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    return bytes(stream.read(length))


def _records(file: BinaryIO) -> Iterator[Any]:
    """Yield the records of a file that matter here, until the index that ends it."""
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, Message, Metadata, Schema
    from mcap.stream_reader import read_magic

    readers: Mapping[int, Any] = {
        Opcode.SCHEMA: Schema.read,
        Opcode.CHANNEL: Channel.read,
        Opcode.CHUNK: Chunk.read,
        Opcode.METADATA: Metadata.read,
    }
    stream = ReadDataStream(file)
    read_magic(stream)
    while True:
        opcode, length = HEAD.unpack(stream.read(HEAD.size))
        if length > LARGEST_RECORD:
            raise ValueError(f'a record says that it has {length} bytes')
        if opcode == Opcode.DATA_END:
            return
        if opcode == Opcode.MESSAGE:
            yield Message.read(stream, length)
        elif opcode in readers:
            end = file.tell() + length
            yield readers[opcode](stream)
            file.seek(end)
        else:
            file.seek(length, 1)


# ---- All other storage ----


Waiting = dict[tuple[int, int], list[tuple[int, int, bytes]]]  # by connection and size


def _read_with_rosbags(folder: Path) -> Iterator[Messages | Damage]:
    from rosbags.rosbag2 import Reader, ReaderError

    count, waiting = 0, Waiting()
    connections: dict[int, Any] = {}
    try:
        with Reader(folder) as reader:
            for connection, received, data in reader.messages():
                connections[connection.id] = connection
                found = waiting.setdefault((connection.id, len(data)), [])
                found.append((count, received, bytes(data)))
                count += 1
                if count % BATCH == 0:
                    yield from _taken(waiting, connections)
    except (ReaderError, ValueError, OSError, KeyError, TypeError, sqlite3.Error) as error:
        yield Damage(f'{folder.name}: cut short after {count} messages: {_short(error)}')
    yield from _taken(waiting, connections)


def _taken(waiting: Waiting, connections: Mapping[int, Any]) -> Iterator[Messages]:
    for (identity, size), found in waiting.items():
        connection = connections[identity]
        numbers, received, data = zip(*found, strict=True)
        times = np.array(received, dtype=np.int64)
        yield Messages(
            connection.topic,
            connection.msgtype,
            connection.msgdef.data,
            np.array(numbers),
            times,
            times,
            np.frombuffer(b''.join(data), 'u1').reshape(-1, size),
        )
    waiting.clear()
