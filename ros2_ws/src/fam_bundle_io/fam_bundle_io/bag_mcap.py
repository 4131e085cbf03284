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
Reads an MCAP file as far as it can be read.

Chunks are taken whole or not at all. Where a record makes no sense, reading goes on at the next
chunk. How many messages there should be, the end of the file tells.
"""

from collections.abc import Callable, Iterator
from io import BytesIO
import os
from pathlib import Path
import re
import struct
from typing import Any, BinaryIO, NamedTuple
import zlib

from fam_bundle_io.bag_parts import Damage, Doubt, Messages, Part, short
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Channel, Chunk, Metadata, Schema, Statistics
import numpy as np

MAGIC = b'\x89MCAP0\r\n'
HEAD = struct.Struct('<BQ')  # of a record: opcode and length
# A message in a chunk: that head, the number of its channel, its own number, both its times.
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
SMALLEST = MESSAGE_HEAD.itemsize - HEAD.size  # length of a message without data
CHANNEL_NUMBER = struct.Struct('<H')
FOOTER = struct.Struct('<BQQQI')  # opcode, length, start of summary, of its offsets, checksum
LARGEST_CHUNK = 1 << 30  # bytes; a damaged size would ask for more than there is memory
LZ4_RATIO = 255  # at most that many bytes come out of one
LOOSE = 1 << 20  # bytes of messages outside of chunks that are taken together
BLOCK = 1 << 20  # bytes that are looked at together
DATA = frozenset(  # opcodes before the index
    (
        Opcode.HEADER,
        Opcode.SCHEMA,
        Opcode.CHANNEL,
        Opcode.MESSAGE,
        Opcode.CHUNK,
        Opcode.MESSAGE_INDEX,
        Opcode.ATTACHMENT,
        Opcode.METADATA,
        Opcode.DATA_END,
    )
)
WANTED = DATA - {Opcode.HEADER, Opcode.MESSAGE_INDEX, Opcode.ATTACHMENT}
PRIVATE = 128  # opcodes from there on are free to be used by anybody
# The head of a chunk: opcode, length; two times, a size, a checksum; compression; length of data.
CHUNK_HEAD = re.compile(
    rb'\x06(?=(.{8}).{28}(\0\0\0\0|\x03\0\0\0lz4|\x04\0\0\0zstd)(.{8}))', re.DOTALL
)
CHUNK_HEAD_SIZE = 57  # bytes at most
CHUNK_FIXED = 36  # bytes of a chunk beside its data and its compression's name


def read_mcap(path: Path, first: int) -> Iterator[Part]:
    """Yield what is in a file; its messages are numbered from ``first``."""
    with path.open('rb') as file:
        yield from _Mcap(path.name, file, first).parts()


class _Mcap:
    """Schemas and channels of a file as they come, and the messages in its chunks."""

    def __init__(self, name: str, file: BinaryIO, first: int) -> None:
        self.name, self.first, self.count = name, first, first
        self.summary = summary_of(file)
        self.schemas, self.channels = dict(self.summary.schemas), dict(self.summary.channels)
        self.walk = _Walk(file)
        self.damaged: list[str] = []  # chunks and records
        self.unknown, self.foreign, self.unchecked = 0, dict[str, int](), 0

    def parts(self) -> Iterator[Part]:
        """Yield all that can be read, and in the end what is wrong with the file."""
        loose = bytearray()
        for at, opcode, data in self.walk.records():
            if opcode == Opcode.MESSAGE:
                loose += self.loose(data, at)
            if loose and (opcode != Opcode.MESSAGE or len(loose) > LOOSE):
                yield self.messages_in(bytes(loose), at, checked=False)
                loose.clear()
            if opcode == Opcode.CHUNK:
                yield self.chunk(self.read(Chunk.read, data, at), at)
            elif opcode == Opcode.METADATA:
                record = self.read(Metadata.read, data, at)
                if record is not None:
                    yield {record.name: dict(record.metadata)}
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.note(opcode, data, at)
        if loose:
            yield self.messages_in(bytes(loose), self.walk.at, checked=False)
        yield from self.account()

    def loose(self, data: bytes, at: int) -> bytes:
        """Return a message outside of a chunk as it would be in one."""
        if len(data) < SMALLEST:
            self.damaged.append(f'at byte {at}: a message of {len(data)} bytes')
            return b''
        return HEAD.pack(Opcode.MESSAGE, len(data)) + data

    def read(self, read: Callable[[Any], Any], data: bytes, at: int) -> Any:
        """Return a record, None if it is damaged."""
        try:
            return read(ReadDataStream(BytesIO(data)))
        except Exception as error:  # of whatever damaged bytes make of the reader
            self.damaged.append(f'at byte {at}: {short(error)}')
            return None

    def note(self, opcode: int, data: bytes, at: int) -> None:
        """Note a schema or a channel."""
        is_schema = opcode == Opcode.SCHEMA
        record = self.read(Schema.read if is_schema else Channel.read, data, at)
        if record is not None:
            (self.schemas if is_schema else self.channels)[record.id] = record

    def chunk(self, chunk: Any, at: int) -> list[Messages]:
        """Return the messages in a chunk, none of them if it is damaged."""
        good, found = False, list[Messages]()
        if chunk is not None:
            try:
                data = _data_of(chunk)
                found = self.messages_in(data, at, checked=chunk.uncompressed_crc != 0)
                good = True
            except Exception as error:  # of whatever decompresses damaged data
                self.damaged.append(f'at byte {at}: {short(error)}')
        self.walk.judge(good=good)
        return found

    def messages_in(self, data: bytes, at: int, *, checked: bool) -> list[Messages]:
        """
        Return the messages in the data of a chunk by topic and size.

        Raises ValueError or struct.error when it is damaged.
        """
        offsets: dict[tuple[int, int], list[int]] = {}
        numbers: dict[tuple[int, int], list[int]] = {}
        place, count, size = 0, self.count, len(data)
        head, channel_number, head_size = HEAD.unpack_from, CHANNEL_NUMBER.unpack_from, HEAD.size
        message = int(Opcode.MESSAGE)  # compared some million times
        while place < size:
            opcode, length = head(data, place)
            begin = place + head_size
            if begin + length > size or (opcode == message and length < SMALLEST):
                raise ValueError(f'a record of {length} bytes')
            if opcode == message:
                key = (channel_number(data, begin)[0], length)
                offsets.setdefault(key, []).append(place)
                numbers.setdefault(key, []).append(count)
                count += 1
            elif opcode in (Opcode.SCHEMA, Opcode.CHANNEL):
                self.note(opcode, data[begin : begin + length], at)  # noqa: E203
            place = begin + length
        self.unchecked += 0 if checked else count - self.count
        self.count = count
        raw = np.frombuffer(data, 'u1')
        found = (
            self.messages(channel, raw, np.array(starts), length, numbers[channel, length])
            for (channel, length), starts in offsets.items()
        )
        return [messages for messages in found if messages is not None]

    def messages(
        self, number: int, raw: np.ndarray, starts: np.ndarray, length: int, numbers: list[int]
    ) -> Messages | None:
        """Return the messages of a channel that lie at ``starts`` in ``raw``."""
        channel = self.channels.get(number)
        schema = self.schemas.get(channel.schema_id) if channel else None
        if channel is None or schema is None:
            self.unknown += len(starts)
            return None
        if channel.message_encoding != 'cdr' or schema.encoding != 'ros2msg':
            words = f'{channel.topic}: messages in {channel.message_encoding}, {schema.encoding}'
            self.foreign[words] = self.foreign.get(words, 0) + len(starts)
            return None
        whole = raw[starts[:, None] + np.arange(HEAD.size + length)]
        heads = np.ascontiguousarray(whole[:, : MESSAGE_HEAD.itemsize]).view(MESSAGE_HEAD)[:, 0]
        return Messages(
            channel.topic,
            schema.name,
            schema.data.decode(errors='replace'),
            np.array(numbers),
            heads['received'].astype(np.int64),
            heads['published'].astype(np.int64),
            heads['sequence'].astype(np.int64),
            whole[:, MESSAGE_HEAD.itemsize :],  # noqa: E203
            channel.metadata.get('offered_qos_profiles', ''),
            channel.metadata.get('topic_type_hash', ''),
        )

    def account(self) -> Iterator[Damage | Doubt]:
        """Yield what is wrong with the file."""
        count, wanted = self.count - self.first, self.summary.messages
        for words in self.walk.gaps:
            yield Damage(f'{self.name}: {words}')
        if self.walk.end:
            yield Damage(f'{self.name}: cut short after {count} messages: {self.walk.end}')
        elif self.summary.damage:
            yield Damage(f'{self.name}: its index is damaged: {self.summary.damage}')
        if self.damaged:
            more = f' and {len(self.damaged) - 1} more' if self.damaged[1:] else ''
            yield Damage(f'{self.name}: damaged {self.damaged[0]}{more}')
        if self.unknown:
            yield Damage(f'{self.name}: {self.unknown} messages of an unknown channel')
        for words, number in self.foreign.items():
            yield Damage(f'{words}: {number} are not read')
        if wanted not in (None, count):
            yield Damage(f'{self.name}: {count} messages were read, its index says {wanted}')
        whole = not (self.walk.gaps or self.walk.end)
        checksum = self.walk.checksum if whole else 0
        if checksum and checksum != self.walk.crc:
            yield Damage(f'{self.name}: its checksum is wrong: something has changed')
        elif self.unchecked and not checksum:
            yield Doubt(
                f'{self.name}: {self.unchecked} messages carry no checksum: '
                'if their numbers have changed, nothing shows it'
            )


def _data_of(chunk: Any) -> bytes:
    size, packed = chunk.uncompressed_size, chunk.data
    if size > LARGEST_CHUNK or (chunk.compression == 'lz4' and size > LZ4_RATIO * len(packed)):
        raise ValueError(f'a chunk of {size} bytes out of {len(packed)}')
    if chunk.compression == 'lz4':
        import lz4.frame

        data = lz4.frame.LZ4FrameDecompressor().decompress(packed, max_length=size)
    elif chunk.compression == 'zstd':
        import zstandard

        if zstandard.frame_content_size(packed) not in (-1, size):
            raise ValueError('two sizes of one chunk')
        data = zstandard.ZstdDecompressor().decompress(packed, max_output_size=size)
    elif chunk.compression:
        raise ValueError(f'compression {chunk.compression!r}')
    else:
        data = packed
    if len(data) != size:
        raise ValueError(f'{len(data)} of {size} bytes')
    if chunk.uncompressed_crc not in (0, zlib.crc32(data)):
        raise ValueError('wrong checksum')
    return bytes(data)


# ---- From record to record ----


class _Broken(Exception):
    """No record begins here."""


class _Walk:
    """Goes through the records of a file; what makes no sense is passed over."""

    def __init__(self, file: BinaryIO) -> None:
        self.file, self.at, self.crc = file, 0, 0
        self.size = os.fstat(file.fileno()).st_size
        self.gaps: list[str] = []  # what was passed over, in words
        self.end = ''  # why it ended too early
        self.checksum = 0  # what the file says of itself, 0 where it says nothing
        self._chunk, self._trusted = 0, 0  # begin of the newest, end of the last good one
        file.seek(0)

    def records(self) -> Iterator[tuple[int, int, bytes]]:
        """Yield place, opcode and content of records; nothing of those that do not matter."""
        begins = True
        while True:
            at = self.at
            try:
                if begins:
                    self.magic()
                    begins, at = False, self.at
                opcode, data = self.record()
            except _Broken as error:
                begins = False
                if not self.go_on(f'{error}'):
                    return
                continue
            if opcode == Opcode.DATA_END:
                (self.checksum,) = struct.unpack('<I', data)
                return
            if opcode == Opcode.CHUNK:
                self._chunk = at
            yield at, opcode, data

    def magic(self) -> None:
        if self.take(len(MAGIC)) != MAGIC:
            raise _Broken('it does not begin as an MCAP file')

    def record(self) -> tuple[int, bytes]:
        """Return the next record; raises _Broken where there is none."""
        crc = self.crc
        opcode, length = HEAD.unpack(self.take(HEAD.size))
        if opcode not in DATA and opcode < PRIVATE:
            raise _Broken(f'opcode {opcode}')
        if length > self.size - self.at:
            left = self.size - self.at
            if left < 0:
                raise _Broken('it was still being written')
            raise _Broken(f'the file ends within a record: {left} of its {length} bytes are there')
        if opcode == Opcode.DATA_END:
            if length != 4:
                raise _Broken(f'an end of {length} bytes')
            data = self.take(length)
            self.crc = crc  # it does not cover itself
            return opcode, data
        if opcode in WANTED:
            return opcode, self.take(length)
        for begin in range(0, length, BLOCK):
            self.take(min(BLOCK, length - begin))
        return opcode, b''

    def take(self, size: int) -> bytes:
        data = self.file.read(size)
        self.at += len(data)
        if len(data) < size:
            raise _Broken('the file ends')
        self.crc = zlib.crc32(data, self.crc)
        return data

    def judge(self, *, good: bool) -> None:
        """Note whether the newest chunk could be read; another may begin in one that was not."""
        self._trusted = self.at if good else self._chunk + 1
        inside = None if good else self.find(self._chunk + 1, self.at)
        if inside is not None:
            self.seek(inside)

    def go_on(self, why: str) -> bool:
        """Go on at the next chunk behind the last good one, and return whether there is any."""
        found = self.find(self._trusted, self.size)
        if found is None:
            self.end = why
            return False
        self.gaps.append(f'nothing to be read from byte {self._trusted} to {found}: {why}')
        self._trusted = found + 1
        self.seek(found)
        return True

    def seek(self, place: int) -> None:
        self.at = place
        self.file.seek(place)

    def find(self, begin: int, end: int) -> int | None:
        """Return where the first chunk between ``begin`` and ``end`` begins."""
        for start in range(begin, end, BLOCK):
            self.file.seek(start)
            data = self.file.read(min(BLOCK, end - start) + CHUNK_HEAD_SIZE)
            self.file.seek(self.at)
            for match in CHUNK_HEAD.finditer(data):
                length, size = (int.from_bytes(match[group], 'little') for group in (1, 3))
                compression = len(match[2]) - 4
                place = start + match.start()
                fits = place < end and place + HEAD.size + length <= self.size
                if fits and length == CHUNK_FIXED + 4 + compression + size:
                    return place
        return None


# ---- The end of a file ----


class Summary(NamedTuple):
    """What the end of a file says of it; ``damage`` is why it cannot be read, in words."""

    schemas: dict[int, Schema]
    channels: dict[int, Channel]
    messages: int | None = None
    damage: str = ''


def summary_of(file: BinaryIO) -> Summary:
    """Return what the end of a file says of it."""
    try:
        return _summary_of(file)
    except Exception as error:  # of whatever damaged bytes make of the readers
        return Summary({}, {}, None, short(error))


def _summary_of(file: BinaryIO) -> Summary:
    end = file.seek(-FOOTER.size - len(MAGIC), os.SEEK_END)
    footer = file.read(FOOTER.size)
    opcode, length, begin, _, checksum = FOOTER.unpack(footer)
    if file.read() != MAGIC or (opcode, length) != (Opcode.FOOTER, FOOTER.size - HEAD.size):
        raise ValueError('no footer')
    if begin == 0:
        return Summary({}, {})
    file.seek(begin)
    data = file.read(end - begin)
    if checksum not in (0, zlib.crc32(data + footer[:-4])):
        raise ValueError('wrong checksum')
    schemas, channels, messages, at = dict[int, Schema](), dict[int, Channel](), None, 0
    while at < len(data):
        opcode, length = HEAD.unpack_from(data, at)
        at += HEAD.size
        stream = ReadDataStream(BytesIO(data[at : at + length]))  # noqa: E203
        if opcode == Opcode.SCHEMA:
            schema = Schema.read(stream)
            schemas[schema.id] = schema
        elif opcode == Opcode.CHANNEL:
            channel = Channel.read(stream)
            channels[channel.id] = channel
        elif opcode == Opcode.STATISTICS:
            messages = Statistics.read(stream).message_count
        at += length
    return Summary(schemas, channels, messages)
