# SPDX-License-Identifier: Apache-2.0
"""Whether a record of the loop is whole: what its ticks and sequence numbers prove."""

import json
import struct
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

# A message of the loop begins with a header and a tick. In CDR: four bytes that tell the byte
# order, the stamp (two of four bytes), the length of frame_id, its text, and at the next multiple
# of eight, counted from the fifth byte, the tick.
LITTLE_ENDIAN = 1
FRAME_ID = 16
MOST_GAPS = 20  # that are named; all are counted


def carries_tick(definition: str) -> bool:
    """Return whether messages of this definition begin with a header and a tick."""
    lines = (line.partition('#')[0].split() for line in definition.splitlines())
    fields = [line for line in lines if line][:2]
    return fields == [['std_msgs/Header', 'header'], ['uint64', 'tick']]


def tick_of(data: bytes) -> int:
    """Return the tick of a serialized message of the loop.

    Raises struct.error or IndexError when it is too short.
    """
    order = '<' if data[1] == LITTLE_ENDIAN else '>'
    (length,) = struct.unpack_from(f'{order}I', data, FRAME_ID - 4)
    start = 4 + -(-(FRAME_ID - 4 + length) // 8) * 8
    (tick,) = struct.unpack_from(f'{order}Q', data, start)
    return int(tick)


class TopicLedger:
    """Counts what came on one topic and what is missing between."""

    def __init__(self, *, ticks: bool) -> None:
        """Know nothing yet; ``ticks`` tells whether the messages carry one."""
        self._has_ticks = ticks
        self._count, self._runs = 0, 0
        self._first, self._newest = -1, -1
        self._missing_ticks, self._repeated_ticks, self._without_tick = 0, 0, 0
        self._gaps: list[tuple[int, int]] = []
        self._sequence, self._lost = 0, 0

    def note(self, sequence: int, data: bytes) -> None:
        """Note one message; ``sequence`` is its publisher's number of it, 0 where unknown."""
        self._count += 1
        if not self._has_ticks:
            return  # such a topic may have many publishers, each with numbers of its own
        if sequence > self._sequence > 0:
            self._lost += sequence - self._sequence - 1
        self._sequence = sequence  # one that goes back is a new publisher's
        try:
            tick = tick_of(data)
        except (struct.error, IndexError):
            self._without_tick += 1
        else:
            self._note_tick(tick)

    def _note_tick(self, tick: int) -> None:
        if tick == 0 and self._newest != 0:
            self._runs += 1
            self._first = 0 if self._first < 0 else self._first
        elif self._newest < 0:
            self._runs, self._first = 1, tick
        elif tick > self._newest + 1:
            self._missing_ticks += tick - self._newest - 1
            if len(self._gaps) < MOST_GAPS:
                self._gaps.append((self._newest + 1, tick - 1))
        elif tick <= self._newest:
            self._repeated_ticks += 1
            return
        self._newest = tick

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
            }
        return found


def record_of(
    summaries: Mapping[str, dict[str, Any]],
    dropped: int | None,
    skipped: Mapping[str, str],
    damage: Sequence[str] = (),
) -> dict[str, str]:
    """Return what a bag says of its completeness, each value as JSON.

    ``summaries`` are those of the topics' ledgers, ``dropped`` the messages that the disk did not
    take in time, None where nobody knows, ``skipped`` why a topic was not recorded, ``damage``
    what was lost since, in words.
    """
    missing = [*damage, *shortcomings(summaries, dropped or 0)]
    found: dict[str, Any] = {
        'whole': not missing,
        'missing': missing,
        'dropped': dropped,
        'skipped_topics': dict(skipped),
        **summaries,
    }
    return {name: json.dumps(value) for name, value in found.items()}


def shortcomings(summaries: Mapping[str, dict[str, Any]], dropped: int) -> Iterator[str]:
    """Yield in words what is missing from a record; nothing when it is whole.

    A tick may be missing without being lost: a controller does not answer a stale sample. What
    was published and not recorded shows in the sequence numbers.
    """
    if dropped:
        yield f'{dropped} messages dropped, for the disk was too slow'
    for topic, summary in summaries.items():
        if summary.get('lost'):
            yield f'{topic}: {summary["lost"]} messages lost before they were recorded'
        if summary.get('missing_ticks'):
            gaps = ', '.join(f'{a}-{b}' if b > a else f'{a}' for a, b in summary['gaps'])
            yield f'{topic}: {summary["missing_ticks"]} ticks without a message ({gaps})'
        if summary.get('without_tick'):
            yield f'{topic}: {summary["without_tick"]} messages too short to carry a tick'
    yield from _ends(summaries)


def _ends(summaries: Mapping[str, dict[str, Any]]) -> Iterator[str]:
    """Yield which topics of a bundle begin later or end earlier than the others.

    That shows neither in their own ticks nor in their sequence numbers.
    """
    bundles: dict[str, dict[str, tuple[int, int]]] = {}
    for topic, summary in summaries.items():
        if summary.get('last_tick', -1) >= 0:
            ends = summary['first_tick'], summary['last_tick']
            bundles.setdefault(topic.rpartition('/')[0], {})[topic] = ends
    for topics in bundles.values():
        first = min(begin for begin, _ in topics.values())
        last = max(end for _, end in topics.values())
        for topic, (begin, end) in topics.items():
            if begin > first:
                yield f'{topic}: begins with tick {begin}, the others with {first}'
            if end < last:
                yield f'{topic}: ends with tick {end}, the others with {last}'
