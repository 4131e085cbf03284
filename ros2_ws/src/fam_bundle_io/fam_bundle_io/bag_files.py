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
The files of a bag, and the serialized messages in them as far as they can be read.

Each file is read by itself: one without its end, or without ``metadata.yaml``, gives all that is
whole. It may be compressed with zstd, the whole file or each message. What ``metadata.yaml`` says
is held against what was read.
"""

from collections.abc import Iterator
from pathlib import Path
import re
import tempfile
from typing import NamedTuple

from fam_bundle_io.bag_mcap import read_mcap
from fam_bundle_io.bag_parts import Damage, Doubt, Messages, Part, rows_of, short
from fam_bundle_io.bag_sqlite import read_sqlite
from fam_bundle_io.bag_writer import BagError
import numpy as np
import yaml

# What files begin with; a message in CDR begins with 0.
ZSTD, SQLITE = b'\x28\xb5\x2f\xfd', b'SQLite format 3\0'
STORAGES = {'.mcap', '.db3'}
LARGEST_MESSAGE = 1 << 30  # bytes; a damaged size would ask for more than there is memory


def read_parts(path: Path) -> Iterator[Part]:
    """
    Yield what is in the bag at ``path``, a folder or one file, part by part.

    Raises BagError when there is no bag.
    """
    if path.is_file():
        yield from _read_files([path], {})
        return
    if not path.is_dir():
        raise BagError(f'{path}: no such bag')
    described = _description_of(path)
    present = sorted((p for p in path.iterdir() if STORAGES & set(p.suffixes)), key=_natural)
    if described is None:
        yield Damage('metadata.yaml is missing or damaged')
        files = present
    else:
        listed = [path / name for name in described.files]
        missing = [file for file in listed if not file.is_file()]
        others = [file for file in present if file not in listed]
        # A file that is missing may have another name.
        files = sorted({*listed, *others}, key=_natural) if missing and others else listed
        for file in missing:
            yield Damage(f'{file.name} is missing')
        for file in others:
            yield Doubt(f'{file.name} is not in metadata.yaml{"" if missing else ": not read"}')
    files = [file for file in files if file.is_file()]
    if not files:
        raise BagError(f'{path}: holds no .mcap and no .db3 file')
    topics: dict[str, tuple[str, int]] = {}
    yield from _read_files(files, topics)
    if described is not None:
        yield from _differences(described.topics, topics)


def _read_files(files: list[Path], topics: dict[str, tuple[str, int]]) -> Iterator[Part]:
    """Yield what is in files, and note type and count of each topic in ``topics``."""
    first, told = 0, set[str]()
    for file in files:
        for part in _read_file(file, first):
            if isinstance(part, Damage):
                if part.words in told:
                    continue
                told.add(part.words)
            elif isinstance(part, list):
                for messages in part:
                    first = max(first, int(messages.numbers[-1]) + 1)
                    _, count = topics.get(messages.topic, ('', 0))
                    topics[messages.topic] = messages.type, count + len(messages.numbers)
            yield part


def _read_file(file: Path, first: int) -> Iterator[Part]:
    """Yield what is in a file; its messages are numbered from ``first``."""
    with tempfile.TemporaryDirectory() as folder:
        plain = file
        try:
            if _begins_with(file, ZSTD):
                plain = Path(folder, file.stem)
                yield from _decompress(file, plain)
            storage = read_sqlite if _begins_with(plain, SQLITE) else read_mcap
            for part in storage(plain, first):
                if isinstance(part, list) and any(_is_compressed(m) for m in part):
                    yield from _decompressed(part)
                else:
                    yield part
        except OSError as error:
            yield Damage(f'{file.name}: {short(error)}')


def _begins_with(file: Path, mark: bytes) -> bool:
    with file.open('rb') as stream:
        return stream.read(len(mark)) == mark


def _natural(path: Path) -> list[tuple[int, str]]:
    """Sort by name, numbers in it by value: bag_10 comes after bag_9."""
    words = re.findall(r'\d+|\D+', path.name)
    return [(int(word), '') if word.isdecimal() else (0, word) for word in words]


# ---- What the bag says of itself ----


class _Description(NamedTuple):
    """The files of a bag, and type and count of each topic, as metadata.yaml has them."""

    files: list[str]
    topics: dict[str, tuple[str, int]]


def _description_of(folder: Path) -> _Description | None:
    """Return what metadata.yaml says, None where it cannot be read."""
    try:
        found = yaml.safe_load((folder / 'metadata.yaml').read_text())
        found = found['rosbag2_bagfile_information']
        names = [Path(str(name)).name for name in found['relative_file_paths']]
        topics = {}
        for topic in found['topics_with_message_count']:
            about = topic['topic_metadata']
            topics[str(about['name'])] = str(about['type']), int(topic['message_count'])
    except (OSError, ValueError, TypeError, KeyError, AttributeError, yaml.YAMLError):
        return None
    return _Description(names, topics) if names else None


def _differences(
    said: dict[str, tuple[str, int]], found: dict[str, tuple[str, int]]
) -> Iterator[Damage]:
    """Yield what metadata.yaml says of the topics and is not so."""
    for topic in sorted(said.keys() | found.keys()):
        (kind, count), (real_kind, real_count) = (d.get(topic, ('', 0)) for d in (said, found))
        if count != real_count:
            words = f'{real_count} messages were read, metadata.yaml says {count}'
            yield Damage(f'{topic}: {words}')
        elif count and kind != real_kind:
            yield Damage(f'{topic}: is of type {real_kind}, metadata.yaml says {kind}')


# ---- Compression ----


def _decompress(file: Path, plain: Path) -> Iterator[Damage]:
    import zstandard

    with file.open('rb') as source, plain.open('wb') as target:
        try:
            zstandard.ZstdDecompressor().copy_stream(source, target)
        except (zstandard.ZstdError, OSError) as error:
            yield Damage(f'{file.name}: cut short: {short(error)}')


def _is_compressed(messages: Messages) -> bool:
    return bool(messages.data[0, : len(ZSTD)].tobytes() == ZSTD)


def _decompressed(parts: list[Messages]) -> Iterator[list[Messages] | Damage]:
    """Yield messages that were compressed one by one as what they were."""
    plain, lost = list[Messages](), dict[str, int]()
    for messages in parts:
        sizes: dict[int, list[tuple[int, bytes]]] = {}
        for row, compressed in enumerate(messages.data):
            data = _plain(compressed.tobytes())
            if data is None:
                lost[messages.topic] = lost.get(messages.topic, 0) + 1
            else:
                sizes.setdefault(len(data), []).append((row, data))
        plain += [_at(messages, found) for found in sizes.values()]
    yield plain
    for topic, count in lost.items():
        yield Damage(f'{topic}: {count} messages cannot be decompressed')


def _plain(compressed: bytes) -> bytes | None:
    import zstandard

    try:
        if zstandard.frame_content_size(compressed) > LARGEST_MESSAGE:
            return None
        return bytes(zstandard.ZstdDecompressor().decompress(compressed))
    except (zstandard.ZstdError, MemoryError):
        return None


def _at(messages: Messages, found: list[tuple[int, bytes]]) -> Messages:
    """Return the messages of some rows with other data."""
    rows = np.array([row for row, _ in found])
    return messages._replace(
        numbers=messages.numbers[rows],
        received=messages.received[rows],
        published=messages.published[rows],
        sequences=messages.sequences[rows],
        data=rows_of([data for _, data in found]),
    )
