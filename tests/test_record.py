# SPDX-License-Identifier: Apache-2.0
"""A run through the graph is recorded whole, and its bag gives the same trace."""

import json
import os
import signal
import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest

from fam_bundle_bringup.graph import own_domain, run_graph
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.processes import executable
from fam_bundle_io.bag import read_bag, trace_of
from fam_bundle_model.parameters import Configuration

LOOP = ('/bundle_state', '/pressure_reference', '/recruitment_state', '/valve_command')


def test_a_recorded_run_gives_its_trace_to_the_last_bit(
    quick: Callable[..., Configuration], tmp_path: Path
) -> None:
    configuration = quick()
    trace = run_graph(configuration, tmp_path, record=True)
    bag = read_bag(tmp_path / 'bag')
    assert bag.warnings == []
    run = trace_of(bag)
    assert run.warnings == []
    offline = run_offline(configuration)  # without the graph, the recorder and the bag
    assert set(run.trace) == set(trace) == set(offline)
    for name, values in offline.items():
        assert run.trace[name].tobytes() == trace[name].tobytes() == values.tobytes(), name
    completeness = bag.records['fam_bundle.completeness']
    assert json.loads(completeness['whole']) is True
    for topic in LOOP:
        summary = json.loads(completeness[topic])
        assert summary['count'] == configuration.ticks()
        assert (summary['first_tick'], summary['runs']) == (0, 1)
        assert summary['last_tick'] == configuration.ticks() - 1
        assert summary['lost'] == summary['missing_ticks'] == 0
    provenance = bag.records['fam_bundle.provenance']
    assert provenance['parameters_hash'] == configuration.hash()
    assert provenance['scheme'] == configuration.recruitment.scheme


def recorder(*options: str) -> subprocess.Popen[str]:
    command = [executable('fam_bundle_io', 'bag_recorder'), '--ros-args']
    command += [word for option in options for word in ('-p', option)]
    return subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)


@pytest.mark.parametrize(
    ('options', 'words'),
    [
        ((), "bag.folder = '': must name a folder"),
        (('bag.folder:=/proc/no/bag',), '/proc/no/bag: '),
        (('bag.folder:=x', 'bag.split_size:=-1'), 'bag.split_size = -1: must be >= 0'),
    ],
)
def test_the_recorder_refuses_in_one_line(options: tuple[str, ...], words: str) -> None:
    with own_domain():
        process = recorder(*options)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 2
    assert err.startswith(f'bag_recorder: {words}')
    assert err.count('\n') == 1


def test_a_recorder_of_nothing_ends_well_when_told(tmp_path: Path) -> None:
    with own_domain():
        process = recorder(f'bag.folder:={tmp_path / "bag"}')
        while not (tmp_path / 'bag').exists():
            assert process.poll() is None
        process.send_signal(signal.SIGTERM)
        _, err = process.communicate(timeout=60)
    assert process.returncode == 0, err
    assert 'Traceback' not in err
    assert (tmp_path / 'bag' / 'metadata.yaml').exists()
