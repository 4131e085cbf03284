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

"""A report on a damaged bag: an error in one line, the true numbers, or a warning."""

from collections.abc import Callable
import json
from pathlib import Path
import random

import damage
from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.report import reported_runs, ReportedRun, without_nan
from fam_bundle_io.report_page import report_page
from fam_bundle_model.parameters import Configuration, load_configuration
import pytest

CONFIG = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
PAGES = 20  # the first of so many cases is drawn too, which takes longer


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    return damage.whole_bags(tmp_path_factory.mktemp('whole'))


@pytest.fixture(scope='module')
def true(
    whole: Callable[[str], Path], configuration: Configuration
) -> Callable[[str], ReportedRun]:
    """Return what gives the report of a whole bag, made once."""
    known: dict[str, ReportedRun] = {}

    def report(kind: str) -> ReportedRun:
        if kind not in known:
            (known[kind],) = reported_runs(whole(kind), kind, configuration)[0]
        return known[kind]

    return report


@pytest.fixture(scope='module')
def configuration() -> Configuration:
    return load_configuration(CONFIG)


def told(run: ReportedRun) -> str:
    """Return all numbers of a run but what is of its place and its time."""
    kept = {k: v for k, v in run.numbers.items() if k not in ('bag', 'warnings', 'timing')}
    return json.dumps(without_nan(kept), allow_nan=False)


@pytest.mark.parametrize('name', damage.CASES)
def test_a_damaged_bag_gives_the_numbers_of_the_whole_one_or_a_warning(
    name: str,
    whole: Callable[[str], Path],
    true: Callable[[str], ReportedRun],
    configuration: Configuration,
    tmp_path: Path,
) -> None:
    case = damage.CASES[name]
    path = case.make(whole(case.of), tmp_path / 'bag', random.Random(name))
    try:
        runs, warnings = reported_runs(path, 'damaged', configuration)
    except BagError as error:
        assert '\n' not in f'{error}'
        return
    expected = true(case.of)
    for run in runs:
        new = set(run.numbers['warnings']) - set(expected.numbers['warnings'])
        unguarded = any('checksum' in words for words in run.numbers['warnings'])
        assert new or unguarded or told(run) == told(expected)
    assert runs or set(warnings) - set(expected.numbers['warnings'])
    if runs and list(damage.CASES).index(name) % PAGES == 0:
        assert report_page(runs, warnings).rstrip().endswith('</html>')
