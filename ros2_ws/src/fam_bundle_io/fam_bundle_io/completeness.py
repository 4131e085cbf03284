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

"""Whether a record of the loop is whole: what its ticks and sequence numbers prove."""

from collections.abc import Iterator, Mapping, Sequence
import json
import struct
from typing import Any

# A message of the loop begins with a header and a tick. In CDR: four bytes that tell the byte
# order, the stamp (two of four bytes), the length of frame_id, its text, and at the next multiple
# of eight, counted from the fifth byte, the tick.
LITTLE_ENDIAN = 1
FRAME_ID = 16
ANSWERS = ('pressure_reference', 'recruitment_state', 'valve_command')  # to bundle_state
MOST_GAPS = 20  # that are kept; all are counted
NAMED_GAPS = 3  # in words


def carries_tick(definition: str) -> bool:
    """Return whether messages of this definition begin with a header and a tick."""
    lines = (line.partition('#')[0].split() for line in definition.splitlines())
    fields = [line for line in lines if line][:2]
    return fields == [['std_msgs/Header', 'header'], ['uint64', 'tick']]


def tick_of(data: bytes) -> int:
    """
    Return the tick of a serialized message of the loop.

    Raises struct.error or IndexError when it is too short.
    """
    order = '<' if data[1] == LITTLE_ENDIAN else '>'
    (length,) = struct.unpack_from(f'{order}I', data, FRAME_ID - 4)
    start = 4 + -(-(FRAME_ID - 4 + length) // 8) * 8
    (tick,) = struct.unpack_from(f'{order}Q', data, start)
    return int(tick)


def is_answer(topic: str) -> bool:
    """Return whether a topic of the loop answers samples: not every one, if they come late."""
    return topic.rpartition('/')[2] in ANSWERS


class TopicLedger:
    """Counts what came on one topic and what is missing between."""

    def __init__(self, *, ticks: bool, answers: bool = False) -> None:
        """
        Know nothing yet; ``ticks`` tells whether the messages carry one.

        Where they are ``answers``, a tick was not answered if its publisher numbered the messages
        around it one after the other.
        """
        self._has_ticks, self._answers = ticks, answers
        self._count, self._runs = 0, 0
        self._first, self._newest = -1, -1
        self._missing_ticks, self._repeated_ticks, self._without_tick = 0, 0, 0
        self._gaps: list[tuple[int, int]] = []
        self._unanswered, self._unanswered_gaps = 0, list[tuple[int, int]]()
        self._sequence, self._lost = 0, 0

    def note(self, sequence: int, data: bytes) -> None:
        """Note one message; ``sequence`` is its publisher's number of it, 0 where unknown."""
        self._count += 1
        if not self._has_ticks:
            return  # such a topic may have many publishers, each with numbers of its own
        if sequence > self._sequence > 0:
            self._lost += sequence - self._sequence - 1
        numbered = self._sequence > 0 or self._count == 1
        follows = numbered and sequence == self._sequence + 1
        self._sequence = sequence  # one that goes back is a new publisher's
        try:
            tick = tick_of(data)
        except (struct.error, IndexError):
            self._without_tick += 1
        else:
            self._note_tick(tick, unanswered=self._answers and follows)

    def _note_tick(self, tick: int, *, unanswered: bool) -> None:
        if tick == 0 and self._newest != 0:
            self._runs += 1
            self._first = 0 if self._first < 0 else self._first
        elif self._newest < 0:
            self._runs, self._first = 1, tick
            if unanswered:
                self._note_gap(0, tick - 1, unanswered=True)
        elif tick > self._newest + 1:
            self._note_gap(self._newest + 1, tick - 1, unanswered=unanswered)
        elif tick <= self._newest:
            self._repeated_ticks += 1
            return
        self._newest = tick

    def _note_gap(self, first: int, last: int, *, unanswered: bool) -> None:
        gaps = self._unanswered_gaps if unanswered else self._gaps
        if unanswered:
            self._unanswered += last - first + 1
        else:
            self._missing_ticks += last - first + 1
        if len(gaps) < MOST_GAPS:
            gaps.append((first, last))

    def newest_tick(self) -> int | None:
        """Return the newest tick, None where the messages carry none."""
        return self._newest if self._has_ticks else None

    def summary(self) -> dict[str, Any]:
        """Return the counts by name; only the count of messages where they carry no ticks."""
        found: dict[str, Any] = {'count': self._count}
        if self._has_ticks:
            found |= {
                'lost': self._lost,
                'first_tick': self._first,
                'last_tick': self._newest,
                'runs': self._runs,
                'missing_ticks': self._missing_ticks,
                'repeated_ticks': self._repeated_ticks,
                'without_tick': self._without_tick,
                'gaps': self._gaps,
                'unanswered': self._unanswered,
                'unanswered_gaps': self._unanswered_gaps,
            }
        return found


def record_of(
    summaries: Mapping[str, dict[str, Any]],
    dropped: int | None,
    skipped: Mapping[str, str],
    damage: Sequence[str] = (),
) -> dict[str, str]:
    """
    Return what a bag says of its completeness, each value as JSON.

    ``summaries`` are those of the topics' ledgers, ``dropped`` the messages that the disk did not
    take in time, None where nobody knows, ``skipped`` why a topic was not recorded, ``damage``
    what was lost since, in words. ``whole`` answers whether the record is complete; that samples
    were not answered takes nothing from it.
    """
    missing = [*damage, *shortcomings(summaries, dropped or 0, skipped)]
    found: dict[str, Any] = {
        'whole': not missing,
        'missing': missing,
        'unanswered': list(unanswered(summaries)),
        'dropped': dropped,
        'skipped_topics': dict(skipped),
        **summaries,
    }
    return {name: json.dumps(value) for name, value in found.items()}


def shortcomings(
    summaries: Mapping[str, dict[str, Any]], dropped: int, skipped: Mapping[str, str]
) -> Iterator[str]:
    """Yield in words what is missing from a record; nothing when it is whole."""
    if not any(summary['count'] for summary in summaries.values()):
        yield 'no message was recorded'
    for topic, why in skipped.items():
        yield f'{topic}: {why}'
    if dropped:
        yield f'{dropped} messages dropped, for the disk was too slow'
    for topic, summary in summaries.items():
        if summary.get('lost'):
            yield f'{topic}: {summary["lost"]} messages lost before they were recorded'
        if summary.get('missing_ticks'):
            named = _ranges(summary['gaps'])
            yield f'{topic}: {summary["missing_ticks"]} ticks without a message ({named})'
        if summary.get('without_tick'):
            yield f'{topic}: {summary["without_tick"]} messages too short to carry a tick'
    yield from _ends(summaries)


def unanswered(summaries: Mapping[str, dict[str, Any]]) -> Iterator[str]:
    """Yield in words which samples were not answered, as sequence numbers prove."""
    for topic, summary in summaries.items():
        if summary.get('unanswered'):
            named = _ranges(summary['unanswered_gaps'])
            yield f'{topic}: {summary["unanswered"]} samples were not answered ({named})'


def _ranges(gaps: Sequence[tuple[int, int]]) -> str:
    named = [f'{a}-{b}' if b > a else f'{a}' for a, b in gaps[:NAMED_GAPS]]
    return ', '.join([*named, '...'] if len(gaps) > NAMED_GAPS else named)


def _ends(summaries: Mapping[str, dict[str, Any]]) -> Iterator[str]:
    """
    Yield which topics begin later than with tick 0, or end earlier than others of a bundle.

    That shows neither in their own ticks nor in their sequence numbers.
    """
    bundles: dict[str, dict[str, int]] = {}
    for topic, summary in summaries.items():
        if summary.get('last_tick', -1) >= 0:
            bundles.setdefault(topic.rpartition('/')[0], {})[topic] = summary['last_tick']
            first = summary['first_tick']
            if first > 0 and (0, first - 1) not in summary['unanswered_gaps']:
                yield f'{topic}: begins with tick {first}'
    for topics in bundles.values():
        last = max(topics.values())
        for topic, end in topics.items():
            if end < last:
                yield f'{topic}: ends with tick {end}, the others with {last}'
