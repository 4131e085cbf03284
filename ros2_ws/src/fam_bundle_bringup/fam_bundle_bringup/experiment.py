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

"""One experiment: check, run at a pace, and write its folder."""

from collections.abc import Callable, Iterable, Mapping
import dataclasses
import importlib.metadata
import json
import os
from pathlib import Path
import platform
from typing import Any, NamedTuple

from fam_bundle_bringup.failure import RunFailed
from fam_bundle_bringup.graph import run_graph
from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.completeness import ANSWERS
from fam_bundle_io.energy import energy, powers, summary
from fam_bundle_io.hardware.calibration import HardwareFile, write_hardware
from fam_bundle_io.metrics import shift_times, Tracking, tracking, Window
from fam_bundle_io.trace import save_trace, Trace
from fam_bundle_model.bundle import check_reachable, motor_units
from fam_bundle_model.parameters import (
    check_period,
    Configuration,
    load_configuration,
    write_yaml,
)
from fam_bundle_model.schema import ConfigurationError

PACES = ('lockstep', 'realtime', 'offline')
RESULTS = ('metrics.json', 'trace.npz', 'loop_statistics.json')
LARGEST_RUN = 20_000_000  # ticks that a trace in memory can hold


class Result(NamedTuple):
    """Trace of a run and its metrics over ``last_cycle``."""

    trace: Trace
    metrics: dict[str, Any]


def default_configuration() -> Path:
    """Return the installed configuration of the paper's rig."""
    from ament_index_python.packages import get_package_share_directory

    return Path(get_package_share_directory('fam_bundle_bringup')) / 'config' / 'lhacd.yaml'


def checked_configuration(
    path: Path, changes: Mapping[str, Mapping[str, Any]] | None = None, *, offline: bool = False
) -> Configuration:
    """
    Return the configuration in ``path`` with ``changes`` if the rig can do what it asks.

    Raises ConfigurationError naming parameter, value and bound.
    """
    configuration = load_configuration(path, changes)
    check_feasible(configuration, offline=offline)
    return configuration


def check_feasible(configuration: Configuration, *, offline: bool = True) -> None:
    """
    Raise ConfigurationError, naming parameter, value and bound, unless the rig can run it.

    ``offline`` tells that there is no graph, from which a live reference could come.
    """
    if offline and configuration.reference.kind == 'topic':
        raise ConfigurationError('reference.kind = topic: a run offline has no topics')
    check_reachable(configuration, motor_units(configuration))
    check_length(configuration)


def check_length(configuration: Configuration) -> None:
    """Raise ConfigurationError where a run has too few ticks for its reference, or too many."""
    period, ticks = configuration.simulation.period, configuration.ticks()
    reference = configuration.reference
    check_period(reference, period)
    if ticks > LARGEST_RUN:
        given = f'reference.cycles = {reference.cycles}'
        bound = f'{LARGEST_RUN * reference.cycles // ticks}'
        if reference.kind == 'samples':
            given = f'reference.times[{len(reference.times) - 1}] = {reference.times[-1]:g} s'
            bound = f'{LARGEST_RUN * period:g} s'
        raise ConfigurationError(
            f'{given}: must be <= {bound}, for a trace holds at most {LARGEST_RUN} ticks'
        )


def last_cycle(configuration: Configuration) -> tuple[float, float]:
    """
    Return start and end of the last cycle in s: the settled one, if there are two.

    The whole run where the reference does not repeat.
    """
    return configuration.cycles()[-1]


def measure_tracking(configuration: Configuration, trace: Trace) -> Tracking:
    """Return IAE and largest error over the last cycle, or the whole run if nothing repeats."""
    return tracking(trace, *last_cycle(configuration))


def versions() -> dict[str, str]:
    """Return the versions of what shapes a result."""
    found = {'python': platform.python_version()}
    for name in ('fam_bundle_bringup', 'numpy', 'scipy', 'numba'):
        try:
            found[name] = importlib.metadata.version(name)
        except importlib.metadata.PackageNotFoundError:
            found[name] = 'none'
    return found


def energy_of(
    configuration: Configuration, trace: Trace, window: Window
) -> dict[str, float | None] | None:
    """Return what was spent within ``window``; None where a sensor gave no number."""
    try:
        return summary(energy(trace, powers(trace, configuration), window))
    except ValueError:
        return None


def metrics_of(configuration: Configuration, pace: str, trace: Trace) -> dict[str, Any]:
    """Return what ``metrics.json`` holds."""
    start, stop = last_cycle(configuration)
    up, down = shift_times(trace)
    return {
        'scheme': configuration.recruitment.scheme,
        **measure_tracking(configuration, trace)._asdict(),
        'ticks': len(trace['time']),
        'upshift_times': up,
        'downshift_times': down,
        'energy': energy_of(configuration, trace, Window(start, stop)),
        'metrics_from': start,
        'metrics_to': stop,
        'upshift_threshold': configuration.recruitment.upshift_threshold,
        'pace': pace,
        'parameters_hash': configuration.hash(),
        'versions': versions(),
    }


def loop_of(reports: list[dict[str, Any]]) -> dict[str, Any]:
    """Return what the plant's loop statistics come to: counts, and every state but 'running'."""
    owners = ('/plant_simulator', '/hardware_bridge')
    plant = [report for report in reports if report['node'].endswith(owners)]
    last = plant[-1] if plant else {}
    counts = ('missing', 'late', 'duplicate', 'out_of_order', 'refused')
    return {
        'answered': last.get('ticks', 0),
        **{name: last.get(name, 0) for name in ('skipped_periods', 'overruns', *counts)},
        'states': list(dict.fromkeys(r['state'] for r in plant if r['state'] != 'running')),
    }


def with_bridge(
    configuration: Configuration, pace: str, hardware: HardwareFile, path: Path
) -> Configuration:
    """
    Write ``hardware`` to ``path`` and return the configuration of a bridge that uses it.

    A simulated rig takes the pace of the run, and rests until the first command.
    """
    volts = {'pace': 'steady' if pace == 'realtime' else 'lockstep', 'hold': True}
    options = {**hardware.options, 'volts': {**hardware.options.get('volts', {}), **volts}}
    write_hardware(dataclasses.replace(hardware, options=options), path)
    bridge = dataclasses.replace(configuration.bridge, hardware=str(path.resolve()), start='armed')
    return dataclasses.replace(configuration, bridge=bridge)


def bag_of(bag: Path) -> dict[str, Any]:
    """Return what the recorder says of its bag: what is missing, and what recording took."""
    import yaml

    content = yaml.safe_load((bag / 'metadata.yaml').read_text())
    said = content['rosbag2_bagfile_information']
    notes = said['custom_data']
    cost = {
        name: float(notes[f'fam_bundle.recorder.{name}'])
        for name in ('elapsed', 'cpu_time', 'peak_memory')
    }
    return {
        'messages': said['message_count'],
        'missing': json.loads(notes['fam_bundle.completeness.missing']),
        'unanswered': {
            topic: json.loads(notes[f'fam_bundle.completeness.{topic}']).get('unanswered', 0)
            for topic in (f'/{name}' for name in ANSWERS)
            if f'fam_bundle.completeness.{topic}' in notes
        },
        'cpu_share': cost['cpu_time'] / cost['elapsed'],
        'peak_memory': cost['peak_memory'],
    }


def prepare_folder(folder: Path, results: Iterable[str]) -> None:
    """
    Make ``folder`` and take away ``results`` of an earlier call in it.

    Raises ConfigurationError when it cannot be written to.
    """
    try:
        folder.mkdir(parents=True, exist_ok=True)
        for name in results:
            (folder / name).unlink(missing_ok=True)
    except OSError as error:
        raise ConfigurationError(f'--out {folder}: cannot be written ({error.strerror})') from None
    if not os.access(folder, os.W_OK):
        raise ConfigurationError(f'--out {folder}: cannot be written')


def run_experiment(
    configuration: Configuration,
    pace: str,
    folder: Path,
    progress: Callable[[int], None] | None = None,
    *,
    composed: bool = False,
    hardware: HardwareFile | None = None,
    record: bool = False,
) -> Result:
    """
    Run ``configuration`` and write its parameters, trace and metrics to ``folder``.

    With ``hardware`` the hardware bridge takes the place of the plant simulator.
    With ``record`` all topics go to the bag ``folder / 'bag'``, which must not exist.
    Raises ConfigurationError when ``folder`` cannot be written, and RunFailed when the run
    ends early; the trace of the ticks until then is kept.
    """
    prepare_folder(folder, RESULTS)
    if hardware is not None:
        configuration = with_bridge(configuration, pace, hardware, folder / 'hardware.yaml')
    write_yaml(configuration, folder / 'parameters.yaml')
    try:
        if pace == 'offline':
            trace = run_offline(configuration, progress)
        else:
            run = dataclasses.replace(configuration.run, pace=pace)
            paced = dataclasses.replace(configuration, run=run)
            trace = run_graph(
                paced,
                folder,
                progress,
                composed=composed,
                bridge=hardware is not None,
                record=record,
            )
    except RunFailed as error:
        save_trace(error.trace, folder / 'trace.npz')
        raise
    save_trace(trace, folder / 'trace.npz')
    try:
        metrics = metrics_of(configuration, pace, trace)
    except ValueError as error:
        raise RunFailed(f'no metrics: {error}', trace) from None
    if record:
        metrics['bag'] = bag_of(folder / 'bag')
    if pace == 'realtime':
        metrics['loop'] = loop_of(json.loads((folder / 'loop_statistics.json').read_text()))
    write_json(metrics, folder / 'metrics.json')
    return Result(trace, metrics)
