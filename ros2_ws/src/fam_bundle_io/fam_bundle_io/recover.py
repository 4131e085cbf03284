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

"""Makes a whole bag of what can be read of a damaged one."""

from collections.abc import Callable, Iterator
import json
from pathlib import Path
import shutil
from typing import Any, NamedTuple

from fam_bundle_io.bag_files import read_parts
from fam_bundle_io.bag_parts import Damage, Messages, Part
from fam_bundle_io.bag_writer import BagError, BagFolder, Item, Topic
from fam_bundle_io.completeness import (
    carries_tick,
    is_answer,
    record_of,
    TopicLedger,
)

COMPLETENESS, RECOVERY = 'fam_bundle.completeness', 'fam_bundle.recovery'
STEP = 10_000  # messages between two words of progress


class Found(NamedTuple):
    """How many messages can be read of a bag, and what cannot, in words."""

    messages: int
    damage: list[str]


def look(bag: Path) -> Found:
    """Return what can be read of ``bag``; raises BagError when there is none."""
    count, damage = 0, []
    for part in read_parts(bag):
        if isinstance(part, Damage):
            damage.append(part.words)
        elif isinstance(part, list):
            count += sum(len(messages.numbers) for messages in part)
    return Found(count, damage)


class Recovery(NamedTuple):
    """
    What was written: a ledger's summary for each topic, and in words what was lost.

    ``missing`` is all that the new bag lacks, also of what was missing before it was damaged.
    """

    topics: dict[str, dict[str, Any]]
    damage: list[str]
    missing: list[str]


def recover_bag(
    bag: Path, out: Path, progress: Callable[[int], None] = lambda done: None
) -> Recovery:
    """
    Write what can be read of ``bag`` as a whole bag into the folder ``out``.

    ``progress`` is called with the messages written so far. Raises BagError when ``out`` exists or
    cannot be written, or nothing can be read; ``out`` is then not there.
    """
    if out.exists():
        raise BagError(f'{out}: exists; a bag never overwrites')
    part = out.with_name(f'{out.name}.part')
    folder = BagFolder(part, name=out.name)
    try:
        recovery = _Recoverer(bag, folder, progress).run()
        part.rename(out)
    except OSError as error:
        raise BagError(f'{out}: {error.strerror}') from None
    finally:
        shutil.rmtree(part, ignore_errors=True)
    return recovery


class _Recoverer:
    """Copies one bag, message by message."""

    def __init__(self, bag: Path, folder: BagFolder, progress: Callable[[int], None]) -> None:
        self.bag, self.folder, self.progress = bag, folder, progress
        self.topics: dict[str, Topic] = {}
        self.ledgers: dict[str, TopicLedger] = {}
        self.records: dict[str, dict[str, str]] = {}
        self.damage: list[str] = []
        self.count, self.timeless, self.others = 0, 0, dict[str, int]()

    def run(self) -> Recovery:
        try:
            for part in read_parts(self.bag):
                self.take(part)
        except BaseException:
            self.folder.abandon()
            raise
        if not self.count:
            raise BagError('; '.join([f'{self.bag}: no messages', *self.damage]))
        for topic, count in self.others.items():
            self.damage.append(f'{topic}: {count} messages of another type are left out')
        if self.timeless:
            self.damage.append(f'{self.timeless} messages of no possible time are left out')
        summaries = {name: ledger.summary() for name, ledger in self.ledgers.items()}
        said = self.said_of_itself(summaries)
        self.folder.close(self.records | said)
        return Recovery(summaries, self.damage, json.loads(said[COMPLETENESS]['missing']))

    def take(self, part: Part) -> None:
        """Copy messages, and note all else."""
        if isinstance(part, Damage):
            self.damage.append(part.words)
        elif isinstance(part, dict):
            self.records |= part
        elif isinstance(part, list):
            known = [messages for messages in part if self.knows(messages)]
            for messages, row in in_order(known):
                self.copy(messages, row)

    def knows(self, messages: Messages) -> bool:
        """Make a topic known; False for messages that are not of its type."""
        known = self.topics.get(messages.topic)
        if known is None:
            definition = messages.definition
            known = Topic(
                messages.topic,
                messages.type,
                definition,
                messages.type_hash,
                _profiles(messages.qos),
            )
            self.topics[known.name] = known
            self.ledgers[known.name] = TopicLedger(
                ticks=carries_tick(definition), answers=is_answer(known.name)
            )
            self.folder.add_topic(known)
        same = (messages.type, messages.definition) == (known.type, known.definition)
        if not same:
            self.others[known.name] = self.others.get(known.name, 0) + len(messages.numbers)
        return same

    def copy(self, messages: Messages, row: int) -> None:
        """Write one message."""
        data, sequence = messages.data[row].tobytes(), int(messages.sequences[row])
        received, published = int(messages.received[row]), int(messages.published[row])
        if min(received, published) < 0:
            self.timeless += 1
            return
        self.folder.write(Item(messages.topic, received, published, sequence, data))
        self.ledgers[messages.topic].note(sequence, data)
        self.count += 1
        if self.count % STEP == 0:
            self.progress(self.count)

    def said_of_itself(self, summaries: dict[str, dict[str, Any]]) -> dict[str, dict[str, str]]:
        """Return what the new bag says of its completeness and of its recovery."""
        before = self.records.get(COMPLETENESS, {})
        return {
            COMPLETENESS: record_of(
                summaries,
                _json(before.get('dropped'), int),
                _json(before.get('skipped_topics'), dict) or {},
                self.damage,
            ),
            RECOVERY: {
                'source': self.bag.resolve().name,
                'messages': json.dumps(self.count),
                'damage': json.dumps(self.damage),
            },
        }


def in_order(parts: list[Messages]) -> Iterator[tuple[Messages, int]]:
    """Yield each message in the order of the bag: the part that holds it and its row there."""
    places = [
        (number, index, row)
        for index, part in enumerate(parts)
        for row, number in enumerate(part.numbers.tolist())
    ]
    for _, index, row in sorted(places):
        yield parts[index], row


def _profiles(text: str) -> tuple[dict[str, Any], ...]:
    """Return quality of service profiles in the words of the newest rosbag2."""
    from rosbags.rosbag2.metadata import dump_qos_v9, parse_qos

    try:
        return tuple(dict(profile) for profile in dump_qos_v9(parse_qos(text)))
    except Exception:  # of whatever damaged text makes of the parser; it is no message
        return ()


def _json(text: str | None, kind: type) -> Any:
    try:
        value = json.loads(text or 'null')
    except ValueError:
        return None
    return value if isinstance(value, kind) else None
