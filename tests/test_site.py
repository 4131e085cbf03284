# SPDX-License-Identifier: Apache-2.0
"""The documentation as a site: whole, no broken link, nothing loaded from elsewhere."""

from collections import Counter
from collections.abc import Iterator
from html import unescape
from html.parser import HTMLParser
import os
from pathlib import Path
import re
import subprocess
import sys
from typing import Any
from urllib.parse import unquote, urlsplit

from browser import headless, problems, requested
import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / 'ros2_ws' / 'src'
EQUATIONS = 18  # of the paper, all of which the model derives
# What a page loads by itself; a link is only followed by who reads.
LOADED = {'script': 'src', 'img': 'src', 'source': 'src', 'iframe': 'src', 'link': 'href'}
CSS_ADDRESS = re.compile(r'url\(\s*["\']?([^"\')]+)|@import\s+["\']([^"\']+)')


@pytest.fixture(scope='session')
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Build the site as ``./fam docs`` does, strictly: a warning fails it."""
    pytest.importorskip('mkdocs')
    if not (ROOT / 'docs' / 'site' / 'node_modules').is_dir():
        pytest.skip('the scripts of the site are missing: install npm, then ./fam test')
    folder = tmp_path_factory.mktemp('site')
    words = [sys.executable, '-m', 'mkdocs', 'build', '--strict', '--site-dir', folder]
    env = {**os.environ, 'NO_MKDOCS_2_WARNING': '1'}
    built = subprocess.run(words, cwd=ROOT, env=env, capture_output=True, text=True)
    assert built.returncode == 0, built.stderr
    return folder


class Page(HTMLParser):
    """The anchors of a page, its links, what it loads, and its own styles."""

    def __init__(self, path: Path) -> None:
        super().__init__()
        self.anchors: set[str] = set()
        self.links: list[str] = []
        self.loaded: list[str] = []
        self.styles = ''
        self._in_style = False
        self.feed(path.read_text(encoding='utf-8'))

    def handle_starttag(self, tag: str, attributes: list[tuple[str, str | None]]) -> None:
        found = {name: value or '' for name, value in attributes}
        self.anchors |= {found[name] for name in ('id', 'name') if name in found}
        self._in_style = tag == 'style'
        self.styles += found.get('style', '')
        if tag == 'a' and 'href' in found:
            self.links.append(found['href'])
        elif LOADED.get(tag) in found and found.get('rel') not in ('prev', 'next', 'canonical'):
            self.loaded.append(found[LOADED[tag]])

    def handle_data(self, data: str) -> None:
        if self._in_style:
            self.styles += data
        self._in_style = False


@pytest.fixture(scope='module')
def pages(site: Path) -> dict[Path, Page]:
    return {path: Page(path) for path in site.rglob('*.html') if path.name != '404.html'}


def target(page: Path, address: str) -> tuple[Path, str]:
    """Return the file and the anchor that ``address`` in ``page`` names."""
    parts = urlsplit(address)
    path = (page.parent / unquote(parts.path)).resolve() if parts.path else page
    return path / 'index.html' if path.is_dir() else path, unquote(parts.fragment)


def is_outside(address: str) -> bool:
    parts = urlsplit(address)
    return bool(parts.netloc) or parts.scheme not in ('', 'data')


def test_every_document_has_a_page(site: Path) -> None:
    readmes = (*SOURCE.glob('*/README.md'), ROOT / 'README.md')
    for path in (*readmes, *ROOT.glob('docs/*.md'), *ROOT.glob('studies/**/*.md')):
        page = site / path.relative_to(ROOT).with_suffix('.html')
        page = page.with_name('index.html') if path.name == 'README.md' else page
        assert page.is_file(), path


def test_examples_stand_on_their_pages(site: Path) -> None:
    """A mark that the site does not know would stay where the example is to be."""
    names = []
    for path in sorted(ROOT.glob('docs/*.md')):
        page = site / path.relative_to(ROOT).with_suffix('.html')
        text = unescape(re.sub(r'<[^>]+>', '', page.read_text(encoding='utf-8')))
        assert '--8' not in text, path.name
        for name in re.findall(r'--8.*?["\'](\S+?)["\']', path.read_text(encoding='utf-8')):
            names.append(name)
            for line in (ROOT / name).read_text(encoding='utf-8').splitlines():
                assert line.strip() in text, (path.name, line)
    assert len(names) == len(set(names)) == 5


def test_every_link_and_anchor_leads_somewhere(pages: dict[Path, Page]) -> None:
    broken = []
    for path, page in pages.items():
        for address in page.links:
            if is_outside(address):
                continue
            file, anchor = target(path, address)
            there = file in pages and anchor and anchor not in pages[file].anchors
            # A bare "#" is the top of the page.
            if not file.is_file() or there:
                broken.append((path.name, address))
    assert not broken


def test_pages_load_nothing_from_elsewhere(site: Path, pages: dict[Path, Page]) -> None:
    for path, page in pages.items():
        styles = [a or b for a, b in CSS_ADDRESS.findall(page.styles)]
        for address in page.loaded + styles:
            assert not is_outside(address), (path, address)
            assert address.startswith('data:') or target(path, address)[0].is_file(), address
    for path in site.rglob('*.css'):
        for addresses in CSS_ADDRESS.findall(path.read_text(encoding='utf-8')):
            address = ''.join(addresses)
            assert not is_outside(address), (path, address)
            assert address.startswith('data:') or target(path, address)[0].is_file(), address


def test_every_equation_of_the_paper_stands_once_with_its_number(site: Path) -> None:
    text = (site / 'docs' / 'model.html').read_text(encoding='utf-8')
    numbers = Counter(int(number) for number in re.findall(r'\\tag\{(\d+)\}', text))
    assert numbers == dict.fromkeys(range(1, EQUATIONS + 1), 1)
    assert all(f'id="equation-{number}"' in text for number in numbers)


def test_figures_are_there_and_each_is_shown(site: Path, pages: dict[Path, Page]) -> None:
    drawn = {path.resolve() for path in (site / 'figures').glob('*.png')}
    shown = {target(path, image)[0] for path, page in pages.items() for image in page.loaded}
    assert drawn
    assert drawn <= shown


def test_reference_names_what_the_code_has(site: Path) -> None:
    text = (site / 'reference' / 'fam_bundle_control.html').read_text(encoding='utf-8')
    assert 'id="fam_bundle_control.recruitment.recruitment_step"' in text
    messages = (site / 'reference' / 'messages.html').read_text(encoding='utf-8')
    for path in (SOURCE / 'fam_bundle_msgs').glob('*/*.*'):
        if path.suffix in ('.msg', '.srv', '.action'):
            assert f'id="{path.stem.lower()}"' in messages


@pytest.fixture(scope='module')
def browser() -> Iterator[Any]:
    yield from headless()


def test_equations_and_diagrams_are_drawn_without_network(browser: Any, site: Path) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import WebDriverWait

    requested(browser)
    browser.get((site / 'docs' / 'model.html').as_uri())
    equations = browser.find_elements(By.CSS_SELECTOR, '.arithmatex')
    assert len(equations) > EQUATIONS
    assert all(equation.find_elements(By.CSS_SELECTOR, '.katex-html') for equation in equations)
    tags = [tag.text for tag in browser.find_elements(By.CSS_SELECTOR, '.katex-html .tag')]
    assert sorted(int(re.sub(r'\D', '', tag)) for tag in tags) == [*range(1, EQUATIONS + 1)]
    browser.get((site / 'index.html').as_uri())
    # The theme puts the drawing in a closed shadow: its size is what can be seen from outside.
    drawn = WebDriverWait(browser, 60).until(
        lambda found: found.find_elements(By.CSS_SELECTOR, 'div.mermaid')
    )
    assert all(diagram.size['height'] > 100 for diagram in drawn)
    assert problems(browser) == []
    assert all(address.startswith(('file:', 'data:', 'blob:')) for address in requested(browser))


def test_search_finds_a_word_without_a_server(browser: Any, site: Path) -> None:
    from selenium.webdriver.common.by import By
    from selenium.webdriver.support.ui import WebDriverWait

    browser.get((site / 'index.html').as_uri())
    browser.execute_script('document.querySelector("#__search").click()')
    box = browser.find_element(By.CSS_SELECTOR, '.md-search__input')
    WebDriverWait(browser, 30).until(lambda _: box.is_displayed())
    box.send_keys('de-slack')
    results = WebDriverWait(browser, 60).until(
        lambda found: found.find_elements(By.CSS_SELECTOR, '.md-search-result__link')
    )
    assert any('model.html' in link.get_attribute('href') for link in results)
