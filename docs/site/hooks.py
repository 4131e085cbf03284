# SPDX-License-Identifier: Apache-2.0
"""
What makes a site of the repository's Markdown files, which are written to be read in place too.

Every page keeps its path, so the links between pages need no change. Files of other kinds that a
page links to get a page each, with their text; figures and reference pages are made of the code.
"""

from collections.abc import Iterator
from pathlib import Path
import re
import sys
from typing import Any

from mkdocs.structure.files import File, Files

HERE = Path(__file__).resolve().parent
ROOT = HERE.parents[1]
sys.path.insert(0, str(HERE))

import figures  # noqa: E402
import reference  # noqa: E402

NPM = HERE / 'node_modules'
SHIPPED = (
    '@mermaid-js/tiny/dist/mermaid.tiny.js',
    'iframe-worker/shim/index.js',
    'katex/dist/katex.min.css',
    'katex/dist/katex.min.js',
    'katex/dist/fonts/*',
)
PAGES = ('*.md', 'docs/*.md', 'docker/*.md', 'ros2_ws/src/*/README.md', 'studies/**/*.md')
# By the end of a file's name; others are shown as plain text.
LANGUAGES = {'.py': 'python', '.xml': 'xml', '.yaml': 'yaml', '.json': 'json', '.patch': 'diff'}

FENCE = re.compile(r'^(```|~~~)')
CODE = re.compile(r'`[^`\n]*`')
LINK = re.compile(r'(\]\()([^)\s]+)(\))')
FIGURE = re.compile(r'<!-- figure (\w+): (.+) -->')
ITEM = re.compile(r'([-*]|\d+\.) ')
TAG = re.compile(r'\\tag\{(\d+)\}')


# ---- Which files there are ----


def pages() -> list[Path]:
    """Return the Markdown files that are pages."""
    return sorted({path for pattern in PAGES for path in ROOT.glob(pattern)})


def linked_files() -> set[Path]:
    """Return the files of other kinds that pages link to."""
    found = set()
    for page in pages():
        for line, fenced in lines_of(page.read_text(encoding='utf-8')):
            for _, target, _ in [] if fenced else LINK.findall(CODE.sub('', line)):
                if shown := shown_file(page, target):
                    found.add(shown)
    return found


def shown_file(page: Path, target: str) -> Path | None:
    """Return the file of another kind that ``target`` of a link in ``page`` names, if it does."""
    path = (page.parent / target.partition('#')[0]).resolve()
    other = '://' not in target and path.suffix != '.md' and path.is_file()
    return path if other and path.is_relative_to(ROOT) else None


def on_files(files: Files, config: Any) -> Files:
    """Add pages, files that they link to, figures, reference pages, and scripts from npm."""
    for path in pages():
        files.append(File(str(path.relative_to(ROOT)), str(ROOT), config.site_dir, False))
    for path in linked_files():
        name = str(path.relative_to(ROOT))
        files.append(File.generated(config, f'{name}.md', content=text_page(name, path)))
    for pattern in SHIPPED:
        found = sorted(NPM.glob(pattern))
        if not found:
            raise FileNotFoundError(f'{NPM / pattern}: missing; ./fam docs installs it')
        for path in found:
            name = f'npm/{path.relative_to(NPM)}'
            files.append(File.generated(config, name, abs_src_path=str(path)))
    for name, content in {**reference.pages(), **figures.drawn()}.items():
        files.append(File.generated(config, name, content=content))
    return files


def text_page(name: str, path: Path) -> str:
    """Return a page that shows a file, and that the search leaves out."""
    text = path.read_text(encoding='utf-8')
    language = LANGUAGES.get(path.suffix, 'text')
    head = f'---\ntitle: {path.name}\nsearch:\n  exclude: true\n---\n'
    return f'{head}# {path.name}\n\n`{name}`\n\n~~~~~{language}\n{text}\n~~~~~\n'


# ---- What is changed in a page ----


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Return ``markdown`` as this Markdown needs it; see the functions below."""
    source = ROOT / page.file.src_uri
    if not source.is_file():
        return markdown
    lines = []
    before = ''
    for line, fenced in lines_of(markdown):
        if not fenced:
            if begins_block(before, line):
                lines.append('')
            line = figure(shown_links(source, line), source)
        lines.append(line)
        before = line
    return anchored('\n'.join(lines))


def lines_of(text: str) -> Iterator[tuple[str, bool]]:
    """Yield each line and whether it is within a fence or bounds one."""
    fence = ''
    for line in text.splitlines():
        mark = FENCE.match(line)
        if fence:
            yield line, True
            fence = '' if line.strip() == fence else fence
        else:
            fence = mark[1] if mark else ''
            yield line, bool(mark)


def begins_block(before: str, line: str) -> bool:
    """Return whether a list or table follows a paragraph directly: it needs a blank line here."""
    paragraph = bool(before) and not before[0].isspace()
    item = ITEM.match(line) and not ITEM.match(before)
    row = line.startswith('|') and not before.startswith('|')
    return bool(paragraph and (item or row))


def shown_links(source: Path, line: str) -> str:
    """Let links to files of other kinds lead to the pages that show them."""

    def shown(link: re.Match[str]) -> str:
        return f'{link[1]}{link[2]}.md{link[3]}' if shown_file(source, link[2]) else link[0]

    return LINK.sub(shown, line)


def figure(line: str, source: Path) -> str:
    """Put a figure where a comment asks for one."""
    up = '../' * (len(source.relative_to(ROOT).parts) - 1)

    def drawn(comment: re.Match[str]) -> str:
        image = f'![{comment[1]}]({up}figures/{comment[1]}.png)'
        words = f'<figcaption markdown>{comment[2]}</figcaption>'
        return f'<figure markdown>\n{image}\n{words}\n</figure>'

    return FIGURE.sub(drawn, line)


def anchored(markdown: str) -> str:
    """Give each numbered equation the anchor ``equation-N``."""
    parts: list[str] = []
    for block in re.split(r'(?m)(^```math$.*?^```$)', markdown, flags=re.DOTALL):
        tag = TAG.search(block) if block.startswith('```math') else None
        parts += [f'<span id="equation-{tag[1]}"></span>\n\n' if tag else '', block]
    return ''.join(parts)
