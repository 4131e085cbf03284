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

"""Parameters that were set while a recorded run went on."""

from typing import Any, TYPE_CHECKING

from fam_bundle_model.parameters import Configuration, with_values
from fam_bundle_model.schema import ConfigurationError

if TYPE_CHECKING:
    import pandas as pd

TOPIC = 'parameter_changes'
NEEDED = {'published', 'tick', 'node', 'names', 'values'}
# From which tick on, and the whole configuration of the node then.
Change = tuple[int, Configuration]


class Changing:
    """The configuration of a node that changes from tick to tick."""

    def __init__(self, configuration: Configuration, changes: list[Change]) -> None:
        """Begin with ``configuration``; ``changes`` are in the order of ticks."""
        self.now = configuration
        self._due = list(changes)

    def at(self, tick: int) -> bool:
        """Make ``now`` that of ``tick``, which is later than before; return whether it changed."""
        due = [changed for since, changed in self._due if since <= tick]
        del self._due[: len(due)]
        if due:
            self.now = due[-1]
        return bool(due)


def changes_of(
    table: 'pd.DataFrame | None', begun: int, configuration: Configuration
) -> tuple[dict[str, list[Change]], list[str]]:
    """
    Return the changes of each node, and notes, from the messages of ``TOPIC`` in a bag.

    ``begun`` is when the run's first sample was published (ns); what was changed in an earlier
    run acts from the beginning on.
    """
    found: dict[str, list[Change]] = {}
    if table is None:
        return found, []
    notes = []
    try:
        for row in rows_of(table):
            tick = int(row['tick']) if row['published'] >= begun else 0
            changes = found.setdefault(row['node'], [])
            before = changes[-1][1] if changes else configuration
            values = dict(zip(row['names'], row['values'], strict=True))
            changes.append((tick, with_values(before, values)))
            said = ', '.join(f'{name} = {value:g}' for name, value in values.items())
            notes.append(f'{row["node"]}: {said} from tick {tick} on')
    except (ConfigurationError, ValueError, TypeError, KeyError) as error:
        return {}, [f'{TOPIC}: damaged ({error}); changed parameters are not replayed']
    return found, notes


def rows_of(table: 'pd.DataFrame') -> list[dict[str, Any]]:
    """
    Return the messages in a table, whether or not their arrays are columns of their own.

    Raises KeyError where one lacks a field.
    """
    rows = []
    for row in table.to_dict('records'):
        arrays: dict[str, dict[int, Any]] = {'names': {}, 'values': {}}
        for name in list(row):
            field, _, index = str(name).rstrip(']').partition('[')
            if index and field in arrays and row[name] == row[name] and row[name] is not None:
                arrays[field][int(index)] = row[name]
        for field, elements in arrays.items():
            row.setdefault(field, [elements[k] for k in sorted(elements)])
        missing = NEEDED - set(row)
        if missing:
            raise KeyError(f'no {", ".join(sorted(missing))}')
        rows.append(row)
    return rows
