# SPDX-License-Identifier: Apache-2.0
"""The container files against the packages; no engine is needed, and nothing is built."""

import json
from pathlib import Path
import re

from fam_bundle_bringup.graph import nodes_of
import yaml

ROOT = Path(__file__).resolve().parents[1]
DOCKERFILE = (ROOT / 'docker/Dockerfile').read_text()
COMPOSE = yaml.safe_load((ROOT / 'docker/compose.yaml').read_text())
COPIED = re.findall(r'^COPY (?!--from)(\S+) \S+$', DOCKERFILE, re.MULTILINE)


def test_what_is_copied_is_there_and_manifests_come_first() -> None:
    assert all((ROOT / path).exists() for path in COPIED)
    manifests = {str(path.relative_to(ROOT)) for path in ROOT.glob('ros2_ws/src/*/package.xml')}
    assert manifests <= set(COPIED[: COPIED.index('ros2_ws/src')])


def test_images_do_not_run_as_root() -> None:
    for image in DOCKERFILE.split('\nFROM ')[1:]:
        if ' AS runtime' in image or ' AS development' in image:
            (user,) = re.findall(r'^USER (\d+)$', image, re.MULTILINE)
            assert int(user) > 0


def test_services_start_every_node_once() -> None:
    words = {name: ' '.join(found['command']) for name, found in COMPOSE['services'].items()}
    for package, executable in [*nodes_of(), ('fam_bundle_io', 'bag_recorder')]:
        (found,) = [
            text for text in words.values() if executable in text.replace(';', ' ').split()
        ]
        assert f'ros2 run {package} ' in found


def test_extras_are_entries_of_the_lock() -> None:
    lock = (ROOT / 'requirements/base.txt').read_text()
    for line in (ROOT / 'docker/requirements.txt').read_text().splitlines():
        assert line.startswith('#') or line in lock


def test_devcontainer_names_a_stage() -> None:
    build = json.loads((ROOT / '.devcontainer/devcontainer.json').read_text())['build']
    assert f' AS {build["target"]}\n' in DOCKERFILE
    assert (ROOT / '.devcontainer' / build['dockerfile']).samefile(ROOT / 'docker/Dockerfile')
