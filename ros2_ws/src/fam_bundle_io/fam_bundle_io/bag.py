# SPDX-License-Identifier: Apache-2.0
"""Reads any bag of a bundle's topics into tables; needs no ROS.

MCAP or SQLite, whole or cut short, as ``bag_recorder`` and ``rosbags`` write them; compressed bags
and those of ``ros2 bag record`` follow the same format and have not been tried. What could not be
read is said in ``Bag.warnings``.
"""

import contextlib
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from fam_bundle_io import cdr
from fam_bundle_io.bag_files import Damage, Messages, read_parts
from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.trace import Trace, empty_trace
from fam_bundle_model.parameters import (
    Configuration,
    make_configuration,
    parse_yaml,
    seconds,
)

if TYPE_CHECKING:
    import pandas as pd

TIMES = ('received', 'published')  # columns of every table: system time, ns
BATCH = 16 * 1024 * 1024  # bytes of a topic that are decoded at once
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
    },
    'fam_bundle_msgs/msg/ValveCommand': {'spool': 'spool'},
}


class Bag(NamedTuple):
    """What is in a bag.

    ``tables`` holds one row per message and one column per number, named as in the message
    (``header.stamp.sec``, ``mu_pressure[0]``), by topic; ``types`` the message types; ``records``
    what the recorder noted, by name; ``warnings`` what is missing or damaged, in words.
    """

    tables: 'dict[str, pd.DataFrame]'
    types: dict[str, str]
    records: dict[str, dict[str, str]]
    warnings: list[str]


def read_bag(path: Path, topics: Callable[[str], bool] = lambda name: True) -> Bag:
    """Return what is in the bag at ``path``, a folder or a file, of the ``topics`` asked for.

    Raises BagError when nothing can be read.
    """
    warnings: list[str] = []
    collectors: dict[str, _Collector] = {}
    types: dict[str, str] = {}
    unreadable: set[str] = set()
    records: dict[str, dict[str, str]] = {}
    for part in read_parts(path):
        if isinstance(part, Damage):
            warnings.append(part.words)
        elif isinstance(part, Messages):
            if not topics(part.topic) or part.topic in unreadable:
                continue
            types[part.topic] = part.type
            try:
                if part.topic not in collectors:
                    collectors[part.topic] = _Collector(part)
                collectors[part.topic].add(part)
            except BagError as error:
                unreadable.add(part.topic)
                warnings.append(f'{error}')
        else:
            records |= part
    tables = {}
    for name, collector in collectors.items():
        tables[name] = collector.table()
        warnings += collector.warnings
    if not tables:
        raise BagError('; '.join([f'{path}: no messages', *warnings]))
    return Bag(tables, types, records, warnings)


class _Collector:
    """Decodes the messages of one topic in batches."""

    def __init__(self, first: Messages) -> None:
        from rosbags.typesys import Stores, get_types_from_msg, get_typestore

        self.topic, self.type = first.topic, first.type
        self.warnings: list[str] = []
        self._store = get_typestore(Stores.EMPTY if first.definition else Stores.ROS2_JAZZY)
        if first.definition:
            try:
                self._store.register(get_types_from_msg(first.definition, first.type))
            except Exception as error:  # whatever a damaged definition makes of the parser
                raise BagError(f'{self.topic}: definition of {first.type}: {error}') from None
        if self.type not in self._store.fielddefs:
            raise BagError(f'{self.topic}: the bag does not define its type {self.type}')
        self._waiting: dict[int, list[Messages]] = {}
        self._size, self._damaged = 0, 0
        self._parts: dict[tuple[str, ...], list[tuple[np.ndarray, dict[str, np.ndarray]]]] = {}

    def add(self, messages: Messages) -> None:
        """Take messages of one size."""
        self._waiting.setdefault(messages.data.shape[1], []).append(messages)
        self._size += messages.data.size
        if self._size > BATCH:
            self._decode()

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
        table = frames[0] if len(frames) == 1 else pd.concat(frames) if frames else pd.DataFrame()
        return table.sort_index().reset_index(drop=True)


def _joined(parts: list[np.ndarray]) -> Any:
    import pandas as pd

    values = np.concatenate(parts)
    if values.dtype.kind != 'S':
        return values
    texts, codes = np.unique(values, return_inverse=True)
    names = [text.decode(errors='replace') for text in texts.tolist()]
    return pd.Categorical.from_codes(codes, pd.Index(names))


# ---- One run of the loop ----


def recorded_configuration(bag: Bag) -> Configuration | None:
    """Return the configuration that the recorder noted in the bag, None where it did not.

    Raises ConfigurationError when it is damaged.
    """
    text = bag.records.get('fam_bundle.provenance', {}).get('parameters')
    if text is None:
        return None
    return make_configuration(parse_yaml(text, 'parameters in the bag'))


class Run(NamedTuple):
    """One run of the loop: its trace, and what it lacks, in words.

    The bag does not hold the signals that are ``missing``: they are NaN, or zero in whole numbers.
    """

    trace: Trace
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
    """Return the trace of one of the runs in a bag, of all ticks that are on every topic.

    A topic that the bag misses leaves NaN. Raises BagError without ``bundle_state``.
    """
    tables, warnings = {}, []
    for name, short in LOOP.items():
        table = bag.tables.get(f'{namespace}/{short}')
        if table is None or 'tick' not in table:
            warnings.append(f'{namespace}/{short}: not in the bag')
            continue
        tables[name] = one_run(table, run)
    if STATE not in tables:
        raise BagError(f'{namespace}/{LOOP[STATE]}: not in the bag, without which there is no run')
    ticks = sorted(set.intersection(*(set(table.index) for table in tables.values())))
    if not ticks:
        raise BagError('no tick is on every topic of the loop')
    for name, table in tables.items():
        lost = ticks[-1] - ticks[0] + 1 - len(ticks)
        if len(table) > len(ticks):
            warnings.append(f'{LOOP[name]}: {len(table) - len(ticks)} ticks have no partner')
    if lost:
        warnings.append(f'{lost} ticks between the first and the last are missing')
    units = sum(column.startswith('mu_pressure[') for column in tables[STATE])
    trace = empty_trace(len(ticks), units)
    for values in trace.values():
        values.fill(0 if values.dtype.kind == 'i' else np.nan)
    for name, table in tables.items():
        rows = table.loc[ticks]
        if name == STATE:
            stamps = rows['header.stamp.sec'].to_numpy(np.int64) * 1_000_000_000
            trace['time'][:] = seconds(stamps + rows['header.stamp.nanosec'].to_numpy(np.int64))
        for signal, column in COLUMNS[name].items():
            if trace[signal].ndim == 2:
                for unit in range(units):
                    trace[signal][:, unit] = rows[f'{column}[{unit}]']
            else:
                trace[signal][:] = rows[column]
    missing = {s for name in COLUMNS if name not in tables for s in COLUMNS[name]}
    return Run(trace, warnings, frozenset(missing))


def one_run(table: 'pd.DataFrame', run: int) -> 'pd.DataFrame':
    """Return the rows of one run by tick, each at its first coming; tick 0 begins a run."""
    begins = table['tick'] == 0
    numbers = (begins & ~begins.shift(fill_value=False)).cumsum()
    wanted = numbers.max() if run < 0 else numbers.min() + run
    rows = table[numbers == wanted]
    return rows.drop_duplicates('tick').set_index('tick')
