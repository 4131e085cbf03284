# SPDX-License-Identifier: Apache-2.0
"""The page of a report, in a real browser without network."""

from collections.abc import Iterator
from pathlib import Path
import shutil
from typing import Any

from browser import headless, problems, requested
from fam_bundle_io.metrics import Window
from fam_bundle_io.report_files import write_report
import numpy as np
import pytest


@pytest.fixture(scope='module')
def report(recorded_runs: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp('report')
    bags = [recorded_runs / scheme / 'bag' for scheme in ('baseline', 'lag_pressure')]
    write_report(bags, folder)
    return folder


@pytest.fixture(scope='module')
def browser() -> Iterator[Any]:
    yield from headless()


def ranges(browser: Any, plot: Any) -> list[list[float]]:
    script = """
        const layout = arguments[0]._fullLayout;
        return Object.keys(layout).filter(k => /^xaxis\\d*$/.test(k)).map(k => layout[k].range);
    """
    return [list(found) for found in browser.execute_script(script, plot)]


def test_the_page_works_in_a_browser_without_network(browser: Any, report: Path) -> None:
    from selenium.webdriver.common.action_chains import ActionChains
    from selenium.webdriver.common.by import By

    requested(browser)
    page = (report / 'report.html').resolve().as_uri()
    browser.get(page)
    assert {a for a in requested(browser) if not a.startswith('data:')} == {page}
    assert problems(browser) == []
    plots = browser.find_elements(By.CSS_SELECTOR, '.js-plotly-plot')
    assert len(plots) == 7  # comparison, energy, by state, two runs, two latencies
    for plot in plots:
        drawn = plot.find_elements(By.CSS_SELECTOR, 'path.js-line, .bars path')
        assert drawn
        assert any(path.size['width'] > 20 for path in drawn)
    panels = plots[3]
    before = ranges(browser, panels)
    assert len(before) == 6
    assert all(np.allclose(found, before[0]) for found in before)
    browser.execute_script('arguments[0].scrollIntoView()', panels)
    area = panels.find_element(By.CSS_SELECTOR, '.nsewdrag')
    drag = ActionChains(browser).move_to_element_with_offset(area, -100, 0).click_and_hold()
    drag.move_by_offset(60, 0).move_by_offset(60, 0).release().perform()
    after = ranges(browser, panels)
    assert all(np.allclose(found, after[0]) for found in after)
    span = Window(*after[0])
    assert before[0][0] < span.start < span.stop < before[0][1]


def test_words_in_a_bag_cannot_become_a_part_of_the_page(
    browser: Any, recorded_runs: Path, tmp_path: Path
) -> None:
    from selenium.webdriver.common.by import By

    name = '<img src=x onerror=alert(1)>'
    shutil.copytree(recorded_runs / 'baseline' / 'bag', tmp_path / name)
    write_report([tmp_path / name], tmp_path / 'report')
    browser.get((tmp_path / 'report' / 'report.html').resolve().as_uri())
    assert browser.find_elements(By.CSS_SELECTOR, 'img[src=x]') == []
    assert name in browser.find_element(By.TAG_NAME, 'body').text
