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

"""What the tests of the hardware bridge share; the benches have a module of their own."""

import dataclasses

from benches import CONFIG, MockBench, NidaqmxBench, QuanserBench, VoltsBench
from fam_bundle_io.hardware import backend
from fam_bundle_io.hardware.calibration import load_hardware
from fam_bundle_model.parameters import load_configuration
import pytest


@pytest.fixture(scope='session')
def configuration():
    return load_configuration(CONFIG / 'lhacd.yaml')


@pytest.fixture(scope='session')
def hardware():
    """Return the simulated rig, one valve off its middle, the other wired the other way."""
    found = load_hardware(CONFIG / 'volts_calibration.yaml')
    first, second = found.calibration.valves
    valves = (
        dataclasses.replace(first, null_volts=0.25),
        dataclasses.replace(second, sign='negative', dead_band=0.125, channel=3),
    )
    options = {
        'volts': {'bits': 0},
        'quanser': {'board_type': 'fake'},
        'nidaqmx': {
            'input_device': 'Fake1Mod1',
            'output_device': 'Fake1Mod2',
            'watchdog_device': 'Fake1',
        },
    }
    strain = dataclasses.replace(found.calibration.strain, zero_value=0.0)
    calibration = dataclasses.replace(found.calibration, strain=strain, valves=valves)
    return dataclasses.replace(found, calibration=calibration, options=options)


@pytest.fixture(params=['mock', 'volts', 'quanser', 'nidaqmx'])
def bench(request, hardware, configuration, monkeypatch):
    """Every backend in turn, found by its entry point, not configured yet."""
    arguments = (request.param, hardware, configuration)
    if request.param == 'quanser':
        found = QuanserBench(*arguments, monkeypatch)
    elif request.param == 'nidaqmx':
        found = NidaqmxBench(*arguments, monkeypatch)
    else:
        found = {'mock': MockBench, 'volts': VoltsBench}[request.param](*arguments)
    # Whoever waits lets the time of the card pass.
    monkeypatch.setattr(backend.time, 'sleep', found.let_pass)
    return found
