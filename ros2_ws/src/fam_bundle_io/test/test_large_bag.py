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

"""Ten minutes at 1 kHz fit into memory: read as tables and made a trace, or recovered."""

from pathlib import Path
import subprocess
import sys

import damage
from fam_bundle_io.bag_writer import Item
import pytest

pytestmark = pytest.mark.alone

TICKS = 200_000  # a third of ten minutes
TEN_MINUTES = 600_000
LIMIT = 1_000_000_000  # bytes
FEW = 1_000

READ = """
import pathlib, resource, sys
from fam_bundle_io.bag import read_bag, trace_of
run = trace_of(read_bag(pathlib.Path(sys.argv[1])))
assert not run.warnings
print(len(run.ticks), resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""
RECOVER = """
import pathlib, resource, sys
from fam_bundle_io.recover import recover_bag

bag = pathlib.Path(sys.argv[1])
recovery = recover_bag(bag, bag.with_name('out'))
count = recovery.topics['/bundle_state']['count']
print(count, resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * 1024)
"""


def measured(program: str, bag: Path) -> tuple[int, int]:
    """Return ticks and largest memory (bytes) of a program of its own."""
    done = subprocess.run(
        [sys.executable, '-c', program, str(bag)], capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, done.stderr
    ticks, memory = map(int, done.stdout.split())
    return ticks, memory


def long_run(ticks: int) -> 'list[Item] | map[Item]':
    """Return messages of a long run, of which only the ticks rise."""
    pattern = list(damage.loop(range(100)))
    count = len(damage.TYPES)

    def item(number: int) -> Item:
        tick, time = number // count, damage.START + number * damage.PERIOD // count
        repeated = pattern[number % len(pattern)]._replace(received=time, published=time)
        return damage.with_tick(repeated, tick)

    return map(item, range(count * ticks))


@pytest.fixture(scope='module')
def bags(tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    folder = tmp_path_factory.mktemp('large')
    return {
        ticks: damage.write_bag(folder / f'{ticks}' / 'bag', long_run(ticks), chunk=0)
        for ticks in (FEW, TICKS)
    }


def test_ten_minutes_are_read_within_a_gigabyte(bags: dict[int, Path]) -> None:
    few, base = measured(READ, bags[FEW])
    many, memory = measured(READ, bags[TICKS])
    assert (few, many) == (FEW, TICKS)
    assert base + (memory - base) * TEN_MINUTES / TICKS < LIMIT


def test_recovery_needs_no_more_memory_for_more_messages(bags: dict[int, Path]) -> None:
    for bag in bags.values():
        (bag / 'metadata.yaml').unlink()
    few, base = measured(RECOVER, bags[FEW])
    many, memory = measured(RECOVER, bags[TICKS])
    assert (few, many) == (FEW, TICKS)
    assert memory - base < 0.5 * bags[TICKS].joinpath('bag_0.mcap').stat().st_size
