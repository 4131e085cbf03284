# SPDX-License-Identifier: Apache-2.0
"""
The documents say what the code says: parameters, nodes, topics, commands and links.

Run as a script, it prints the parameter tables for ``fam_bundle_model/README.md``.
"""

import argparse
import ast
from collections.abc import Iterator
from pathlib import Path
import re
from typing import Any, NamedTuple

from ament_index_python.packages import get_package_prefix
from fam_bundle_bringup.cli import parser
from fam_bundle_io.hardware.calibration import (
    FlowCalibration,
    SensorCalibration,
    ValveCalibration,
)
from fam_bundle_io.hardware.limits import Limits
from fam_bundle_io.hardware.nidaqmx_backend import NidaqmxOptions
from fam_bundle_io.hardware.quanser_backend import QuanserOptions
from fam_bundle_io.trace import PER_UNIT, SCALARS
from fam_bundle_model.lag_table import PHYSICS
from fam_bundle_model.parameters import GROUPS
from fam_bundle_model.schema import Declaration, declarations, required
from fam_bundle_node.loop_node import COMMON
from fam_bundle_sim.volts_backend import FAULTS, VoltsOptions
import pytest

ROOT = Path(__file__).resolve().parents[1]
SOURCE = ROOT / 'ros2_ws' / 'src'
MESSAGES = SOURCE / 'fam_bundle_msgs'
PACKAGES = sorted(path.parent.name for path in SOURCE.glob('*/setup.py'))
DOCUMENTS = sorted(
    [
        *ROOT.glob('README.md'),
        *ROOT.glob('docs/*.md'),
        *SOURCE.glob('*/README.md'),
        *ROOT.glob('studies/**/*.md'),
    ]
)
HARDWARE_TABLES = {
    '### backends.quanser': QuanserOptions,
    '### backends.nidaqmx': NidaqmxOptions,
    '### backends.volts': VoltsOptions,
    '### sensors': SensorCalibration,
    '### sensors.source_flow': FlowCalibration,
    '### valves': ValveCalibration,
    '## Limits': Limits,
}
CODE = re.compile(r'^(```|~~~).*?^\1|`[^`\n]*`', re.MULTILINE | re.DOTALL)
LINK = re.compile(r'\]\(([^)\s]+)\)')
HEADING = re.compile(r'^#+ +(.+)$', re.MULTILINE)
RUN = re.compile(r'(?:\./fam|ros2) run ([a-z_]+) ([a-z_]+)')
PARAMETER_FILE = re.compile(r'--params-file (\S+\.yaml)')


# ---- What a document holds ----


def readme(package: str) -> Path:
    return SOURCE / package / 'README.md'


def cells(document: Path, heading: str) -> list[list[str]]:
    """Return the rows of the first table below ``heading``, without backticks; or none."""
    lines = iter(document.read_text(encoding='utf-8').splitlines())
    found = []
    for line in lines:
        if line == heading:
            break
    for line in lines:
        if line.startswith('#') or (found and not line):
            break
        if line.startswith('|'):
            found.append([cell.strip().replace('`', '') for cell in line.strip('|').split('|')])
    return found[2:]  # below the titles and the rule


def link_texts(cell: str) -> list[str]:
    return re.findall(r'\[([^]]+)\]\([^)]+\)', cell)


def anchors(document: Path) -> set[str]:
    """Return the anchors that GitHub makes of the headings."""
    text = CODE.sub(lambda code: '' if '\n' in code[0] else code[0], document.read_text())
    return {
        re.sub(r'[^\w\- ]', '', title.lower()).replace(' ', '-') for title in HEADING.findall(text)
    }


# ---- What the code holds ----


def parameter_row(group: type, name: str, declaration: Declaration) -> list[str]:
    """Return name, type, unit, default, range and meaning of one parameter."""
    default = 'required' if name in required(group) else str(getattr(group, name))
    kind = declaration.kind.__name__ + ('[]' if declaration.array else '')
    allowed = declaration.bound().removeprefix('must be ')
    text = declaration.text + ('; **live**' if declaration.live else '')
    return [name, kind, declaration.unit or '-', default, allowed, text]


def parameter_rows(group: type) -> list[list[str]]:
    return [parameter_row(group, name, found) for name, found in declarations(group).items()]


def executables(package: str) -> set[str]:
    setup = (SOURCE / package / 'setup.py').read_text()
    return set(re.findall(r"'(\w+) = [\w.]+:main'", setup))


class Connection(NamedTuple):
    """One end of a topic as the code makes it."""

    node: str
    topic: str
    message: str
    direction: str
    quality: str


class NodeFile:
    """What the source of one node tells without running it."""

    def __init__(self, path: Path) -> None:
        tree = ast.parse(path.read_text())
        self.calls = [
            call
            for call in ast.walk(tree)
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Attribute)
        ]
        self.made = [
            call
            for call in ast.walk(tree)
            if isinstance(call, ast.Call) and isinstance(call.func, ast.Name)
        ]
        self.types = {
            alias.asname or alias.name: f'{node.module.replace(".", "/")}/{alias.name}'
            for node in ast.walk(tree)
            if isinstance(node, ast.ImportFrom) and node.module
            for alias in node.names
        }
        self.constants = {
            node.targets[0].id: node.value
            for node in tree.body
            if isinstance(node, ast.Assign) and isinstance(node.targets[0], ast.Name)
        }
        start = next((c for c in self.calls if ast.unparse(c.func) == 'super().__init__'), None)
        named = start is not None and start.args and isinstance(start.args[0], ast.Constant)
        self.name: str = start.args[0].value if named else ''
        self.groups: set[str] = set()
        if named and len(start.args) > 1:
            groups = self.constants.get('GROUPS')
            known = {'PHYSICS': PHYSICS, 'GROUPS': groups and ast.literal_eval(groups)}
            self.groups = set(eval(ast.unparse(start.args[1]), known)) | set(COMMON)

    def connections(self) -> Iterator[Connection]:
        for call in self.calls:
            made = call.func.attr
            in_or_out = {'publisher': 'out', 'subscription': 'in', 'listen': 'in'}
            direction = in_or_out.get(made.split('_')[-1])
            if direction is None:
                continue
            quality = 'LOOP_PUBLISHER' if direction == 'out' else 'LOOP_SUBSCRIPTION'
            if made.startswith('create'):
                profiles = [a.id for a in call.args if isinstance(a, ast.Name) and a.id.isupper()]
                quality = profiles[0] if profiles else ''
            topics = self.constants.get('TOPICS')
            if len(call.args) > 1 and isinstance(call.args[1], ast.Constant):
                message = self.types[call.args[0].id]
                yield Connection(self.name, call.args[1].value, message, direction, quality)
            elif made.startswith('create') and isinstance(topics, ast.Dict):
                for topic, message in zip(topics.keys, topics.values, strict=True):
                    found = self.types[message.id]
                    yield Connection(self.name, topic.value, found, direction, quality)

    def actions(self) -> Iterator[tuple[str, str, str]]:
        for call in self.made:
            if call.func.id == 'TickedAction':
                yield self.name, call.args[2].value, self.types[call.args[1].id]

    def services(self) -> Iterator[tuple[str, str, str]]:
        for call in self.calls:
            if call.func.attr == 'create_service':
                yield self.name, call.args[1].value, self.types[call.args[0].id]


def node_files(package: str) -> list[NodeFile]:
    found = [NodeFile(path) for path in sorted((SOURCE / package).glob('*/*_node.py'))]
    return [node for node in found if node.name]


def qualities() -> dict[str, str]:
    """Return each profile of ``qos.py`` in words."""
    tree = ast.parse((SOURCE / 'fam_bundle_node' / 'fam_bundle_node' / 'qos.py').read_text())
    numbers: dict[str, Any] = {}
    found = {}
    for node in tree.body:
        if not isinstance(node, ast.Assign):
            continue
        name, value = node.targets[0].id, node.value
        if isinstance(value, ast.Call):
            depth = eval(ast.unparse(value.args[0]), numbers)
            durability = value.args[1].attr.lower().replace('_', ' ')
            found[name] = f'reliable, {durability}, depth {depth}'
        else:
            numbers[name] = ast.literal_eval(value)
    return found


# ---- Parameters ----


@pytest.mark.parametrize('name', GROUPS)
def test_parameter_table_is_the_schema(name: str) -> None:
    assert cells(readme('fam_bundle_model'), f'### {name}') == parameter_rows(GROUPS[name])


def test_every_parameter_group_and_no_other_has_a_table() -> None:
    text = readme('fam_bundle_model').read_text()
    assert re.findall(r'^### (\w+)$', text, re.MULTILINE) == list(GROUPS)


@pytest.mark.parametrize(('heading', 'group'), HARDWARE_TABLES.items())
def test_table_of_the_hardware_is_its_declaration(heading: str, group: type) -> None:
    assert cells(ROOT / 'docs' / 'hardware.md', heading) == parameter_rows(group)


def test_every_fault_of_the_simulated_rig_is_in_its_table() -> None:
    rows = cells(ROOT / 'docs' / 'hardware.md', '#### Faults')
    assert rows == [[name, text] for name, text in FAULTS.items()]


# ---- Packages ----


@pytest.mark.parametrize('package', PACKAGES)
def test_module_table_names_every_module(package: str) -> None:
    folder = SOURCE / package / package
    modules = {str(path.relative_to(folder)) for path in folder.rglob('*.py')}
    modules = {name for name in modules if not name.endswith('__init__.py')}
    named = [row[0] for row in cells(readme(package), '## Modules')]
    assert sorted(named) == sorted(modules)


@pytest.mark.parametrize('package', PACKAGES)
def test_executables_are_those_of_setup_py(package: str) -> None:
    document = readme(package)
    rows = cells(document, '## Nodes') + cells(document, '## Executables')
    assert {row[0] for row in rows} - {'-'} == executables(package)


@pytest.mark.parametrize('package', PACKAGES)
def test_nodes_and_their_parameter_groups(package: str) -> None:
    named = {row[1]: set(link_texts(row[-1])) for row in cells(readme(package), '## Nodes')}
    assert named == {node.name: node.groups for node in node_files(package)}


@pytest.mark.parametrize('package', PACKAGES)
def test_topics_are_those_of_the_nodes(package: str) -> None:
    named = {tuple(row[:5]) for row in cells(readme(package), '## Topics')}
    words = qualities()
    made = {
        connection._replace(quality=words[connection.quality])
        for node in node_files(package)
        for connection in node.connections()
    }
    assert named == made


@pytest.mark.parametrize('package', PACKAGES)
def test_services_are_those_of_the_nodes(package: str) -> None:
    named = {tuple(row[:3]) for row in cells(readme(package), '## Services')}
    assert named == {service for node in node_files(package) for service in node.services()}


@pytest.mark.parametrize('package', PACKAGES)
def test_actions_are_those_of_the_nodes(package: str) -> None:
    named = {tuple(row[:3]) for row in cells(readme(package), '## Actions')}
    assert named == {action for node in node_files(package) for action in node.actions()}


def test_quality_table_is_the_code() -> None:
    rows = cells(readme('fam_bundle_node'), '## Quality of service')
    assert {row[0]: row[1] for row in rows} == qualities()


def test_trace_table_names_every_array() -> None:
    rows = cells(readme('fam_bundle_io'), '## Trace')
    assert sorted(row[0] for row in rows) == sorted([*SCALARS, *PER_UNIT])
    assert {row[0] for row in rows if 'units' in row[1]} == set(PER_UNIT)


def test_command_line_options() -> None:
    commands = next(a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    known: dict[str, set[str]] = {}
    for command, options in commands.choices.items():
        for action in options._actions:
            for name in action.option_strings[-1:]:  # none: a bag
                known.setdefault(name, set()).add(command)
    del known['--help']
    rows = cells(readme('fam_bundle_bringup'), '## Options')
    assert {row[0]: set(row[1].split(', ')) for row in rows} == known


# ---- Messages ----


def test_message_package_names_its_files() -> None:
    rows = cells(MESSAGES / 'README.md', '## Messages')
    rows += cells(MESSAGES / 'README.md', '## Services')
    rows += cells(MESSAGES / 'README.md', '## Actions')
    named = {LINK.search(row[0])[1] for row in rows}
    files = {
        path for kind in ('msg', 'srv', 'action') for path in MESSAGES.glob(f'{kind}/*.{kind}')
    }
    assert named == {str(path.relative_to(MESSAGES)) for path in files}
    assert all(link_texts(row[0]) == [Path(LINK.search(row[0])[1]).stem] for row in rows)


def test_message_package_names_the_topics_that_are_published() -> None:
    reports = SOURCE / 'fam_bundle_node' / 'fam_bundle_node' / 'statistics_publisher.py'
    nodes = [node for package in PACKAGES for node in node_files(package)]
    published = {
        (c.message.rpartition('/')[2], c.topic)
        for node in [*nodes, NodeFile(reports), NodeFile(reports.with_name('loop_node.py'))]
        for c in node.connections()
        if c.direction == 'out' and c.message.startswith('fam_bundle_msgs/')
    }
    rows = cells(MESSAGES / 'README.md', '## Messages')
    ours = [row for row in rows if row[2] != 'from outside']
    named = {(link_texts(row[0])[0], row[1].split(' ')[0]) for row in ours}
    assert {(m, topic) for m, topic in named if topic != 'inside'} == published


@pytest.mark.parametrize('package', PACKAGES)
def test_every_type_that_a_table_names_is_a_file(package: str) -> None:
    for row in cells(readme(package), '## Topics') + cells(readme(package), '## Services'):
        owner, kind, name = row[2].split('/')
        if owner != 'fam_bundle_msgs':
            assert get_package_prefix(owner)
            continue
        assert (SOURCE / owner / kind / f'{name}.{kind}').is_file(), row[2]


# ---- Commands and links in every document ----


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_commands_name_what_exists(document: Path) -> None:
    text = document.read_text(encoding='utf-8')
    for package, executable in RUN.findall(text):
        assert executable in executables(package)
    for path in PARAMETER_FILE.findall(text):
        assert (ROOT / path).is_file(), path


@pytest.mark.parametrize('document', DOCUMENTS, ids=lambda path: str(path.relative_to(ROOT)))
def test_relative_links_lead_somewhere(document: Path) -> None:
    broken = []
    for target in LINK.findall(CODE.sub('', document.read_text(encoding='utf-8'))):
        if re.match(r'[a-z]+:', target):
            continue
        path, _, anchor = target.partition('#')
        file = (document.parent / path).resolve() if path else document
        if not file.exists() or (anchor and file.suffix == '.md' and anchor not in anchors(file)):
            broken.append(target)
    assert not broken


@pytest.mark.parametrize('document', ['README.md', 'docs', 'studies'])
def test_no_placeholder_is_left(document):
    path = ROOT / document
    for text in [path] if path.is_file() else path.rglob('*.md'):
        assert not re.search(r'@[A-Z]+@', text.read_text()), text


if __name__ == '__main__':
    for group_name, parameters in GROUPS.items():
        print(f'### {group_name}\n\n{" ".join(parameters.__doc__.split())}\n')
        print('| Name | Type | Unit | Default | Range | Meaning |\n|---|---|---|---|---|---|')
        for name, *others, meaning in parameter_rows(parameters):
            print(f'| `{name}` | {" | ".join(others)} | {meaning} |')
        print()
