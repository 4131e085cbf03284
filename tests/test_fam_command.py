# SPDX-License-Identifier: Apache-2.0
"""The command ./fam itself, in a small tree of its own whose tools are all imitations."""

import ast
from importlib.machinery import SourceFileLoader
import importlib.util
import json
import os
from pathlib import Path
import re
import shutil
import signal
import stat
import subprocess
import sys
import time

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
TOOLS = {
    'cc': '',
    'c++': '',
    'make': '',
    'cmake': 'echo cmake version 3.25.1',
}
PROFILE = 'ros2_ws/src/fam_bundle_bringup/config/fastdds_loopback.xml'
LOCKS = sorted((REPOSITORY / 'requirements').glob('*.txt'))
NPM = ('tests/readers', 'docs/site')  # what npm installs into
NPM_FILES = [
    f'{folder}/{name}' for folder in NPM for name in ('package.json', 'package-lock.json')
]


def executable(path, script):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(f'#!/bin/sh\n{script}\n')
    path.chmod(0o755)


def files(tree):
    return {path: path.read_bytes() for path in tree.rglob('*') if path.is_file()}


class Tree:
    """A small checkout, with the commands that stand on its PATH."""

    def __init__(self, folder):
        self.root = folder / 'tree'
        self.path = folder / 'bin'
        for name in (
            'fam',
            'cmake/wheel_include_dirs.cmake',
            PROFILE,
            *NPM_FILES,
            *(f'requirements/{p.name}' for p in LOCKS),
        ):
            target = self.root / name
            target.parent.mkdir(parents=True, exist_ok=True)
            target.write_bytes((REPOSITORY / name).read_bytes())
        self.message = self.root / 'ros2_ws/src/some_msgs/msg/Some.msg'
        self.message.parent.mkdir(parents=True)
        self.message.write_text('float64 value\n')
        for name, script in TOOLS.items():
            executable(self.path / name, script)
        (self.path / 'bash').symlink_to('/bin/bash')

    def popen(self, *arguments, prelude='', **variables):
        # Like `python3 fam ...`, after a prelude that may bend the interpreter.
        start = (
            f'import runpy, sys; sys.argv = {["fam", *arguments]!r}; {prelude}\n'
            f'runpy.run_path({str(self.root / "fam")!r}, run_name="__main__")'
        )
        return subprocess.Popen(
            [sys.executable, '-c', start],
            env={'PATH': str(self.path), **variables},
            stdin=subprocess.DEVNULL,
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
        )

    def fam(self, *arguments, **options):
        process = self.popen(*arguments, **options)
        out, err = process.communicate(timeout=60)
        return process.returncode, out, err

    def module(self):
        loader = SourceFileLoader('fam_command', str(self.root / 'fam'))
        spec = importlib.util.spec_from_loader('fam_command', loader)
        module = importlib.util.module_from_spec(spec)
        loader.exec_module(module)
        return module

    def due(self):
        module = self.module()
        return [step.title for step in module.plan(False) if module.is_due(step)]

    def pretend_set_up(self):
        """Write what a finished set-up leaves: stamps, environment, one executable."""
        executable(self.root / '.venv/bin/python', 'echo python "$@"')
        node = self.root / 'ros2_ws/install/some_nodes/lib/some_nodes/some_node'
        executable(node, 'echo "$@"; /usr/bin/env')
        install = self.root / 'ros2_ws/install'
        (install / 'setup.bash').touch()
        (install / 'fam_environment.json').write_text(
            '{"PATH": "/sourced:", "PYTHONPATH": "/ours"}'
        )
        self.stamp()

    def stamp(self):
        for step in self.module().plan(False, testing=True, site=True):
            step.stamp.parent.mkdir(parents=True, exist_ok=True)
            step.stamp.write_text(step.digest)

    def build_is_due(self, colcon):
        """Pretend a finished set-up, after which a message changed; colcon is this script."""
        self.pretend_set_up()
        build = self.root / 'ros2_ws/build'
        build.mkdir()
        underlay = (self.root / '.venv/fam_stamp').read_text()
        (build / 'fam_underlay').write_text(underlay)
        executable(self.root / '.venv/bin/colcon', colcon)
        self.message.write_text('float32 value\n')
        assert self.due() == ['workspace']


@pytest.fixture
def tree(tmp_path):
    return Tree(tmp_path)


def assert_one_line(text, *words):
    assert text.startswith('fam: ')
    assert text.count('\n') == 1
    for word in words:
        assert word in text


# ---- What it says ----


@pytest.mark.parametrize('arguments', [(), ('help',), ('-h',), ('--help',)])
def test_help_lists_every_command(tree, arguments):
    status, out, _ = tree.fam(*arguments)
    assert status == 0
    module = tree.module()
    for command in (*module.PASSED_ON, *module.OWN):
        assert re.search(rf'^  {command}  +\S', out, re.MULTILINE)


def test_the_readme_names_every_command(tree):
    text, module = (REPOSITORY / 'README.md').read_text(), tree.module()
    missing = [
        command
        for command in (*module.PASSED_ON, *module.OWN)
        if not re.search(rf'\./fam {command}\b', text)
    ]
    assert missing == []


def test_an_unknown_command_is_refused_in_one_line(tree):
    status, out, err = tree.fam('dmeo')
    assert (status, out) == (2, '')
    assert_one_line(err, "'dmeo'")


@pytest.mark.parametrize('command', ['setup', 'shell'])
def test_an_argument_that_would_be_ignored_is_refused(tree, command):
    status, _, err = tree.fam(command, '-h')
    assert status == 2
    assert_one_line(err, command, 'no arguments')


def test_python_3_6_parses_it():
    ast.parse((REPOSITORY / 'fam').read_text(), feature_version=(3, 6))


# ---- Prerequisites ----


@pytest.mark.parametrize(
    ('tool', 'named'),
    [
        ('cc', 'a C compiler is missing'),
        ('c++', 'a C++ compiler is missing'),
        ('make', 'make is missing'),
        ('cmake', 'cmake 3.21 or newer is needed, found none'),
        ('bash', 'bash is missing'),
    ],
)
def test_a_missing_tool_is_named_and_nothing_is_written(tree, tool, named):
    (tree.path / tool).unlink()
    before = files(tree.root)
    status, _, err = tree.fam('setup')
    assert status == 2
    assert_one_line(err, named, 'install')
    assert files(tree.root) == before


def test_an_old_cmake_is_named(tree):
    executable(tree.path / 'cmake', 'echo cmake version 3.16.3')
    status, _, err = tree.fam('setup')
    assert status == 2
    assert_one_line(err, '3.21', '3.16')


def test_everything_missing_is_one_line_each(tree):
    for tool in tree.path.iterdir():
        tool.unlink()
    status, _, err = tree.fam('setup')
    assert status == 2
    assert err.count('\n') == err.count('fam: ') == len(TOOLS) + 1


def test_a_path_with_a_space_is_refused(tmp_path):
    status, _, err = Tree(tmp_path / 'my checkout').fam('setup')
    assert status == 2
    assert_one_line(err, 'space', str(tmp_path / 'my checkout'))


@pytest.mark.parametrize('version', [(3, 6, 15), (3, 9, 2), (3, 14, 0)])
def test_a_python_outside_the_range_is_named_and_nothing_is_written(tree, version):
    before = files(tree.root)
    status, _, err = tree.fam('setup', prelude=f'sys.version_info = {version}')
    assert status == 2
    assert_one_line(err, 'Python 3.10 to 3.13', '.'.join(map(str, version)))
    assert files(tree.root) == before


def test_another_python_of_the_path_takes_over(tree):
    executable(tree.path / 'python3.12', 'echo "not this version" >&2; exit 127')
    executable(tree.path / 'python3.11', '[ "$1" = -c ] || echo started "$@"')
    status, out, _ = tree.fam('setup', prelude='sys.version_info = (3, 9, 2)')
    assert (status, out) == (0, f'started {tree.root / "fam"} setup\n')


@pytest.mark.parametrize('distribution', ['humble', 'rolling'])
def test_another_ros_distribution_is_refused(tree, distribution):
    status, _, err = tree.fam('setup', ROS_DISTRO=distribution)
    assert status == 2
    assert_one_line(err, distribution, 'Jazzy')


# ---- Steps and stamps ----


def test_nothing_is_due_after_a_set_up(tree):
    assert tree.due() == ['Python packages', 'workspace']
    tree.pretend_set_up()
    assert tree.due() == []


def test_a_changed_lock_makes_everything_due(tree):
    tree.pretend_set_up()
    with (tree.root / 'requirements/ros.txt').open('a') as lock:
        lock.write('# changed\n')
    assert tree.due() == ['Python packages', 'workspace']


def test_a_changed_module_needs_compilation_only(tree):
    package = tree.root / 'ros2_ws/src/fam_bundle_bringup/fam_bundle_bringup'
    package.mkdir(parents=True)
    (package / 'warm.py').write_text('')
    tree.pretend_set_up()
    assert tree.due() == []
    (package / 'new.py').write_text('')
    assert tree.due() == ['compiled functions']
    tree.pretend_set_up()
    (package.parent / 'test').mkdir()
    (package.parent / 'test/test_new.py').write_text('')
    assert tree.due() == []


def test_a_vanished_interpreter_makes_the_packages_due(tree):
    tree.pretend_set_up()
    (tree.root / '.venv/bin/python').unlink()
    assert tree.due() == ['Python packages']


@pytest.mark.parametrize('folder', NPM)
def test_what_npm_has_is_installed_once_where_npm_is_and_only_for_tests(tree, folder):
    tree.pretend_set_up()
    note, modules = tree.root / 'asked', tree.root / folder / 'node_modules'
    shutil.rmtree(modules, ignore_errors=True)
    # As `npm ci --prefix FOLDER` does it: what was there before is gone.
    npm = f'echo "$@" >> {note}; m=$3/node_modules; /bin/rm -rf $m; /bin/mkdir $m'
    asked = f'ci --prefix {tree.root / folder} '
    assert tree.fam('test')[0] == 0
    assert not modules.exists()
    executable(tree.path / 'npm', f'{npm}; echo > $m/.package-lock.json')
    assert tree.fam('setup')[0] == 0
    assert not note.exists()
    for _ in range(2):
        assert tree.fam('test')[0] == 0
    assert note.read_text().count(asked) == 1
    (tree.root / folder / 'package-lock.json').write_text('{}')
    assert tree.fam('test')[0] == 0
    assert note.read_text().count(asked) == 2


def test_the_site_is_built_strictly_and_needs_npm(tree):
    tree.pretend_set_up()
    status, _, err = tree.fam('docs')
    assert status == 2
    assert_one_line(err, 'npm is missing')
    executable(
        tree.path / 'npm', 'd=$3/node_modules; /bin/mkdir -p $d; echo > $d/.package-lock.json'
    )
    status, out, _ = tree.fam('docs', '--site-dir', 'elsewhere')
    built = f'python -m mkdocs build --strict --config-file {tree.root / "mkdocs.yml"}'
    assert (status, out) == (0, f'{built} --site-dir elsewhere\n')


def test_a_step_that_fails_shows_the_end_of_its_log(tree):
    tree.build_is_due('for i in $(/usr/bin/seq 100); do echo line $i; done; exit 7')
    status, _, err = tree.fam('setup')
    assert status == 1
    log = tree.root / 'ros2_ws/log/fam/workspace.log'
    assert err.splitlines()[1:21] == [f'line {i}' for i in range(81, 101)]
    assert err.splitlines()[21:] == [f'fam: workspace: failed, the whole log is {log}']
    assert 'line 1\n' in log.read_text()
    assert tree.due() == ['workspace']


@pytest.mark.parametrize(('number', 'status'), [(signal.SIGINT, 130), (signal.SIGTERM, 143)])
def test_an_interrupted_step_ends_its_children_and_stays_due(tree, number, status):
    tree.build_is_due('/bin/sleep 61 & echo $! > ../child; wait')
    process = tree.popen('setup')
    note = tree.root / 'child'
    wait_for(lambda: note.exists() and note.read_text())
    process.send_signal(number)
    _, err = process.communicate(timeout=20)
    assert process.returncode == status
    assert 'Traceback' not in err
    wait_for(lambda: not alive(int(note.read_text())))
    assert tree.due() == ['workspace']


def test_a_workspace_that_colcon_built_is_not_taken_away(tree):
    setup = tree.root / 'ros2_ws/install/setup.bash'
    setup.parent.mkdir(parents=True)
    setup.write_text('mine')
    before = files(tree.root)
    status, _, err = tree.fam('setup')
    assert status == 2
    assert_one_line(err, 'ros2_ws/install was built by colcon', 'ros2 run', 'remove')
    lock = tree.root / 'ros2_ws/log/fam/lock'
    assert files(tree.root) == {**before, lock: b''}


def test_two_at_once_build_once(tree):
    tree.build_is_due('echo once >> ../built; while [ ! -e ../go ]; do /bin/sleep 0.05; done')
    first = tree.popen('setup')
    wait_for((tree.root / 'built').exists)
    second = tree.popen('setup')
    said = second.stderr.readline()
    (tree.root / 'go').touch()
    rest = second.communicate(timeout=20)[1]
    first.communicate(timeout=20)
    assert (first.returncode, second.returncode) == (0, 0)
    assert_one_line(said + rest, 'another ./fam')
    assert (tree.root / 'built').read_text() == 'once\n'


def wait_for(condition, seconds=20):
    end = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < end
        time.sleep(0.02)


def alive(process):
    try:
        state = Path(f'/proc/{process}/stat').read_text()
    except FileNotFoundError:
        return False
    return state.rpartition(')')[2].split()[0] != 'Z'


# ---- Starting things ----


def test_run_lists_the_packages_when_one_is_unknown(tree):
    tree.pretend_set_up()
    status, _, err = tree.fam('run', 'no_such_package', 'some_node')
    assert status == 2
    assert_one_line(err, "'no_such_package'", 'packages: some_nodes')


def test_run_lists_the_executables_when_one_is_unknown(tree):
    tree.pretend_set_up()
    status, _, err = tree.fam('run', 'some_nodes', 'no_such_node')
    assert status == 2
    assert_one_line(err, "'no_such_node'", 'executables: some_node')


def test_run_without_an_executable_says_what_it_takes(tree):
    status, _, err = tree.fam('run', 'some_nodes')
    assert status == 2
    assert_one_line(err, 'PACKAGE EXECUTABLE')


def test_run_starts_the_executable_in_the_sourced_environment(tree):
    tree.pretend_set_up()
    foreign = {'PYTHONPATH': '/theirs', 'AMENT_PREFIX_PATH': '/theirs', 'ROS_DOMAIN_ID': '7'}
    status, out, _ = tree.fam('run', 'some_nodes', 'some_node', '--ros-args', '-h', **foreign)
    assert status == 0
    arguments, *lines = out.splitlines()
    assert arguments == '--ros-args -h'
    variables = dict(line.split('=', 1) for line in lines)
    assert variables['PATH'] == f'/sourced:{tree.path}'
    assert variables['PYTHONPATH'] == '/ours'
    assert 'AMENT_PREFIX_PATH' not in variables
    assert variables['ROS_DOMAIN_ID'] == '7'
    assert variables['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'SYSTEM_DEFAULT'
    assert variables['FASTRTPS_DEFAULT_PROFILES_FILE'] == str(tree.root / PROFILE)
    assert variables['RMW_IMPLEMENTATION'] == 'rmw_fastrtps_cpp'


def test_in_a_full_installation_python_finds_the_users_own_packages(tree, monkeypatch):
    tree.pretend_set_up()
    module = tree.module()
    monkeypatch.setenv('PYTHONPATH', '/extras')
    monkeypatch.delenv('ROS_DISTRO', raising=False)
    assert module.environment()['PYTHONPATH'] == '/ours'
    monkeypatch.setenv('ROS_DISTRO', 'jazzy')
    assert module.environment()['PYTHONPATH'] == '/ours:/extras'


def test_a_full_installation_that_is_not_sourced_is_said(tree):
    status, _, err = tree.fam('setup', ROS_DISTRO='jazzy')
    assert status == 2
    assert 'nothing is sourced: source /opt/ros/jazzy/setup.bash' in err


def test_nothing_starts_that_would_use_every_network(tree):
    tree.pretend_set_up()
    (tree.root / PROFILE).unlink()
    tree.stamp()
    status, out, err = tree.fam('run', 'some_nodes', 'some_node')
    assert (status, out) == (2, '')
    assert_one_line(err, PROFILE, 'is missing')


@pytest.mark.parametrize('command', ['demo', 'experiment', 'bench', 'faults', 'top'])
def test_commands_of_the_python_side_are_passed_on_with_their_options(tree, command):
    tree.pretend_set_up()
    status, out, _ = tree.fam(command, '-h', '--some', 'thing')
    assert (status, out) == (0, f'python -m fam_bundle_bringup.cli {command} -h --some thing\n')


# ---- Locks ----


@pytest.mark.parametrize('lock', LOCKS, ids=lambda path: path.stem)
def test_a_lock_pins_with_hashes_and_holds_no_address(lock):
    text = lock.read_text()
    assert '://' not in text
    assert not re.search(
        r'^\s*-', re.sub(r'^    --hash=.*$', '', text, flags=re.MULTILINE), re.MULTILINE
    )
    for block in re.split(r'\n(?=\S)', text):
        if not block.startswith('#'):
            assert re.match(r'[a-z0-9-]+==\S+', block)
            assert '--hash=sha256:' in block


@pytest.mark.parametrize('folder', NPM)
def test_a_lock_of_npm_pins_with_hashes_and_holds_no_address(folder):
    text = (REPOSITORY / folder / 'package-lock.json').read_text()
    assert '://' not in text
    packages = json.loads(text)['packages']
    wanted = json.loads((REPOSITORY / folder / 'package.json').read_text())['dependencies']
    assert packages.pop('')['dependencies'] == wanted
    assert {f'node_modules/{name}' for name in wanted} < set(packages)
    for package in packages.values():
        assert re.fullmatch(r'sha512-\S+', package['integrity'])
        assert re.fullmatch(r'[\d.]+', package['version'])


# What pytest says of the tests that bear company and of those that need the machine alone.
@pytest.mark.parametrize(
    ('beside', 'alone', 'status'),
    [(0, 0, 0), (5, 0, 0), (0, 5, 0), (5, 5, 1), (1, 0, 1), (0, 1, 1), (5, 1, 1), (2, 5, 1)],
)
def test_tests_fail_if_either_part_fails_or_none_was_chosen(tree, beside, alone, status):
    tree.pretend_set_up()
    script = f'case "$*" in *"not alone"*) exit {beside};; *pytest*) exit {alone};; esac'
    executable(tree.root / '.venv/bin/python', script)
    assert tree.fam('test', '-k', 'lag')[0] == status


def test_fam_is_executable():
    assert os.stat(REPOSITORY / 'fam').st_mode & stat.S_IXUSR


def test_the_set_up_does_not_run_in_the_environment_that_it_may_remove(tree, monkeypatch):
    module, started = tree.module(), []
    monkeypatch.setattr(os, 'execv', lambda *words: started.append(words))
    module.leave_own_venv()
    assert started == []
    monkeypatch.setattr(sys, 'prefix', str(module.VENV))
    monkeypatch.setattr(sys, 'argv', ['fam', 'setup'])
    module.leave_own_venv()
    python = os.path.realpath(sys.executable)
    assert started == [(python, [python, str(tree.root / 'fam'), 'setup'])]
