# SPDX-License-Identifier: Apache-2.0
"""Each package says of itself what is true: imports, executables, versions, licence, changes."""

import ast
from collections.abc import Iterator
import importlib
from importlib.metadata import distribution
from pathlib import Path
import re
import shlex
import subprocess
import sys
from xml.etree import ElementTree

from catkin_pkg.changelog import get_changelog_from_path
from catkin_pkg.package import Package, parse_package
import pytest
import yaml

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / 'ros2_ws' / 'src'
PACKAGES = sorted(path.parent.name for path in SOURCE.glob('*/package.xml'))
PYTHON = [name for name in PACKAGES if (SOURCE / name / 'setup.py').exists()]
# Modules whose rosdep key has another name.
KEYS = {
    name: f'python3-{name}'
    for name in ('hypothesis', 'matplotlib', 'numba', 'numpy', 'pandas', 'pytest', 'rich', 'scipy')
} | {'yaml': 'python3-yaml'}
# Without a rosdep key, and so only where they are needed; package.xml says so too.
OPTIONAL = {
    'fam_bundle_bringup': {'cyclonedds', 'distributed', 'pyarrow'},
    'fam_bundle_io': {'lz4', 'mcap', 'plotly', 'rosbags', 'zstandard'},
}
AT_TOP = {'fam_bundle_io': {'mcap'}}  # of these, what a module that is itself loaded late imports
# Keys that no import shows.
UNSEEN = {
    'fam_bundle_bringup': {'ros2launch'},  # `ros2 launch` itself
}
# Tests of io look at the configuration and run it beside control and sim, which depend on it.
BESIDE = {'fam_bundle_io': {'fam_bundle_bringup', 'fam_bundle_control', 'fam_bundle_sim'}}
LINTERS = {'ament_copyright', 'ament_flake8', 'ament_pep257'}


def manifest(name: str) -> Package:
    return parse_package(str(SOURCE / name / 'package.xml'))


def imported(folder: Path) -> Iterator[tuple[str, bool]]:
    """Give the module of each import, and whether it is loaded with its file."""
    for path in folder.rglob('*.py'):
        tree = ast.parse(path.read_text())
        for node in ast.walk(tree):
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom) and node.module and not node.level:
                names = [node.module]
            else:
                continue
            yield from ((name.split('.')[0], node in tree.body) for name in names)


def keys_of(modules: set[str], name: str) -> set[str]:
    ours = {path.stem for path in (SOURCE / name / 'test').rglob('*.py')} | {name}
    foreign = modules - set(sys.stdlib_module_names) - ours
    return {KEYS.get(module, module) for module in foreign - OPTIONAL.get(name, set())}


@pytest.mark.parametrize('name', PACKAGES)
def test_no_dependency_stands_twice(name: str) -> None:
    tree = ElementTree.parse(SOURCE / name / 'package.xml')
    found = [(item.tag, item.text) for item in tree.getroot() if item.tag.endswith('depend')]
    assert len(found) == len(set(found))


@pytest.mark.parametrize('name', PYTHON)
def test_what_is_imported_is_depended_on_and_the_other_way_round(name: str) -> None:
    modules = {module for module, _ in imported(SOURCE / name / name)}
    declared = {depend.name for depend in manifest(name).exec_depends}
    assert keys_of(modules, name) | UNSEEN.get(name, set()) == declared


@pytest.mark.parametrize('name', PYTHON)
def test_what_only_tests_import_is_a_dependency_of_the_tests(name: str) -> None:
    modules = {module for module, _ in imported(SOURCE / name / 'test')}
    package = manifest(name)
    wanted = keys_of(modules, name) - {depend.name for depend in package.exec_depends}
    declared = {depend.name for depend in package.test_depends}
    assert wanted - BESIDE.get(name, set()) == declared


@pytest.mark.parametrize('name', sorted(OPTIONAL))
def test_what_is_optional_is_named_in_the_manifest_and_loaded_late(name: str) -> None:
    text = (SOURCE / name / 'package.xml').read_text()
    found = dict(sorted(imported(SOURCE / name / name), key=lambda pair: pair[1]))
    for module in OPTIONAL[name]:
        assert module in text
        assert module in found
        assert not found[module] or module in AT_TOP.get(name, set())


def test_the_package_of_the_physics_needs_no_ros() -> None:
    modules = {module for module, _ in imported(SOURCE / 'fam_bundle_model')}
    assert not {m for m in modules if 'rcl' in m or m.startswith(('ament', 'rosidl'))}


@pytest.mark.parametrize('name', PACKAGES)
def test_manifest_set_up_licence_and_changes_agree(name: str) -> None:
    package, folder = manifest(name), SOURCE / name
    assert package.name == name
    assert package.licenses == ['Apache-2.0']
    assert (folder / package.licenses[0].file).read_text() == (ROOT / 'LICENSE').read_text()
    assert {manifest(other).version for other in PACKAGES} == {package.version}
    get_changelog_from_path(str(folder / 'CHANGELOG.rst'))
    changes = (folder / 'CHANGELOG.rst').read_text()
    assert f'\nChangelog for package {name}\n' in changes
    assert 'Forthcoming\n-----------\n* ' in changes
    assert (folder / 'README.md').read_text().startswith(f'# {name}\n')
    if name in PYTHON:
        text = (folder / 'setup.py').read_text()
        for line in (
            f"package = '{name}'",
            f"version='{package.version}'",
            f'description={package.description!r}',
            "license='Apache-2.0'",
            f"maintainer_email='{package.maintainers[0].email}'",
            "['LICENSE', 'package.xml']",
        ):
            assert line in text, line
        assert (folder / 'resource' / name).exists()
        assert f'script_dir=$base/lib/{name}' in (folder / 'setup.cfg').read_text()


@pytest.mark.parametrize('name', PYTHON)
def test_every_executable_has_its_function(name: str) -> None:
    entries = distribution(name.replace('_', '-')).entry_points
    scripts = entries.select(group='console_scripts')
    assert len(scripts) > 0 or name in ('fam_bundle_model', 'fam_bundle_node')
    for entry in entries:
        module, _, attribute = entry.value.partition(':')
        assert callable(getattr(importlib.import_module(module), attribute))


@pytest.mark.parametrize('linter', sorted(LINTERS))
def test_the_rules_of_aments_linters_hold_where_they_are_installed(linter: str) -> None:
    main = pytest.importorskip(f'{linter}.main')
    done = subprocess.run(
        [sys.executable, '-c', f'import sys; from {main.__name__} import main; sys.exit(main())'],
        cwd=SOURCE,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_a_class_and_its_first_method_stand_apart() -> None:
    # ament_flake8's CNL100, the one of its rules that neither ruff nor its formatter knows.
    joined = re.compile(r'^ *class [^\n]*:\n *(def|@|async)\b', re.MULTILINE)
    assert joined.search('class X:\n    def f(self): ...')
    for path in SOURCE.glob('*/*/**/*.py'):
        assert not joined.search(path.read_text()), path


HOOKS = yaml.safe_load((ROOT / '.pre-commit-config.yaml').read_text())['repos'][0]['hooks']
GOOD = {
    'python': '"""One number."""\n\na = 1\n',
    'xml': '<a><b/></a>',
    'yaml': 'a: !!python/name:b.c\n---\n- 1\n',
}
BAD = {'python': "a = 'a\n", 'xml': '<a><b></a>', 'yaml': 'a: [1\n'}


@pytest.mark.parametrize('hook', HOOKS, ids=lambda hook: hook['id'])
@pytest.mark.skipif(not (ROOT / '.venv').exists(), reason='hooks use what ./fam test installs')
def test_what_runs_before_a_commit_is_installed_and_notices(hook: dict, tmp_path: Path) -> None:
    (kind,) = hook['types']
    statuses = []
    for text in (GOOD[kind], BAD[kind]):
        (tmp_path / 'file').with_suffix('.py' if kind == 'python' else '').write_text(text)
        file = next(tmp_path.iterdir())
        words = [*shlex.split(hook['entry']), str(file)]
        done = subprocess.run(words, cwd=ROOT, capture_output=True, check=False)
        statuses.append(done.returncode)
    assert statuses[0] == 0
    assert statuses[1] != 0


def test_every_file_of_a_package_begins_with_the_licence() -> None:
    files = [path for name in PACKAGES for path in (SOURCE / name).rglob('*.py')]
    header = files[0].read_text().split('\n\n')[0]
    assert header.startswith('# Copyright ')
    assert 'Apache License, Version 2.0' in header
    for path in files:
        assert path.read_text().startswith(header), path
