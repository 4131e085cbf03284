# SPDX-License-Identifier: Apache-2.0
"""
All public functions say their units and errors; all equations stand where they are computed.

That each has a docstring is ruff's to find.
"""

import ast
import builtins
from collections.abc import Iterator
import functools
from pathlib import Path
import re
from typing import NamedTuple

import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / 'ros2_ws' / 'src'
PACKAGES = sorted(path.parent.name for path in SOURCE.glob('*/setup.py'))
PURE = ('fam_bundle_control', 'fam_bundle_model', 'fam_bundle_sim')
QUANTITY = re.compile(
    r'(^|_)(pressure|strain|flow|length|radius|dt|time|force|volume|mass|rate|lag|weight|period)$'
)
UNIT = re.compile(
    r"(?<!['’])\b(Pa|kPa|m|N|s|ns|kg|m\^3|m\^3/s|1/s|V|Hz|SI units|dimensionless|shares?)\b"
)
# Not meant to reach who calls.
INTERNAL = {'ArgumentTypeError', 'AttributeError', 'NotImplementedError', 'SystemExit'}
CITED = re.compile(r'[Ee]quations? (\d+(?:(?:, | and |-)\d+)*)')

# Where each equation of the paper is computed. Of (3) and (4) the force has the structure.
COMPUTED = {
    1: 'fam.mesh_coefficient',
    2: 'fam.bladder_force',
    3: 'fam.force',
    4: 'fam.force',
    5: 'hydraulics.unit_flow',
    6: 'hydraulics.unit_flow',
    7: 'fam.pressure_of',
    8: 'fam.volume',
    9: 'fam.deslack_pressure',
    10: 'recruitment.compensating_pressure',
    11: 'recruitment.compensating_pressure',
    12: 'recruitment.attainable_pressure',
    13: 'recruitment.attainable_pressure',
    14: 'predictors.expected_strain',
    15: 'predictors.time_to_rise',
    16: 'predictors.time_to_fall',
    17: 'metrics.tracking',
    18: 'metrics.tracking',
}
SOURCES = re.compile(r'\b([Pp]aper|[Ee]quations?|Figures?|Table|Textbook|[Oo]urs?|same laws)\b')


class Function(NamedTuple):
    """A public function: where it is, what is said of it and of its classes."""

    path: Path
    node: ast.FunctionDef
    said: str


def functions(package: str) -> Iterator[Function]:
    for path in sorted((SOURCE / package / package).rglob('*.py')):
        yield from within(path, ast.parse(path.read_text()), '')


def within(path: Path, node: ast.AST, said: str) -> Iterator[Function]:
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.ClassDef) and is_public(child.name):
            yield from within(path, child, f'{said} {ast.get_docstring(child)}')
        elif isinstance(child, ast.FunctionDef) and is_public(child.name):
            yield Function(path, child, f'{said} {ast.get_docstring(child)}')


def is_public(name: str) -> bool:
    return not name.startswith('_') or name == '__init__'


def escaping(node: ast.AST) -> Iterator[str]:
    """Give the names of the exceptions that are raised and not caught in the same function."""
    for child in ast.iter_child_nodes(node):
        if isinstance(child, ast.Try) and child.handlers:
            caught = {name for handler in child.handlers for name in caught_by(handler)}
            tried = escaping(ast.Module(child.body, []))
            yield from (name for name in tried if not caught & kinds(name))
            for part in (*child.handlers, *child.orelse, *child.finalbody):
                yield from escaping(part)
        elif isinstance(child, ast.Raise) and isinstance(child.exc, ast.Call):
            raised = child.exc.func
            yield raised.id if isinstance(raised, ast.Name) else raised.attr  # type: ignore[attr-defined]
        elif not isinstance(child, ast.FunctionDef):
            yield from escaping(child)


def kinds(name: str) -> set[str]:
    """Return an exception and all that it is derived from, by our sources or by Python's."""
    found = {name}
    for base in error_bases().get(name, []):
        found |= kinds(base)
    kind = getattr(builtins, name, None)
    return found | {parent.__name__ for parent in kind.__mro__} if kind else found


@functools.cache
def error_bases() -> dict[str, list[str]]:
    trees = (ast.parse(path.read_text()) for path in SOURCE.glob('*/fam_bundle_*/**/*.py'))
    classes = (node for tree in trees for node in ast.walk(tree) if isinstance(node, ast.ClassDef))
    return {c.name: [base.id for base in c.bases if isinstance(base, ast.Name)] for c in classes}


def caught_by(handler: ast.ExceptHandler) -> Iterator[str]:
    """Give the names of the exceptions that a handler catches."""
    for node in ast.walk(handler.type) if handler.type else ():
        if isinstance(node, ast.Name):
            yield node.id
        elif isinstance(node, ast.Attribute):
            yield node.attr
    if handler.type is None:
        yield 'BaseException'


@pytest.mark.parametrize('package', PACKAGES)
def test_errors_that_a_function_raises_are_named(package: str) -> None:
    unsaid = [
        f'{found.path.name}: {found.node.name} raises {name}'
        for found in functions(package)
        for name in set(escaping(found.node)) - INTERNAL
        if name.lstrip('_') not in found.said
    ]
    assert unsaid == []


@pytest.mark.parametrize('package', PURE)
def test_quantities_that_a_law_takes_have_their_unit(package: str) -> None:
    unsaid = [
        f'{found.path.name}: {found.node.name}({", ".join(names)})'
        for found in functions(package)
        if not found.path.stem.endswith('_node')
        and (names := [a.arg for a in found.node.args.args if QUANTITY.search(a.arg)])
        and not UNIT.search(found.said)
    ]
    assert unsaid == []


def numbers(text: str) -> set[int]:
    """Return the equations that a text cites."""
    found: set[int] = set()
    for cited in CITED.findall(text):
        for part in re.split(r', | and ', cited):
            first, _, last = part.partition('-')
            found |= set(range(int(first), int(last or first) + 1))
    return found


def test_every_equation_of_the_paper_stands_where_it_is_computed() -> None:
    tags = [int(n) for n in re.findall(r'\\tag\{(\d+)\}', (ROOT / 'docs/model.md').read_text())]
    assert sorted(tags) == list(range(1, 19)), 'each once, numbered as in the paper'
    assert sorted(COMPUTED) == sorted(tags)
    said: dict[str, str] = {}
    for package in PACKAGES:
        for found in functions(package):
            said[f'{found.path.stem}.{found.node.name}'] = found.said
    assert [n for n, name in COMPUTED.items() if n not in numbers(said[name])] == []
    assert set().union(*map(numbers, said.values())) <= set(tags)


def test_every_law_says_where_it_comes_from() -> None:
    silent, laws = [], 0
    for package in PACKAGES:
        for path in sorted((SOURCE / package / package).rglob('*.py')):
            text = path.read_text()
            if '\n@compiled\n' in text:
                laws += 1
                if not SOURCES.search(ast.get_docstring(ast.parse(text)) or ''):
                    silent.append(path.name)
    assert silent == []
    assert laws > 15


def test_the_walk_finds_what_is_missing() -> None:
    assert sum(1 for package in PACKAGES for _ in functions(package)) > 1000
    tree = ast.parse('def f():\n try:\n  raise A()\n except A:\n  raise B()\n raise C()')
    assert set(escaping(tree.body[0])) == {'B', 'C'}
    assert numbers('see equations 1-3 and 9, Equation 12') == {1, 2, 3, 9, 12}
    assert not UNIT.search('Return the next output of a filter.')
