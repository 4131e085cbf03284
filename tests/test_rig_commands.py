# SPDX-License-Identifier: Apache-2.0
"""``./fam doctor``, ``check-channels`` and ``zero``, on a rig that is broken on purpose."""

from collections.abc import Callable, Iterator
import dataclasses
import os
from pathlib import Path
import re
import resource
import signal
import subprocess
import sys
import time
from typing import Any

from fam_bundle_bringup import doctor, rig_commands
from fam_bundle_bringup.cli import main
from fam_bundle_bringup.doctor import MISSING, OK, WARNING
from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_io.hardware import backend as backend_module
from fam_bundle_io.hardware.calibration import load_hardware, Scaling
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_sim.plant import truth
from fam_bundle_sim.volts_backend import VoltsBackend
import numpy as np
import pytest
import yaml

pytestmark = pytest.mark.alone

ROOT = Path(__file__).resolve().parents[1]
VOLTS = default_configuration().with_name('volts_calibration.yaml')
TEMPLATE = default_configuration().with_name('hardware_calibration_template.yaml')
SAFE = -9.375  # V, of each valve of the simulated rig: its middle less full scale
LIMIT = 200e3  # Pa, if not told otherwise

Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch


class WatchedRig(VoltsBackend):
    """The simulated rig, broken as asked, whose true pressures are watched."""

    def __init__(self, *faults: tuple[Any, ...]) -> None:
        super().__init__()
        self.broken_from_start = faults
        self.at_sample: dict[int, Callable[[WatchedRig], None]] = {}
        self.samples, self.peak, self.opened, self.moved = 0, 0.0, False, False
        self.changes: dict[str, Any] = {}

    def configure(self, setup: Any) -> None:
        super().configure(dataclasses.replace(setup, **self.changes))
        self.opened = True
        for fault in self.broken_from_start:
            self.inject(*fault)

    def read(self, volts: Any) -> None:
        super().read(volts)
        pressures = np.empty(len(self.outputs))
        truth(self.rig, self.state, pressures)
        self.peak = max(self.peak, float(pressures.max()))
        self.moved = self.moved or set(self.outputs) != {SAFE}
        self.samples += 1
        if self.samples in self.at_sample:
            self.at_sample[self.samples](self)

    def is_left_safe(self) -> bool:
        return not self.configured and set(self.outputs) == {SAFE}


class ReversedRig(WatchedRig):
    """Its second valve is wired the other way."""

    def configure(self, setup: Any) -> None:
        super().configure(setup)
        first, second = setup.calibration.valves
        valves = (first, dataclasses.replace(second, sign='negative'))
        self.scaling = Scaling(dataclasses.replace(setup.calibration, valves=valves))


class JoinedRig(WatchedRig):
    """Both valves hang on the first output."""

    def write(self, volts: Any) -> None:
        super().write(volts)
        self.outputs[1] = self.outputs[0]


def assert_refused(status: int, message: str, words: tuple[str, ...]) -> None:
    assert status == 2
    assert message.count('\n') == 1, message
    assert all(word in message for word in words), message


def run(arguments: list[str]) -> int:
    try:
        return main(arguments)
    except SystemExit as end:  # by the parser
        return int(end.code or 0)


@pytest.fixture(autouse=True)
def signals_as_before() -> Iterator[None]:
    kept = {number: signal.getsignal(number) for number in (signal.SIGTERM, signal.SIGHUP)}
    yield
    for number, handler in kept.items():
        signal.signal(number, handler)


@pytest.fixture
def on(monkeypatch: Patch) -> Callable[..., int]:
    """Return a function that runs a command on a rig and returns its exit status."""

    def run_on(rig: WatchedRig, *arguments: Any, backend: str = 'volts') -> int:
        monkeypatch.setattr(rig_commands, 'load_backend', lambda name: rig)
        command, *others = map(str, arguments)
        return run([command, '--backend', backend, *others])

    return run_on


def edited(path: Path, out: Path, change: Callable[[Any], None]) -> Path:
    content = yaml.safe_load(path.read_text())
    change(content)
    out.write_text(yaml.safe_dump(content))
    return out


# ---- check-channels ----


def test_a_healthy_rig_passes_and_no_unit_gets_far(on: Any, capsys: Capture) -> None:
    rig = WatchedRig()
    assert on(rig, 'check-channels') == 0
    said = capsys.readouterr().out
    assert said.count(': ok: ') == 2
    assert 'every valve is answered by its own transducer' in said
    # An answer is 30 kPa; the valve is closed again within a few samples.
    assert 30e3 < rig.peak < 40e3
    assert rig.is_left_safe()


@pytest.mark.parametrize(
    ('fault', 'lines'),
    [
        (
            ('outputs_swapped', 0, 1),
            (
                'motor unit 0: swapped: valves[0] (output 0) is answered by mu_pressure[1]',
                'motor unit 1: swapped: valves[1] (output 1) is answered by mu_pressure[0]',
            ),
        ),
        (
            ('inputs_swapped', 4, 5),
            (
                'motor unit 0: swapped: valves[0] (output 0) is answered by mu_pressure[1]',
                'motor unit 1: swapped: valves[1] (output 1) is answered by mu_pressure[0]',
            ),
        ),
        (('inputs_swapped', 2, 5), ('swapped with that of source_pressure',)),
        (('inputs_swapped', 0, 4), ('mu_pressure[0] = -1.19 V',)),
        (('valve_dead', 0), ('motor unit 0: dead: valves[0] (output 0)', 'motor unit 1: ok')),
        (('valve_dead', 1), ('motor unit 0: ok', 'motor unit 1: dead: valves[1] (output 1)')),
        (('output_open', 1), ('motor unit 0: ok', 'motor unit 1: dead: valves[1] (output 1)')),
        (('input_frozen', 4), ('motor unit 0: no answer', 'mu_pressure[0]', 'motor unit 1: ok')),
        (('input_frozen', 5), ('motor unit 0: ok', 'motor unit 1: no answer', 'mu_pressure[1]')),
        (('input_open', 5), ('mu_pressure[1] = 0 V',)),
        (('input_rail', 1), ('force or source_flow does not measure',)),
        (('output_rail', 1), ('mu_pressure[1]', 'not vented')),
        (('source_off',), ('source_pressure', 'must be >= 100.0 kPa', 'start the pump')),
        (('read_error',), ('the converter does not answer',)),
    ],
    ids=lambda value: '_'.join(map(str, value)) if isinstance(value, tuple) else None,
)
def test_a_fault_is_found_and_named(
    fault: tuple[Any, ...], lines: tuple[str, ...], on: Any, capsys: Capture
) -> None:
    rig = WatchedRig()
    # What is frozen stays where it was at rest.
    rig.at_sample[20] = lambda broken: broken.inject(*fault)
    if fault[0] in ('input_open', 'input_rail', 'inputs_swapped', 'source_off'):
        rig = WatchedRig(fault)
    assert on(rig, 'check-channels') == 1
    said = ''.join(capsys.readouterr())
    for line in lines:
        assert line in said
    assert rig.peak <= LIMIT
    assert rig.is_left_safe()


def test_a_reversed_sign_shows_before_anything_is_opened(on: Any, capsys: Capture) -> None:
    rig = ReversedRig()
    assert on(rig, 'check-channels') == 1
    message = capsys.readouterr().err
    assert 'mu_pressure[1]' in message and 'sign of its valve is reversed' in message
    assert not rig.moved
    assert rig.peak <= LIMIT and rig.is_left_safe()


def test_joined_outputs_are_a_leak(on: Any, capsys: Capture) -> None:
    rig = JoinedRig()
    assert on(rig, 'check-channels') == 1
    said = capsys.readouterr().out
    assert 'motor unit 0: leak: mu_pressure[0] (input 4) rose, and so did mu_pressure[1]' in said
    assert 'motor unit 1: dead' in said
    assert rig.peak <= LIMIT and rig.is_left_safe()


@pytest.mark.parametrize('null', [-0.06, 0.06])
def test_a_worn_noisy_rig_passes_and_its_middle_is_noticed(
    null: float, on: Any, tmp_path: Path, capsys: Capture
) -> None:
    def wear(content: Any) -> None:
        content['backends'] = {'volts': {'null_offset': null, 'hysteresis': 0.03}}

    def add_noise(content: Any) -> None:
        content['/**']['ros__parameters']['sensors'] = {
            'strain_noise': 2e-5,
            'force_noise': 1.0,
            'pressure_noise': 1e3,
            'flow_noise': 1e-6,
        }

    hardware = edited(VOLTS, tmp_path / 'hardware.yaml', wear)
    config = edited(default_configuration(), tmp_path / 'config.yaml', add_noise)
    rig = WatchedRig()
    files = ('--hardware', hardware, '--config', config)
    assert on(rig, 'check-channels', *files) == 0
    said = capsys.readouterr().out
    assert said.count(': ok: ') == 2
    assert said.count('null_volts is off') == (2 if null > 0.0 else 0)
    rig = WatchedRig(('outputs_swapped', 0, 1))
    assert on(rig, 'check-channels', *files) == 1
    assert capsys.readouterr().out.count(': swapped: ') == 2
    assert rig.peak <= LIMIT and rig.is_left_safe()


@pytest.mark.parametrize('pressure', ['100', '350'])
@pytest.mark.parametrize('mass', [5.0, 35.0])
def test_a_healthy_rig_passes_with_any_load_and_limit(
    mass: float, pressure: str, on: Any, tmp_path: Path, capsys: Capture
) -> None:
    def load(content: Any) -> None:
        content['/**']['ros__parameters']['load']['mass'] = mass
        content['/**']['ros__parameters']['reference']['amplitude'] = 0.01

    config = edited(default_configuration(), tmp_path / 'config.yaml', load)
    rig = WatchedRig()
    options = ('--config', config, '--pressure', pressure)
    assert on(rig, 'check-channels', *options) == 0, capsys.readouterr()
    assert rig.peak <= 1e3 * float(pressure) and rig.is_left_safe()
    rig = WatchedRig()
    rig.at_sample[1000] = lambda broken: broken.inject('valve_dead', 1)  # it hangs at rest
    assert on(rig, 'check-channels', *options) == 1
    assert 'motor unit 1: dead' in capsys.readouterr().out


def test_the_two_that_are_swapped_are_named_among_three(
    on: Any, tmp_path: Path, capsys: Capture
) -> None:
    def add_unit(content: Any) -> None:
        content['/**']['ros__parameters']['fam']['count'] = [1, 1, 2]

    def add_channels(content: Any) -> None:
        pressures, valves = content['sensors']['mu_pressure'], content['valves']
        pressures.append({**pressures[0], 'channel': 11})
        valves.append({**valves[0], 'channel': 7})

    config = edited(default_configuration(), tmp_path / 'three.yaml', add_unit)
    hardware = edited(VOLTS, tmp_path / 'hardware.yaml', add_channels)
    rig = WatchedRig(('outputs_swapped', 0, 2))
    assert on(rig, 'check-channels', '--config', config, '--hardware', hardware) == 1
    said = capsys.readouterr().out
    assert 'unit 0: swapped: valves[0] (output 0) is answered by mu_pressure[2] (input 11)' in said
    assert 'unit 1: ok: ' in said
    assert 'unit 2: swapped: valves[2] (output 7) is answered by mu_pressure[0] (input 4)' in said
    assert '2 of 3 motor units' in said
    assert rig.peak <= LIMIT and rig.is_left_safe()


def test_no_transducer_is_needed_to_keep_the_limit(on: Any, capsys: Capture) -> None:
    rig = WatchedRig()

    def freeze_all(broken: WatchedRig) -> None:
        broken.inject('input_frozen', 4)
        broken.faults['input_frozen'] = (0, 4, 5)  # strain and both pressures

    rig.at_sample[20] = freeze_all
    assert on(rig, 'check-channels', '--pressure', '100') == 1
    # They were filled blindly, as far as the source goes that was turned down.
    assert 80e3 < rig.peak <= 100e3
    assert ': ok: ' not in capsys.readouterr().out
    assert rig.is_left_safe()


def test_a_source_that_rises_meanwhile_ends_the_check(on: Any, capsys: Capture) -> None:
    rig = WatchedRig()
    rig.at_sample[2200] = lambda broken: broken.inject('source_high')
    assert on(rig, 'check-channels') == 1
    message = capsys.readouterr().err
    assert 'source_pressure = 20' in message and 'turn it down' in message
    assert rig.moved and rig.is_left_safe()


@pytest.mark.parametrize('error', [KeyboardInterrupt, RuntimeError('a bug'), MemoryError])
@pytest.mark.parametrize('sample', [1, 500, 2250, 2400, 2600])
def test_whatever_ends_it_leaves_the_safe_volts_out(error: Any, sample: int, on: Any) -> None:
    rig = WatchedRig()

    def fail(broken: WatchedRig) -> None:
        raise error

    rig.at_sample[sample] = fail
    assert on(rig, 'check-channels') in (1, 130)
    assert rig.opened and rig.is_left_safe()


def test_outputs_that_cannot_be_written_are_left_to_the_watchdog(on: Any) -> None:
    rig = WatchedRig()
    rig.at_sample[2250] = lambda broken: broken.inject('write_error')
    assert on(rig, 'check-channels') == 1
    assert rig.moved and rig.is_left_safe()


SIGNALLED = """
import atexit, os, signal, sys
default = signal.default_int_handler if '{name}' == 'SIGINT' else signal.SIG_DFL
sys.path.insert(0, {tests!r})
from test_rig_commands import WatchedRig, main, rig_commands
signal.signal(signal.{name}, default)  # a parent may have had it ignored
rig = WatchedRig()
rig_commands.load_backend = lambda name: rig
rig.at_sample[2250] = lambda broken: os.kill(os.getpid(), signal.{name})
status = main(['check-channels', '--backend', 'volts'])
print(status, rig.moved, rig.is_left_safe())
"""


@pytest.mark.parametrize('name', ['SIGINT', 'SIGTERM', 'SIGHUP'])
def test_a_signal_in_the_middle_of_a_pulse_vents(name: str) -> None:
    code = SIGNALLED.format(tests=str(Path(__file__).parent), name=name)
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, timeout=60.0, check=False
    )
    assert done.stdout.splitlines()[-1] == '130 True True', done.stderr
    assert done.stderr.count('\n') == 1 and 'interrupted' in done.stderr


@pytest.fixture
def real(tmp_path: Path) -> Path:
    """Return the hardware file of what passes for a real rig: other names, a card's options."""
    named = tmp_path / 'named.yaml'
    named.write_text(VOLTS.read_text().replace('simulated rig', 'rig 7'))

    def choose(content: Any) -> None:
        content['backends'] = {'quanser': {'board_type': 'none'}}

    return edited(named, tmp_path / 'rig.yaml', choose)


def test_a_real_rig_is_not_opened_unless_somebody_agrees(
    on: Any, real: Path, capsys: Capture
) -> None:
    rig = WatchedRig()
    status = on(rig, 'check-channels', '--hardware', real, backend='quanser')
    out, message = capsys.readouterr()
    assert_refused(status, message, ('--backend quanser', 'not told to move'))
    assert 'Pump off' in out and '100 to 200 kPa' in out
    assert not rig.opened


def test_a_real_rig_is_waited_for_until_its_source_is_turned_down(
    on: Any, real: Path, monkeypatch: Patch, capsys: Capture
) -> None:
    monkeypatch.setattr(rig_commands, 'agreed', lambda: True)
    monkeypatch.setattr(rig_commands, 'PATIENCE', 0.5)
    rig = WatchedRig()
    rig.changes['options'] = {'pace': 'steady'}
    assert on(rig, 'check-channels', '--hardware', real, backend='quanser') == 1
    message = capsys.readouterr().err
    assert 'source_pressure = 689.' in message and 'turn it down' in message
    assert rig.opened and not rig.moved and rig.is_left_safe()


# ---- zero ----


def test_zero_finds_what_the_sensors_give_at_rest(
    on: Any, tmp_path: Path, capsys: Capture
) -> None:
    before = VOLTS.read_bytes()
    out = tmp_path / 'zeroed.yaml'
    rig = WatchedRig()
    moved = {4: 0.512, 5: 0.493}

    def move(found: WatchedRig) -> None:
        offsets = found.scaling.offset  # type: ignore[attr-defined]
        for channel, offset in moved.items():
            offsets[channel] = offset

    rig.at_sample[1] = move
    assert on(rig, 'zero', '--out', out) == 0
    old, new = load_hardware(VOLTS), load_hardware(out)
    step = 20.0 / 2**16  # V, of the converter
    for channel, offset in moved.items():
        assert new.calibration.sensors()[channel].offset == pytest.approx(offset, abs=step)
    assert new.calibration.hash() != old.calibration.hash()
    assert new.limits == old.limits and new.calibration.valves == old.calibration.valves
    assert VOLTS.read_bytes() == before
    table = capsys.readouterr().out
    assert re.search(r'mu_pressure\[0\] +0\.50000 +0\.51[12]\d\d +\d+\.?\d* Pa', table), table
    assert re.search(r'source_pressure +0\.50000 +0\.50000 +not zeroed: the source is on', table)
    assert not rig.moved and rig.is_left_safe()


def test_zeroing_twice_moves_nothing_more_than_a_step(on: Any, tmp_path: Path) -> None:
    first, again = tmp_path / 'first.yaml', tmp_path / 'again.yaml'
    assert on(WatchedRig(), 'zero', '--out', first) == 0
    assert on(WatchedRig(), 'zero', '--hardware', first, '--out', again) == 0
    step = 20.0 / 2**16
    for one, two in zip(
        load_hardware(first).calibration.sensors(),
        load_hardware(again).calibration.sensors(),
        strict=True,
    ):
        assert two.offset == pytest.approx(one.offset, abs=step)


@pytest.mark.parametrize(
    ('fault', 'words'),
    [
        (('valve_dead', 1), ('mu_pressure[1]', 'must be < 20000 Pa')),
        (('input_open', 4), ('mu_pressure[0] = 0 V', '>= 0.25')),
        (('input_open', 0), ('strain', 'shift')),
        (('read_error',), ('the converter does not answer',)),
    ],
    ids=lambda value: '_'.join(map(str, value)),
)
def test_a_rig_that_is_not_at_rest_is_not_zeroed(
    fault: tuple[Any, ...], words: tuple[str, ...], on: Any, tmp_path: Path, capsys: Capture
) -> None:
    def strict(content: Any) -> None:
        content['limits'] = {'frozen_samples': 0, 'zero_strain_shift': 0.01}
        # Without current the middle of a valve is slightly open to the source.
        content['backends'] = {'volts': {'null_offset': 0.02}}

    rig, out = WatchedRig(fault), tmp_path / 'zeroed.yaml'
    hardware = edited(VOLTS, tmp_path / 'hardware.yaml', strict)
    assert on(rig, 'zero', '--hardware', hardware, '--out', out) == 1
    message = capsys.readouterr().err
    assert message.count('\n') == 1 and message.startswith('fam zero: ')
    assert all(word in message for word in words), message
    assert not out.exists() and rig.is_left_safe()


def test_noise_beyond_its_bound_is_not_zeroed(on: Any, tmp_path: Path, capsys: Capture) -> None:
    def add_noise(content: Any) -> None:
        content['/**']['ros__parameters']['sensors'] = {'pressure_noise': 3e3}

    config = edited(default_configuration(), tmp_path / 'config.yaml', add_noise)
    out = tmp_path / 'zeroed.yaml'
    assert on(WatchedRig(), 'zero', '--config', config, '--out', out) == 1
    assert 'standard deviation' in capsys.readouterr().err
    assert not out.exists()


def test_zero_that_is_interrupted_writes_nothing(on: Any, tmp_path: Path) -> None:
    rig = WatchedRig()

    def interrupt(_: WatchedRig) -> None:
        raise KeyboardInterrupt

    rig.at_sample[3500] = interrupt
    assert on(rig, 'zero', '--out', tmp_path / 'zeroed.yaml') == 130
    assert list(tmp_path.iterdir()) == []
    assert rig.is_left_safe()


def test_zero_overwrites_nothing(on: Any, tmp_path: Path, capsys: Capture) -> None:
    rig, out = WatchedRig(), tmp_path / 'zeroed.yaml'
    out.write_text('precious')
    status = on(rig, 'zero', '--out', out)
    assert_refused(status, capsys.readouterr().err, (str(out), 'exists already'))
    assert out.read_text() == 'precious' and not rig.opened


# ---- What both refuse ----


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('--backend', 'quansr'), ('--backend quansr', 'there are:', 'quanser')),
        (('--backend', 'quanser'), ('--backend quanser', 'needs --hardware')),
        (('--backend', 'nidaqmx', '--hardware', VOLTS), ('that of the simulated rig',)),
        (('--backend', 'volts', '--hardware', '/no/such.yaml'), ('/no/such.yaml', 'No such file')),
        (('--backend', 'volts', '--hardware', TEMPLATE), (str(TEMPLATE), 'sensors.strain.gain')),
        (('--backend', 'volts', '--config', '/no/such.yaml'), ('/no/such.yaml',)),
        (('--backend', 'volts', '--bogus'), ('--bogus',)),
        ((), ('--backend', 'required')),
    ],
)
@pytest.mark.parametrize('command', ['check-channels', 'zero'])
def test_bad_input_is_refused_in_one_line(
    command: str,
    arguments: tuple[Any, ...],
    words: tuple[str, ...],
    tmp_path: Path,
    capsys: Capture,
) -> None:
    out = tmp_path / 'zeroed.yaml'
    more = ['--out', str(out)] if command == 'zero' else []
    status = run([command, *map(str, arguments), *more])
    assert_refused(status, capsys.readouterr().err, words)
    assert not out.exists()


@pytest.mark.parametrize('pressure', ['99', '351', 'nan', 'inf', '-200', 'much'])
def test_a_pressure_out_of_range_is_refused(pressure: str, capsys: Capture) -> None:
    status = run(['check-channels', '--backend', 'volts', f'--pressure={pressure}'])
    assert_refused(status, capsys.readouterr().err, ('--pressure', pressure, '>= 100', '<= 350'))


def test_zero_needs_a_new_file_in_a_folder_that_is_there(tmp_path: Path, capsys: Capture) -> None:
    out = tmp_path / 'deep' / 'zeroed.yaml'
    status = run(['zero', '--backend', 'volts', '--out', str(out)])
    assert_refused(status, capsys.readouterr().err, (str(out.parent), 'no folder'))
    status = run(['zero', '--backend', 'volts'])
    assert_refused(status, capsys.readouterr().err, ('--out', 'required'))


def test_valves_must_be_as_many_as_motor_units(tmp_path: Path, capsys: Capture) -> None:
    def add_unit(content: Any) -> None:
        content['/**']['ros__parameters']['fam']['count'] = [1, 1, 2]

    config = edited(default_configuration(), tmp_path / 'three.yaml', add_unit)
    status = run(['check-channels', '--backend', 'volts', '--config', str(config)])
    assert_refused(status, capsys.readouterr().err, ('2 valves for 3 motor units',))
    assert doctor.check_configuration(config, None, 'volts').state == MISSING


# ---- doctor ----


def state_of(said: str, name: str) -> str:
    found = re.search(rf'^(ok|warning|missing) +{name} ', said, re.MULTILINE)
    assert found, said
    return found[1]


def test_doctor_finds_nothing_missing_where_tests_run(capsys: Capture) -> None:
    assert run(['doctor']) == 0
    lines = capsys.readouterr().out.splitlines()
    assert len(lines) == len(doctor.checks(None, None, None)) + 1
    assert all(re.match(r'(ok|warning) ', line) for line in lines[:-1]), lines
    assert lines[-1].endswith('0 missing')


def test_doctor_names_what_the_template_leaves_blank(capsys: Capture) -> None:
    blank = re.findall(r'^\s*(?:- )?\w+: +#|^id: +#', TEMPLATE.read_text(), re.MULTILINE)
    assert len(doctor.unfilled(TEMPLATE)) == len(blank) > 20
    assert run(['doctor', '--backend', 'quanser', '--hardware', str(TEMPLATE)]) == 1
    said = capsys.readouterr().out
    assert state_of(said, 'hardware file') == MISSING
    assert f'{len(blank)} values not filled in: id, sensors.strain.gain' in said


@pytest.mark.parametrize(
    ('backend', 'words'),
    [
        ('quansr', ('not registered', 'quanser')),
        ('quanser', ('install the Python packages', "vendor's SDK")),
        ('nidaqmx', ('pip install nidaqmx',)),
    ],
)
def test_doctor_says_what_a_backend_lacks(backend: str, words: tuple[str, ...]) -> None:
    result = doctor.check_backend(backend)
    assert result.state == MISSING
    assert all(word in result.found for word in words)


def test_doctor_opens_no_card(monkeypatch: Patch) -> None:
    rig = WatchedRig()
    monkeypatch.setattr(backend_module, 'load_backend', lambda name: rig)
    assert run(['doctor']) == 0
    assert not rig.opened


def test_no_line_of_the_simulated_rig_is_left_to_a_real_one(real: Path, tmp_path: Path) -> None:
    def forget(content: Any) -> None:
        content['sensors']['mu_pressure'][1]['calibration_id'] = ' Simulated Rig 1'

    file = edited(real, tmp_path / 'forgotten.yaml', forget)
    name = 'sensors.mu_pressure[1].calibration_id'
    assert backend_module.made_up(load_hardware(real).calibration) == []
    for backend in ('quanser', 'nidaqmx', 'of_another_package'):
        with pytest.raises(ConfigurationError, match=re.escape(name)):
            backend_module.check_rig(load_hardware(file), file, backend, 2)
    for backend in ('volts', 'volts_card', 'mock'):
        backend_module.check_rig(load_hardware(VOLTS), VOLTS, backend, 2)
    found = doctor.check_hardware(file, 'quanser')
    assert found.state == MISSING and name in found.found
    # Whatever is changed in it: each of its lines says whose it is.
    assert len(backend_module.made_up(load_hardware(VOLTS).calibration)) == 9


def test_doctor_looks_into_the_hardware_file_of_a_real_rig(real: Path, tmp_path: Path) -> None:
    assert doctor.check_hardware(None, 'quanser').state == MISSING
    assert 'simulated' in doctor.check_hardware(VOLTS, 'quanser').found
    assert doctor.check_hardware(VOLTS, 'quanser').state == MISSING
    never_frozen = doctor.check_hardware(real, 'quanser')
    assert never_frozen.state == WARNING and 'frozen_samples' in never_frozen.found

    def watch(content: Any) -> None:
        content['limits']['frozen_samples'] = 500

    good = edited(real, tmp_path / 'good.yaml', watch)
    result = doctor.check_hardware(good, 'quanser')
    assert result.state == OK
    assert 'rig 7' in result.found and load_hardware(good).calibration.hash()[:12] in result.found
    assert 'backends.nidaqmx' in doctor.check_hardware(good, 'nidaqmx').found

    def share_a_channel(content: Any) -> None:
        content['sensors']['force']['channel'] = 4

    bad = doctor.check_hardware(edited(good, tmp_path / 'bad.yaml', share_a_channel), 'quanser')
    assert bad.state == MISSING and 'sensors' in bad.found and 'taken' in bad.found
    gone = doctor.check_hardware(tmp_path / 'gone.yaml', 'quanser')
    assert gone.state == MISSING and 'No such file' in gone.found


def test_doctor_tells_refused_rights_and_the_way_to_them(monkeypatch: Patch) -> None:
    def refuse(*_: Any) -> None:
        raise PermissionError(1, 'Operation not permitted')

    monkeypatch.setattr(os, 'sched_setscheduler', refuse)
    monkeypatch.setattr(resource, 'getrlimit', lambda which: (0, 0))
    monkeypatch.setattr(doctor, '_has_capability', lambda bit: False)
    priority, memory = doctor.check_priority(30), doctor.check_memory_lock(asked=True)
    assert priority.state == memory.state == WARNING
    assert 'SCHED_FIFO 30 refused (Operation not permitted; limit 0)' in priority.found
    assert all('docs/performance.md#real-time-rights' in r.cure for r in (priority, memory))


def test_asking_for_rights_changes_nothing() -> None:
    before = os.sched_getscheduler(0), Path('/proc/self/timerslack_ns').read_text()
    doctor.check_priority(20)
    doctor.check_timer_slack(1e-6)
    assert (os.sched_getscheduler(0), Path('/proc/self/timerslack_ns').read_text()) == before


def test_doctor_knows_slow_clocks_and_few_cores(tmp_path: Path, monkeypatch: Patch) -> None:
    clock = tmp_path / 'clock'
    clock.write_text('hpet\n')
    assert doctor.check_clock(clock).state == WARNING
    clock.write_text('tsc\n')
    assert doctor.check_clock(clock) == (OK, 'tsc', '')
    assert doctor.check_clock(tmp_path / 'none').state == WARNING
    monkeypatch.setattr(os, 'sched_getaffinity', lambda which: {0, 1, 2, 3})
    assert doctor.check_cores(0).state == OK
    assert 'core 5' in doctor.check_cores(0b100001).found


def test_doctor_sees_a_network_that_is_not_the_loopback(monkeypatch: Patch) -> None:
    profile = default_configuration().with_name('fastdds_loopback.xml')
    monkeypatch.setenv('RMW_IMPLEMENTATION', 'rmw_fastrtps_cpp')
    monkeypatch.setenv('ROS_AUTOMATIC_DISCOVERY_RANGE', 'SYSTEM_DEFAULT')
    monkeypatch.setenv('FASTRTPS_DEFAULT_PROFILES_FILE', str(profile))
    for name in doctor.OVERRULING:
        monkeypatch.delenv(name, raising=False)
    assert doctor.check_middleware().state == OK
    monkeypatch.setenv('ROS_LOCALHOST_ONLY', '1')
    assert 'ROS_LOCALHOST_ONLY is set' in doctor.check_middleware().found
    monkeypatch.delenv('FASTRTPS_DEFAULT_PROFILES_FILE')
    result = doctor.check_middleware()
    assert result.state == WARNING and 'fastdds_loopback.xml' in result.found


def test_a_check_that_breaks_is_a_line() -> None:
    result = doctor.examine(lambda: 1 / 0)  # type: ignore[arg-type, return-value]
    assert result.state == MISSING
    assert 'ZeroDivisionError: division by zero' in result.found


@pytest.mark.parametrize('package', ['numpy', 'rclpy', 'rosbags', 'yaml'])
def test_doctor_works_with_a_broken_package(package: str, tmp_path: Path) -> None:
    (tmp_path / f'{package}.py').write_text("raise RuntimeError('broken\\nin two lines')\n")
    path = os.pathsep.join([str(tmp_path), os.environ.get('PYTHONPATH', '')])
    done = subprocess.run(
        [sys.executable, '-m', 'fam_bundle_bringup.doctor'],
        env={**os.environ, 'PYTHONPATH': path},
        capture_output=True,
        text=True,
        timeout=120.0,
        check=False,
    )
    assert done.stderr == ''
    assert len(done.stdout.splitlines()) == len(doctor.checks(None, None, None)) + 1
    assert f'{package} (broken in two lines)' in done.stdout
    needed = package != 'rosbags'
    assert done.returncode == int(needed)
    shown = {'rclpy': 'ROS', 'rosbags': 'bags'}.get(package, 'packages')
    assert state_of(done.stdout, shown) == (MISSING if needed else WARNING)


def test_doctor_points_to_sections_that_exist() -> None:
    source = Path(doctor.__file__).read_text()
    links = set(re.findall(r'docs/(\w+\.md)#([\w-]+)', source))
    assert links
    for document, anchor in links:
        headings = re.findall(r'^#+ (.+)$', (ROOT / 'docs' / document).read_text(), re.MULTILINE)
        assert anchor in {heading.lower().replace(' ', '-') for heading in headings}


def test_fam_passes_the_commands_on() -> None:
    script = (ROOT / 'fam').read_text()
    for command in rig_commands.NAMES:
        assert re.search(rf"^    '{command}': '", script, re.MULTILINE)


def test_doctor_knows_how_long_a_disk_lasts() -> None:
    assert doctor.check_disk(1e-3, Path()).state == OK
    # A period of a nanosecond: no disk is large enough for ten minutes.
    assert doctor.check_disk(1e-9, Path()).state == WARNING


def test_a_steady_rehearsal_takes_as_long_as_a_rig_would(
    on: Any, tmp_path: Path, capsys: Capture
) -> None:
    def pace(content: Any) -> None:
        content['backends'] = {'volts': {'pace': 'steady'}}
        content['limits'] |= {'read_timeout': 0.3, 'watchdog_timeout': 0.4, 'command_lost': 0.5}

    hardware = edited(VOLTS, tmp_path / 'steady.yaml', pace)
    rig, begin = WatchedRig(), time.monotonic()
    assert on(rig, 'check-channels', '--hardware', hardware) == 0, capsys.readouterr()
    assert time.monotonic() - begin > 4.0
    assert rig.peak < 60e3 and rig.is_left_safe()
