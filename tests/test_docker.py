# SPDX-License-Identifier: Apache-2.0
"""The container files against the packages; no engine is needed, and nothing is built."""

from importlib.metadata import requires
import json
from pathlib import Path
import re
import signal
import time

from ament_index_python.packages import get_package_prefix, get_package_share_directory
from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.graph import nodes_in, nodes_of, own_domain
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.processes import executable
from fam_bundle_io.bag import read_bag, trace_of
from fam_bundle_model.parameters import load_configuration, write_yaml
from packaging.requirements import Requirement
import yaml

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / 'docker/Dockerfile').read_text()
COMPOSE = yaml.safe_load((ROOT / 'docker/compose.yaml').read_text())
QUICK = {'amplitude': 0.05, 'frequency': 0.5, 'cycles': 1}
COPIED = [
    path
    for words in re.findall(r'^COPY (?!--from)(.+) \S+$', DOCKERFILE, re.MULTILINE)
    for path in words.split()
]


def test_what_is_copied_is_there_and_manifests_come_first() -> None:
    assert all((ROOT / path).exists() for path in COPIED)
    let_through = re.findall(r'^!(\S+)$', (ROOT / '.dockerignore').read_text(), re.MULTILINE)
    assert all(any(path.startswith(part) for part in let_through) for path in COPIED)
    manifests = {str(path.relative_to(ROOT)) for path in ROOT.glob('ros2_ws/src/*/package.xml')}
    assert manifests <= set(COPIED[: COPIED.index('ros2_ws/src')])


def test_images_do_not_run_as_root() -> None:
    for image in DOCKERFILE.split('\nFROM ')[1:]:
        if ' AS runtime' in image or ' AS development' in image:
            (user,) = re.findall(r'^USER (\d+)$', image, re.MULTILINE)
            assert int(user) > 0


def words_of(service: str, folder: Path) -> list[str]:
    """Return a service's command for this machine, with ``folder`` in place of its volume."""
    words = COMPOSE['services'][service]['command']
    install = str(Path(get_package_prefix('fam_bundle_bringup')).parent)
    places = {'/fam_bundle/ros2_ws/install': install, '/runs': str(folder), '${BAG:-bag}': 'bag'}
    for there, here in places.items():
        words = [word.replace(there, here) for word in words]
    return words


def test_the_controllers_are_a_launch_file_that_exists() -> None:
    program, verb, package, file = COMPOSE['services']['controllers']['command']
    assert (program, verb) == ('ros2', 'launch')
    assert Path(get_package_share_directory(package), 'launch', file).exists()


def test_the_commands_of_the_services_run_the_loop_to_the_last_bit(tmp_path: Path) -> None:
    for service, name in (('simulator', 'plant_simulator'), ('recorder', 'bag_recorder')):
        assert words_of(service, tmp_path)[0].endswith(f'/{name}')
    short = load_configuration(default_configuration(), {'reference': QUICK})
    file = tmp_path / 'short.yaml'
    write_yaml(short, file)
    with own_domain(), nodes_in(tmp_path) as group:
        also = ['--params-file', str(file)]  # of two files the later one holds
        recorder = group.start('recorder', [*words_of('recorder', tmp_path), *also])
        for package, name in nodes_of()[:-1]:
            group.start(name, [executable(package, name), '--ros-args', *also])
        group.start('simulator', [*words_of('simulator', tmp_path), *also])
        while not group.finished('simulator'):
            time.sleep(0.05)
        # What an engine sends; the middleware sends what was lost within three seconds.
        time.sleep(4.0)
        recorder.send_signal(signal.SIGTERM)
        assert recorder.wait(20.0) == 0
    trace, alone = trace_of(read_bag(tmp_path / 'bag')).trace, run_offline(short)
    for name, values in alone.items():
        assert trace[name].tobytes() == values.tobytes(), name


def test_extras_are_entries_of_the_lock() -> None:
    lock = (ROOT / 'requirements/base.txt').read_text()
    for line in (ROOT / 'docker/requirements.txt').read_text().splitlines():
        assert line.startswith('#') or line in lock


def test_extras_are_whole_but_for_what_ubuntu_has() -> None:
    """They are installed without what they depend on."""
    text = (ROOT / 'docker/requirements.txt').read_text()
    there = {name.replace('_', '-') for name in re.findall(r'^([\w-]+)==', text, re.MULTILINE)}
    ubuntu = {'numpy', 'packaging'}  # of python3-numpy and python3-matplotlib
    python = {'python_version': '3.12', 'python_full_version': '3.12.3', 'extra': ''}
    needed = {
        re.sub(r'[._]', '-', found.name)
        for name in there
        for found in map(Requirement, requires(name) or ())
        if found.marker is None or found.marker.evaluate(python)
    }
    assert needed - there - ubuntu == set()
    assert needed & there


def test_every_shell_of_an_image_has_its_environment() -> None:
    """A devcontainer's terminals do not come through the entrypoint."""
    assert 'source /environment.sh' in (ROOT / 'docker/entrypoint.sh').read_text()
    development = DOCKERFILE[DOCKERFILE.index(' AS development') :]
    assert re.search(r'environment\.sh.*\.bashrc', development)


def test_devcontainer_names_a_stage() -> None:
    build = json.loads((ROOT / '.devcontainer/devcontainer.json').read_text())['build']
    assert f' AS {build["target"]}\n' in DOCKERFILE
    assert (ROOT / '.devcontainer' / build['dockerfile']).samefile(ROOT / 'docker/Dockerfile')
