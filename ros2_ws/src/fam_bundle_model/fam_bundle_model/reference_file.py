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

"""A strain reference from a CSV file."""

from collections.abc import Iterator
import csv
from pathlib import Path

from fam_bundle_model.parameters import MOST_SAMPLES, ReferenceParameters
from fam_bundle_model.schema import ConfigurationError, declarations

HEADER = ['time', 'strain']


def read_samples(path: Path) -> tuple[list[float], list[float]]:
    """
    Return the times (s) and strains in a CSV file with the header ``time,strain``.

    Rows are numbered as lines of the file; blank ones are passed over. Raises ConfigurationError
    naming file, row, value and bound.
    """
    known = declarations(ReferenceParameters)
    times: list[float] = []
    strains: list[float] = []
    for number, row in _rows(path):
        where = f'{path}: row {number}'
        if len(row) != len(HEADER):
            raise ConfigurationError(f'{where}: {len(row)} values; must be 2, time and strain')
        (time,) = known['times'].convert(f'{where}: time', row[0])
        (strain,) = known['strains'].convert(f'{where}: strain', row[1])
        if times and time <= times[-1]:
            raise ConfigurationError(
                f'{where}: time = {time:g} s: must be > {times[-1]:g} s, the one before'
            )
        if len(times) == MOST_SAMPLES:
            raise ConfigurationError(f'{where}: must be the last; <= {MOST_SAMPLES} samples')
        times.append(time)
        strains.append(strain)
    if len(times) < 2:
        raise ConfigurationError(f'{path}: {len(times)} samples; must be >= 2')
    return times, strains


def _rows(path: Path) -> Iterator[tuple[int, list[str]]]:
    """Give number and cells of each row below the header."""
    try:
        with path.open(encoding='utf-8-sig', newline='') as file:
            reader = csv.reader(file, strict=True)
            first = [cell.strip() for cell in next(reader, [])]
            if first != HEADER:
                shown = ','.join(first)[:40]
                raise ConfigurationError(f'{path}: row 1 = {shown!r}: must be time,strain')
            for row in reader:
                if any(cell.strip() for cell in row):
                    yield reader.line_num, [cell.strip() for cell in row]
    except OSError as error:
        raise ConfigurationError(f'{path}: cannot be read ({error.strerror})') from None
    except (UnicodeDecodeError, csv.Error) as error:
        raise ConfigurationError(f'{path}: not CSV ({error})') from None
