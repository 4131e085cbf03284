# SPDX-License-Identifier: Apache-2.0
"""Shared pieces of the tests of the whole system."""

from collections.abc import Callable, Iterator
import fcntl
import functools
import os
from pathlib import Path
import signal
import subprocess
import sys
import tempfile
from typing import Any

from fam_bundle_bringup.experiment import default_configuration, run_experiment
from fam_bundle_model.parameters import Configuration, load_configuration
import pytest

# What a shell runs in the background has SIGINT ignored, and all that a test starts would too.
if signal.getsignal(signal.SIGINT) == signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)

# One quick cycle in which every scheme shifts up and down.
QUICK = {'amplitude': 0.06, 'frequency': 0.25, 'cycles': 1}


@pytest.fixture(scope='session')
def quick() -> Callable[..., Configuration]:
    """Return a maker of short configurations of the paper's rig."""

    def make(scheme: str = 'lag_pressure', **changes: Any) -> Configuration:
        merged = {'recruitment': {'scheme': scheme}, 'reference': QUICK, **changes}
        return load_configuration(default_configuration(), merged)

    return make


@pytest.fixture(scope='session')
def recorded_run(
    tmp_path_factory: pytest.TempPathFactory, quick: Callable[..., Configuration]
) -> Callable[[str], Path]:
    """
    Return what gives the folder of a quick experiment through the graph, run once a scheme.

    A bag is with it. Test processes side by side share them.
    """
    base = tmp_path_factory.getbasetemp()
    folder = (base.parent if 'PYTEST_XDIST_WORKER' in os.environ else base) / 'runs'
    folder.mkdir(exist_ok=True)

    @functools.cache
    def run(scheme: str) -> Path:
        with (folder / f'{scheme}.lock').open('w') as lock:
            fcntl.flock(lock, fcntl.LOCK_EX)
            if not (folder / scheme).exists():
                made = Path(tempfile.mkdtemp(dir=folder)) / scheme
                run_experiment(quick(scheme), 'lockstep', made, record=True)
                made.rename(folder / scheme)
        return folder / scheme

    return run


@pytest.fixture(scope='session')
def recorded_runs(recorded_run: Callable[[str], Path]) -> Path:
    """Return a folder with two of these experiments."""
    (folder,) = {recorded_run(scheme).parent for scheme in ('baseline', 'lag_pressure')}
    return folder


@pytest.fixture(scope='session')
def three_units(
    tmp_path_factory: pytest.TempPathFactory, quick: Callable[..., Configuration]
) -> tuple[Configuration, Path]:
    """Return a run of three unequal units with noise, and its folder; a bag is with it."""
    configuration = quick(
        fam={'count': [1, 1, 2]},
        recruitment={'scheme': 'lag_pressure', 'predictor': 'sinusoid'},
        allocation={'policy': 'orderly'},
        pressure_loop={
            'proportional_gain': [3e-6, 3.5e-6, 7e-6],
            'integral_limit': [0.1, 0.2, 0.3],
        },
        sensors={
            'strain_noise': 1e-5,
            'force_noise': 0.5,
            'pressure_noise': 200.0,
            'strain_resolution': 1e-6,
        },
    )
    folder = tmp_path_factory.mktemp('three_units')
    run_experiment(configuration, 'lockstep', folder, record=True)
    return configuration, folder


@pytest.fixture
def both_cores_busy() -> Iterator[None]:
    """Burn every core with other processes meanwhile."""
    burners = [
        subprocess.Popen([sys.executable, '-c', 'while True: pass'])
        for _ in range(os.cpu_count() or 1)
    ]
    yield
    for burner in burners:
        burner.kill()
        burner.wait()


Fam = Callable[..., 'subprocess.CompletedProcess[str]']


@pytest.fixture
def fam() -> Fam:
    """Return a function that runs one command of the command line to its end."""

    def run(*arguments: str | Path) -> 'subprocess.CompletedProcess[str]':
        return subprocess.run(
            [sys.executable, '-m', 'fam_bundle_bringup.cli', *map(str, arguments)],
            stdin=subprocess.DEVNULL,
            capture_output=True,
            text=True,
            timeout=120.0,
            check=False,
        )

    return run
