# Copyright 2026 fam_bundle maintainers
#
# Licensed under the Apache License, Version 2.0 (the "License");
# you may not use this file except in compliance with the License.
# You may obtain a copy of the License at
#
#     http://www.apache.org/licenses/LICENSE-2.0
#
# Unless required by applicable law or agreed to in writing, software
# distributed under the License is distributed on an "AS IS" BASIS,
# WITHOUT WARRANTIES OR CONDITIONS OF ANY KIND, either express or implied.
# See the License for the specific language governing permissions and
# limitations under the License.

"""
Compiled and interpreted code give the same bits.

This file runs itself a second time with FAM_BUNDLE_INTERPRET=1 and compares every number.
"""

import dataclasses
import json
import os
from pathlib import Path
import subprocess
import sys
import tempfile

from fam_bundle_model import bundle, compile, fam, hydraulics, lag_table, pressure_pi, reference
from fam_bundle_model.parameters import KINDS, load_configuration
import numpy as np
import pytest

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
SAMPLES = 300


def bits(value):
    return np.asarray(value, dtype=np.float64).tobytes().hex()


def evaluate():
    """Return the bits of every compiled function on a fixed random set, by name."""
    random = np.random.default_rng(11)
    configuration = load_configuration(CONFIGURATION)
    units = bundle.motor_units(configuration)
    supply = hydraulics.hydraulic_law(configuration)
    gains = pressure_pi.pressure_gains(configuration)[1]
    law, modulus = units[0].fam, supply.bulk_modulus
    axis = np.linspace(0.0, 7e5, 5)
    table = lag_table.LagTable(
        axis, axis, random.random((2, 5, 5)), random.random((2, 5, 5)) * 1e5
    )
    waveforms = [
        reference.reference_law(dataclasses.replace(configuration.reference, kind=kind))
        for kind in KINDS[:8]
    ]
    found = {'tables': [bits(law.compression), bits(law.slack)]}

    def note(function, *arguments):
        found.setdefault(function.__name__, []).append(bits(function(*arguments)))

    for _ in range(SAMPLES):
        p, q = random.uniform(0.0, 1.3e6, 2)
        e, s, load = random.uniform(-0.05, 0.3), random.uniform(-1.0, 1.0), random.uniform(0, 900)
        oil = fam.oil_of(law, p, e, modulus)
        note(fam.force, law, p, e)
        note(fam.bladder_force, law, e)
        note(fam.volume, law, e)
        note(fam.deslack_pressure, law, e)
        note(fam.free_strain, law, p)
        note(fam.oil_of, law, p, e, modulus)
        note(fam.pressure_of, law, oil, e, modulus)
        note(hydraulics.unit_flow, supply, s, p, q)
        note(hydraulics.source_pressure_rate, supply, p, 1e-4 * s)
        note(pressure_pi.pressure_pi, gains, 0.1 * s, p, q, 1e-3)
        note(bundle.bundle_force, units, np.array([p, q]), e)
        note(bundle.modelled_strain, units, 1, 0.5 * p, load)
        note(bundle.balancing_pressure, units, 2, 0.05, load, 1e6)
        note(lag_table.look_up, table, 1, p, q)
        for waveform in waveforms:
            note(reference.strain_reference, waveform, random.uniform(-1.0, 21.0))
    none = np.empty((0, 5))
    for target in (5e4, 1.5e5):
        note(lag_table.fill_response, supply, gains, units[1], target, 1.0, 1e-3, 2, none)
    return found


@pytest.fixture(scope='module')
def interpreted():
    environment = {**os.environ, 'FAM_BUNDLE_INTERPRET': '1'}
    environment['PYTHONPATH'] = os.pathsep.join(filter(None, sys.path))
    with tempfile.TemporaryDirectory() as folder:
        path = Path(folder) / 'bits.json'
        subprocess.run(
            [sys.executable, __file__, str(path)], env=environment, check=True, timeout=300
        )
        return json.loads(path.read_text())


def test_compiled_and_interpreted_give_the_same_bits(interpreted):
    assert interpreted.pop('compiled') is False
    compiled = evaluate()
    assert list(compiled) == list(interpreted)
    different = {
        name: sum(a != b for a, b in zip(compiled[name], interpreted[name], strict=True))
        for name in compiled
    }
    assert different == dict.fromkeys(compiled, 0)


@pytest.mark.skipif(compile._DECORATOR is None, reason='nothing is compiled here')
def test_the_outermost_function_agrees_with_its_source():
    units = bundle.motor_units(load_configuration(CONFIGURATION))
    for strain in np.linspace(-0.05, 0.3, 50):
        arguments = (units[0].fam, 2.3e5, strain)
        assert fam.force(*arguments) == fam.force.py_func(*arguments)


def test_the_cache_folder_follows_the_sources(monkeypatch, tmp_path):
    package = tmp_path / 'fam_bundle_example'
    package.mkdir()
    source = package / '__init__.py'
    source.write_text('x = 1\n')
    monkeypatch.syspath_prepend(tmp_path)
    packages = ('fam_bundle_example', 'not_there')
    first = compile.source_digest(packages)
    assert compile.source_digest(packages) == first
    source.write_text('x = 2\n')
    second = compile.source_digest(packages)
    assert second != first
    (package / 'more.py').write_text('')
    assert compile.source_digest(packages) not in (first, second)
    assert compile.source_digest() == compile.source_digest(compile.COMPILED_PACKAGES)


def test_the_cache_is_the_users(monkeypatch, tmp_path):
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    assert compile.cache_directory() == tmp_path / 'fam_bundle'
    monkeypatch.delenv('XDG_CACHE_HOME')
    monkeypatch.setenv('HOME', str(tmp_path))
    assert compile.cache_directory() == tmp_path / '.cache' / 'fam_bundle'


if __name__ == '__main__':
    numbers = {**evaluate(), 'compiled': compile._DECORATOR is not None}
    Path(sys.argv[1]).write_text(json.dumps(numbers))
