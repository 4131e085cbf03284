# SPDX-License-Identifier: Apache-2.0
"""The launch files: every choice of every argument, who is started with what, and the end."""

from collections.abc import Iterator
import importlib.util
import os
from pathlib import Path
import re
import runpy
import signal
import subprocess
import sys
import time
from types import SimpleNamespace
from typing import Any

from fam_bundle_bringup.graph import BRIDGE, COMPOSED, LOOP_LISTENERS, NODES
from fam_bundle_bringup.processes import executable
from fam_bundle_model.parameters import load_configuration
from fam_bundle_node.network import CHOICES
from fam_bundle_node.parent import VARIABLE
import pytest
import yaml

FILES = Path(__file__).parents[1] / 'ros2_ws/src/fam_bundle_bringup/launch'
VOLTS = FILES.parent / 'config' / 'volts_calibration.yaml'
NAMES = ('controllers', 'hardware', 'mock', 'record', 'sim', 'two_bundles')
RECORDER = ('fam_bundle_io', 'bag_recorder')


class Started(SimpleNamespace):
    """What a node action was made of, in place of the real one."""

    def file(self) -> Path:
        """Return the first parameter file."""
        words = self.ros_arguments
        return Path(words[words.index('--params-file') + 1])


@pytest.fixture(scope='module')
def parts(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Any]:
    """Return the module of the parts, on the real ``launch`` where there is one."""
    added = set()
    # Not launch: the folder of that name is found in its place.
    if importlib.util.find_spec('launch_ros') is None:
        import launch_stand_in

        before = set(sys.modules)
        launch_stand_in.install(str(tmp_path_factory.mktemp('launch')))
        added = set(sys.modules) - before
    from fam_bundle_bringup import launch_parts

    yield launch_parts
    for name in (*added, launch_parts.__name__):
        del sys.modules[name]


@pytest.fixture
def needed(tmp_path: Path) -> dict[str, dict[str, str]]:
    """Return the arguments without a default, by launch file; the rig is what passes for one."""
    file = tmp_path / 'rig.yaml'
    file.write_text(VOLTS.read_text().replace('simulated rig', 'rig 7'))
    return {'hardware': {'backend': 'quanser', 'hardware': str(file)}}


@pytest.fixture
def launched(parts: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that evaluates a launch file and returns what it starts."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(parts, 'Node', Started)
    found: list[Any] = []
    monkeypatch.setattr(parts, 'start', lambda bundles: found.append(bundles) or [])

    def run(name: str, **arguments: str) -> list[Any]:
        described = runpy.run_path(str(FILES / f'{name}.launch.py'))['generate_launch_description']
        context = parts.LaunchContext()
        context.launch_configurations.update(arguments)
        for entity in described().entities:
            entity.execute(context)
        return found.pop()

    return run


def arguments_of(name: str) -> tuple[str, ...]:
    found: tuple[str, ...] = runpy.run_path(str(FILES / f'{name}.launch.py'))['ARGUMENTS']
    return found


def test_these_are_all_the_files(parts: Any) -> None:
    assert sorted(path.name for path in FILES.iterdir()) == [f'{n}.launch.py' for n in NAMES]
    used = {argument for name in NAMES for argument in arguments_of(name)}
    assert used == set(parts.ARGUMENTS)


def test_the_table_of_files_in_the_readme_is_whole() -> None:
    text = (FILES.parent / 'README.md').read_text()
    assert sorted(re.findall(r'^\| `(\w+)\.launch\.py` \|', text, re.MULTILINE)) == list(NAMES)


def test_every_argument_says_what_it_is_for_and_its_default_is_a_choice(parts: Any) -> None:
    for argument in parts.ARGUMENTS.values():
        assert argument.text
        if argument.choices and argument.default is not None:
            assert argument.default in argument.choices


def test_every_choice_of_every_argument_starts_what_exists(
    launched: Any, parts: Any, needed: dict[str, dict[str, str]]
) -> None:
    for name in NAMES:
        for argument in arguments_of(name):
            for choice in parts.ARGUMENTS[argument].choices or (None,):
                given = dict(needed.get(name, {}))
                if choice is not None:
                    given[argument] = choice
                for bundle in launched(name, **given):
                    assert bundle.nodes
                    for node in bundle.nodes:
                        assert os.access(executable(node.package, node.executable), os.X_OK)
                        assert int(node.additional_env[VARIABLE]) == os.getpid()
                    for file in {node.file() for node in bundle.nodes}:
                        load_configuration(file)


@pytest.mark.parametrize('composed', ['true', 'false'])
@pytest.mark.parametrize('record', ['true', 'false'])
def test_sim_starts_the_processes_of_the_runner(launched: Any, composed: str, record: str) -> None:
    (bundle,) = launched('sim', composed=composed, record=record, bag='a # b: c')
    wanted = [COMPOSED] if composed == 'true' else list(NODES)
    recorders = [RECORDER] * (record == 'true')
    assert [(n.package, n.executable) for n in bundle.nodes] == [*recorders, *wanted]
    assert bundle.owner is bundle.nodes[-1]
    for node in bundle.nodes:
        assert load_configuration(node.file()).run.listeners == LOOP_LISTENERS + len(recorders)
    if recorders:
        content = yaml.safe_load(Path(bundle.nodes[0].ros_arguments[3]).read_text())
        bag = content['/**']['ros__parameters']['bag']
        assert bag == {'folder': str(Path('a # b: c').resolve())}


def test_arguments_reach_every_node(launched: Any) -> None:
    (bundle,) = launched(
        'sim',
        scheme='lag',
        pace='realtime',
        cycles='7',
        namespace='left',
        log_level='warn',
        record='true',
    )
    for node in bundle.nodes:
        configuration = load_configuration(node.file())
        assert configuration.recruitment.scheme == 'lag'
        assert configuration.run.pace == 'realtime'
        assert configuration.reference.cycles == 7
        assert node.namespace == 'left'
        assert node.ros_arguments[-2:] == ['--log-level', 'warn']


def test_what_is_not_given_stays_as_configured(launched: Any, tmp_path: Path) -> None:
    (bundle,) = launched('sim')
    configured = load_configuration(FILES.parent / 'config' / 'lhacd.yaml')
    assert load_configuration(bundle.nodes[0].file()) == configured


@pytest.mark.parametrize('space', ['', 'left'])
def test_each_process_is_in_its_enclave_of_the_policy(launched: Any, space: str) -> None:
    policy = (FILES.parent / 'security' / 'fam_bundle.policy.xml').read_text()
    known = set(re.findall(r'<enclave path="&root;(/\w+)">', policy))
    assert len(known) > 8
    for composed in ('true', 'false'):
        (bundle,) = launched('sim', namespace=space, composed=composed, record='true')
        (bridge,) = launched('mock', namespace=space)
        for node in (*bundle.nodes, *bridge.nodes):
            words = node.ros_arguments
            enclave = words[words.index('--enclave') + 1]
            assert enclave.removeprefix(f'/{space}' if space else '') in known


def test_two_bundles_have_namespaces_files_and_bags_of_their_own(launched: Any) -> None:
    left, right = launched('two_bundles', record='true')
    assert {node.namespace for node in left.nodes} == {'left'}
    assert {node.namespace for node in right.nodes} == {'right'}
    assert left.nodes[0].file() != right.nodes[0].file()
    assert 'left' in Path(left.nodes[0].ros_arguments[3]).read_text()


def test_mock_arms_a_card_that_moves_nothing_and_hardware_arms_none(
    launched: Any, needed: dict[str, dict[str, str]]
) -> None:
    bridges = []
    for name in ('mock', 'hardware'):
        (bundle,) = launched(name, **needed.get(name, {}))
        assert (bundle.owner.package, bundle.owner.executable) == BRIDGE
        configuration = load_configuration(bundle.owner.file())
        bridges.append((configuration.bridge.backend, configuration.bridge.start))
    assert bridges == [('volts', 'armed'), ('quanser', 'unconfigured')]
    assert configuration.run.pace == 'realtime'


def test_controllers_alone_have_no_owner(launched: Any) -> None:
    (bundle,) = launched('controllers')
    assert [(node.package, node.executable) for node in bundle.nodes] == list(NODES[:-1])
    assert bundle.owner is None


def test_a_recorder_alone_has_no_owner(launched: Any) -> None:
    (bundle,) = launched('record', bag='some')
    assert [(node.package, node.executable) for node in bundle.nodes] == [RECORDER]
    assert bundle.owner is None


@pytest.mark.parametrize(
    ('name', 'arguments', 'words'),
    [
        ('sim', {'params_file': 'none.yaml'}, ('none.yaml',)),
        ('sim', {'scheme': 'lga'}, ('lga',)),
        ('sim', {'cycles': '0'}, ('reference.cycles', '0', '>= 1')),
        ('sim', {'cycles': 'two'}, ('reference.cycles', 'two')),
        ('sim', {'record': 'true', 'bag': '.'}, ('bag = ', 'exists')),
        ('hardware', {'backend': 'quanser', 'hardware': 'none.yaml'}, ('none.yaml',)),
        ('hardware', {'backend': 'volts', 'hardware': str(VOLTS)}, ('volts',)),
        ('hardware', {'backend': 'quanser', 'hardware': str(VOLTS)}, ('simulated rig', 'quanser')),
        ('hardware', {'backend': 'quanser'}, ('hardware',)),
        ('mock', {'params_file': str(FILES.parent / 'config/three_units.yaml')}, ('2', '3')),
    ],
)
def test_what_cannot_be_is_refused_before_anything_starts(
    launched: Any, name: str, arguments: dict[str, str], words: tuple[str, ...]
) -> None:
    with pytest.raises(RuntimeError) as refused:
        launched(name, **arguments)
    assert all(word in str(refused.value) for word in words)
    assert '\n' not in str(refused.value)


# ---- The end ----


class Recorded:
    """An action or event that keeps what it was made of."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.arguments, self.options = arguments, options


@pytest.fixture
def exits(parts: Any, monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return a function that starts bundles and returns what lets a node end."""
    for name in ('RegisterEventHandler', 'OnProcessExit', 'EmitEvent', 'Shutdown', 'TimerAction'):
        monkeypatch.setattr(parts, name, Recorded)

    def begin(*bundles: Any) -> Any:
        handlers = [a.arguments[0] for a in parts.start(bundles) if isinstance(a, Recorded)]

        def end(node: Any, status: int) -> Any:
            (handler,) = (h for h in handlers if h.options['target_action'] is node)
            event = SimpleNamespace(returncode=status, process_name=node.executable)
            return handler.options['on_exit'](event, None)

        return end

    return begin


def bundle_of(parts: Any, name: str) -> Any:
    nodes = [Started(executable=node) for node in ('strain_controller', 'plant_simulator')]
    return parts.Bundle(name, nodes, nodes[-1], True)


def reason(action: Any) -> str:
    text: str = action.options['event'].options['reason']
    return text


def test_the_end_of_the_plant_ends_the_launch_after_the_last_messages(
    parts: Any, exits: Any
) -> None:
    bundle = bundle_of(parts, '')
    later = exits(bundle)(bundle.owner, 0)
    assert later.options['period'] > 3.0  # the middleware's heartbeat
    assert reason(later.options['actions'][0]) == 'the run is over'


def test_the_second_bundle_may_finish(parts: Any, exits: Any) -> None:
    left, right = bundle_of(parts, 'left'), bundle_of(parts, 'right')
    end = exits(left, right)
    assert end(left.owner, 0) is None
    assert reason(end(right.owner, 0).options['actions'][0]) == 'the run is over'


@pytest.mark.parametrize(('node', 'status'), [(0, 0), (0, -9), (1, 1), (1, 130)])
def test_a_node_that_ends_too_early_ends_the_launch_with_its_name(
    parts: Any, exits: Any, node: int, status: int
) -> None:
    bundle = bundle_of(parts, '')
    said = reason(exits(bundle)(bundle.nodes[node], status))
    assert said == f'{bundle.nodes[node].executable} ended with {status}'


@pytest.mark.parametrize('chosen', [None, *CHOICES])
def test_traffic_stays_here_unless_a_network_was_chosen(
    parts: Any, chosen: str | None, monkeypatch: pytest.MonkeyPatch
) -> None:
    for name in CHOICES:
        monkeypatch.delenv(name, raising=False)
    monkeypatch.setattr(parts, 'SetEnvironmentVariable', lambda *pair: pair)
    monkeypatch.setattr(parts, 'UnsetEnvironmentVariable', lambda name: (name, None))
    monkeypatch.setattr(parts, 'LogInfo', lambda msg: msg)
    monkeypatch.setenv('ROS_LOCALHOST_ONLY', '0')  # no choice
    monkeypatch.delenv('RMW_IMPLEMENTATION', raising=False)
    if chosen:
        monkeypatch.setenv(chosen, 'SUBNET')
        assert parts.network() == [f'network as chosen: {chosen}=SUBNET']
    else:
        said, *kept = parts.network()
        assert 'loopback' in said
        assert ('ROS_LOCALHOST_ONLY', None) in kept
        assert dict(kept)['FASTRTPS_DEFAULT_PROFILES_FILE'].endswith('fastdds_loopback.xml')
        monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_cyclonedds_cpp')
        said, *kept = parts.network()
        assert 'rmw_cyclonedds_cpp' in said
        assert dict(kept)['ROS_AUTOMATIC_DISCOVERY_RANGE'] == 'LOCALHOST'
        assert 'RMW_IMPLEMENTATION' not in dict(kept)


@pytest.mark.parametrize('ended', ['after', 'before'])
def test_a_node_ends_with_the_launch_even_if_that_is_killed(ended: str, tmp_path: Path) -> None:
    script = f"""
import os, subprocess, sys, time
os.environ[{VARIABLE!r}] = sys.argv[1] if sys.argv[1:] else str(os.getpid())
node = 'import sys, time; from fam_bundle_node.parent import end_with_parent\\n' \\
    'try:\\n  end_with_parent(); print("begun", flush=True); time.sleep(60)\\n' \\
    'except KeyboardInterrupt: print("told", flush=True)'
subprocess.Popen([sys.executable, '-c', node], stdout=open({str(tmp_path / 'log')!r}, 'w'))
time.sleep(60)
"""
    gone = subprocess.Popen(['true'])
    gone.wait()
    parent = [str(gone.pid)] if ended == 'before' else []
    launch = subprocess.Popen([sys.executable, '-c', script, *parent])
    try:
        wait_for(tmp_path / 'log', 'told' if parent else 'begun')
        launch.send_signal(signal.SIGKILL)
        wait_for(tmp_path / 'log', 'told')
    finally:
        launch.kill()
        launch.wait()


def wait_for(log: Path, word: str) -> None:
    deadline = time.monotonic() + 30.0
    while not (log.exists() and word in log.read_text()):
        assert time.monotonic() < deadline, f'{word!r} was not said'
        time.sleep(0.02)
