# SPDX-License-Identifier: Apache-2.0
"""Shared pieces of the tests of the whole system."""

import os
import subprocess
import sys
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from fam_bundle_bringup.experiment import default_configuration, run_experiment
from fam_bundle_model.parameters import Configuration, load_configuration

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
def recorded_runs(
    tmp_path_factory: pytest.TempPathFactory, quick: Callable[..., Configuration]
) -> Path:
    """Return a folder with two experiments through the graph, each with its bag."""
    folder = tmp_path_factory.mktemp('runs')
    for scheme in ('baseline', 'lag_pressure'):
        run_experiment(quick(scheme), 'lockstep', folder / scheme, record=True)
    return folder


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
