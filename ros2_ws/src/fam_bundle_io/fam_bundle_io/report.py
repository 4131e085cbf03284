# SPDX-License-Identifier: Apache-2.0
"""The numbers of a report: what each recorded run tells, and what its bag lacks."""

import contextlib
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

from fam_bundle_io.bag import (
    Bag,
    Run,
    loop_topics,
    read_bag,
    recorded_configuration,
    trace_of,
)
from fam_bundle_io.bag_writer import BagError
from fam_bundle_io.energy import Powers, energy, powers
from fam_bundle_io.metrics import (
    Window,
    shift_times,
    steps,
    time_at_source,
    time_in_state,
    tracking,
    whole_cycles,
)
from fam_bundle_io.timing import Timing, applied_spool, phases, spread, timing
from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError

OIL_MISMATCH = 0.02  # between modelled and measured flow, beyond which losses are doubtful
# What the energies are computed from.
ENERGETIC = {'strain', 'force', 'source_pressure', 'source_flow', 'mu_pressure', 'spool'}


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
    """Return the last run of every bundle in the bag at ``path``, and what is wrong with it.

    ``given`` stands in for the configuration where the bag holds none. Raises BagError when
    nothing can be read.
    """
    bag = read_bag(path)
    warnings, configuration = list(bag.warnings), given
    try:
        configuration = recorded_configuration(bag) or given
    except ConfigurationError as error:
        warnings.append(f'{error}: not used')
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
    """Return a short name for each bag: the ends of their paths as far as they differ.

    Raises BagError when the same bag is named twice.
    """
    parts = [path.resolve().parts for path in paths]
    # An experiment's bag is DIR/bag: its folder tells more.
    parts = [p[:-1] if p[-1] == 'bag' and len(p) > 2 else p for p in parts]
    for length in range(1, max(map(len, parts))):
        names = ['/'.join(p[-length:]) for p in parts]
        if len(set(names)) == len(names):
            return names
    twice = next(path for path in paths if parts.count(parts[paths.index(path)]) > 1)
    raise BagError(f'{twice}: named twice')


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
    if found is not None:
        warnings += _doubts(energy(trace, found, whole).modelled_oil)
    times = timing(bag, run, namespace)
    safe = {'time': float((step * times.safe).sum()), 'phases': len(phases(times.safe))}
    if safe['phases']:
        warnings.append(
            f'the plant was safe, open to the tank, for {safe["time"]:.3f} s in '
            f'{plural(safe["phases"], "phase")}'
        )
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
        'whole_run': _window_numbers(trace, run.missing, found, whole),
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


def _doubts(modelled_oil: float) -> list[str]:
    off = modelled_oil - 1.0
    if abs(off) <= OIL_MISMATCH:
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
        )
    )
    if window is None:
        return numbers
    numbers |= {'metrics_from': window.start, 'metrics_to': window.stop}
    if not {'strain', 'strain_reference'} & missing:
        with contextlib.suppress(ValueError):  # fewer than two ticks
            numbers |= tracking(trace, *window)._asdict()
    if 'recruitment_state' not in missing:
        up, down = shift_times(trace)
        numbers['upshift_times'] = [t for t in up if window.start <= t < window.stop]
        numbers['downshift_times'] = [t for t in down if window.start <= t < window.stop]
        states = time_in_state(trace, window)
        numbers['time_in_state'] = {str(state): time for state, time in states.items()}
    numbers['time_at_source'] = time_at_source(trace, window)
    if found is not None:
        numbers['energy'] = energy(trace, found, window)._asdict()
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
