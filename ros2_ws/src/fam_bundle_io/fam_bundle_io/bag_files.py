# SPDX-License-Identifier: Apache-2.0
"""The files of a bag, and the serialized messages in them as far as they can be read.

Each file is read by itself: one without its end, or without ``metadata.yaml``, gives all that is
whole. MCAP is read chunk by chunk with the ``mcap`` package, SQLite with Python's own. Either may
be compressed with zstd, the whole file or each message.
"""

import contextlib
import sqlite3
import struct
import tempfile
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
LOOSE = 1 << 20  # bytes of messages outside of chunks that are taken together
BATCH = 50_000  # messages that are taken together out of a database
# What files begin with; a message in CDR begins with 0.
ZSTD, SQLITE = b'\x28\xb5\x2f\xfd', b'SQLite format 3\0'


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
    files, described = _files_of(path)
    if not described:
        yield Damage('metadata.yaml is missing or damaged')
    count, told = 0, set[str]()
    for file in files:
        if not file.is_file():
            yield Damage(f'{file.name} is missing')
            continue
        for part in _read_file(file, count):
            if isinstance(part, Messages):
                count = max(count, int(part.numbers[-1]) + 1)
            elif isinstance(part, Damage):
                if part.words in told:
                    continue
                told.add(part.words)
            yield part


def _files_of(path: Path) -> tuple[list[Path], bool]:
    """Return the files of the bag, and False if its folder does not describe them."""
    if path.is_file():
        return [path], True
    if not path.is_dir():
        raise BagError(f'{path}: no such bag')
    try:
        found = yaml.safe_load((path / 'metadata.yaml').read_text())
        names = found['rosbag2_bagfile_information']['relative_file_paths']
        files = [path / Path(str(name)).name for name in names]
    except (OSError, ValueError, TypeError, KeyError, yaml.YAMLError):
        files = []
    described = bool(files)
    files = files or sorted(p for p in path.iterdir() if {'.mcap', '.db3'} & set(p.suffixes))
    if not files:
        raise BagError(f'{path}: holds no .mcap and no .db3 file')
    return files, described


def _read_file(file: Path, first: int) -> Iterator[Messages | Records | Damage]:
    """Yield what is in a file; its messages are numbered from ``first``."""
    with tempfile.TemporaryDirectory() as folder:
        plain = file
        if _begins_with(file, ZSTD):
            plain = Path(folder, file.stem)
            yield from _decompress(file, plain)
        storage = _read_sqlite if _begins_with(plain, SQLITE) else _read_mcap
        for part in storage(plain, first):
            if isinstance(part, Messages) and part.data[0, : len(ZSTD)].tobytes() == ZSTD:
                yield from _decompressed(part)
            else:
                yield part


def _begins_with(file: Path, mark: bytes) -> bool:
    with file.open('rb') as stream:
        return stream.read(len(mark)) == mark


def _short(error: Exception) -> str:
    return f'{type(error).__name__} {error}'.strip().partition('\n')[0][:120]


# ---- Compression ----


def _decompress(file: Path, plain: Path) -> Iterator[Damage]:
    import zstandard

    with file.open('rb') as source, plain.open('wb') as target:
        try:
            zstandard.ZstdDecompressor().copy_stream(source, target)
        except (zstandard.ZstdError, OSError) as error:
            yield Damage(f'{file.name}: cut short: {_short(error)}')


def _decompressed(messages: Messages) -> Iterator[Messages | Damage]:
    """Yield messages that were compressed one by one as what they were."""
    import zstandard

    decompress = zstandard.ZstdDecompressor().decompress
    sizes: dict[int, list[tuple[int, bytes]]] = {}
    for row, compressed in enumerate(messages.data):
        with contextlib.suppress(zstandard.ZstdError, MemoryError):  # counted below
            data = decompress(compressed.tobytes())
            sizes.setdefault(len(data), []).append((row, data))
    whole = 0
    for found in sizes.values():
        whole += len(found)
        rows = np.array([row for row, _ in found])
        yield messages._replace(
            numbers=messages.numbers[rows],
            received=messages.received[rows],
            published=messages.published[rows],
            data=_rows([data for _, data in found]),
        )
    if whole < len(messages.data):
        lost = len(messages.data) - whole
        yield Damage(f'{messages.topic}: {lost} messages cannot be decompressed')


def _rows(data: list[bytes]) -> np.ndarray:
    """Return messages of one size as the rows of an array."""
    return np.frombuffer(b''.join(data), 'u1').reshape(len(data), -1 if data[0] else 0)


# ---- MCAP ----


def _read_mcap(file: Path, first: int) -> Iterator[Messages | Records | Damage]:
    return _Mcap(file, first).read()


class _Mcap:
    """Schemas and channels of a file as they come, and the messages in its chunks."""

    def __init__(self, path: Path, count: int) -> None:
        self.path, self.count = path, count
        self.schemas: dict[int, Any] = {}
        self.channels: dict[int, Any] = {}

    def read(self) -> Iterator[Messages | Records | Damage]:
        """Yield what is in the file until its end, or until it cannot be read any further."""
        from mcap.records import Channel, Chunk, Metadata, Schema

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
            except Exception as error:  # of whatever damaged bytes make of the readers
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
            return Damage(f'{channel.topic}: messages in {encoding} are not read')
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


def _data_of(chunk: Any) -> bytes:
    from mcap.stream_reader import get_chunk_data_stream

    if chunk.uncompressed_size > LARGEST_RECORD:
        raise ValueError(f'it says that it holds {chunk.uncompressed_size} bytes')
    stream, length = get_chunk_data_stream(chunk, validate_crc=True)
    return bytes(stream.read(length))


def _records(file: BinaryIO) -> Iterator[Any]:
    """Yield the records of a file that matter here, until the index that ends it.

    Messages outside of chunks come as chunks, many in each.
    """
    from mcap.data_stream import ReadDataStream
    from mcap.opcode import Opcode
    from mcap.records import Channel, Chunk, Metadata, Schema
    from mcap.stream_reader import read_magic

    readers: Mapping[int, Any] = {
        Opcode.SCHEMA: Schema.read,
        Opcode.CHANNEL: Channel.read,
        Opcode.CHUNK: Chunk.read,
        Opcode.METADATA: Metadata.read,
    }
    stream, loose, opcode = ReadDataStream(file), bytearray(), 0
    read_magic(stream)
    try:
        while opcode != Opcode.DATA_END:
            head = _exactly(file, HEAD.size)
            opcode, length = HEAD.unpack(head)
            if length > LARGEST_RECORD:
                raise ValueError(f'a record says that it has {length} bytes')
            if opcode == Opcode.MESSAGE:
                loose += head + _exactly(file, length)
            if loose and (opcode != Opcode.MESSAGE or len(loose) > LOOSE):
                yield _chunk_of(loose)
                loose = bytearray()
            if opcode in readers:
                end = file.tell() + length
                yield readers[opcode](stream)
                file.seek(end)
            elif opcode != Opcode.MESSAGE:
                file.seek(length, 1)
    except Exception:
        if loose:
            yield _chunk_of(loose)
        raise


def _exactly(file: BinaryIO, size: int) -> bytes:
    data = file.read(size)
    if len(data) < size:
        raise EOFError('the file ends within a record')
    return data


def _chunk_of(records: bytearray) -> Any:
    from mcap.records import Chunk

    return Chunk(
        compression='',
        data=bytes(records),
        message_end_time=0,
        message_start_time=0,
        uncompressed_crc=0,
        uncompressed_size=len(records),
    )


# ---- SQLite ----


class _Topic(NamedTuple):
    name: str
    type: str
    format: str
    definition: str


Row = tuple[int, int, bytes]  # number of the topic, time, message


def _read_sqlite(file: Path, first: int) -> Iterator[Messages | Damage]:
    begin, rows, damage = first, list[Row](), []
    try:
        with contextlib.closing(_database(file)) as database:
            topics = _topics(database)
            for row in database.execute('SELECT topic_id, timestamp, data FROM messages'):
                rows.append(row)
                if len(rows) == BATCH:
                    yield from _messages(rows, topics, first)
                    first, rows = first + BATCH, []
    except (sqlite3.Error, ValueError, TypeError, OverflowError) as error:
        after = f'after {first + len(rows) - begin} messages'
        damage.append(Damage(f'{file.name}: cut short {after}: {_short(error)}'))
    if rows:
        yield from _messages(rows, topics, first)
    yield from damage


def _database(file: Path) -> sqlite3.Connection:
    # SQLite makes files beside a database unless it can trust that nobody writes it; what a
    # recording that crashed did not bring into its database is in such a file.
    unfinished = file.with_name(f'{file.name}-wal').exists()
    mode = 'mode=ro' if unfinished else 'immutable=1'
    return sqlite3.connect(f'{file.absolute().as_uri()}?{mode}', uri=True)


def _topics(database: sqlite3.Connection) -> dict[int, _Topic]:
    """Return the topics of a database by their number."""
    tables = database.execute("SELECT name FROM sqlite_master WHERE type = 'table'")
    definitions = {}
    if ('message_definitions',) in tables.fetchall():  # not before ROS 2 Iron
        definitions = dict(
            database.execute(
                'SELECT topic_type, encoded_message_definition FROM message_definitions'
                " WHERE encoding = 'ros2msg'"
            )
        )
    rows = database.execute('SELECT id, name, type, serialization_format FROM topics')
    return {
        number: _Topic(f'{name}', f'{kind}', f'{form}', f'{definitions.get(kind, "")}')
        for number, name, kind, form in rows
    }


def _messages(
    rows: list[Row], topics: Mapping[int, _Topic], first: int
) -> Iterator[Messages | Damage]:
    """Yield rows of a database by topic and size."""
    groups: dict[tuple[int, int], list[tuple[int, int, bytes]]] = {}
    damaged = 0
    for number, (identity, received, data) in enumerate(rows, first):
        # A damaged database has values of other types.
        if identity in topics and isinstance(received, int) and isinstance(data, bytes):
            groups.setdefault((identity, len(data)), []).append((number, received, data))
        else:
            damaged += 1
    if damaged:
        yield Damage(f'{damaged} rows of the database are damaged')
    for (identity, _), found in groups.items():
        topic = topics[identity]
        if topic.format != 'cdr':
            yield Damage(f'{topic.name}: messages in {topic.format} are not read')
            continue
        times = np.array([received for _, received, _ in found], dtype=np.int64)
        yield Messages(
            topic.name,
            topic.type,
            topic.definition,
            np.array([number for number, _, _ in found]),
            times,
            times,
            _rows([data for _, _, data in found]),
        )
