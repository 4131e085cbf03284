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
Writes a rosbag2 bag (MCAP), in a thread of its own where messages must not wait; knows no ROS.

The folder, its ``metadata.yaml`` and the contents of the MCAP files follow rosbag2's storage
version 9 (Jazzy). The format itself is the ``mcap`` package's.
"""

from collections import deque
from collections.abc import Callable, Mapping
import contextlib
import os
from pathlib import Path
import threading
import time
from typing import Any, NamedTuple

from fam_bundle_model.files import whole_file
import yaml

Records = Mapping[str, Mapping[str, str]]  # of metadata, by name

VERSION = 9  # of rosbag2's metadata
CHUNK = 256 * 1024  # bytes; a crash loses the one under way
MEMORY = 32 * 1024 * 1024  # bytes of messages that may wait for the disk
LOOK_PERIOD = 0.1  # s between two looks at what has come
SYNC_PERIOD = 0.5  # s between two times that a chunk ends and the file is on the disk for sure


class BagError(Exception):
    """A bag cannot be written or read; the message names it and says why."""


class Topic(NamedTuple):
    """
    What a bag says of a topic.

    ``definition`` is the complete one, ``qos`` the offered profiles as rosbag2 writes them.
    """

    name: str
    type: str  # noqa: A003
    definition: str
    type_hash: str = ''
    qos: tuple[Mapping[str, Any], ...] = ()


class Item(NamedTuple):
    """A message on its way to the disk; times of the system clock in ns."""

    topic: str
    received: int
    published: int
    sequence: int  # its publisher's number of it
    data: bytes


class BagWriter:
    """
    Takes messages from one thread, and writes them in another.

    What waits is bounded by ``memory`` bytes; beyond it messages are dropped and counted.
    """

    def __init__(
        self,
        folder: Path,
        *,
        split_size: int = 0,
        split_duration: float = 0.0,
        memory: int = MEMORY,
        head: Records | None = None,
        watch: Callable[[Item], None] | None = None,
    ) -> None:
        """
        Make ``folder``; raises BagError when it exists or cannot be made.

        ``watch`` gets every message in the writing thread; the others are as in BagFolder.
        """
        self._bag = BagFolder(
            folder, split_size=split_size, split_duration=split_duration, head=head
        )
        self.folder, self.dropped, self.failure = folder, 0, ''
        self._memory, self._watch = memory, watch or (lambda item: None)
        self._waiting: deque[Item] = deque()
        self.taken, self._written = 0, 0  # bytes
        self._end = threading.Event()
        self._thread = threading.Thread(target=self._run, name='bag', daemon=True)
        self._thread.start()

    def add_topic(self, topic: Topic) -> None:
        """Make a topic known before its first message."""
        self._bag.add_topic(topic)

    def write(self, item: Item) -> None:
        """Take a message."""
        if self.taken - self._written > self._memory:
            self.dropped += 1
            return
        self.taken += len(item.data)
        self._waiting.append(item)

    def close(self, records: Callable[[], Records] = dict) -> None:
        """
        Write what waits, the ``records`` of metadata by name, and ``metadata.yaml``.

        Raises BagError when the disk did not take all.
        """
        self._end.set()
        self._thread.join()
        found = records()
        try:
            if self.failure:
                self._bag.abandon()
                self._bag.write_metadata(found)
            else:
                self._bag.close(found)
        except OSError as error:
            self.failure = self.failure or self._because(error)
        if self.failure:
            raise BagError(self.failure)

    # ---- In the writing thread ----

    def _run(self) -> None:
        try:
            synced = time.monotonic()
            while not (self._end.wait(LOOK_PERIOD) and not self._waiting):
                self._write_waiting()
                if time.monotonic() - synced > SYNC_PERIOD:
                    self._bag.sync()
                    synced = time.monotonic()
        except OSError as error:
            self.failure = self._because(error)
        except Exception as error:  # else the thread would end without a word
            self.failure = f'{self.folder}: {type(error).__name__}: {error}'

    def _because(self, error: OSError) -> str:
        return f'{self.folder}: {error.strerror} after {self._bag.messages()} messages'

    def _write_waiting(self) -> None:
        while self._waiting:
            item = self._waiting.popleft()
            self._bag.write(item)
            self._written += len(item.data)
            self._watch(item)


class BagFolder:
    """A bag on the disk: its files, one after the other, and ``metadata.yaml``."""

    def __init__(
        self,
        folder: Path,
        *,
        name: str = '',
        split_size: int = 0,
        split_duration: float = 0.0,
        head: Records | None = None,
    ) -> None:
        """
        Make ``folder``; raises BagError when it exists or cannot be made.

        Its files are called ``name``, or as the folder. A new one begins after ``split_size``
        bytes or ``split_duration`` s (0: never); each begins with the records of metadata
        ``head``, which a crash then does not lose.
        """
        try:
            folder.mkdir(parents=True)
        except FileExistsError:
            raise BagError(f'{folder}: exists; a bag never overwrites') from None
        except OSError as error:
            raise BagError(f'{folder}: {error.strerror}') from None
        self.folder, self._name = folder, name or folder.name
        self._split_size, self._split_duration = split_size, split_duration
        self._head = head or {}
        self._topics: dict[str, Topic] = {}
        self._files: list[BagFile] = []

    def add_topic(self, topic: Topic) -> None:
        """Make a topic known before its first message."""
        self._topics[topic.name] = topic

    def write(self, item: Item) -> None:
        """Write one message."""
        self._file_for(item).write(item)

    def _file_for(self, item: Item) -> 'BagFile':
        if not self._files:
            self._files.append(self._new_file())
        file = self._files[-1]
        large = 0 < self._split_size <= file.size()
        old = 0.0 < self._split_duration * 1e9 <= item.received - file.first
        if file.counts and (large or old):
            file.close({})
            self._files.append(self._new_file())
        return self._files[-1]

    def _new_file(self) -> 'BagFile':
        name = f'{self._name}_{len(self._files)}.mcap'
        return BagFile(self.folder / name, self._topics, self._head)

    def messages(self) -> int:
        """Return how many messages were written."""
        return sum(sum(file.counts.values()) for file in self._files)

    def sync(self) -> None:
        """Bring all that was written onto the disk."""
        if self._files:
            self._files[-1].sync()

    def close(self, records: Records) -> None:
        """Write the ``records`` of metadata by name, the last index, and ``metadata.yaml``."""
        if self._files:
            self._files[-1].close(records)
        self.write_metadata(records)

    def abandon(self) -> None:
        """Close the newest file as it is."""
        if self._files:
            self._files[-1].abandon()

    def write_metadata(self, records: Records) -> None:
        """Write ``metadata.yaml``."""
        information = bag_information(self._files, self._topics, {**self._head, **records})
        with whole_file(self.folder / 'metadata.yaml') as file:
            file.write(yaml.safe_dump(information, sort_keys=False).encode())


class BagFile:
    """One MCAP file of a bag."""

    def __init__(self, path: Path, topics: Mapping[str, Topic], head: Records) -> None:
        """Create the file, which must not be there, with the records ``head`` at its beginning."""
        from mcap.writer import CompressionType, Writer

        self.path, self.counts, self.first, self.last = path, dict[str, int](), 0, 0
        self._topics, self._channels = topics, dict[str, int]()
        self._stream = path.open('xb')
        self._writer = Writer(
            self._stream,
            chunk_size=CHUNK,
            compression=CompressionType.LZ4,
            enable_data_crcs=True,  # chunks have their own; this is for what is between them
        )
        self._writer.start(profile='ros2', library='fam_bundle')
        self._add(head)

    def _add(self, records: Records) -> None:
        for name, values in records.items():
            self._writer.add_metadata(name, dict(values))

    def write(self, item: Item) -> None:
        """Write one message."""
        channel = self._channels.get(item.topic)
        if channel is None:
            channel = self._channels[item.topic] = self._add_channel(self._topics[item.topic])
        self._writer.add_message(
            channel, item.received, item.data, item.published, item.sequence & 0xFFFFFFFF
        )
        self.first = min(self.first, item.received) if self.counts else item.received
        self.last = max(self.last, item.received)
        self.counts[item.topic] = self.counts.get(item.topic, 0) + 1

    def _add_channel(self, topic: Topic) -> int:
        schema = self._writer.register_schema(topic.type, 'ros2msg', topic.definition.encode())
        return self._writer.register_channel(
            topic.name,
            'cdr',
            schema,
            {
                'offered_qos_profiles': yaml.safe_dump(list(topic.qos), sort_keys=False),
                'topic_type_hash': topic.type_hash,
            },
        )

    def size(self) -> int:
        """Return how many bytes are in the file."""
        return self._stream.tell()

    def sync(self) -> None:
        """End the chunk under way and bring all onto the disk."""
        self._writer.flush()  # type: ignore[no-untyped-call]
        os.fsync(self._stream.fileno())

    def close(self, records: Records) -> None:
        """Add the ``records`` of metadata, the index, and close the file."""
        with contextlib.closing(self._stream):
            self._add(records)
            self._writer.finish()  # type: ignore[no-untyped-call]
            self._stream.flush()
            os.fsync(self._stream.fileno())

    def abandon(self) -> None:
        """Close the file as it is; the disk may refuse what still waits for it."""
        with contextlib.suppress(OSError):
            self._stream.close()


def bag_information(
    files: 'list[BagFile]',
    topics: Mapping[str, Topic],
    records: Records,
) -> dict[str, Any]:
    """Return what ``metadata.yaml`` holds."""
    counts = {name: sum(file.counts.get(name, 0) for file in files) for name in topics}
    first = min((file.first for file in files), default=0)
    last = max((file.last for file in files), default=0)
    return {
        'rosbag2_bagfile_information': {
            'version': VERSION,
            'storage_identifier': 'mcap',
            'duration': {'nanoseconds': last - first},
            'starting_time': {'nanoseconds_since_epoch': first},
            'message_count': sum(counts.values()),
            'topics_with_message_count': [
                {
                    'topic_metadata': {
                        'name': topic.name,
                        'type': topic.type,
                        'serialization_format': 'cdr',
                        'offered_qos_profiles': [dict(profile) for profile in topic.qos],
                        'type_description_hash': topic.type_hash,
                    },
                    'message_count': counts[topic.name],
                }
                for topic in topics.values()
            ],
            'compression_format': '',
            'compression_mode': '',
            'relative_file_paths': [file.path.name for file in files],
            'files': [
                {
                    'path': file.path.name,
                    'starting_time': {'nanoseconds_since_epoch': file.first},
                    'duration': {'nanoseconds': file.last - file.first},
                    'message_count': sum(file.counts.values()),
                }
                for file in files
            ],
            'custom_data': {
                f'{name}.{key}': value
                for name, values in records.items()
                for key, value in values.items()
            },
            'ros_distro': 'jazzy',
        }
    }
