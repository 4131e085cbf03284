# SPDX-License-Identifier: Apache-2.0
"""A report on a damaged bag: an error in one line, or numbers that JSON and the page can hold."""

import json
import random
from collections.abc import Callable
from pathlib import Path

import damage
import pytest

from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.report import reported_runs, without_nan
from fam_bundle_io.report_page import report_page
from fam_bundle_model.parameters import load_configuration

CONFIG = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
PAGES = 20  # every so manieth case is drawn too, which takes longer


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    root = tmp_path_factory.mktemp('whole')

    def make(kind: str) -> Path:
        if not (root / kind).exists():
            damage.WHOLE[kind](root / kind)
        return root / kind

    return make


@pytest.mark.parametrize('name', damage.CASES)
def test_every_damaged_bag(name: str, whole: Callable[[str], Path], tmp_path: Path) -> None:
    case = damage.CASES[name]
    path = case.make(whole(case.of), tmp_path / 'bag', random.Random(name))
    try:
        runs, warnings = reported_runs(path, 'damaged', load_configuration(CONFIG))
    except BagError as error:
        assert '\n' not in f'{error}'
        return
    assert runs or warnings
    for run in runs:
        json.dumps(without_nan(run.numbers), allow_nan=False)
    if runs and list(damage.CASES).index(name) % PAGES == 0:
        assert report_page(runs, warnings).rstrip().endswith('</html>')


def test_whole_bags_give_no_warning_but_that_of_a_short_run(
    whole: Callable[[str], Path],
) -> None:
    for kind in damage.WHOLE:
        runs, _ = reported_runs(whole(kind), kind, load_configuration(CONFIG))
        for run in runs:
            assert run.numbers['ticks'] == damage.TICKS, kind
