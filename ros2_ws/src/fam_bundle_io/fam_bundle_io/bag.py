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
Reads any bag of a bundle's topics into tables; needs no ROS.

MCAP or SQLite, compressed or not, whole or cut short, as ``bag_recorder``, ``ros2 bag record`` and
``rosbags`` write them. What could not be read is said in ``Bag.warnings``.
"""

from collections.abc import Callable, Iterable, Iterator
import contextlib
import functools
import json
from pathlib import Path
import re
from typing import Any, NamedTuple, TYPE_CHECKING

from fam_bundle_io import cdr
from fam_bundle_io.bag_files import read_parts
from fam_bundle_io.bag_parts import Damage, Doubt, Messages
from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.trace import empty_trace, Trace
from fam_bundle_model.parameters import (
    Configuration,
    make_configuration,
    parse_yaml,
    seconds,
)
import numpy as np

if TYPE_CHECKING:
    import pandas as pd

TIMES = ('received', 'published')  # columns of every table: system time, ns
LATE = 100  # ticks that a message may be late among others
LONGEST_ANSWER = 10_000_000_000  # ns after its sample; beyond it belongs to another run
BATCH = 16 * 1024 * 1024  # bytes of a topic that are decoded at once
HASH = 'RIHS01_[0-9a-f]{64}'  # of a definition, as ROS 2 makes it
STATE = 'fam_bundle_msgs/msg/BundleState'
LOOP = {
    STATE: 'bundle_state',
    'fam_bundle_msgs/msg/PressureReference': 'pressure_reference',
    'fam_bundle_msgs/msg/RecruitmentState': 'recruitment_state',
    'fam_bundle_msgs/msg/ValveCommand': 'valve_command',
}
# Signals of a trace and the fields that they come from; those per motor unit are lists there.
COLUMNS = {
    STATE: {
        name: name for name in ('strain', 'force', 'source_pressure', 'source_flow', 'mu_pressure')
    },
    'fam_bundle_msgs/msg/PressureReference': {
        'strain_reference': 'strain_reference',
        'pressure_reference': 'pressure',
    },
    'fam_bundle_msgs/msg/RecruitmentState': {
        'recruitment_state': 'recruited',
        'time_to_saturation': 'time_to_saturation',
        'time_to_desaturation': 'time_to_desaturation',
        'recruitment_lag': 'recruitment_lag',
        'pressure_compensation': 'pressure_compensation',
        'deslack_pressure': 'deslack_pressure',
        'prediction_error': 'prediction_error',
    },
    'fam_bundle_msgs/msg/ValveCommand': {'spool': 'spool'},
}


class Bag(NamedTuple):
    """
    What is in a bag.

    ``tables`` holds one row per message and one column per number, named as in the message
    (``header.stamp.sec``, ``mu_pressure[0]``), by topic; ``types`` the message types; ``records``
    what the recorder noted, by name; ``warnings`` what is missing or damaged, in words.
    """

    tables: 'dict[str, pd.DataFrame]'
    types: dict[str, str]
    records: dict[str, dict[str, str]]
    warnings: list[str]


def read_bag(path: Path, topics: Callable[[str], bool] = lambda name: True) -> Bag:
    """
    Return what is in the bag at ``path``, a folder or a file, of the ``topics`` asked for.

    Raises BagError when nothing can be read.
    """
    warnings: list[str] = []
    collectors: dict[str, _Collector] = {}
    types: dict[str, str] = {}
    unreadable: set[str] = set()
    records: dict[str, dict[str, str]] = {}
    for part in read_parts(path):
        if isinstance(part, Damage | Doubt):
            warnings.append(part.words)
        elif isinstance(part, dict):
            records |= part
        else:
            for messages in part:
                name = messages.topic
                if not topics(name) or name in unreadable:
                    continue
                types.setdefault(name, messages.type)
                try:
                    if name not in collectors:
                        collectors[name] = _Collector(messages)
                    collectors[name].add(messages)
                except BagError as error:
                    unreadable.add(name)
                    collectors.pop(name, None)
                    warnings.append(f'{error}')
    tables = {}
    for name, collector in collectors.items():
        tables[name] = collector.table()
        warnings += collector.warnings
    warnings += _recovered(records.get('fam_bundle.recovery'))
    if not tables:
        raise BagError('; '.join([f'{path}: no messages', *warnings]))
    return Bag(tables, types, records, warnings)


def _recovered(record: dict[str, str] | None) -> Iterator[str]:
    """Yield what a bag says of its recovery from a damaged one, nothing of any other."""
    if record is not None:
        try:
            words = [str(words) for words in json.loads(record['damage'])]
        except (ValueError, TypeError, KeyError):
            words = ['what was lost cannot be read']
        yield '; '.join([f'recovered: from {record.get("source", "a damaged bag")}', *words])


class _Collector:
    """Decodes the messages of one topic in batches."""

    def __init__(self, first: Messages) -> None:
        from rosbags.typesys import get_types_from_msg, get_typestore, Stores

        self.topic, self.type, self.definition = first.topic, first.type, first.definition
        self.warnings: list[str] = []
        self._store = get_typestore(Stores.EMPTY if first.definition else Stores.ROS2_JAZZY)
        if first.definition:
            try:
                self._store.register(get_types_from_msg(first.definition, first.type))
            except Exception as error:  # whatever a damaged definition makes of the parser
                why = f'{error}'.partition('\n')[0]
                raise BagError(f'{self.topic}: definition of {first.type}: {why}') from None
        for name in cdr.types_within(self.type, self._store.fielddefs):
            if name not in self._store.fielddefs:
                raise BagError(f'{self.topic}: the bag does not define its type {name}')
        if cdr.holds_itself(self.type, self._store.fielddefs):
            raise BagError(f'{self.topic}: its type {self.type} holds itself')
        self._check_hash(first.type_hash)
        self._waiting: dict[int, list[Messages]] = {}
        self._size, self._damaged, self._others = 0, 0, 0
        self._parts: dict[tuple[str, ...], list[tuple[np.ndarray, dict[str, np.ndarray]]]] = {}

    def add(self, messages: Messages) -> None:
        """Take messages of one size."""
        if (messages.type, messages.definition) != (self.type, self.definition):
            self._others += len(messages.numbers)
            return
        self._waiting.setdefault(messages.data.shape[1], []).append(messages)
        self._size += messages.data.size
        if self._size > BATCH:
            self._decode()

    def _check_hash(self, published: str) -> None:
        """Warn when the definition is not that of the messages that were published."""
        if not re.fullmatch(HASH, published):
            return
        try:
            found = self._store.hash_rihs01(self.type)
        except Exception as error:  # whatever a damaged definition makes of it
            found = f'{type(error).__name__}'
        if found != published:
            self.warnings.append(f'{self.topic}: its definition is not the one it was sent with')

    def _decode(self) -> None:
        for waiting in self._waiting.values():
            data = np.concatenate([messages.data for messages in waiting])
            numbers = np.concatenate([messages.numbers for messages in waiting])
            times = {
                name: np.concatenate([getattr(messages, name) for messages in waiting])
                for name in TIMES
            }
            for part in self._parts_of(data):
                if not part.columns:
                    self._damaged += len(part.rows)
                    continue
                columns = {name: values[part.rows] for name, values in times.items()}
                columns |= part.columns
                key = tuple(columns)
                self._parts.setdefault(key, []).append((numbers[part.rows], columns))
        self._waiting, self._size = {}, 0

    def _parts_of(self, data: np.ndarray) -> Iterable[cdr.Part]:
        try:
            return list(cdr.decode(data, self.type, self._store.fielddefs))
        except cdr.NotFlatError:
            return [self._objects(number, row.tobytes()) for number, row in enumerate(data)]

    def _objects(self, number: int, message: bytes) -> cdr.Part:
        """Return a message that is no row of numbers with one object for each of its fields."""
        columns = {}
        with contextlib.suppress(Exception):  # it is damaged, and counted as that
            found = self._store.deserialize_cdr(message, self.type)
            for field, _ in self._store.fielddefs[self.type][1]:
                columns[field] = np.empty(1, dtype=object)
                columns[field][0] = getattr(found, field)
        return cdr.Part(np.array([number]), columns)

    def table(self) -> 'pd.DataFrame':
        """Return all rows in the order of the bag."""
        import pandas as pd

        self._decode()
        frames = []
        for key, parts in self._parts.items():
            index = np.concatenate([numbers for numbers, _ in parts])
            columns = {name: _joined([columns[name] for _, columns in parts]) for name in key}
            frames.append(pd.DataFrame(columns, index=index, copy=False))
        self._parts = {}
        if self._damaged:
            self.warnings.append(f'{self.topic}: {self._damaged} messages are damaged')
        if self._others:
            words = f'{self._others} messages of another type are not read'
            self.warnings.append(f'{self.topic}: {words}')
        table = frames[0] if len(frames) == 1 else pd.concat(frames) if frames else pd.DataFrame()
        return table.sort_index().reset_index(drop=True)


def _joined(parts: list[np.ndarray]) -> Any:
    import pandas as pd

    values = np.concatenate(parts)
    if values.dtype.kind != 'S':
        return values
    texts, codes = np.unique(values, return_inverse=True)
    # Damaged texts may be the same once they are decoded.
    decoded = [text.decode(errors='replace') for text in texts.tolist()]
    names, numbers = np.unique(decoded, return_inverse=True)
    return pd.Categorical.from_codes(numbers[codes], pd.Index(names.tolist()))


# ---- One run of the loop ----


def recorded_configuration(bag: Bag) -> Configuration | None:
    """
    Return the configuration that the recorder noted in the bag, None where it did not.

    Raises ConfigurationError when it is damaged.
    """
    text = bag.records.get('fam_bundle.provenance', {}).get('parameters')
    if text is None:
        return None
    return make_configuration(parse_yaml(text, 'parameters in the bag'))


class Run(NamedTuple):
    """
    One run of the loop: its trace, the ticks of its rows, and what it lacks, in words.

    The bag does not hold the signals that are ``missing``: they are NaN, or zero in whole numbers.
    """

    trace: Trace
    ticks: np.ndarray
    warnings: list[str]
    missing: frozenset[str]


def loop_topics(bag: Bag) -> dict[str, list[str]]:
    """Return the topics of the loop by the namespace of their bundle, '' for the root."""
    found: dict[str, list[str]] = {}
    for topic, name in bag.types.items():
        if name in COLUMNS and topic.rpartition('/')[2] == LOOP[name]:
            found.setdefault(topic.rpartition('/')[0], []).append(topic)
    return found


def trace_of(bag: Bag, namespace: str = '', run: int = -1) -> Run:
    """
    Return the trace of one of the runs in a bag, of all ticks that are on every topic.

    A topic that the bag misses leaves NaN. Raises BagError without ``bundle_state``.
    """
    tables, warnings = run_tables(bag, namespace, run)
    common = functools.partial(np.intersect1d, assume_unique=True)
    ticks = functools.reduce(common, (table.index.to_numpy() for table in tables.values()))
    if not len(ticks):
        raise BagError('no tick is on every topic of the loop')
    first, last = int(ticks[0]), int(ticks[-1])
    for name, table in tables.items():
        if len(table) > len(ticks):
            warnings.append(f'{LOOP[name]}: {len(table) - len(ticks)} ticks have no partner')
    if first:
        warnings.append(f'the run begins with tick {first}')
    if last - first + 1 > len(ticks):
        lost = last - first + 1 - len(ticks)
        warnings.append(f'{lost} ticks between the first and the last are missing')
    units = sum(column.startswith('mu_pressure[') for column in tables[STATE])
    trace = empty_trace(len(ticks), units)
    for values in trace.values():
        values.fill(0 if values.dtype.kind == 'i' else np.nan)
    missing = {s for name in COLUMNS if name not in tables for s in COLUMNS[name]}
    for name, table in tables.items():
        rows = _Rows(table, table.index.get_indexer(ticks))
        if name == STATE:
            stamps = [rows.column(f'header.stamp.{part}') for part in ('sec', 'nanosec')]
            if any(part is None or part.dtype.kind not in 'iu' for part in stamps):
                missing.add('time')
            else:
                sec, nanosec = (part.astype(np.int64) for part in stamps)
                trace['time'][:] = seconds(sec * 1_000_000_000 + nanosec)
        for signal, column in COLUMNS[name].items():
            if not rows.fill(trace[signal], column):
                missing.add(signal)
    for name, signals in COLUMNS.items():
        if name in tables:
            warnings += [f'{LOOP[name]}: has no {signals[s]}' for s in signals if s in missing]
    return Run(trace, ticks, warnings, frozenset(missing))


class _Rows(NamedTuple):
    """Some rows of a table, by their places."""

    table: 'pd.DataFrame'
    places: np.ndarray

    def column(self, name: str) -> Any:
        """Return the numbers of a column, None where it holds none."""
        if name not in self.table:
            return None
        values = self.table[name].to_numpy()
        return values[self.places] if values.dtype.kind in 'biuf' else None

    def fill(self, values: np.ndarray, name: str) -> bool:
        """Fill ``values`` with a column, or with those of an array; False where it is missing."""
        names = [f'{name}[{unit}]' for unit in range(values.shape[1])] if values.ndim == 2 else []
        columns = [self.column(name) for name in names or [name]]
        whole = values.dtype.kind == 'i'
        if any(c is None or (whole and c.dtype.kind not in 'iu') for c in columns):
            return False
        values[:] = np.stack(columns, axis=-1) if names else columns[0]
        return True


def run_tables(
    bag: Bag, namespace: str = '', run: int = -1
) -> 'tuple[dict[str, pd.DataFrame], list[str]]':
    """
    Return the rows of one run by tick, for each message type of the loop, and warnings.

    What answers the samples of the plant belongs to their run. Raises BagError without them.
    """
    found, warnings = {}, []
    for name, short in LOOP.items():
        topic = f'{namespace}/{short}'
        table = bag.tables.get(topic)
        if table is None:
            warnings.append(f'{topic}: not in the bag')
        elif bag.types[topic] != name:
            warnings.append(f'{topic}: is of type {bag.types[topic]}, not {name}')
        elif 'tick' not in table or table['tick'].dtype.kind not in 'iu':
            warnings.append(f'{topic}: its messages carry no tick')
        else:
            found[name] = table
    if STATE not in found:
        topic = f'{namespace}/{LOOP[STATE]}'
        why = [words for words in warnings if words.startswith(f'{topic}: ')]
        raise BagError(f'{why[0]}, without which there is no run')
    state = found[STATE]
    runs = runs_of(state)
    wanted = run if run >= 0 else runs[-1] + 1 + run
    rows = {STATE: state[runs == wanted]}
    for name in set(found) - {STATE}:
        rows[name] = _answers(found[name], state, runs, wanted)
    tables = {}
    for name in found:
        tables[name] = rows[name].drop_duplicates('tick').set_index('tick')
        repeated = len(rows[name]) - len(tables[name])
        if repeated:
            warnings.append(f'{LOOP[name]}: {repeated} messages repeat a tick')
    return tables, warnings


def runs_of(table: 'pd.DataFrame') -> np.ndarray:
    """
    Return for each row the number of its run, counted from 0.

    A run begins at tick 0; where that is lost, ticks fall back by more than some that were late.
    """
    ticks = table['tick'].to_numpy().astype(np.int64)
    begins = np.zeros(len(ticks), dtype=bool)
    begins[1:] = (ticks[1:] == 0) & (ticks[:-1] != 0)
    begins[1:] |= ticks[1:] < ticks[:-1] - LATE
    return np.asarray(np.cumsum(begins))


def _answers(
    table: 'pd.DataFrame', state: 'pd.DataFrame', runs: np.ndarray, wanted: int
) -> 'pd.DataFrame':
    """Return the answers to the samples of one run: those nearest in time of the same tick."""
    import pandas as pd

    if runs[-1] == 0:
        return table if wanted == 0 else table[:0]
    samples = state[['tick', 'published']].assign(run=runs).sort_values('published')
    answers = table[['tick', 'published']].sort_values('published')
    samples['tick'], answers['tick'] = samples['tick'].astype('u8'), answers['tick'].astype('u8')
    nearest = pd.merge_asof(
        answers,
        samples,
        on='published',
        by='tick',
        direction='nearest',
        tolerance=LONGEST_ANSWER,
    )
    places = answers.index[(nearest['run'] == wanted).to_numpy()]
    return table.loc[places.sort_values()]
