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

"""Reads an SQLite database of rosbag2 as far as it can be read, with Python's own SQLite."""

from collections.abc import Iterator, Mapping
import contextlib
from pathlib import Path
import sqlite3
from typing import NamedTuple

from fam_bundle_io.bag_parts import Damage, Doubt, Messages, rows_of, short
import numpy as np

BATCH = 50_000  # messages that are taken together


class _Topic(NamedTuple):
    name: str
    type: str  # noqa: A003
    format: str  # noqa: A003
    definition: str
    qos: str
    type_hash: str


Row = tuple[int, int, bytes]  # number of the topic, time, message


def read_sqlite(file: Path, first: int) -> Iterator[list[Messages] | Damage | Doubt]:
    """Yield what is in a file; its messages are numbered from ``first``."""
    begin, rows, damage = first, list[Row](), []
    try:
        with contextlib.closing(_database(file)) as database:
            database.text_factory = lambda text: text.decode(errors='replace')
            topics = _topics(database)
            for row in database.execute('SELECT topic_id, timestamp, data FROM messages'):
                rows.append(row)
                if len(rows) == BATCH:
                    yield from _messages(rows, topics, first)
                    first, rows = first + BATCH, []
            (state,) = database.execute('PRAGMA integrity_check(1)').fetchone()
            if state != 'ok':
                damage.append(Damage(f'{file.name}: {" ".join(state.split())[:120]}'))
    except (sqlite3.Error, ValueError, TypeError, OverflowError, KeyError) as error:
        after = f'after {first + len(rows) - begin} messages'
        damage.append(Damage(f'{file.name}: cut short {after}: {short(error)}'))
    if rows:
        yield from _messages(rows, topics, first)
    yield from damage
    yield Doubt(
        f'{file.name}: its messages carry no checksum: if numbers have changed, nothing shows it'
    )


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
    columns = [column for _, column, *_ in database.execute('PRAGMA table_info(topics)')]
    topics = {}
    for row in database.execute('SELECT * FROM topics'):
        about = {column: f'{value}' for column, value in zip(columns, row, strict=True)}
        topics[row[columns.index('id')]] = _Topic(
            about['name'],
            about['type'],
            about['serialization_format'],
            f'{definitions.get(about["type"], "")}',
            about.get('offered_qos_profiles', ''),
            about.get('type_description_hash', ''),
        )
    return topics


def _messages(
    rows: list[Row], topics: Mapping[int, _Topic], first: int
) -> Iterator[list[Messages] | Damage]:
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
    parts = []
    for (identity, _), found in groups.items():
        topic = topics[identity]
        if topic.format != 'cdr':
            yield Damage(f'{topic.name}: messages in {topic.format} are not read')
            continue
        times = np.array([received for _, received, _ in found], dtype=np.int64)
        parts.append(
            Messages(
                topic.name,
                topic.type,
                topic.definition,
                np.array([number for number, _, _ in found]),
                times,
                times,
                np.zeros(len(found), dtype=np.int64),
                rows_of([data for _, _, data in found]),
                topic.qos,
                topic.type_hash,
            )
        )
    yield parts
