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

"""What is each vendor's own: the order of its calls, its codes, its absence."""

import dataclasses
import sys
import types

from benches import NidaqmxBench, QuanserBench, RESTING_VOLTS
import fake_nidaqmx
import fake_quanser
from fam_bundle_io.hardware import backend as module
from fam_bundle_io.hardware.backend import backend_names, BackendError, load_backend
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import pytest


@pytest.fixture
def quanser(hardware, configuration, monkeypatch):
    return QuanserBench('quanser', hardware, configuration, monkeypatch)


@pytest.fixture
def nidaqmx(hardware, configuration, monkeypatch):
    return NidaqmxBench('nidaqmx', hardware, configuration, monkeypatch)


def complaint(call, *arguments):
    with pytest.raises(BackendError) as caught:
        call(*arguments)
    assert '\n' not in str(caught.value)
    return str(caught.value)


# ---- Finding a backend ----


def test_the_backends_of_all_packages_are_registered():
    assert {'mock', 'nidaqmx', 'quanser', 'volts'} <= set(backend_names())


def test_an_unknown_backend_is_refused_with_those_that_exist():
    there = ', '.join(backend_names())  # with those of other packages
    assert complaint(load_backend, 'ni') == f'backend ni: not registered; there are: {there}'


def test_a_backend_that_cannot_be_imported_is_named_with_its_reason(monkeypatch):
    def lost():
        raise OSError('libhil.so: cannot open shared object file')

    point = types.SimpleNamespace(name='lost', value='lost_package:Lost', load=lost)
    monkeypatch.setattr(module.importlib.metadata, 'entry_points', lambda group: [point])
    text = complaint(load_backend, 'lost')
    assert text == 'backend lost: lost_package:Lost (libhil.so: cannot open shared object file)'


# ---- Quanser ----


def test_quanser_is_initialised_in_the_order_of_the_vendors_own_code(quanser):
    quanser.backend.configure(quanser.setup)
    assert quanser.board.calls == [
        'open',
        'watchdog_clear',
        'set_analog_input_ranges',
        'set_analog_output_ranges',
        'write_analog',
        'watchdog_set_analog_expiration_state',
        'task_create_analog_reader',
        'task_set_buffer_overflow_mode',
        'task_start',
    ]


def test_quanser_gets_its_channels_ranges_and_expiration_states(quanser):
    quanser.backend.configure(quanser.setup)
    assert quanser.board.input_range == dict.fromkeys(range(6), (-10.0, 10.0))
    assert quanser.board.output_range == {0: (-10.0, 10.0), 3: (-10.0, 10.0)}
    assert quanser.board.expiration == {0: 0.25 - 9.375, 3: 9.375}


def test_quanser_reads_each_channel_into_its_place(quanser):
    quanser.backend.configure(quanser.setup)
    quanser.backend.read(quanser.read_volts)
    assert tuple(quanser.read_volts) == RESTING_VOLTS


def test_quanser_watchdog_clear_may_fail_with_599_only(quanser):
    quanser.board.broken['watchdog_clear'] = fake_quanser.HILError(-595, 'not supported')
    assert complaint(quanser.backend.configure, quanser.setup) == 'not supported (code -595)'
    assert not quanser.board.open


def test_a_card_that_cannot_hold_the_safe_volts_by_itself_is_refused(quanser):
    quanser.board.supports_expiration = False
    text = complaint(quanser.backend.configure, quanser.setup)
    assert text == 'no such expiration state (code -592)'
    assert not quanser.board.open


def test_a_hold_up_beyond_the_read_time_out_is_an_error_and_no_backlog(quanser):
    quanser.backend.configure(quanser.setup)
    quanser.board.late = 20
    quanser.backend.read(quanser.read_volts)
    quanser.board.late = 21
    text = complaint(quanser.backend.read, quanser.read_volts)
    assert text == 'samples were lost (code -111)'


def test_an_unknown_board_says_so_in_the_vendors_words(quanser):
    setup = dataclasses.replace(quanser.setup, options={'board_type': 'qpid'})
    assert complaint(quanser.backend.configure, setup) == 'no board qpid 0 (code -108)'


@pytest.mark.parametrize(
    ('options', 'message'),
    [
        ({}, 'backends.quanser.board_type: missing; must be text that is not blank'),
        (
            {'board_type': ' '},
            'backends.quanser.board_type =  : must be text that is not blank',
        ),
        (
            {'board': 'qpid_e'},
            'backends.quanser.board: no such parameter; did you mean backends.quanser.board_type?',
        ),
    ],
)
def test_options_that_cannot_be_are_named(quanser, options, message):
    with pytest.raises(ConfigurationError) as caught:
        quanser.backend.configure(dataclasses.replace(quanser.setup, options=options))
    assert str(caught.value) == message


def test_options_of_the_card_are_passed_on(quanser):
    options = {'board_type': 'fake', 'card_options': 'update_rate=fast'}
    quanser.backend.configure(dataclasses.replace(quanser.setup, options=options))
    assert quanser.board.calls[1] == 'set_card_specific_options'


class Blocked:
    """Fails every import of one package, by ImportError or as a lost native library does."""

    def __init__(self, package, error):
        self.package, self.error = package, error

    def find_spec(self, name, path=None, target=None):
        if name.split('.')[0] == self.package:
            raise self.error


@pytest.mark.parametrize('error', [ImportError('no module'), OSError('libhil.so is missing')])
@pytest.mark.parametrize(
    ('name', 'package', 'cure'),
    [('quanser', 'quanser', "the vendor's SDK"), ('nidaqmx', 'nidaqmx', 'pip install nidaqmx')],
)
def test_a_missing_package_says_what_to_install(
    hardware, configuration, monkeypatch, name, package, cure, error
):
    kind = {'quanser': QuanserBench, 'nidaqmx': NidaqmxBench}[name]
    bench = kind(name, hardware, configuration, monkeypatch)
    for module_name in [m for m in sys.modules if m.split('.')[0] == package]:
        monkeypatch.delitem(sys.modules, module_name)
    monkeypatch.setattr(sys, 'meta_path', [Blocked(package, error), *sys.meta_path])
    text = complaint(bench.backend.configure, bench.setup)
    assert text.startswith(f'backend {name}: ') and cure in text and str(error) in text


# ---- National Instruments ----


def test_a_missing_driver_says_what_to_install(nidaqmx):
    nidaqmx.device.driver = False
    text = complaint(nidaqmx.backend.configure, nidaqmx.setup)
    assert text.startswith('backend nidaqmx: install the NI-DAQmx driver')


def test_nidaqmx_samples_by_hardware_timed_single_point(nidaqmx):
    nidaqmx.backend.configure(nidaqmx.setup)
    task = nidaqmx.backend._input
    assert task.timing.mode is fake_nidaqmx.AcquisitionType.HW_TIMED_SINGLE_POINT
    assert task.timing.rate == 1000.0


def test_nidaqmx_takes_the_newest_of_a_stream_where_single_point_is_missing(nidaqmx):
    nidaqmx.device.single_point = False
    nidaqmx.backend.configure(nidaqmx.setup)
    assert nidaqmx.backend._input.timing.mode is fake_nidaqmx.AcquisitionType.CONTINUOUS
    nidaqmx.backend.read(nidaqmx.read_volts)
    assert tuple(nidaqmx.read_volts) == RESTING_VOLTS


def test_nidaqmx_closes_every_task(nidaqmx):
    for single_point in (True, False):
        nidaqmx.device.single_point = single_point
        nidaqmx.backend.configure(nidaqmx.setup)
        assert nidaqmx.device.tasks == 3
        nidaqmx.backend.close()
        assert nidaqmx.device.tasks == 0


@pytest.mark.parametrize('call', ['write', 'expiration', 'start'])
def test_nidaqmx_leaves_no_task_behind_a_failure(nidaqmx, call):
    nidaqmx.device.broken[call] = fake_nidaqmx.DaqError('broken', -50103)
    assert complaint(nidaqmx.backend.configure, nidaqmx.setup) == 'broken (code -50103)'
    assert nidaqmx.device.tasks == 0


def test_nidaqmx_expiration_states_are_volts_of_the_safe_state(nidaqmx):
    nidaqmx.backend.configure(nidaqmx.setup)
    assert nidaqmx.device.expiration == {0: 0.25 - 9.375, 3: 9.375}


def test_a_failing_reset_of_the_timer_is_an_error_and_no_expiry(nidaqmx):
    nidaqmx.backend.configure(nidaqmx.setup)
    nidaqmx.backend.arm()
    nidaqmx.device.broken['reset_timer'] = fake_nidaqmx.DaqError('cable', -88709)
    assert complaint(nidaqmx.backend.reload_watchdog) == 'cable (code -88709)'


# ---- The mock ----


def test_the_mock_mirrors_its_outputs(hardware, configuration):
    from fam_bundle_io.hardware.backend import make_setup

    backend = load_backend('mock')
    setup = make_setup(hardware, 'mock', 0.001)
    backend.configure(setup)
    volts = np.empty(6)
    rest = np.array([0.0, 0.0, 0.5, 0.0, 0.5, 0.5])
    for k in range(1, 4):
        backend.read(volts)
        assert volts == pytest.approx(rest + 0.001 * (-1) ** k, abs=1e-12)
    backend.arm()
    backend.write(np.array([0.25, 4.375]))
    backend.read(volts)
    assert volts == pytest.approx(rest + 0.001 + 0.01 * np.array([9.375, -5.0] * 3), abs=1e-12)
