# SPDX-License-Identifier: Apache-2.0
"""A run owns its processes: a dead node ends it with its name, and nothing outlives it."""

import os
from pathlib import Path
import signal
import subprocess
import sys
import time

from fam_bundle_bringup.graph import NODES
from fam_bundle_io.trace import load_trace
import pytest

pytestmark = pytest.mark.alone

PATIENCE = 60.0  # s; only a hang takes that long


def children(parent: int) -> dict[str, int]:
    """Return the running nodes below a process by name, from the kernel's tables."""
    found = {}
    for entry in Path('/proc').iterdir():
        if not entry.name.isdigit():
            continue
        try:
            ppid = int((entry / 'stat').read_text().rsplit(')', 1)[1].split()[1])
            words = (entry / 'cmdline').read_text().split('\0')
        except OSError:
            continue
        for _, node in NODES:
            if ppid == parent and any(word.endswith(f'/{node}') for word in words):
                found[node] = int(entry.name)
    return found


@pytest.fixture
def long_run(tmp_path: Path) -> 'subprocess.Popen[str]':
    """Start an experiment that is in mid-run on return and would go on for long."""
    command = [sys.executable, '-m', 'fam_bundle_bringup.cli', 'experiment', '--cycles', '1000']
    run = subprocess.Popen(
        [*command, '--out', str(tmp_path)],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.PIPE,
        text=True,
    )
    log = tmp_path / 'log' / 'plant_simulator.log'
    deadline = time.monotonic() + PATIENCE
    while time.monotonic() < deadline and run.poll() is None:
        if log.exists() and 'in lock-step' in log.read_text():
            time.sleep(1.0)  # some ticks
            return run
        time.sleep(0.05)
    run.kill()
    raise AssertionError('the run did not start')


def assert_gone(pids: dict[str, int]) -> None:
    assert len(pids) == len(NODES)
    for pid in pids.values():
        assert not Path(f'/proc/{pid}').exists()


# One that has done its part, one in the loop, and the one that owns it.
@pytest.mark.parametrize(
    'victim', ['lag_table_server', 'recruitment_supervisor', 'plant_simulator']
)
def test_killed_node_ends_the_run_with_its_name(
    victim: str, long_run: 'subprocess.Popen[str]', tmp_path: Path
) -> None:
    nodes = children(long_run.pid)
    os.kill(nodes[victim], signal.SIGKILL)
    _, stderr = long_run.communicate(timeout=PATIENCE)
    assert long_run.returncode == 1
    assert victim in stderr
    assert 'SIGKILL' in stderr
    assert 'Traceback' not in stderr
    trace = load_trace(tmp_path / 'trace.npz')
    assert len(trace['time']) > 0
    assert not (tmp_path / 'metrics.json').exists()
    assert_gone(nodes)


def test_plant_that_is_told_to_stop_has_not_finished(
    long_run: 'subprocess.Popen[str]', tmp_path: Path
) -> None:
    os.kill(children(long_run.pid)['plant_simulator'], signal.SIGTERM)
    _, stderr = long_run.communicate(timeout=PATIENCE)
    assert long_run.returncode == 1
    assert 'plant_simulator ended with exit status 130' in stderr
    assert len(load_trace(tmp_path / 'trace.npz')['time']) > 0


@pytest.mark.parametrize('sent', [signal.SIGINT, signal.SIGTERM])
def test_signal_ends_every_process(
    sent: int, long_run: 'subprocess.Popen[str]', tmp_path: Path
) -> None:
    nodes = children(long_run.pid)
    long_run.send_signal(sent)
    _, stderr = long_run.communicate(timeout=PATIENCE)
    assert long_run.returncode == 130
    assert 'interrupted' in stderr
    assert 'Traceback' not in stderr
    assert_gone(nodes)
    for log in (tmp_path / 'log').iterdir():
        assert 'FATAL' not in log.read_text()
        assert 'Error' not in log.read_text()


def test_controllers_that_are_told_to_stop_end_well(
    long_run: 'subprocess.Popen[str]', tmp_path: Path
) -> None:
    nodes = children(long_run.pid)
    for name in ('strain_controller', 'lag_table_server'):
        os.kill(nodes[name], signal.SIGINT)
    _, stderr = long_run.communicate(timeout=PATIENCE)
    assert long_run.returncode == 1  # the run is not finished
    assert 'ended with exit status 0' in stderr


def test_second_interrupt_does_not_cut_the_first_ones_work_short(tmp_path: Path) -> None:
    script = """
import os, signal, sys, threading, time
from pathlib import Path
from fam_bundle_bringup.processes import NodeGroup

patient = 'import signal, time; signal.signal(signal.SIGINT, lambda *_: (time.sleep(0.5), ' \
    'print("done", flush=True), exit())); print("ready", flush=True); time.sleep(60)'
with NodeGroup(os.environ, Path(sys.argv[1])) as group:
    group.start('patient', [sys.executable, '-c', patient])
    while not (Path(sys.argv[1]) / 'patient.log').read_text():
        time.sleep(0.01)
    threading.Timer(0.2, os.kill, (os.getpid(), signal.SIGINT)).start()
"""
    done = subprocess.run(
        [sys.executable, '-c', script, str(tmp_path)],
        capture_output=True,
        text=True,
        timeout=PATIENCE,
        check=False,
    )
    assert (tmp_path / 'patient.log').read_text() == 'ready\ndone\n'
    assert done.returncode == -signal.SIGINT  # and then it counts
    assert 'KeyboardInterrupt' in done.stderr


def test_killed_runner_leaves_no_node_behind(long_run: 'subprocess.Popen[str]') -> None:
    nodes = children(long_run.pid)
    long_run.kill()
    long_run.wait()
    deadline = time.monotonic() + PATIENCE
    while any(Path(f'/proc/{pid}').exists() for pid in nodes.values()):
        assert time.monotonic() < deadline, 'nodes outlived their runner'
        time.sleep(0.05)
