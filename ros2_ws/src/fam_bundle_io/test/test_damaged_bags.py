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

"""Whatever happens to a bag: an error in one line, or what it held, or a warning."""

from collections.abc import Callable, Iterator
import contextlib
from pathlib import Path
import random
import resource
import shutil
import sqlite3
import time
from typing import Any

import damage
from fam_bundle_io import cdr
from fam_bundle_io.bag import Bag, read_bag, Run, trace_of
from fam_bundle_io.bag_mcap import read_mcap
from fam_bundle_io.bag_parts import Damage
from fam_bundle_io.bag_writer import BagError, Item, Topic
from fam_bundle_io.completeness import tick_of
from mcap.reader import make_reader
import numpy as np
import pandas as pd
import pytest

PATIENCE = 20.0  # s; only a hang takes that long
MEMORY = 1 << 30  # bytes that reading one of these bags of 0.3 MB may ask for


Make = Callable[[str], Path]


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> Make:
    """Return a maker of whole bags, each written once."""
    return damage.whole_bags(tmp_path_factory.mktemp('whole'))


Truth = Callable[[damage.Case], dict[str, pd.DataFrame]]


@pytest.fixture(scope='module')
def truth(whole: Make, tmp_path_factory: pytest.TempPathFactory) -> Truth:
    """Return what gives the tables of a case's bag as it was before, by time of receipt."""
    known: dict[tuple[str, int], dict[str, pd.DataFrame]] = {}

    def tables(case: damage.Case) -> dict[str, pd.DataFrame]:
        key = (case.of, id(case.items))
        if key not in known:
            bag = whole(case.of)
            if case.items is not damage.ITEMS:
                bag = damage.write_bag(tmp_path_factory.mktemp('truth') / 'bag', case.items)
            found = read_bag(bag).tables
            known[key] = {name: table.set_index('received') for name, table in found.items()}
        return known[key]

    return tables


@pytest.fixture(scope='module')
def runs(tmp_path_factory: pytest.TempPathFactory) -> list[Run]:
    """Return the traces of the two runs, from tick 0 on."""
    folder = tmp_path_factory.mktemp('runs')

    def run(name: str, items: list[Item]) -> Run:
        found = trace_of(read_bag(damage.write_bag(folder / name, items)))
        assert np.array_equal(found.ticks, np.arange(damage.TICKS))
        return found

    return [run('first', damage.ITEMS), run('second', damage.SECOND)]


@contextlib.contextmanager
def bounded() -> Iterator[None]:
    """Bound memory and time; what asks for more gets a MemoryError."""
    pages = int(Path('/proc/self/statm').read_text().split()[0])
    limits = resource.getrlimit(resource.RLIMIT_AS)
    resource.setrlimit(resource.RLIMIT_AS, (pages * resource.getpagesize() + MEMORY, limits[1]))
    begin = time.monotonic()
    try:
        yield
    finally:
        resource.setrlimit(resource.RLIMIT_AS, limits)
    assert time.monotonic() - begin < PATIENCE


def alike(one: pd.Series, other: pd.Series) -> np.ndarray:
    """Return where two columns are the same to the last bit, or the same text."""
    if one.dtype != other.dtype:
        return np.asarray(one.astype(str).to_numpy() == other.astype(str).to_numpy())
    if one.dtype.kind == 'f':
        return np.asarray(one.to_numpy().view('i8') == other.to_numpy().view('i8'))
    return np.asarray(one.to_numpy() == other.to_numpy())


def wrong_rows(found: pd.DataFrame, true: pd.DataFrame | None) -> int:
    """Return how many rows are not those of the same message in the whole bag."""
    if true is None or not len(found):
        return len(found)
    known = found['received'].isin(true.index).to_numpy()
    rows = found[known].set_index('received')
    if set(rows.columns) != set(true.columns):
        return len(found)
    same = np.ones(len(rows), dtype=bool)
    wanted = true.loc[rows.index]
    for name in true.columns:
        same &= alike(rows[name], wanted[name])
    return len(found) - int(same.sum())


def wrong_ticks(run: Run, runs: list[Run]) -> int:
    """Return how many rows of a trace are not those of one and the same run, the likeliest."""
    counts = []
    for true in runs:
        known = run.ticks < damage.TICKS
        same = known.copy()
        for name, values in run.trace.items():
            if name in run.missing:
                continue
            wanted = true.trace[name][run.ticks[known].astype(int)]
            equal = (values[known] == wanted) | (np.isnan(values[known]) & np.isnan(wanted))
            same[known] &= equal.reshape(len(equal), -1).all(axis=1)
        counts.append(len(same) - int(same.sum()))
    return min(counts)


def last_run(items: list[Item]) -> int:
    """Return the number of ticks of the last run."""
    ticks = [tick_of(item.data) for item in items if item.topic == '/bundle_state']
    return ticks[::-1].index(0) + 1


def assert_one_line(error: BagError) -> None:
    assert str(error)
    assert '\n' not in str(error)


def assert_honest(bag: Bag, case: damage.Case, true: dict[str, pd.DataFrame]) -> None:
    assert all(words and '\n' not in words for words in bag.warnings)
    wrong = {name: wrong_rows(table, true.get(name)) for name, table in bag.tables.items()}
    if case.checked:
        assert not any(wrong.values()), wrong
    if not bag.warnings:
        assert not any(wrong.values()), wrong
        counts = {name: len(table) for name, table in bag.tables.items()}
        assert counts == {name: len(table) for name, table in true.items()}


def test_there_are_more_than_two_hundred_cases() -> None:
    assert len(damage.CASES) > 200


@pytest.mark.parametrize('name', damage.CASES)
def test_a_damaged_bag_is_an_error_or_right_or_warned_of(
    name: str, whole: Make, truth: Truth, runs: list[Run], tmp_path: Path
) -> None:
    case = damage.CASES[name]
    path = case.make(whole(case.of), tmp_path / 'bag', random.Random(name))
    true = truth(case)
    try:
        with bounded():
            bag = read_bag(path)
    except BagError as error:
        assert_one_line(error)
        return
    assert_honest(bag, case, true)
    try:
        with bounded():
            run = trace_of(bag)
    except BagError as error:
        assert_one_line(error)
        return
    warnings = bag.warnings + run.warnings
    wrong = wrong_ticks(run, runs)
    assert not wrong or (warnings and not case.checked), (wrong, warnings)
    if not warnings:
        assert len(run.ticks) == last_run(case.items)


# ---- What is said ----


def file_of(whole: Make, kind: str, tmp_path: Path) -> Path:
    """Return a copy of the file of a whole bag alone, which no metadata.yaml describes."""
    return Path(shutil.copy(damage.storage_of(whole(kind)), tmp_path))


def chunks(file: Path) -> list[Any]:
    """Return where the chunks of a file begin and end, as the ``mcap`` package reads them."""
    with file.open('rb') as stream:
        summary = make_reader(stream).get_summary()
    assert summary is not None
    return [
        (chunk.chunk_start_offset, chunk.chunk_start_offset + chunk.chunk_length)
        for chunk in summary.chunk_indexes
    ]


def overwrite(file: Path, at: int, content: bytes) -> None:
    with file.open('r+b') as stream:
        stream.seek(at)
        stream.write(content)


def test_a_chunk_that_looks_like_something_else_is_missed(whole: Make, tmp_path: Path) -> None:
    file = file_of(whole, 'rosbag2', tmp_path)
    message_index = b'\x07'
    overwrite(file, chunks(file)[2][0], message_index)
    warnings = read_bag(file).warnings
    assert any('messages were read, its index says 2400' in words for words in warnings)


def test_what_is_between_chunks_has_a_checksum_too(whole: Make, tmp_path: Path) -> None:
    file = file_of(whole, 'ours', tmp_path)
    at = file.read_bytes().index(b'seed') + len(b'seed') + 4
    overwrite(file, at, b'2')
    bag = read_bag(file)
    assert bag.records['fam_bundle.provenance'] == {'seed': '2'}
    assert any('its checksum is wrong' in words for words in bag.warnings)


def test_a_file_that_ends_too_early_says_where(whole: Make, tmp_path: Path) -> None:
    file = file_of(whole, 'ours', tmp_path)
    (_, end), *_ = chunks(file)[3:]
    file.write_bytes(file.read_bytes()[:end])
    bag = read_bag(file)
    count = sum(len(table) for table in bag.tables.values())
    assert any(f'cut short after {count} messages' in words for words in bag.warnings)


def test_a_file_that_ends_within_a_record_says_how_much_is_there(
    whole: Make, tmp_path: Path
) -> None:
    file = file_of(whole, 'ours', tmp_path)
    (begin, end), *_ = chunks(file)[3:]
    file.write_bytes(file.read_bytes()[: begin + 9 + 100])
    words = f'the file ends within a record: 100 of its {end - begin - 9} bytes are there'
    assert any(words in warning for warning in read_bag(file).warnings)


def test_a_file_that_grows_while_it_is_read_is_still_being_written(
    whole: Make, tmp_path: Path
) -> None:
    file = file_of(whole, 'ours', tmp_path)
    content = file.read_bytes()
    (begin, _), *_ = chunks(file)[3:]
    file.write_bytes(content[: begin + 5])  # within the head of a record
    parts = read_mcap(file, 0)
    found = [next(parts)]
    with file.open('ab') as stream:
        stream.write(content[begin + 5 :])  # noqa: E203
    found += parts
    (damage,) = [part.words for part in found if isinstance(part, Damage)]
    assert damage.endswith(' messages: it was still being written')


def test_rows_that_an_index_of_a_database_has_and_its_table_not(
    whole: Make, tmp_path: Path
) -> None:
    file = file_of(whole, 'sqlite', tmp_path)
    hide = "DELETE FROM sqlite_master WHERE name = 'timestamp_idx'"
    show = 'INSERT INTO sqlite_master VALUES (?, ?, ?, ?, ?)'
    with contextlib.closing(sqlite3.connect(file)) as database:
        (index,) = database.execute("SELECT * FROM sqlite_master WHERE name = 'timestamp_idx'")
    for statement, values in (
        (hide, ()),
        ('DELETE FROM messages WHERE id = 7', ()),
        (show, index),
    ):
        with contextlib.closing(sqlite3.connect(file)) as database:
            database.execute('PRAGMA writable_schema = ON')
            database.execute(statement, values)
            database.commit()
    assert any('entries in index' in words for words in read_bag(file).warnings)


def test_holes_in_the_ticks_are_counted(tmp_path: Path) -> None:
    path = damage.CASES['ours ticks with holes'].make(tmp_path, tmp_path / 'bag', random.Random())
    run = trace_of(read_bag(path))
    holes = 4 * damage.TICKS // 50 - 4  # the first four ticks are no hole
    assert run.warnings == [
        'the run begins with tick 4',
        f'{holes} ticks between the first and the last are missing',
    ]


def test_a_topic_of_another_type_is_none_of_the_loop(tmp_path: Path) -> None:
    topics = {
        **damage.TOPICS,
        '/valve_command': damage.TOPICS['/pressure_reference']._replace(name='/valve_command'),
    }
    items = [
        item._replace(topic='/valve_command')
        for item in damage.ITEMS
        if item.topic == '/pressure_reference'
    ]
    bag = read_bag(damage.write_bag(tmp_path / 'bag', [*damage.ITEMS, *items], topics))
    run = trace_of(bag)
    assert any('is of type fam_bundle_msgs/msg/PressureReference' in w for w in run.warnings)
    assert 'spool' in run.missing
    assert np.isnan(run.trace['spool']).all()


def test_a_length_that_lies_in_every_message_costs_no_hours() -> None:
    """Read as a text's length, the low half of a float64 is another one in every message."""
    types = {'a/msg/Text': ([], [('text', (1, ('string', 0)))])}
    messages = np.zeros((200_000, 64), dtype='u1')
    messages[:, 1] = 1
    messages[:, 4:8] = np.arange(1000, 1000 + len(messages), dtype='<u4').view('u1').reshape(-1, 4)
    begin = time.monotonic()
    parts = list(cdr.decode(messages, 'a/msg/Text', types))
    assert time.monotonic() - begin < PATIENCE
    assert sum(len(part.rows) for part in parts) == len(messages)
    assert not any(part.columns for part in parts)


# ---- What is saved ----


def rows_lost(bag: Bag) -> list[int]:
    """Return the ticks of the plant that are not there."""
    return sorted(set(range(damage.TICKS)) - set(bag.tables['/bundle_state']['tick'].tolist()))


def test_a_chunk_in_pieces_costs_no_other(whole: Make, tmp_path: Path) -> None:
    file = file_of(whole, 'ours', tmp_path)
    begin, end = chunks(file)[4]
    overwrite(file, (begin + end) // 2, bytes(100))
    lost = rows_lost(read_bag(file))
    assert len(lost) == damage.CHUNK
    assert lost == list(range(lost[0], lost[0] + damage.CHUNK))


@pytest.mark.parametrize('kind', ['ours', 'rosbag2', 'zstd'])
@pytest.mark.parametrize('offset', [0, 1, 3, 33, 41])
def test_a_chunk_with_a_damaged_head_costs_no_other(
    whole: Make, tmp_path: Path, kind: str, offset: int
) -> None:
    """Opcode, low and high byte of its length, its compression, the length of its data."""
    file = file_of(whole, kind, tmp_path)
    places = chunks(file)
    sizes = len(places)
    begin, _ = places[1]
    overwrite(file, begin + offset, bytes([file.read_bytes()[begin + offset] ^ 0x10]))
    bag = read_bag(file)
    assert len(rows_lost(bag)) < 1.5 * damage.TICKS / sizes
    assert bag.warnings


def test_the_first_chunk_names_the_topics_and_so_does_the_index(
    whole: Make, tmp_path: Path
) -> None:
    file = file_of(whole, 'ours', tmp_path)
    (begin, _), (_, end), *_ = chunks(file)  # the first has one message
    overwrite(file, begin, bytes(end - begin))
    bag = read_bag(file)
    assert set(bag.tables) == set(damage.TYPES)
    assert 0 < len(rows_lost(bag)) <= damage.CHUNK + 1


def test_files_without_a_description_are_read_in_their_order(tmp_path: Path) -> None:
    damage.write_bag(tmp_path / 'bag', split=0.05)
    assert (tmp_path / 'bag' / 'bag_10.mcap').exists()
    (tmp_path / 'bag' / 'metadata.yaml').unlink()
    bag = read_bag(tmp_path / 'bag')
    assert list(bag.tables['/bundle_state']['tick']) == list(range(damage.TICKS))


def test_a_file_with_another_name_is_found(whole: Make, tmp_path: Path) -> None:
    bag = tmp_path / 'bag'
    shutil.copytree(whole('split'), bag)
    (bag / 'split_1.mcap').rename(bag / 'split_1_copy.mcap')
    found = read_bag(bag)
    assert rows_lost(found) == []
    assert 'split_1.mcap is missing' in found.warnings


def test_a_type_is_what_the_bag_says_not_what_is_installed(tmp_path: Path) -> None:
    name = 'std_msgs/msg/Bool'
    topics = {'/x': Topic('/x', name, 'float64 data\n')}
    data = b'\0\1\0\0' + np.float64(0.1).tobytes()
    bag = read_bag(damage.write_bag(tmp_path / 'bag', [Item('/x', 1, 1, 1, data)], topics))
    assert list(bag.tables['/x']['data']) == [0.1]
    assert bag.warnings == []
