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

"""The numbers of a report: what each recorded run tells, and what its bag lacks."""

from collections.abc import Sequence
import contextlib
import math
from pathlib import Path
from typing import Any, NamedTuple

from fam_bundle_io.bag import (
    Bag,
    LOOP,
    loop_topics,
    read_bag,
    recorded_configuration,
    Run,
    runs_of,
    STATE,
    trace_of,
)
from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.energy import energy, energy_by_state, Powers, powers
from fam_bundle_io.metrics import (
    shift_times,
    steps,
    time_at_source,
    time_in_state,
    tracking,
    whole_cycles,
    Window,
)
from fam_bundle_io.timing import applied_spool, spread, Timing, timing
from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import numpy.typing as npt

LONGEST_GAP = 1.0  # s between two ticks
OIL_MISMATCH = 0.02  # between modelled and measured flow, beyond which losses are doubtful
# What the energies are computed from.
ENERGETIC = {'strain', 'force', 'source_pressure', 'source_flow', 'mu_pressure', 'spool'}
FINITE = ENERGETIC | {'strain_reference', 'pressure_reference'}  # predicted times may be infinite


class ReportedRun(NamedTuple):
    """One recorded run: the ``numbers`` of ``report.json``, and what they were computed from."""

    name: str
    numbers: dict[str, Any]
    trace: Trace
    missing: frozenset[str]
    configuration: Configuration | None
    powers: Powers | None
    timing: Timing


def reported_runs(
    path: Path, name: str, given: Configuration | None = None
) -> tuple[list[ReportedRun], list[str]]:
    """
    Return the last run of every bundle in the bag at ``path``, and what is wrong with it.

    ``given`` takes the place of the configuration in the bag. Raises BagError when nothing can be
    read.
    """
    bag = read_bag(path)
    warnings, recorded = list(bag.warnings), None
    try:
        recorded = recorded_configuration(bag)
    except ConfigurationError as error:
        warnings.append(f'{error}: not used')
    if given is not None and recorded is not None and given != recorded:
        warnings.append('the parameters are those of --config, not those in the bag')
    configuration = given or recorded
    if configuration is None:
        warnings.append(
            "no parameters in the bag: cycles are taken from the reference's valleys, and there "
            'are no energies; name the parameter file with --config'
        )
    runs = []
    for namespace in loop_topics(bag):
        try:
            run = trace_of(bag, namespace)
            found = _reported(bag, run, namespace, f'{name}{namespace}', configuration)
        except BagError as error:
            warnings.append(f'{error}')
            continue
        found.numbers['bag'] = str(path)
        found.numbers['warnings'] = [*warnings, *found.numbers['warnings']]
        runs.append(found)
    if not runs:
        topics = ', '.join(sorted(bag.tables))
        warnings.append(f'no run of a bundle in it; its topics: {topics}')
    return runs, warnings


def names_of(paths: Sequence[Path]) -> list[str]:
    """
    Return a short name for each bag: the ends of their paths as far as they differ.

    Raises BagError when the same bag is named twice.
    """
    parts = [path.resolve().parts for path in paths]
    # An experiment's bag is DIR/bag: its folder tells more.
    parts = [p[:-1] if p[-1] == 'bag' and len(p) > 2 else p for p in parts]
    for length in range(1, max(map(len, parts)) + 1):
        names = ['/'.join(p[-length:]).encode(errors='replace').decode() for p in parts]
        if len(set(names)) == len(names):
            return names
    twice = next(path for path in paths if parts.count(parts[paths.index(path)]) > 1)
    raise BagError(f'{twice}: named twice')


def last_cycle_of(run: ReportedRun) -> Window | None:
    """Return the cycle that the metrics of a run are over, if there is one."""
    if not run.numbers['cycles']:
        return None
    last = run.numbers['cycles'][-1]
    return Window(last['metrics_from'], last['metrics_to'])


def _reported(
    bag: Bag, run: Run, namespace: str, name: str, configuration: Configuration | None
) -> ReportedRun:
    trace, warnings = run.trace, list(run.warnings)
    if 'time' in run.missing:
        raise BagError(f'{namespace}/bundle_state: has no time of its samples')
    if configuration is not None and len(configuration.fam.count) != trace['spool'].shape[1]:
        warnings.append(
            f'the parameters are of {len(configuration.fam.count)} motor units, the bag of '
            f'{trace["spool"].shape[1]}: not used'
        )
        configuration = None
    warnings += _checked_times(trace['time'], namespace)
    warnings += _gaps(trace, run.missing)
    runs = int(runs_of(bag.tables[f'{namespace}/{LOOP[STATE]}']).max()) + 1
    if runs > 1:
        warnings.append(f'{runs} runs in the bag: this is the last')
    changes = bag.tables.get(f'{namespace}/parameter_changes')
    if changes is not None and len(changes):
        warnings.append(
            f'{plural(len(changes), "change")} of parameters while the nodes ran '
            f'({namespace}/parameter_changes): the hash is that of the first ones'
        )
    time, step = trace['time'], steps(trace)
    whole = Window(float(time[0]), float(time[-1] + step[-1]))
    told = configuration is not None or 'strain_reference' not in run.missing
    cycles = whole_cycles(trace, configuration) if told else []
    warnings += _shortness(cycles, whole, run, configuration)
    lacking = sorted(ENERGETIC & run.missing)
    found = None
    if configuration is not None and not lacking:
        found = powers(trace, configuration, applied_spool(bag, run, namespace))
    elif lacking:
        warnings.append(f'no energies without {", ".join(lacking)}')
    times = timing(bag, run, namespace)
    warnings += times.doubts
    safe = None
    if times.safe is None:
        warnings.append('the bag does not tell when the plant was safe')
    else:
        duration = sum(phase.stop - phase.start for phase in times.safe)
        safe = {'time': duration, 'phases': len(times.safe)}
        if times.safe:
            warnings.append(
                f'the plant was safe, open to the tank, for {duration:.3f} s in '
                f'{plural(len(times.safe), "phase")}'
            )
    whole_numbers = _window_numbers(trace, run.missing, found, whole)
    warnings += _doubts(whole_numbers['energy'])
    numbers = {
        'namespace': namespace,
        'warnings': warnings,
        'scheme': configuration.recruitment.scheme if configuration else None,
        'pace': configuration.run.pace if configuration else None,
        'parameters_hash': configuration.hash() if configuration else None,
        'ticks': len(time),
        'start': whole.start,
        'stop': whole.stop,
        'safe': safe,
        **_window_numbers(trace, run.missing, found, cycles[-1] if cycles else None),
        'whole_run': whole_numbers,
        'cycles': [_window_numbers(trace, run.missing, found, cycle) for cycle in cycles],
        'timing': _timing_numbers(times),
    }
    return ReportedRun(name, numbers, trace, run.missing, configuration, found, times)


def _shortness(
    cycles: list[Window], whole: Window, run: Run, configuration: Configuration | None
) -> list[str]:
    """Return in words where the run is no whole one."""
    words = []
    step = float(steps(run.trace)[-1])
    if configuration is not None and whole.stop < configuration.duration() - 2.0 * step:
        words.append(
            f'the run ends at {whole.stop:g} s of {configuration.duration():g} s: metrics are '
            'over the last whole cycle in the bag'
        )
    if whole.start > 2.0 * step:
        words.append(f'the bag begins {whole.start:g} s after the run')
    if not cycles:
        words.append('no whole cycle of the reference in the bag: no metrics over a cycle')
    return words


def _checked_times(time: npt.NDArray[np.float64], namespace: str) -> list[str]:
    """Return what is odd about the times of the ticks; raises BagError where they are none."""
    name = f'{namespace}/{LOOP[STATE]}'
    if len(time) < 2:
        raise BagError(f'{name}: one tick is no run')
    gap = np.diff(time)
    if not np.all(gap > 0.0):
        at = int(np.argmin(gap > 0.0))
        raise BagError(f'{name}: its stamps do not rise after {time[at]:g} s')
    at = int(np.argmax(gap))
    if gap[at] <= LONGEST_GAP:
        return []
    return [f'nothing for {gap[at]:g} s after {time[at]:g} s: what is summed over it is doubtful']


def _gaps(trace: Trace, missing: frozenset[str]) -> list[str]:
    """Return which measured signals are not finite, and how often."""
    words = []
    for name in sorted(FINITE - missing):
        values = trace[name].reshape(len(trace['time']), -1)
        count = int(np.count_nonzero(~np.isfinite(values).all(axis=1)))
        if count:
            words.append(
                f'{name}: not finite at {plural(count, "tick")}: no metrics of such a cycle'
            )
    return words


def _doubts(energies: dict[str, Any] | None) -> list[str]:
    off = energies['modelled_oil'] - 1.0 if energies else 0.0
    if not abs(off) > OIL_MISMATCH:
        return []
    return [
        f'the modelled flow of the units is {abs(off):.1%} {"above" if off > 0.0 else "below"} '
        'the measured one: the losses in valves and hoses are that uncertain'
    ]


def _window_numbers(
    trace: Trace, missing: frozenset[str], found: Powers | None, window: Window | None
) -> dict[str, Any]:
    """Return the metrics over a window; None for what cannot be told."""
    numbers: dict[str, Any] = dict.fromkeys(
        (
            'metrics_from',
            'metrics_to',
            'iae',
            'max_error',
            'upshift_times',
            'downshift_times',
            'time_in_state',
            'time_at_source',
            'energy',
            'energy_in_state',
        )
    )
    if window is None:
        return numbers
    numbers |= {'metrics_from': window.start, 'metrics_to': window.stop}
    if not {'strain', 'strain_reference'} & missing:
        with contextlib.suppress(ValueError):  # fewer than two ticks
            found_tracking = tracking(trace, *window)
            if np.isfinite(found_tracking).all():
                numbers |= found_tracking._asdict()
    if 'recruitment_state' not in missing:
        up, down = shift_times(trace)
        numbers['upshift_times'] = [t for t in up if window.start <= t < window.stop]
        numbers['downshift_times'] = [t for t in down if window.start <= t < window.stop]
        states = time_in_state(trace, window)
        numbers['time_in_state'] = {str(state): time for state, time in states.items()}
    numbers['time_at_source'] = time_at_source(trace, window)
    if found is not None:
        with contextlib.suppress(ValueError):  # not finite
            numbers['energy'] = energy(trace, found, window)._asdict()
            if 'recruitment_state' not in missing:
                spent = energy_by_state(trace, found, window)
                numbers['energy_in_state'] = {str(k): e._asdict() for k, e in spent.items()}
    return numbers


def _timing_numbers(times: Timing) -> dict[str, Any]:
    def words(values: Any) -> dict[str, float] | None:
        found = spread(values)
        return None if found is None else found._asdict()

    return {
        'samples': times.samples,
        'interval': words(times.interval),
        'answers': {topic: words(values) for topic, values in times.answers.items()},
        'unanswered': {topic: times.samples - n for topic, n in times.answered.items()},
        'nodes': times.nodes,
    }


def plural(count: float, word: str) -> str:
    """Return a count with its noun."""
    return f'{count:g} {word}' if count == 1 else f'{count:g} {word}s'


def without_nan(content: Any) -> Any:
    """Return ``content`` with None for every number that is not finite, as JSON has none."""
    if isinstance(content, dict):
        return {str(name): without_nan(value) for name, value in content.items()}
    if isinstance(content, list | tuple):
        return [without_nan(value) for value in content]
    if isinstance(content, float) and not math.isfinite(content):
        return None
    return content
