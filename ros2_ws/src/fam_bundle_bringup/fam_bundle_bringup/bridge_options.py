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

"""The options by which an experiment goes through the hardware bridge."""

import argparse
from pathlib import Path
import sys

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_io.hardware.backend import backend_names, check_rig, SIMULATED
from fam_bundle_io.hardware.calibration import HardwareFile, load_hardware
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError


def add_bridge_options(command: argparse.ArgumentParser) -> None:
    """Add the options to a command."""
    command.add_argument(
        '--backend',
        metavar='NAME',
        help='through the hardware bridge and this card in place of the plant simulator: volts '
        '(the plant behind simulated volts), or a rig: quanser, nidaqmx',
    )
    command.add_argument(
        '--hardware',
        type=Path,
        metavar='FILE',
        help='calibration and limits of the rig (default, for volts: that of the simulated one)',
    )


def check_backend_name(backend: str) -> None:
    """Raise ConfigurationError unless ``backend`` is registered."""
    if backend not in backend_names():
        known = ', '.join(backend_names())
        raise ConfigurationError(f'--backend {backend}: not known; there are: {known}')


def check_backend(backend: str | None, options: argparse.Namespace) -> None:
    """Raise ConfigurationError where options do not fit together for a hardware bridge."""
    if backend is None:
        if options.hardware is not None:
            raise ConfigurationError('--hardware: of which card? name it with --backend')
        return
    check_backend_name(backend)
    if options.composed:
        raise ConfigurationError('--backend: not with --composed')
    if options.pace == 'offline':
        raise ConfigurationError('--backend: --pace offline has no bridge')
    if backend in SIMULATED:
        return
    check_hardware_is_named(options.hardware, backend)
    if options.pace != 'realtime':
        raise ConfigurationError(f'--backend {backend}: needs --pace realtime')


def check_hardware_is_named(path: Path | None, backend: str) -> None:
    """Raise ConfigurationError where ``backend`` has no hardware file, and there is no default."""
    if path is None and backend not in SIMULATED:
        raise ConfigurationError(
            f'--backend {backend}: needs --hardware FILE, the calibration of this very rig'
        )


def hardware_of(
    backend: str | None, path: Path | None, configuration: Configuration
) -> HardwareFile | None:
    """
    Return the rig that the options ask for; on a real one valves move only if told so.

    Raises ConfigurationError.
    """
    if backend is None:
        return None
    hardware = rig_for(path, configuration, backend)
    if backend not in SIMULATED and not agreed():
        raise ConfigurationError(f'--backend {backend}: the valves were not told to move')
    return hardware


def simulated_hardware() -> Path:
    """Return the hardware file of the simulated rig."""
    return default_configuration().with_name('volts_calibration.yaml')


def rig_for(path: Path | None, configuration: Configuration, backend: str) -> HardwareFile:
    """
    Return the rig in ``path``, the simulated one if there is none and ``backend`` needs no other.

    Raises ConfigurationError where it is no rig for ``backend`` or this bundle.
    """
    check_hardware_is_named(path, backend)
    path = path or simulated_hardware()
    hardware = load_hardware(path)
    check_rig(hardware, path, backend, len(configuration.fam.count))
    return hardware


def agreed() -> bool:
    """Ask whether valves may move; no without a terminal."""
    if not sys.stdin.isatty():
        return False
    print('This moves the valves of a real rig. Go through docs/hardware.md first.')
    return input("Type 'arm' to go on: ").strip() == 'arm'
