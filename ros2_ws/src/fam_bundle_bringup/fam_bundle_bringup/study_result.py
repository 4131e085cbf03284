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

"""The result of a study: one row for each case with its provenance, as Parquet or CSV."""

from collections.abc import Mapping, Sequence
import csv
import datetime
import importlib.util
import io
import json
from pathlib import Path
from typing import Any, NamedTuple

from fam_bundle_bringup.experiment import versions
from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.study import Case, Study, text_of, varied
from fam_bundle_bringup.study_case import MEASURED, RIVALS, Row
from fam_bundle_bringup.study_run import rival_of, row_of
from fam_bundle_model.files import whole_file
from fam_bundle_model.parameters import make_configuration, yaml_text
from fam_bundle_model.schema import ConfigurationError

KEY = b'fam_bundle.study'  # of the provenance in the metadata of a Parquet file
RIVAL = ('status', 'reason', 'iae', 'max_error', 'efficiency')  # and what is its own
RATIOS = ('iae', 'max_error')


class Result(NamedTuple):
    """
    Columns of one value for each case, and their provenance.

    A number that there is not is None, a text that there is not is empty.
    """

    columns: dict[str, list[Any]]
    provenance: dict[str, Any]


def result_of(
    study: Study, cases: Sequence[Case], rows: Mapping[str, Row], made_by: str, run: Row
) -> Result:
    """Return the result of all ``cases``; ``run`` goes into its provenance as it is."""
    columns: dict[str, list[Any]] = {'case': list(range(len(cases)))}
    columns['scheme'] = [case.scheme for case in cases]
    for axis in study.grid:
        if axis.name in cases[0].labels:
            columns[axis.name] = [case.labels[axis.name] for case in cases]
    for name in varied(study):
        columns[name] = [_plain(case.values[name]) for case in cases]
    own = [row_of(case, rows, made_by) for case in cases]
    for name in ('status', 'reason', *MEASURED):
        columns[name] = [row[name] for row in own]
    for rival in study.rivals:
        theirs = [rival_of(case, rival, rows, made_by) for case in cases]
        for name in (*RIVALS[rival].extra, *RIVAL):
            columns[f'{rival}.{name}'] = [row[name] for row in theirs]
        for name in RATIOS:
            both = zip(own, theirs, strict=True)
            columns[f'{rival}.{name}_ratio'] = [_ratio(a[name], b[name]) for a, b in both]
    columns['parameters_hash'] = [case.setting and case.setting.hash() for case in cases]
    # A CSV file cannot tell None from empty text, nor the label '4' from a number.
    text = [name for name, cells in columns.items() if any(isinstance(c, str) for c in cells)]
    columns |= {name: [cell or '' for cell in columns[name]] for name in text}
    return Result(columns, {**provenance_of(study, made_by), 'text_columns': text, **run})


def _plain(value: Any) -> Any:
    return text_of(value) if isinstance(value, tuple) else value


def _ratio(value: float | None, other: float | None) -> float | None:
    return None if value is None or not other else value / other


def provenance_of(study: Study, made_by: str) -> dict[str, Any]:
    """Return where the numbers of a study come from."""
    base = make_configuration(study.base)
    return {
        'study': study.path.name,
        'study_text': study.text,
        'parameters': yaml_text(base),
        'parameters_hash': base.hash(),
        'axes': [axis.name for axis in study.grid],
        'schemes': list(study.schemes.choices),
        'sampled': list(study.sample.ranges) if study.sample else [],
        'rivals': list(study.rivals),
        'heat_map': list(study.heat_map),
        'seed': study.sample.seed if study.sample else None,
        'versions': versions(),
        'origin': made_by,
        'date': datetime.datetime.now(datetime.timezone.utc).isoformat(timespec='seconds'),
    }


# ---- Files ----


def can_parquet() -> bool:
    """Return whether the package that writes Parquet is there."""
    return importlib.util.find_spec('pyarrow') is not None


def write_result(result: Result, folder: Path, as_csv: bool) -> Path:
    """
    Write ``study.parquet`` or ``study.csv``, and ``study.json`` beside it, each whole.

    The provenance is in the metadata of the Parquet file, and in ``study.json``.
    """
    path = folder / ('study.csv' if as_csv else 'study.parquet')
    content = _csv(result) if as_csv else _parquet(result)
    with whole_file(path) as file:
        file.write(content)
    write_json(result.provenance, folder / 'study.json')
    return path


def _csv(result: Result) -> bytes:
    text = io.StringIO()
    writer = csv.writer(text)
    writer.writerow(result.columns)
    writer.writerows(zip(*result.columns.values(), strict=True))
    return text.getvalue().encode()


def _parquet(result: Result) -> bytes:
    import pyarrow
    from pyarrow import parquet

    table = pyarrow.table(result.columns)
    note = json.dumps(result.provenance, allow_nan=False).encode()
    buffer = io.BytesIO()
    parquet.write_table(table.replace_schema_metadata({KEY: note}), buffer)
    return buffer.getvalue()


def read_result(folder: Path) -> Result:
    """
    Return the result in ``folder``, of whichever kind is there.

    Raises ConfigurationError where there is none.
    """
    try:
        if (folder / 'study.parquet').exists():
            from pyarrow import parquet

            table = parquet.read_table(folder / 'study.parquet')
            return Result(table.to_pydict(), json.loads(table.schema.metadata[KEY]))
        with (folder / 'study.csv').open(encoding='utf-8', newline='') as file:
            names, *rows = csv.reader(file)
        provenance = json.loads((folder / 'study.json').read_text(encoding='utf-8'))
        cells: dict[str, list[Any]] = dict(
            zip(names, map(list, zip(*rows, strict=True)), strict=True)
        )
        for name in cells.keys() - set(provenance['text_columns']):
            cells[name] = [_number(cell) for cell in cells[name]]
        return Result(cells, provenance)
    except (OSError, ValueError, KeyError, TypeError) as error:
        reason = ' '.join(str(error).split())
        raise ConfigurationError(f'{folder}: holds no result of a study ({reason})') from None


def _number(cell: str) -> float | None:
    """Return the number in a cell of a CSV file, None where there is none."""
    if not cell:
        return None
    try:
        return int(cell)
    except ValueError:
        return float(cell)
