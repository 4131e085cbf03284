# SPDX-License-Identifier: Apache-2.0
"""``./fam recover`` tells a whole bag from a damaged one, and refuses in one line."""

from collections.abc import Callable
from pathlib import Path
import subprocess

from fam_bundle_io.bag import read_bag
from fam_bundle_io.bag_writer import BagFolder, Item, Topic
import pytest

COUNT = 20_000
Fam = Callable[..., 'subprocess.CompletedProcess[str]']


@pytest.fixture
def bag(tmp_path: Path) -> Path:
    """Return a whole bag of one topic without ticks."""
    folder = BagFolder(tmp_path / 'bag')
    folder.add_topic(Topic('/number', 'std_msgs/msg/UInt64', 'uint64 data\n'))
    for number in range(COUNT):
        data = b'\0\1\0\0' + number.to_bytes(8, 'little')
        folder.write(Item('/number', number, number, number + 1, data))
    folder.close({})
    return tmp_path / 'bag'


def cut(bag: Path) -> None:
    file = bag / 'bag_0.mcap'
    file.write_bytes(file.read_bytes()[: file.stat().st_size // 2])


def assert_refused(done: 'subprocess.CompletedProcess[str]', words: str) -> None:
    assert done.returncode == 2
    assert done.stdout == ''
    lines = [line for line in done.stderr.splitlines() if line.startswith('fam recover: ')]
    assert len(lines) == 1
    assert words in lines[0]
    assert 'Traceback' not in done.stderr


def test_a_whole_bag_is_left_alone(bag: Path, fam: Fam, tmp_path: Path) -> None:
    done = fam('recover', bag)
    assert done.returncode == 0
    assert done.stdout == f'{bag}: nothing is damaged, {COUNT} messages\n'
    assert list(tmp_path.iterdir()) == [bag]


def test_a_damaged_bag_is_written_beside_it(bag: Path, fam: Fam) -> None:
    cut(bag)
    done = fam('recover', bag)
    assert done.returncode == 0
    recovered = bag.with_name('bag_recovered')
    count = len(read_bag(recovered).tables['/number'])
    assert 0 < count < COUNT
    lines = done.stdout.splitlines()
    assert lines[0] == f'/number: {count} messages'
    assert any(f'cut short after {count} messages' in line for line in lines)
    assert any(f'metadata.yaml says {COUNT}' in line for line in lines)
    assert lines[-1] == f'written to {recovered}'


def test_a_file_alone_is_written_where_it_was_asked_for(
    bag: Path, fam: Fam, tmp_path: Path
) -> None:
    cut(bag)
    done = fam('recover', bag / 'bag_0.mcap', '--out', tmp_path / 'a' / 'b')
    assert done.returncode == 0
    assert read_bag(tmp_path / 'a' / 'b').warnings[0].startswith('recovered: from bag_0.mcap; ')


def test_what_cannot_be_is_refused(bag: Path, fam: Fam, tmp_path: Path) -> None:
    cut(bag)
    assert_refused(fam('recover', tmp_path / 'nowhere'), 'nowhere: no such bag')
    assert_refused(fam('recover', bag, '--out', tmp_path), 'exists; a bag never overwrites')
    assert_refused(fam('recover', bag, '--out', '/proc/x'), '/proc/x')
    (bag / 'bag_0.mcap').write_bytes(b'')
    assert_refused(fam('recover', bag), 'no messages')
    assert list(tmp_path.iterdir()) == [bag]
