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
Serialized messages of one type as columns, decoded many at a time.

Messages of the loop differ only in their numbers: the first of them tells where every field lies,
and all that have the same lengths are decoded by numpy at once, some hundred times faster than one
by one. The wire format is XCDR1, plain CDR, as ROS 2 uses it.
"""

from collections.abc import Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np

ENCAPSULATION = 4  # bytes before the message, from the end of which alignment counts
NUMBERS = {
    'bool': '?',
    'byte': 'u1',
    'octet': 'u1',
    'char': 'u1',
    'int8': 'i1',
    'uint8': 'u1',
    'int16': 'i2',
    'uint16': 'u2',
    'int32': 'i4',
    'uint32': 'u4',
    'int64': 'i8',
    'uint64': 'u8',
    'float32': 'f4',
    'float64': 'f8',
}
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4  # kinds of fields in rosbags' type system
LARGEST_ARRAY = 64  # elements that become columns

Fields = Sequence[tuple[str, Any]]
Types = Mapping[str, tuple[Any, Fields]]


class NotFlatError(Exception):
    """The message has parts that are no columns: arrays of messages or of texts, or long ones."""


class DamagedError(Exception):
    """The message is shorter than its type asks for, or longer."""


class Column(NamedTuple):
    """Where a number or a text lies in a message."""

    name: str
    dtype: str
    offset: int


class Layout(NamedTuple):
    """Where all fields lie, in messages whose ``lengths`` (offset, value) are these."""

    columns: list[Column]
    lengths: list[tuple[int, int]]


class _Walk:
    """Goes through one serialized message field by field."""

    def __init__(self, data: bytes, types: Types) -> None:
        self.data, self.types = data, types
        self.at = ENCAPSULATION
        self.order = '<' if data[1:2] == b'\1' else '>'
        self.layout = Layout([], [])
        self.too_long = -1  # where a length lies that is more than the whole message

    def whole(self, name: str) -> None:
        if len(self.data) < ENCAPSULATION or self.data[0] != 0 or self.data[1] not in (0, 1):
            raise DamagedError(f'unknown encapsulation {self.data[:2].hex()}')
        self.message(name, '')
        if len(self.data) - self.at > 3:  # writers may fill up to four bytes
            raise DamagedError(f'{len(self.data)} bytes, {self.at} wanted')

    def message(self, name: str, prefix: str) -> None:
        for field, kind in self.types[name][1]:
            self.field(f'{prefix}{field}', kind)

    def field(self, name: str, kind: Any) -> None:
        if kind[0] == NAME:
            self.message(kind[1], f'{name}.')
        elif kind[0] == BASE:
            self.number_or_text(name, kind[1][0])
        else:
            element, length = kind[1]
            if element[0] != BASE or element[1][0] in ('string', 'wstring'):
                raise NotFlatError(name)
            if kind[0] == SEQUENCE:
                length = self.length()
            if length > LARGEST_ARRAY:
                raise NotFlatError(name)
            for index in range(length):
                self.number_or_text(f'{name}[{index}]', element[1][0])

    def number_or_text(self, name: str, base: str) -> None:
        if base == 'wstring':
            raise NotFlatError(name)
        if base == 'string':
            length = self.length()
            self.add(name, f'S{max(length, 1)}', length, 1)
        else:
            dtype = NUMBERS[base]
            size = np.dtype(dtype).itemsize
            self.add(name, dtype if size == 1 else f'{self.order}{dtype}', size, size)

    def length(self) -> int:
        self.align(4)
        offset = self.at
        self.take(4)
        value = int(np.frombuffer(self.data, f'{self.order}u4', 1, offset)[0])
        if value > len(self.data):
            self.too_long = offset
            raise DamagedError(f'a length of {value} in {len(self.data)} bytes')
        self.layout.lengths.append((offset, value))
        return value

    def add(self, name: str, dtype: str, size: int, alignment: int) -> None:
        self.align(alignment)
        self.layout.columns.append(Column(name, dtype, self.at))
        self.take(size)

    def align(self, to: int) -> None:
        self.at += -(self.at - ENCAPSULATION) % to

    def take(self, size: int) -> None:
        self.at += size
        if self.at > len(self.data):
            raise DamagedError(f'{len(self.data)} bytes, at least {self.at} wanted')


def types_within(name: str, types: Types) -> set[str]:
    """Return the names of the message type ``name`` and of all that it is made of."""
    found, waiting = set[str](), [name]
    while waiting:
        name = waiting.pop()
        if name in found:
            continue
        found.add(name)
        waiting += _types_in(name, types)
    return found


def holds_itself(name: str, types: Types) -> bool:
    """Return whether a message of type ``name``, or what is in it, never ends."""
    return any(
        outer in types_within(inner, types)
        for outer in types_within(name, types)
        for inner in _types_in(outer, types)
    )


def _types_in(name: str, types: Types) -> Iterator[str]:
    for _, kind in types[name][1] if name in types else ():
        element = kind[1][0] if kind[0] in (ARRAY, SEQUENCE) else kind
        if element[0] == NAME:
            yield element[1]


class Part(NamedTuple):
    """Messages of one layout: their ``rows`` among all, and their columns."""

    rows: np.ndarray
    columns: dict[str, np.ndarray]


def decode(messages: np.ndarray, name: str, types: Types) -> Iterator[Part]:
    """
    Yield all messages, those of one layout together.

    ``messages`` is a (n, size) array of bytes, ``types`` is as from
    ``rosbags.typesys.get_types_from_msg``. Messages that are damaged come without columns. Raises
    NotFlatError for a type that is no row of numbers and texts.
    """
    left = np.arange(len(messages))
    while len(left):
        walk = _Walk(messages[left[0]].tobytes(), types)
        damaged = False
        try:
            walk.whole(name)
        except DamagedError:  # so are all with the lengths that were met until then
            damaged = True
        same = np.all(messages[left, :2] == messages[left[0], :2], axis=1)
        for offset, _ in walk.layout.lengths:
            field = slice(offset, offset + 4)
            same &= np.all(messages[left, field] == messages[left[0], field], axis=1)
        if walk.too_long >= 0:
            field = slice(walk.too_long, walk.too_long + 4)
            lengths = np.ascontiguousarray(messages[left, field]).view(f'{walk.order}u4')
            same &= lengths[:, 0] > messages.shape[1]
        rows = left[same]
        alike = messages if len(rows) == len(messages) else messages[rows]
        yield Part(rows, {} if damaged else _columns(alike, walk.layout))
        left = left[~same]


def _columns(messages: np.ndarray, layout: Layout) -> dict[str, np.ndarray]:
    dtype = np.dtype(
        {
            'names': [column.name for column in layout.columns],
            'formats': [column.dtype for column in layout.columns],
            'offsets': [column.offset for column in layout.columns],
            'itemsize': messages.shape[1],
        }
    )
    table = np.ascontiguousarray(messages).view(dtype)[:, 0]
    return {name: _native(table[name]) for name in dtype.names or ()}


def _native(values: np.ndarray) -> np.ndarray:
    if values.dtype == bool:  # a byte from elsewhere may be more than 1
        return np.asarray(np.ascontiguousarray(values).view('u1') != 0)
    return values.astype(values.dtype.newbyteorder('='))
