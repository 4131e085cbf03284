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

"""The commands for a rig: ``./fam doctor``, ``./fam check-channels`` and ``./fam zero``."""

import argparse
from collections.abc import Callable, Iterator
from contextlib import contextmanager
import dataclasses
import math
from pathlib import Path
import shutil
import signal
import sys
import time
from types import FrameType
from typing import Any, NamedTuple

from fam_bundle_bringup.bridge_options import agreed, check_backend_name, rig_for
from fam_bundle_bringup.doctor import add_doctor_options, run_doctor
from fam_bundle_bringup.experiment import checked_configuration, default_configuration
from fam_bundle_io.hardware.backend import load_backend, make_setup, Setup, SIMULATED
from fam_bundle_io.hardware.calibration import (
    Calibration,
    HardwareFile,
    MU_PRESSURE,
    SensorCalibration,
    SOURCE_PRESSURE,
    write_hardware,
)
from fam_bundle_io.hardware.channel_check import ChannelCheck, Finding, LOWEST_SHARE
from fam_bundle_io.hardware.monitor import Monitor, Sample
from fam_bundle_io.hardware.safety import Refused
from fam_bundle_io.hardware.zeroing import Zeroing
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.tuning import tune

NAMES = ('doctor', 'check-channels', 'zero')
PRESSURE, LOWEST, HIGHEST = 200.0, 100.0, 350.0  # kPa of check-channels
SIMULATED_SHARE = 0.9  # of the highest pressure: to what a simulated source is turned down
PATIENCE, SIMULATED_PATIENCE = 600.0, 3.0  # s for the source to be set by hand
VENT_TIME, REST_TIME = 10.0, 3.0  # s until vented, and from there until pressures rest
BEFORE = """\
One valve after the other opens a little until a transducer answers. The load moves by millimetres.
  1. The load hangs free of people and of what it could strike; somebody holds the emergency stop.
  2. Pump off, every motor unit vented. From now on the safe volts are out.
  3. When asked for, start the pump and set the source to {low:g} to {high:g} kPa, by its gauge.
  4. Watch which muscle moves: two swaps at once hide from the transducers, not from the eye."""


def add_rig_commands(commands: Any) -> None:
    """Add the parsers of the commands."""
    doctor = commands.add_parser(
        'doctor', help='is everything there that a run or a rig needs: one line each'
    )
    add_doctor_options(doctor)
    check = commands.add_parser(
        'check-channels', help='one valve at a time at low pressure: does its transducer answer?'
    )
    _add_card_options(check)
    check.add_argument(
        '--pressure',
        type=_pressure,
        default=PRESSURE,
        metavar='KPA',
        help='highest pressure, to which the source is turned down by hand (%(default)g kPa)',
    )
    zero = commands.add_parser(
        'zero', help='zero strain and pressures of a vented rig into a new hardware file'
    )
    _add_card_options(zero)
    zero.add_argument(
        '--out', type=Path, required=True, metavar='FILE', help='the new file; must not exist'
    )


def _add_card_options(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        '--backend',
        required=True,
        metavar='NAME',
        help='what drives the card: quanser, nidaqmx, one that is registered; volts to rehearse',
    )
    command.add_argument(
        '--hardware',
        type=Path,
        metavar='FILE',
        help='calibration and limits of the rig (default, for volts: that of the simulated one)',
    )
    command.add_argument(
        '--config', type=Path, help='parameter file (default: the rig of the paper, lhacd.yaml)'
    )


def _pressure(text: str) -> float:
    try:
        pressure = float(text)
    except ValueError:
        pressure = math.nan
    if not LOWEST <= pressure <= HIGHEST:
        raise argparse.ArgumentTypeError(
            f'{text} kPa: must be a number >= {LOWEST:g} and <= {HIGHEST:g}'
        )
    return pressure


def run_rig_command(options: argparse.Namespace) -> int:
    """
    Run one of the commands and return its exit status.

    Raises ConfigurationError for what cannot be used, OSError and RuntimeError where the card or
    the rig does not do what it should; the card is closed by then.
    """
    if options.command == 'doctor':
        return run_doctor(options)
    if signal.getsignal(signal.SIGHUP) == signal.SIG_DFL:
        signal.signal(signal.SIGHUP, _terminate)  # a lost terminal must not leave a valve open
    if options.command == 'check-channels':
        return run_check(options)
    return run_zero(options)


def _terminate(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


class Rig(NamedTuple):
    """What the options name."""

    hardware: HardwareFile
    configuration: Configuration
    setup: Setup
    clock: Callable[[], int] | None
    simulated: bool


def rig_of(options: argparse.Namespace, source: float | None = None) -> Rig:
    """
    Return the rig that the options name; nothing is opened yet.

    A simulated one hangs vented, with its source at ``source`` Pa. Raises ConfigurationError.
    """
    name, simulated = options.backend, options.backend in SIMULATED
    check_backend_name(name)
    configuration = checked_configuration(options.config or default_configuration())
    hardware = rig_for(options.hardware, configuration, name)
    if simulated:
        configuration = _vented(configuration, hardware.calibration, source)
    setup = make_setup(hardware, name, configuration.simulation.period, configuration)
    # Samples pace themselves where no clock paces the card.
    counted = simulated and setup.options.get('pace', 'lockstep') == 'lockstep'
    clock = None if counted else time.monotonic_ns
    return Rig(hardware, configuration, setup, clock, simulated)


def _vented(
    configuration: Configuration, calibration: Calibration, source: float | None
) -> Configuration:
    hanging = min(max(calibration.strain.zero_value, -0.1), 0.25)
    simulation = dataclasses.replace(configuration.simulation, initial_strain=hanging)
    pressure = source or configuration.source.nominal_pressure
    turned_down = dataclasses.replace(configuration.source, nominal_pressure=pressure)
    return dataclasses.replace(configuration, simulation=simulation, source=turned_down)


@contextmanager
def live_line() -> Iterator[Callable[[str], None]]:
    """Give a function that shows a line in place of the one before, on a terminal only."""
    shown = sys.stderr.isatty()

    def show(line: str) -> None:
        if shown:
            width = shutil.get_terminal_size().columns - 1
            print(f'\r\x1b[2K{line[:width]}', end='', file=sys.stderr, flush=True)

    try:
        yield show
    finally:
        show('')


@contextmanager
def opened(rig: Rig, backend: str, highest: float) -> Iterator[Monitor]:
    """
    Give the monitor of an opened card; ``highest`` (Pa) is the set value of its source.

    Whatever happens meanwhile, the safe volts are out and the card is closed in the end.
    """
    if not rig.simulated:
        for warning in tune(rig.configuration.process, 'realtime'):
            print(f'warning: {warning}', file=sys.stderr)
    monitor = Monitor(load_backend(backend), rig.setup, rig.hardware.limits, highest, rig.clock)
    with monitor:
        yield monitor


def _calibration_line(rig: Rig) -> str:
    calibration = rig.hardware.calibration
    return f'{rig.setup.outputs.size} motor units of {calibration.id} ({calibration.hash()[:12]})'


# ---- check-channels ----


def run_check(options: argparse.Namespace) -> int:
    """
    Check every motor unit; status 1 unless each is answered by its own transducer.

    Raises ConfigurationError where valves were not told to move, or the rig cannot be used.
    """
    limit = 1e3 * options.pressure
    rig = rig_of(options, SIMULATED_SHARE * limit)
    if not rig.simulated:
        print(BEFORE.format(low=1e-3 * LOWEST_SHARE * limit, high=1e-3 * limit))
        if not agreed():
            raise ConfigurationError(
                f'--backend {options.backend}: the valves were not told to move'
            )
    print(f'{_calibration_line(rig)} on {options.backend}, at most {options.pressure:g} kPa')
    findings = check_rig(rig, options.backend, limit)
    bad = [finding for finding in findings if not finding.ok]
    if not bad:
        print('every valve is answered by its own transducer')
        return 0
    print(f'{len(bad)} of {len(findings)} motor units are not as the hardware file says')
    return 1


def check_rig(rig: Rig, backend: str, limit: float) -> list[Finding]:
    """
    Check every motor unit at ``limit`` Pa at most, and print what is found as it is found.

    Raises CheckFailed where the check cannot go on.
    """
    patience = SIMULATED_PATIENCE if rig.simulated else PATIENCE
    findings = []
    with live_line() as show, opened(rig, backend, limit) as monitor:
        check = ChannelCheck(monitor, rig.setup, rig.hardware.limits, limit, show, patience)
        check.wait_for_rest()
        for unit in range(rig.setup.outputs.size):
            finding = check.check_unit(unit)
            show('')
            print(f'motor unit {unit}: {finding.word}: {finding.text}', flush=True)
            findings.append(finding)
    return findings


# ---- zero ----


def run_zero(options: argparse.Namespace) -> int:
    """
    Zero a vented rig into a new file.

    Raises ConfigurationError where the file exists or cannot be, or the rig cannot be used.
    """
    out = options.out
    if out.exists():
        raise ConfigurationError(f'--out {out}: exists already: name another file')
    if not out.parent.is_dir():
        raise ConfigurationError(f'--out {out}: there is no folder {out.parent}')
    rig = rig_of(options)
    print(f'{_calibration_line(rig)} on {options.backend}: all are opened to the tank')
    zeroing = zero_rig(rig, options.backend)
    new = zeroing.result
    assert new is not None
    write_hardware(dataclasses.replace(rig.hardware, calibration=new), out)
    for line in zero_table(zeroing, new):
        print(line)
    print(f'written to {out} ({new.hash()[:12]}), without the comments of the old file')
    return 0


def zero_rig(rig: Rig, backend: str) -> Zeroing:
    """
    Return a zeroing with its result, of a rig at rest with every unit vented.

    Raises RuntimeError where it cannot be zeroed.
    """
    nominal = rig.configuration.source.nominal_pressure
    with live_line() as show, opened(rig, backend, nominal) as monitor:
        try:
            _wait_until_vented(rig, monitor, show)
            monitor.zero()
            zeroing = monitor.zeroing
            assert zeroing is not None
            while not zeroing.done():
                show(f'zeroing: {zeroing.taken} of {zeroing.samples} samples')
                _sample(monitor)
        except Refused as error:
            raise RuntimeError(error) from None
        if zeroing.result is None:
            raise RuntimeError(zeroing.refusal)
        return zeroing


def _wait_until_vented(rig: Rig, monitor: Monitor, show: Callable[[str], None]) -> None:
    """Wait until every unit has been vented for a while, or for as long as that may take."""
    bound = rig.hardware.limits.depressurised
    period = rig.setup.period
    rested = 0
    for _ in range(round((VENT_TIME + REST_TIME) / period)):
        pressures = _sample(monitor).values[MU_PRESSURE:]
        rested = rested + 1 if (pressures < bound).all() else 0
        if rested * period >= REST_TIME:
            return
        show(f'venting: {" ".join(f"{1e-3 * p:.1f}" for p in pressures.tolist())} kPa')


def _sample(monitor: Monitor) -> Sample:
    sample = monitor.tick()
    if sample.fault:
        raise RuntimeError(sample.fault)
    return sample


def zero_table(zeroing: Zeroing, new: Calibration) -> Iterator[str]:
    """Yield the offsets before and after, a line for each sensor that zeroing can move."""
    old = zeroing.calibration
    yield f'{"sensor":16}{"old offset (V)":>16}{"new offset (V)":>16}  it read, vented'
    for i in sorted({*zeroing.channels, SOURCE_PRESSURE}):
        name, before, after = old.names()[i], old.sensors()[i], new.sensors()[i]
        assert isinstance(before, SensorCalibration)
        offsets = f'{name:16}{before.offset:16.5f}{after.offset:16.5f}'
        if i not in zeroing.channels:
            yield f'{offsets}  not zeroed: the source is on'
            continue
        read = before.zero_value + (after.offset - before.offset) * before.gain
        yield f'{offsets}  {read:.5g} {before.unit}'.rstrip()
