# SPDX-License-Identifier: Apache-2.0
"""The examples that the documents show work as they stand there."""

from collections.abc import Iterator
import dataclasses
import os
from pathlib import Path
import shutil
import socketserver
import subprocess
import sys
import threading
from typing import Any

from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.hardware.backend import BackendError, load_backend, make_setup, Setup
from fam_bundle_io.hardware.calibration import load_hardware
from fam_bundle_io.metrics import shift_times, tracking
from fam_bundle_io.trace import load_trace
from fam_bundle_model.parameters import load_configuration
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
EXAMPLES = ROOT / 'examples'
SOURCE = ROOT / 'ros2_ws' / 'src'
CONFIG = SOURCE / 'fam_bundle_bringup' / 'config'
PATIENCE = 60.0  # s; only a hang takes that long


def apply(patch: str, folder: Path) -> None:
    """Apply a patch of the examples in ``folder``, which belongs to no repository."""
    env = {**os.environ, 'GIT_CEILING_DIRECTORIES': str(folder.parent)}
    subprocess.run(['git', 'apply', EXAMPLES / patch], cwd=folder, env=env, check=True)


# ---- A bundle ----


def test_three_pairs_climb_the_ladder_and_come_down(tmp_path: Path) -> None:
    shutil.copy(CONFIG / 'lhacd.yaml', tmp_path / 'mine.yaml')
    apply('three_pairs.patch', tmp_path)
    configuration = load_configuration(tmp_path / 'mine.yaml', {'reference': {'cycles': 1}})
    assert configuration.fam.count == (2, 2, 2)
    state = run_offline(configuration)['recruitment_state']
    assert state[0] == 1
    assert state.max() == 3
    assert state[-1] == 1


# ---- A policy ----

RUN = """
import sys
from pathlib import Path
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.trace import save_trace
from fam_bundle_model.parameters import load_configuration

quick = {
    'recruitment': {'scheme': sys.argv[2]},
    'reference': {'cycles': 1, 'frequency': 0.4},
    'lag_table': {'source_points': 2, 'deslack_points': 2},
}
trace = run_offline(load_configuration(Path(sys.argv[1]), quick))
save_trace(trace, Path(sys.argv[3]))
"""


def run_with(packages: Path, scheme: str, trace: Path) -> dict[str, Any]:
    """Run the loop with the model and the laws in ``packages``, interpreted, and return it."""
    ours = [str(packages / name) for name in ('fam_bundle_model', 'fam_bundle_control')]
    path = os.pathsep.join([*ours, os.environ['PYTHONPATH']])
    env = {**os.environ, 'PYTHONPATH': path, 'NUMBA_DISABLE_JIT': '1'}
    words = [sys.executable, '-c', RUN, CONFIG / 'lhacd.yaml', scheme, trace]
    subprocess.run(words, env=env, check=True)
    return load_trace(trace)


def test_directed_policy_shifts_only_the_way_the_strain_goes(tmp_path: Path) -> None:
    packages = tmp_path / 'ros2_ws' / 'src'
    for name in ('fam_bundle_model', 'fam_bundle_control'):
        shutil.copytree(SOURCE / name, packages / name)
    apply('directed_policy.patch', tmp_path)
    trace = run_with(packages, 'directed', tmp_path / 'trace.npz')
    ups, downs = shift_times(trace)
    assert ups
    assert downs
    rate = np.gradient(trace['strain'], trace['time'])
    for times, sign in ((ups, 1.0), (downs, -1.0)):
        assert (sign * np.interp(times, trace['time'], rate) > 0.0).all()
    # The schemes that were there are what they were.
    before = run_with(SOURCE, 'baseline', tmp_path / 'before.npz')
    after = run_with(packages, 'baseline', tmp_path / 'after.npz')
    assert all(np.array_equal(before[name], after[name]) for name in before)


# ---- A backend ----


class Firmware(socketserver.StreamRequestHandler):
    """The lines of the card; its inputs mirror its outputs."""

    def handle(self) -> None:
        for line in self.rfile:
            word, *values = line.decode().split()
            answer = self.server.card.answer(word, [float(value) for value in values])
            self.wfile.write(f'{answer}\n'.encode())


class Microcontroller:
    """The state of that card, whose watchdog a test ends."""

    def __init__(self) -> None:
        self.out: list[float] = []
        self.safe: list[float] = []
        self.timeout = 0.0
        self.runs = self.expired = False

    def expire(self) -> None:
        if self.runs:
            self.out, self.runs, self.expired = self.safe, False, True

    def answer(self, word: str, values: list[float]) -> str:
        if word == 'safe':
            self.timeout, *self.safe = values
            self.out, self.runs, self.expired = self.safe, False, False
        elif word == 'read':
            return ' '.join(str(self.out[i % len(self.out)]) for i in range(16))
        elif self.expired:
            return 'expired'
        elif word == 'write':
            self.out = values
        elif word in ('arm', 'stop'):
            self.runs = word == 'arm'
        return 'ok'


@pytest.fixture(scope='module')
def installed(tmp_path_factory: pytest.TempPathFactory) -> Iterator[None]:
    """Install the example's package into a folder of its own, without network."""
    build, target = tmp_path_factory.mktemp('build'), tmp_path_factory.mktemp('installed')
    shutil.copytree(EXAMPLES / 'line_card', build / 'line_card')
    options = ['--no-deps', '--no-build-isolation', '--no-index', '--quiet', '--target', target]
    words = [sys.executable, '-m', 'pip', 'install', *options, build / 'line_card']
    subprocess.run(words, check=True)
    sys.path.insert(0, str(target))
    yield
    sys.path.remove(str(target))
    sys.modules.pop('line_card', None)


@pytest.fixture
def card() -> Iterator[tuple[Microcontroller, int]]:
    with socketserver.ThreadingTCPServer(('127.0.0.1', 0), Firmware) as server:
        server.card = Microcontroller()
        server.daemon_threads = True
        thread = threading.Thread(target=server.serve_forever, args=(0.01,))
        thread.start()
        yield server.card, server.server_address[1]
        server.shutdown()
        thread.join()


def setup_of(**options: Any) -> Setup:
    hardware = load_hardware(CONFIG / 'volts_calibration.yaml')
    hardware.options['line_card'] = options
    # Patient: the card of the test is a thread among others on a machine that may be busy.
    setup = make_setup(hardware, 'line_card', period=0.001)
    return dataclasses.replace(setup, read_timeout=PATIENCE)


@pytest.mark.usefixtures('installed')
def test_a_backend_of_another_package_drives_its_card(card: tuple[Microcontroller, int]) -> None:
    there, port = card
    setup = setup_of(host='127.0.0.1', port=port)
    backend = load_backend('line_card')
    backend.configure(setup)
    assert there.safe == setup.safe_volts.tolist() == there.out
    assert there.timeout == setup.watchdog_timeout
    volts = np.empty(setup.inputs.size)
    backend.read(volts)
    assert volts.tolist() == [there.out[i % len(there.out)] for i in setup.inputs]
    wanted = setup.safe_volts + 0.25
    with pytest.raises(BackendError, match='not armed'):
        backend.write(wanted)
    backend.arm()
    backend.write(wanted)
    assert there.out == wanted.tolist()
    assert backend.reload_watchdog()
    there.expire()
    assert there.out == setup.safe_volts.tolist()
    assert not backend.reload_watchdog()
    with pytest.raises(BackendError, match='the watchdog has expired'):
        backend.write(wanted)
    backend.configure(setup)
    backend.arm()
    backend.write(wanted)
    backend.close()
    assert there.out == setup.safe_volts.tolist()
    assert not there.runs


@pytest.mark.usefixtures('installed')
def test_a_card_that_is_not_there_is_one_line() -> None:
    with socketserver.TCPServer(('127.0.0.1', 0), Firmware) as gone:
        port = gone.server_address[1]
    with pytest.raises(BackendError, match=f'127.0.0.1:{port}: '):
        load_backend('line_card').configure(setup_of(host='127.0.0.1', port=port))
    with pytest.raises(ConfigurationError, match='must hold host and port'):
        load_backend('line_card').configure(setup_of(host='127.0.0.1'))


# ---- A bag ----


def test_the_bag_script_prints_what_the_run_measured(recorded_runs: Path) -> None:
    folder = recorded_runs / 'lag_pressure'
    words = [sys.executable, EXAMPLES / 'analyse_bag.py', folder / 'bag']
    printed = subprocess.run(words, check=True, capture_output=True, text=True)
    assert printed.stderr == ''
    trace = load_trace(folder / 'trace.npz')
    found = tracking(trace, trace['time'][0], trace['time'][-1])
    assert f'IAE {found.iae:.6f} s, maximum error {found.max_error:.6f}' in printed.stdout
    ups, downs = shift_times(trace)
    assert f'{len(trace["time"])} ticks' in printed.stdout
    assert ' '.join(['shifts up at (s):', *(f'{t:.3f}' for t in ups)]) in printed.stdout
    assert ' '.join(['shifts down at (s):', *(f'{t:.3f}' for t in downs)]) in printed.stdout
