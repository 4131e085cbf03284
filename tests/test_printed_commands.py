# SPDX-License-Identifier: Apache-2.0
"""Each command that a document prints: its program, options, files, names and values exist."""

import ast
from collections.abc import Callable, Iterator
from importlib.machinery import SourceFileLoader
import importlib.util
from pathlib import Path
import re
import shlex
from typing import Any, NamedTuple

from ament_index_python.packages import get_package_prefix
from fam_bundle_bringup.cli import parser
from fam_bundle_bringup.doctor import add_doctor_options
from fam_bundle_bringup.graph import BRIDGE, NODES
from fam_bundle_bringup.one_line_parser import Parser
from fam_bundle_model.parameters import GROUPS, PACES, SCHEMES
from fam_bundle_model.schema import ConfigurationError, declarations
from fam_bundle_node.network import CHOICES
import pytest
import yaml

ROOT = Path(__file__).parents[1]
LAUNCH = ROOT / 'ros2_ws/src/fam_bundle_bringup/launch'
BLOCK = re.compile(r'^ *```(\S*).*?\n(.*?)^ *```', re.MULTILINE | re.DOTALL)
# Graphs of text, and what commands print: how these begin.
PICTURE = re.compile(r'bundle_state$|unconfigured ─|fam experiment: |domain \d+, |plant +─')
SHELLS = ('', 'bash', 'console', 'sh')
# What stands for something of the reader's own.
THEIRS = ('mine.csv', 'other.yaml', 'rig.yaml', 'rig_config.yaml', 'rig_zeroed.yaml')
STANDS_FOR = ('ADDRESS', 'FILE', 'NAME', '/absolute/rig.yaml', '/path/to/copy.xml')
EXECUTABLES = {name: package for package, name in (*NODES, BRIDGE)}
SERVICES = ('arm', 'disarm', 'emergency_stop', 'reset_fault', 'zero')
# Of the launch arguments that are printed; tests/test_launch.py tries every choice.
LAUNCH_CHOICES = {
    'scheme': SCHEMES,
    'pace': PACES,
    'record': ('true', 'false'),
    'composed': ('true', 'false'),
}
TRANSITIONS = ('configure', 'activate', 'deactivate', 'cleanup', 'shutdown')
VARIABLES = (
    *CHOICES,
    'P',
    'PYTHONPATH',
    'RMW_IMPLEMENTATION',
    'ROS_SECURITY_ENABLE',
    'ROS_SECURITY_ENCLAVE_OVERRIDE',
    'ROS_SECURITY_KEYSTORE',
    'ROS_SECURITY_STRATEGY',
)
OWN_PARAMETERS = ('bag.folder', 'bag.topics', 'bag.split_size', 'bag.split_duration')


def documents() -> list[Path]:
    found = [ROOT / 'README.md', ROOT / 'CONTRIBUTING.md', ROOT / 'docker/README.md']
    for pattern in ('docs/*.md', 'ros2_ws/src/*/README.md', 'studies/**/README.md'):
        found += sorted(ROOT.glob(pattern))
    return found


class Command(NamedTuple):
    """A printed command: where it stands, and in which block of that document."""

    document: Path
    block: int
    line: str


def printed() -> Iterator[Command]:
    """Give each printed command."""
    for document in documents():
        for number, (language, text) in enumerate(BLOCK.findall(document.read_text())):
            lines = [line.strip() for line in text.replace('\\\n', ' ').splitlines()]
            lines = [line for line in lines if line and not line.startswith('#')]
            if language in SHELLS and lines and not PICTURE.match(lines[0]):
                yield from (Command(document, number, line) for line in lines)


def commands() -> Iterator[tuple[Path, list[str], str]]:
    """Give each printed command: its document, the commands before it there, and itself."""
    before: dict[Path, list[str]] = {}
    for document, _, line in printed():
        earlier = before.setdefault(document, [])
        yield document, list(earlier), line
        earlier.append(line)


def program(line: str) -> str:
    word = line.split()[0]
    return 'export' if re.match(r'[A-Z]+=', word) else word.removeprefix('.venv/bin/')


class Printed:
    """A command as words, and what else its document and the repository know."""

    def __init__(self, before: list[str], line: str) -> None:
        self.before = before
        self.words = shlex.split(line, comments=True)

    def file(self, name: str) -> None:
        """Assert that a file exists, is the reader's, or is made by a command before."""
        if name in STANDS_FOR or Path(name).name in THEIRS or name.startswith('$'):
            return
        made = any(folder_of(line, name) for line in self.before)
        assert made or (ROOT / name).exists(), f'{name}: not there, and nothing before makes it'


def folder_of(line: str, name: str) -> bool:
    """Return whether a command makes the folder that ``name`` is in."""
    words = shlex.split(line, comments=True)
    if words[0] == 'cp':
        return name == words[2]
    out = words[words.index('--out') + 1] if '--out' in words else None
    if words[:2] == ['./fam', 'demo']:
        out = 'runs/demo'
    return bool(out) and (name == out or name.startswith(f'{out}/'))


def fam_module() -> Any:
    loader = SourceFileLoader('fam_printed', str(ROOT / 'fam'))
    spec = importlib.util.spec_from_loader('fam_printed', loader)
    assert spec is not None
    module = importlib.util.module_from_spec(spec)
    loader.exec_module(module)
    return module


# ---- One check for each program ----


def check_fam(printed: Printed) -> None:
    command, *rest = printed.words[1:]
    module = fam_module()
    if command in module.OWN:
        if command == 'run':
            check_run(printed, rest)
        elif command == 'test':
            assert rest in ([], ['-q', '-k', 'lag_table'])
        else:
            assert not rest
        return
    assert command in module.PASSED_ON, command
    if rest == ['--help']:
        return
    try:
        if command == 'doctor':
            doctor = Parser()
            add_doctor_options(doctor)
            options = doctor.parse_args(rest)
        else:
            # What a patch of the same document adds is not known here.
            known = ['lag' if word == 'directed' else word for word in rest]
            options = parser().parse_args([command, *known])
    except SystemExit:
        raise AssertionError('the parser refuses it') from None
    given = vars(options)
    for name in ('config', 'study', 'hardware'):
        if given.get(name) is not None:
            printed.file(str(given[name]))
    bags = given.get('bags') or given.get('bag') or []
    for bag in bags if isinstance(bags, list) else [bags]:
        printed.file(str(bag))
    reference = given.get('reference')
    if reference and reference.endswith('.csv'):
        printed.file(reference)
    for group, name in (('recruitment', 'scheme'), ('allocation', 'policy')):
        value = given.get('scheme' if name == 'scheme' else 'allocation')
        if value is not None:
            declarations(GROUPS[group])[name].convert(name, value)


def check_run(printed: Printed, words: list[str]) -> None:
    package, executable, *rest = words
    assert (Path(get_package_prefix(package)) / 'lib' / package / executable).exists()
    if executable == 'fam_bundle':
        check_fam(Printed(printed.before, shlex.join(['./fam', *rest])))
        return
    assert rest[:1] == ['--ros-args']
    for option, value in zip(rest[1::2], rest[2::2], strict=True):
        if option == '--params-file':
            printed.file(value)
        elif option == '-p':
            check_parameter(*value.split(':=', 1))
        else:
            assert option == '-r', option
            assert re.fullmatch(r'__ns:=/\w+', value), value


def check_parameter(name: str, value: str | None = None) -> None:
    if name in OWN_PARAMETERS:
        return
    group, _, field = name.partition('.')
    declaration = declarations(GROUPS[group])[field]
    if value is not None and value not in STANDS_FOR:
        try:
            declaration.convert(name, yaml.safe_load(value))
        except ConfigurationError as error:
            raise AssertionError(str(error)) from None


def check_ros2(printed: Printed) -> None:
    verb, *rest = printed.words[1:]
    checks: dict[str, Callable[[], None]] = {
        'run': lambda: check_run(printed, rest),
        'launch': lambda: check_launch(*rest),
        'param': lambda: check_param(*rest),
        'lifecycle': lambda: check_lifecycle(*rest),
        'service': lambda: check_service(*rest),
        'topic': lambda: check_words(rest, ['list']),
        'bag': lambda: check_words(rest, ['record', '-a']),
        'daemon': lambda: check_known(printed),
        'security': lambda: check_security(printed),
    }
    checks[verb]()


def check_words(words: list[str], wanted: list[str]) -> None:
    assert words == wanted


def check_launch(package: str, file: str, *arguments: str) -> None:
    if package == 'foxglove_bridge':  # not ours
        assert file == 'foxglove_bridge_launch.xml'
        return
    assert package == 'fam_bundle_bringup'
    names = argument_names(LAUNCH / file)
    for argument in arguments:
        if argument != '--show-args':
            name, _, value = argument.partition(':=')
            assert name in names
            if name == 'cycles':
                check_parameter('reference.cycles', value)
            allowed = LAUNCH_CHOICES.get(name)
            assert allowed is None or value in allowed


def argument_names(file: Path) -> tuple[str, ...]:
    """Return the names of a launch file's arguments without importing ``launch``."""
    made = re.search(r'^ARGUMENTS = (\([^)]*\))', file.read_text(), re.MULTILINE)
    assert made is not None
    names: tuple[str, ...] = ast.literal_eval(made[1])
    return names


def node_of(name: str) -> str:
    node = name.removeprefix('/')
    assert node in EXECUTABLES, node
    return node


def check_param(verb: str, node: str, *rest: str) -> None:
    assert verb in ('describe', 'dump', 'get', 'list', 'set')
    node_of(node)
    if rest:
        check_parameter(*rest)
        group, _, field = rest[0].partition('.')
        if verb == 'set':
            assert declarations(GROUPS[group])[field].live


def check_lifecycle(verb: str, node: str, transition: str) -> None:
    assert (verb, node_of(node)) == ('set', 'hardware_bridge')
    assert transition in TRANSITIONS


def check_service(verb: str, name: str, kind: str) -> None:
    assert verb == 'call'
    _, node, service = name.split('/')
    assert (node_of(node), kind) == ('hardware_bridge', 'std_srvs/srv/Trigger')
    assert service in SERVICES


def check_security(printed: Printed) -> None:
    check_known(printed)
    for word in printed.words:
        if word.endswith('.xml'):
            printed.file(word)


def check_variables(printed: Printed) -> None:
    verb = printed.words[0]
    for word in printed.words[verb in ('export', 'unset') :]:
        name, given, value = word.partition('=')
        if given or verb == 'unset':  # else a part of what is substituted
            assert name in VARIABLES
        if value.startswith(('ros2_ws', '/path')):
            printed.file(value)


def check_python(printed: Printed) -> None:
    if printed.words[1] == '-m':
        assert printed.words[2:4] == ['pip', 'install']
    else:
        # Our packages are in the workspace, not in the virtual environment.
        assert printed.before[-1:] == ['./fam shell']
    for word in printed.words[1:]:
        if '/' in word:
            printed.file(word)


def check_copy(printed: Printed) -> None:
    _, source, target = printed.words
    printed.file(source)
    assert Path(target).name in THEIRS or target == 'mine.yaml'


def check_git(printed: Printed) -> None:
    verb, *rest = printed.words[1:]
    assert verb in ('apply', 'clone')
    if verb == 'apply':
        printed.file(rest[0])


def check_docker(printed: Printed) -> None:
    words = printed.words
    printed.file(words[words.index('-f') + 1])
    if words[1] == 'build':
        stage = words[words.index('--target') + 1]
        assert f' AS {stage}\n' in (ROOT / 'docker/Dockerfile').read_text()
    else:
        assert words[1] == 'compose'
        assert 'up' in words


def check_known(printed: Printed) -> None:
    """Assert that the form of a command of others is known here."""
    assert any(re.fullmatch(form, shlex.join(printed.words)) for form in KNOWN), printed.words


KNOWN = (
    r'cd (fam_bundle(/ros2_ws)?|ros2_ws)',
    r'source (/opt/ros/jazzy|install)/setup.bash',
    r'sudo rosdep init',
    r'rosdep update',
    r'rosdep install --from-paths src -i -y',
    r'pip3 install --no-deps --require-hashes --target \S+ -r \.\./docker/requirements\.txt',
    r'ros2 daemon stop',
    r'ros2 security create_keystore keystore',
    r'ros2 security generate_artifacts -k keystore -p \S+\.policy\.xml',
    r'colcon build --cmake-args -DCMAKE_BUILD_TYPE=Release',
    r'colcon test(-result)?',
    r'pre-commit install',
    r'dask scheduler --host 127\.0\.0\.1 --no-dashboard',
    r'dask worker tcp://127\.0\.0\.1:8786 --nthreads 1 --nworkers 2 --no-dashboard',
)
CHECKS: dict[str, Callable[[Printed], None]] = {
    './fam': check_fam,
    'ros2': check_ros2,
    'export': check_variables,
    'unset': check_variables,
    'python': check_python,
    'python3': check_python,
    'cp': check_copy,
    'git': check_git,
    'docker': check_docker,
    **dict.fromkeys(
        ('cd', 'source', 'rosdep', 'colcon', 'pre-commit', 'dask', 'pip3', 'sudo'), check_known
    ),
}
FOUND = list(commands())


@pytest.mark.parametrize(
    ('before', 'line'),
    [(before, line) for _, before, line in FOUND],
    ids=[f'{path.relative_to(ROOT)}-{line[:60]}' for path, _, line in FOUND],
)
def test_a_printed_command_fits_what_exists(before: list[str], line: str) -> None:
    assert program(line) in CHECKS, f'{line}: a form that is not known here'
    CHECKS[program(line)](Printed(before, line))


def test_there_are_commands_and_wrong_ones_are_found() -> None:
    assert len(FOUND) > 80
    for wrong in (
        './fam experimnt',
        './fam experiment --scheem lag',
        './fam experiment --scheme lagg',
        './fam replay runs/nowhere/bag',
        './fam run fam_bundle_sim plant --ros-args',
        'ros2 launch fam_bundle_bringup sim.launch.py pce:=realtime',
        'ros2 param set /strain_controller fam.length 0.3',
        'ros2 param set /strain_controller strain_loop.tracking_time 0.0',
        'ros2 service call /hardware_bridge/amr std_srvs/srv/Trigger',
        'ros2 lifecycle set /hardware_bridge begin',
        'ros2 launch fam_bundle_bringup sim.launch.py pace:=nonsense',
        'ros2 launch fam_bundle_bringup sim.launch.py cycles:=none',
        'ros2 security generate_artifacts -k keystore -p nowhere.policy.xml',
        './fam test -x',
        'python -m venv x',
        'python3 examples/analyse_bag.py runs/one/bag',
        'export ROS_DISCOVERY=1',
        'docker build -f docker/Dockerfil --target runtime -t x .',
        'colcon biuld',
    ):
        with pytest.raises((AssertionError, ConfigurationError)):
            CHECKS[program(wrong)](Printed([], wrong))
