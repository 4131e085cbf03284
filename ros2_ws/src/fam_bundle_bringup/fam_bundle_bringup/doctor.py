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
``./fam doctor``: is everything there that a run or a rig needs? One line for each thing.

It must work where parts are broken: only the standard library is imported before a check begins,
and a check that fails is a line too. No card is opened, and nothing is changed.
"""

import argparse
from collections.abc import Callable, Iterable, Iterator, Sequence
import importlib
import importlib.metadata
import os
from pathlib import Path
import platform
import resource
import shutil
import sys
import threading
from typing import Any, NamedTuple

OK, WARNING, MISSING = 'ok', 'warning', 'missing'
COLOURS = {OK: '32', WARNING: '33', MISSING: '31'}

OLDEST_PYTHON, NEWEST_PYTHON = (3, 10), (3, 13)
NEEDED = ('numpy', 'scipy', 'matplotlib', 'rich', 'yaml')
FOR_BAGS = ('mcap', 'rosbags', 'pandas', 'plotly')
PACKAGES = 'fam_bundle_model', 'fam_bundle_control', 'fam_bundle_sim', 'fam_bundle_io'
LOOPBACK = 'fastdds_loopback.xml'
OVERRULING = ('ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')
GOOD_CLOCKS = ('tsc', 'kvm-clock', 'hyperv_clocksource_tsc_page', 'arch_sys_counter')
CLOCK = Path('/sys/devices/system/clocksource/clocksource0/current_clocksource')
REALTIME_KERNEL = Path('/sys/kernel/realtime')
RIGHTS = 'docs/performance.md#real-time-rights'
USUAL_PRIORITY = 20  # asked for where the configuration asks for none
FEWEST_CORES = 4
BYTES_PER_TICK = 420  # of a bag of two motor units behind the bridge, as measured
BAG_MINUTES = 10
IPC_LOCK = 14  # bit of the capability


class Result(NamedTuple):
    """What a check found, in words, and what to do about it."""

    state: str
    found: str
    cure: str = ''


# ---- The machine ----


def check_python() -> Result:
    """Check that this Python is one of those that we test with."""
    version = sys.version_info[:2]
    if OLDEST_PYTHON <= version <= NEWEST_PYTHON:
        return Result(OK, f'{platform.python_version()} at {sys.executable}')
    wanted = ' to '.join('.'.join(map(str, v)) for v in (OLDEST_PYTHON, NEWEST_PYTHON))
    return Result(MISSING, platform.python_version(), f'install Python {wanted}')


def check_packages(names: Sequence[str], lacking: str) -> Result:
    """Can these packages be imported? ``lacking`` is the state where one cannot."""
    broken = [trouble for name in names if (trouble := import_trouble(name))]
    if broken:
        return Result(lacking, '; '.join(broken), './fam setup, or install them for this Python')
    return Result(OK, ', '.join(f'{name} {version_of(name)}'.strip() for name in names))


def import_trouble(name: str) -> str:
    """Return why a module cannot be imported, or nothing."""
    try:
        importlib.import_module(name)
    except Exception as error:  # a broken package may raise anything
        return f'{name} ({words(error)})'
    return ''


def version_of(name: str) -> str:
    """Return the version of the distribution that holds a module, or nothing."""
    try:
        return importlib.metadata.version({'yaml': 'PyYAML'}.get(name, name))
    except importlib.metadata.PackageNotFoundError:
        return ''


def words(error: BaseException) -> str:
    """Return an error in one line."""
    text = ' '.join(str(error).split())
    return text or type(error).__name__


def check_kernel() -> Result:
    """Check whether the kernel keeps promises of time."""
    found = f'{platform.system()} {platform.release()}'
    if REALTIME_KERNEL.exists() or 'PREEMPT_RT' in platform.version():
        return Result(OK, f'{found}, PREEMPT_RT')
    return Result(WARNING, f'{found} without PREEMPT_RT', 'a wake-up may be late by milliseconds')


def check_clock(path: Path = CLOCK) -> Result:
    """Check that the steady clock is quick to read."""
    try:
        name = path.read_text().strip()
    except OSError as error:
        return Result(WARNING, f'unknown ({error.strerror})', 'it should be tsc')
    if name in GOOD_CLOCKS:
        return Result(OK, name)
    return Result(WARNING, name, 'slow to read: boot with clocksource=tsc if the machine has it')


def check_cores(mask: int) -> Result:
    """Check for cores enough for five nodes, and those that ``process.cpu_mask`` names."""
    cores = os.sched_getaffinity(0)
    absent = {cpu for cpu in range(mask.bit_length()) if mask >> cpu & 1} - cores
    if absent:
        found = f'process.cpu_mask = {mask:#x}: core {min(absent)} may not be used'
        return Result(WARNING, found, f'see {RIGHTS}')
    if len(cores) < FEWEST_CORES:
        found = f'{len(cores)} for five nodes'
        return Result(WARNING, found, 'commands come late at times: docs/performance.md#real-time')
    return Result(OK, f'{len(cores)}')


def check_disk(period: float, folder: Path) -> Result:
    """Check for room for a bag of ten minutes."""
    free = shutil.disk_usage(folder).free
    minutes = free / (BYTES_PER_TICK / period * 60.0)
    found = f'{free / 1e9:.1f} GB free at {folder.resolve()}: bags of {minutes:.0f} minutes'
    if minutes < BAG_MINUTES:
        return Result(WARNING, found, f'make room for {BAG_MINUTES} minutes')
    return Result(OK, found)


# ---- Real-time rights ----


def refusal(action: Callable[[], Any]) -> str:
    """Return why the system refuses ``action`` to a thread of its own, or nothing."""
    found: list[str] = []

    def attempt() -> None:
        try:
            action()
        except (OSError, AttributeError) as error:
            found.append(getattr(error, 'strerror', None) or words(error))

    thread = threading.Thread(target=attempt)
    thread.start()
    thread.join()
    return found[0] if found else ''


def check_priority(asked: int) -> Result:
    """Check whether SCHED_FIFO would be granted."""
    wanted = asked or USUAL_PRIORITY
    parameter = os.sched_param(wanted)
    refused = refusal(lambda: os.sched_setscheduler(0, os.SCHED_FIFO, parameter))
    asks = f'process.priority = {asked}' + ('' if asked else ': not asked for')
    if not refused:
        return Result(OK, f'SCHED_FIFO {wanted} granted; {asks}')
    limit = resource.getrlimit(resource.RLIMIT_RTPRIO)[0]
    found = f'SCHED_FIFO {wanted} refused ({refused}; limit {limit}); {asks}'
    return Result(WARNING, found, f'rtprio in /etc/security/limits.d: {RIGHTS}')


def check_memory_lock(*, asked: bool) -> Result:
    """Check whether all memory could be locked."""
    limit = resource.getrlimit(resource.RLIMIT_MEMLOCK)[0]
    asks = f'process.lock_memory = {str(asked).lower()}' + ('' if asked else ': not asked for')
    if limit == resource.RLIM_INFINITY or _has_capability(IPC_LOCK):
        return Result(OK, f'all memory may be locked; {asks}')
    found = f'only {limit / 1e6:.1f} MB may be locked; {asks}'
    return Result(WARNING, found, f'memlock in /etc/security/limits.d: {RIGHTS}')


def _has_capability(bit: int) -> bool:
    for line in Path('/proc/self/status').read_text().splitlines():
        if line.startswith('CapEff:'):
            return bool(int(line.split()[1], 16) >> bit & 1)
    return False


def check_timer_slack(asked: float) -> Result:
    """Check that the kernel would wake sleepers as punctually as the configuration asks."""
    from fam_bundle_node.tuning import set_timer_slack

    if asked == 0.0:
        return Result(OK, 'process.timer_slack = 0: not asked for')
    refused = refusal(lambda: set_timer_slack(asked))
    asks = f'process.timer_slack = {asked:g} s'
    if refused:
        return Result(WARNING, f'{asks} refused ({refused})', RIGHTS)
    return Result(OK, f'{asks} granted')


# ---- ROS ----


def check_ros() -> Result:
    """Check that nodes can be made and our messages be sent."""
    needed = ('rclpy', 'std_srvs.srv', 'fam_bundle_msgs.msg', 'fam_bundle_msgs.srv', *PACKAGES)
    broken = [trouble for name in needed if (trouble := import_trouble(name))]
    if broken:
        return Result(MISSING, '; '.join(broken), './fam setup, or source the workspace')
    import rclpy.utilities

    distribution = os.environ.get('ROS_DISTRO', 'jazzy, from wheels')
    found = f'rclpy of {distribution}, {rclpy.utilities.get_rmw_implementation_identifier()}'
    return Result(OK, f'{found}, messages built')


def check_middleware() -> Result:
    """Check that nodes that are started from here stay on this machine."""
    from ament_index_python.packages import get_package_share_directory

    share = Path(get_package_share_directory('fam_bundle_bringup'))
    ours = (share / 'config' / LOOPBACK).resolve()
    if not ours.exists():
        return Result(MISSING, f'{ours}', './fam setup: without it every network would be used')
    profile = Path(os.environ.get('FASTRTPS_DEFAULT_PROFILES_FILE', ''))
    wrong = [f'{name} is set' for name in OVERRULING if name in os.environ]
    if os.environ.get('RMW_IMPLEMENTATION') != 'rmw_fastrtps_cpp':
        wrong.append('RMW_IMPLEMENTATION is not rmw_fastrtps_cpp')
    if os.environ.get('ROS_AUTOMATIC_DISCOVERY_RANGE') != 'SYSTEM_DEFAULT':
        wrong.append('ROS_AUTOMATIC_DISCOVERY_RANGE is not SYSTEM_DEFAULT')
    if profile.resolve() != ours:
        wrong.append(f'FASTRTPS_DEFAULT_PROFILES_FILE is not {LOOPBACK}')
    if wrong:
        cure = './fam sets it for what it starts; by hand: docs/architecture.md#real-time'
        return Result(WARNING, '; '.join(wrong), cure)
    return Result(OK, f'loopback only ({LOOPBACK})')


# ---- Backend, hardware file, configuration ----


def check_backend(name: str) -> Result:
    """Is the backend registered, and its vendor's package there? No card is asked."""
    from fam_bundle_io.hardware.backend import BackendError, load_backend

    try:
        module = importlib.import_module(type(load_backend(name)).__module__)
        if hasattr(module, 'import_vendor'):
            module.import_vendor()
            return Result(OK, f"{name}, and the vendor's package; the card itself is not asked")
    except BackendError as error:
        return Result(MISSING, str(error).removeprefix('backend '))
    return Result(OK, name)


def check_hardware(path: Path | None, backend: str) -> Result:
    """Check that the hardware file is whole and made for this rig."""
    from fam_bundle_bringup.bridge_options import simulated_hardware
    from fam_bundle_io.hardware.backend import made_up, MOVE_NOTHING, SIMULATED
    from fam_bundle_io.hardware.calibration import load_hardware
    from fam_bundle_model.schema import ConfigurationError

    if path is None:
        if backend not in SIMULATED:
            cure = 'copy config/hardware_calibration_template.yaml, fill it in: docs/hardware.md'
            return Result(MISSING, 'no --hardware FILE', cure)
        path = simulated_hardware()
    blank = unfilled(path)
    if blank:
        more = f' and {len(blank) - 4} more' if len(blank) > 4 else ''
        found = f'{path}: {len(blank)} values not filled in: {", ".join(blank[:4])}{more}'
        return Result(MISSING, found, 'measure them: docs/hardware.md')
    try:
        hardware = load_hardware(path)
    except ConfigurationError as error:
        return Result(MISSING, str(error))
    calibration = hardware.calibration
    inputs, outputs = len(calibration.sensors()), len(calibration.valves)
    found = f'{calibration.id}: {inputs} inputs, {outputs} outputs, hash {calibration.hash()[:12]}'
    if backend in MOVE_NOTHING:
        return Result(OK, found)
    invented = made_up(calibration)
    if invented:
        more = f' and {len(invented) - 1} more' if invented[1:] else ''
        found = f'{path}: {invented[0]}{more}: that of the simulated rig'
        return Result(MISSING, found, 'name the certificate or record of each of your own')
    if backend not in hardware.options:
        return Result(WARNING, f'{found}; no options in backends.{backend}', 'which card?')
    if hardware.limits.frozen_samples == 0:
        cure = 'a transducer that hangs is not seen: 500'
        return Result(WARNING, f'{found}; limits.frozen_samples = 0', cure)
    return Result(OK, found)


def unfilled(path: Path) -> list[str]:
    """Return the names of all values that a YAML file leaves blank; none where it is no YAML."""
    import yaml

    try:
        content = yaml.safe_load(path.read_text(encoding='utf-8'))
    except (OSError, ValueError, yaml.YAMLError):
        return []
    return list(_blanks('', content)) if isinstance(content, dict) else []


def _blanks(name: str, content: Any) -> Iterator[str]:
    if content is None:
        yield name
    inner: Iterable[tuple[str, Any]] = ()
    if isinstance(content, dict):
        inner = ((f'{name}.{key}'.lstrip('.'), value) for key, value in content.items())
    elif isinstance(content, list):
        inner = ((f'{name}[{i}]', value) for i, value in enumerate(content))
    for key, value in inner:
        yield from _blanks(key, value)


def check_configuration(path: Path | None, hardware: Path | None, backend: str) -> Result:
    """Check that the parameter file is valid and of as many motor units as the hardware file."""
    from fam_bundle_bringup.bridge_options import simulated_hardware
    from fam_bundle_bringup.experiment import checked_configuration, default_configuration
    from fam_bundle_io.hardware.backend import SIMULATED
    from fam_bundle_io.hardware.calibration import load_hardware
    from fam_bundle_model.doubts import doubts
    from fam_bundle_model.schema import ConfigurationError

    path = path or default_configuration()
    try:
        configuration = checked_configuration(path)
    except ConfigurationError as error:
        return Result(MISSING, str(error))
    units = len(configuration.fam.count)
    found = f'{path.name}: {units} motor units, hash {configuration.hash()[:12]}'
    doubted = doubts(configuration)
    good = Result(WARNING, f'{found}; {"; ".join(doubted)}') if doubted else Result(OK, found)
    if hardware is None and backend not in SIMULATED:
        return good
    try:
        rig = load_hardware(hardware or simulated_hardware())
    except ConfigurationError:
        return good  # a line of its own says so
    valves = len(rig.calibration.valves)
    if valves != units:
        return Result(MISSING, f'{found}, but {valves} valves in the hardware file')
    return good


# ---- All of it ----


class Asked(NamedTuple):
    """What the configuration asks of the machine, or its defaults where it cannot be read."""

    backend: str = 'volts'
    priority: int = 0
    cpu_mask: int = 0
    lock_memory: bool = False
    timer_slack: float = 1e-6
    period: float = 1e-3


def asked_by(path: Path | None) -> Asked:
    """Return what a configuration asks of the machine."""
    try:
        from fam_bundle_bringup.experiment import default_configuration
        from fam_bundle_model.parameters import load_configuration

        found = load_configuration(path or default_configuration())
    except Exception:  # its own line says why
        return Asked()
    p = found.process
    return Asked(
        found.bridge.backend,
        p.priority,
        p.cpu_mask,
        p.lock_memory,
        p.timer_slack,
        found.simulation.period,
    )


def checks(
    backend: str | None, hardware: Path | None, config: Path | None
) -> list[tuple[str, Callable[[], Result]]]:
    """Return the name of every check and what makes it."""
    asked = asked_by(config)
    card = backend or asked.backend
    return [
        ('Python', check_python),
        ('packages', lambda: check_packages(NEEDED, MISSING)),
        ('compiled laws', lambda: check_packages(('numba',), WARNING)),
        ('bags', lambda: check_packages(FOR_BAGS, WARNING)),
        ('ROS', check_ros),
        ('network', check_middleware),
        ('priority', lambda: check_priority(asked.priority)),
        ('memory lock', lambda: check_memory_lock(asked=asked.lock_memory)),
        ('timer slack', lambda: check_timer_slack(asked.timer_slack)),
        ('kernel', check_kernel),
        ('clock', check_clock),
        ('cores', lambda: check_cores(asked.cpu_mask)),
        ('disk', lambda: check_disk(asked.period, Path())),
        ('backend', lambda: check_backend(card)),
        ('hardware file', lambda: check_hardware(hardware, card)),
        ('configuration', lambda: check_configuration(config, hardware, card)),
    ]


def examine(check: Callable[[], Result]) -> Result:
    """Return the result of a check, also where the check itself breaks."""
    try:
        return check()
    except Exception as error:
        return Result(MISSING, f'could not be checked ({type(error).__name__}: {words(error)})')


def line(name: str, result: Result, *, coloured: bool) -> str:
    """Return a result as a line."""
    state = f'{result.state:8}'
    if coloured:
        state = f'\x1b[{COLOURS[result.state]}m{state}\x1b[0m'
    cure = f': {result.cure}' if result.cure else ''
    return f'{state} {name:14} {result.found}{cure}'


def add_doctor_options(command: argparse.ArgumentParser) -> None:
    """Add the options."""
    command.add_argument(
        '--backend', metavar='NAME', help='what drives the card (default: as configured, volts)'
    )
    command.add_argument('--hardware', type=Path, metavar='FILE', help='hardware file of the rig')
    command.add_argument(
        '--config', type=Path, help='parameter file (default: the rig of the paper, lhacd.yaml)'
    )


def run_doctor(options: argparse.Namespace) -> int:
    """Print a line for each check; status 1 when something that is needed is missing."""
    coloured = sys.stdout.isatty() and 'NO_COLOR' not in os.environ
    found = {OK: 0, WARNING: 0, MISSING: 0}
    for name, check in checks(options.backend, options.hardware, options.config):
        result = examine(check)
        found[result.state] += 1
        print(line(name, result, coloured=coloured), flush=True)
    print(', '.join(f'{count} {state}' for state, count in found.items()))
    return 1 if found[MISSING] else 0


def main() -> int:
    """Run the command by itself: that of the whole command line needs all packages."""
    from fam_bundle_bringup.one_line_parser import Parser

    parser = Parser(prog='fam doctor', description='Is everything there? One line each.')
    add_doctor_options(parser)
    try:
        return run_doctor(parser.parse_args())
    except KeyboardInterrupt:
        return 130


if __name__ == '__main__':
    sys.exit(main())
