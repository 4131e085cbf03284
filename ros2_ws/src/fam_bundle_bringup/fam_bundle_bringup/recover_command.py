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

"""``./fam recover``: makes a whole bag out of a damaged one, and says what is in it."""

from collections.abc import Iterator
from pathlib import Path
from typing import Any

from fam_bundle_bringup.progress import progress_bar
from fam_bundle_io.completeness import unanswered
from fam_bundle_io.recover import look, recover_bag, Recovery


def run_recover(bag: Path, out: Path | None) -> int:
    """
    Recover ``bag`` into the folder ``out``, or ``BAG_recovered``, and return the exit status.

    A bag in which nothing is damaged is left as it is. Raises BagError.
    """
    found = look(bag)
    if not found.damage:
        print(f'{bag}: nothing is damaged, {found.messages} messages')
        return 0
    out = out or beside(bag)
    with progress_bar('recover', found.messages) as progress:
        recovery = recover_bag(bag, out, progress)
    print(*words_of(recovery), f'written to {out}', sep='\n')
    return 0


def beside(bag: Path) -> Path:
    """Return the folder for what is recovered of ``bag``."""
    bag = bag if bag.stem.strip('.') else bag.resolve()
    return bag.with_name(f'{bag.stem if bag.is_file() else bag.name}_recovered')


def words_of(recovery: Recovery) -> Iterator[str]:
    """Yield what was recovered, topic by topic, and what was not."""
    for topic, summary in recovery.topics.items():
        yield f'{topic}: {summary["count"]} messages{_ticks(summary)}'
    yield from recovery.missing
    yield from unanswered(recovery.topics)


def _ticks(summary: dict[str, Any]) -> str:
    if 'first_tick' not in summary:
        return ''
    runs = f' of the last of {summary["runs"]} runs' if summary['runs'] > 1 else ''
    return f', ticks {summary["first_tick"]} to {summary["last_tick"]}{runs}'
