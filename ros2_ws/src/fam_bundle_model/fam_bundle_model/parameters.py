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
Every parameter of the system, declared once (see ``schema.py``), and its YAML file.

The file is a ROS 2 parameter file, so that one file serves the experiment runner, the offline
loop and single nodes (``--ros-args --params-file``). SI units throughout.
"""

from collections.abc import Iterable, Mapping
import dataclasses
from dataclasses import dataclass
import hashlib
from itertools import pairwise
import json
import math
from pathlib import Path
from typing import Any

from fam_bundle_model.files import whole_file
from fam_bundle_model.schema import (
    choice,
    ConfigurationError,
    flag,
    integer,
    make_group,
    number,
    per_unit,
    positive,
    series,
    unknown,
    word,
)

PACES = ('lockstep', 'realtime')
PAPER_SCHEMES = ('baseline', 'lag', 'pressure', 'lag_pressure')
SCHEMES = (*PAPER_SCHEMES, 'all')  # the last keeps all units recruited: a rival
ALLOCATIONS = ('batch', 'force', 'orderly')
CYCLIC = ('sine', 'trapezoid', 'steps', 'minimum_jerk')  # and some sums of sines
KINDS = (*CYCLIC, 'sum_of_sines', 'chirp', 'ramp', 'random', 'samples', 'topic')
LEAST_PART = 1e-6  # s between two samples; its fifth power is divided by
MOST_SAMPLES = 10_000  # they stand in the parameter file of every run
PREDICTORS = ('constant_rate', 'constant_acceleration', 'sinusoid', 'preview')
GRAVITY = 9.80665  # m/s^2

_POSITIVE = {'minimum': 0.0, 'exclusive': True}


@dataclass(frozen=True)
class FamParameters:
    """The fluidic artificial muscles, one value per motor unit (Table 1, equations 1-4)."""

    count: tuple[int, ...] = per_unit(
        int, '', 'FAMs in parallel in each motor unit, in recruitment order', minimum=1, maximum=64
    )
    inner_radius: tuple[float, ...] = per_unit(float, 'm', 'initial inner radius r0', **_POSITIVE)
    thickness: tuple[float, ...] = per_unit(float, 'm', 'initial bladder wall t0', **_POSITIVE)
    braid_angle: tuple[float, ...] = per_unit(
        float, 'rad', 'initial braid angle a0, from the axis', minimum=0.05, maximum=0.95
    )
    length: tuple[float, ...] = per_unit(float, 'm', 'initial length L0', **_POSITIVE)
    youngs_modulus: tuple[float, ...] = per_unit(
        float, 'Pa', "bladder's Young's modulus before its correction factor", **_POSITIVE
    )
    youngs_modulus_factor: tuple[float, ...] = per_unit(
        float, '', "correction factor on Young's modulus", **_POSITIVE
    )
    mooney_rivlin_share: tuple[float, ...] = per_unit(
        float, '', 'C2 / (C1 + C2) of the bladder; 0 is neo-Hookean', minimum=0.0, maximum=1.0
    )
    poisson_ratio: tuple[float, ...] = per_unit(
        float, '', "bladder's Poisson ratio in the Brazier moment", minimum=0.0, maximum=0.5
    )
    collapse_moment_factor: tuple[float, ...] = per_unit(
        float, '', 'correction factor on the collapse moment', **_POSITIVE
    )
    end_spring_span: tuple[float, ...] = per_unit(
        float, '', 'base end spring is E I / (span x outer radius)', **_POSITIVE
    )
    end_spring_slope: tuple[float, ...] = per_unit(
        float, '1/Pa', 'growth of the end spring factor with pressure', minimum=0.0
    )
    end_spring_offset: tuple[float, ...] = per_unit(
        float, '', 'end spring factor at zero pressure', **_POSITIVE
    )
    transition_constant: tuple[float, ...] = per_unit(
        float, '', 'decay beta from buckled to collapsed per unit strain', **_POSITIVE
    )


@dataclass(frozen=True)
class SourceParameters:
    """The pressure reducing/relief valve that feeds the servo valves (Figure 10)."""

    nominal_pressure: float = positive('Pa', 'set value of the source pressure')
    droop: float = number('Pa s/m^3', 'loss of source pressure per flow', minimum=0.0)
    time_constant: float = positive('s', 'first-order lag of the source pressure')


@dataclass(frozen=True)
class ValveParameters:
    """One servo valve per motor unit (equation 5)."""

    rated_flow: float = positive('m^3/s', 'flow of the open valve at the rated pressure drop')
    rated_pressure_drop: float = positive('Pa', 'pressure drop over one land at rated flow')
    spool_time_constant: float = positive('s', 'first-order lag of the spool')


@dataclass(frozen=True)
class HoseParameters:
    """The hose from each servo valve to its motor unit (equation 6)."""

    radius: float = positive('m', 'inner radius')
    length: float = positive('m', 'length')
    viscosity: float = positive('Pa s', 'dynamic viscosity in the hose')


@dataclass(frozen=True)
class OilParameters:
    """The hydraulic fluid (equation 7)."""

    bulk_modulus: float = positive('Pa', 'effective bulk modulus, entrained air included')


@dataclass(frozen=True)
class LoadParameters:
    """The hanging load and what damps it."""

    mass: float = positive('kg', 'load mass')
    damping: float = number('N s/m', 'viscous damping of the contraction', minimum=0.0)
    friction_force: float = number('N', 'Coulomb friction', minimum=0.0)
    friction_rate: float = positive('1/s', 'strain rate at which friction is fully developed')


@dataclass(frozen=True)
class StrainLoopParameters:
    """Outer PI on strain; its output is the pressure reference (Figure 3a)."""

    proportional_gain: float = number(
        'Pa', 'pressure per unit strain error', minimum=0.0, live=True
    )
    integral_gain: float = number(
        'Pa/s', 'pressure rate per unit strain error', minimum=0.0, live=True
    )
    tracking_time: float = positive(
        's', 'time constant of the back-calculation anti-windup', live=True
    )


@dataclass(frozen=True)
class PressureLoopParameters:
    """Inner PI of each motor unit; its output is the spool command (Figure 3b, c)."""

    proportional_gain: tuple[float, ...] = per_unit(
        float, '1/Pa', 'spool per pressure error', minimum=0.0
    )
    integral_gain: tuple[float, ...] = per_unit(
        float, '1/(Pa s)', 'spool rate per pressure error', minimum=0.0
    )
    integral_limit: tuple[float, ...] = per_unit(
        float, '', 'largest integral share', minimum=0.0, maximum=1.0
    )


@dataclass(frozen=True)
class RecruitmentParameters:
    """When to shift (Figures 4 and 8) and what to add meanwhile (equations 9-11)."""

    scheme: str = choice('what decides a shift, and what is compensated', SCHEMES)
    upshift_threshold: float = number(
        '',
        'share of the nominal pressure that shifts up',
        minimum=0.05,
        maximum=1.0,
        live=True,
    )
    downshift_threshold: float = number(
        '',
        'share of the nominal pressure that shifts down',
        minimum=0.0,
        maximum=0.95,
        live=True,
    )
    strain_rate_time_constant: float = positive('s', 'filter of the strain rate', live=True)
    force_time_constant: float = positive('s', 'filter of the measured force', live=True)
    minimum_strain_rate: float = positive('1/s', 'slower is taken as standing still', live=True)
    minimum_dwell: float = number('s', 'least time between two shifts', minimum=0.0, live=True)
    reserve: float = number(
        'Pa',
        'source pressure kept in reserve by the prediction: more recruits earlier and tracks '
        'better, less recruits later and spends less oil',
        default=0.0,
        minimum=-5e5,
        maximum=5e5,
        live=True,
    )
    predictor: str = choice(
        'how the strain is expected to go on', PREDICTORS, default='constant_rate'
    )
    prediction_horizon: float = number(
        's',
        "how far ahead the predictor's error is measured",
        default=0.3,
        minimum=0.01,
        maximum=5.0,
    )


@dataclass(frozen=True)
class AllocationParameters:
    """What each recruited motor unit is asked for."""

    policy: str = choice(
        'batch: all the same pressure; force: shares of a force by the model; orderly: the '
        'newest unit is controlled, those before it give what they can',
        ALLOCATIONS,
        default='batch',
    )
    feedforward: float = number(
        '',
        'share of the pressure that balances the load at the reference strain, fed forward by '
        'the strain loop; force and orderly only',
        default=1.0,
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class SensorParameters:
    """Noise (standard deviation) and resolution of the simulated sensors; 0 is ideal."""

    strain_noise: float = number('', 'strain', default=0.0, minimum=0.0)
    force_noise: float = number('N', 'force', default=0.0, minimum=0.0)
    pressure_noise: float = number('Pa', 'all pressures', default=0.0, minimum=0.0)
    flow_noise: float = number('m^3/s', 'source flow', default=0.0, minimum=0.0)
    strain_resolution: float = number('', 'strain', default=0.0, minimum=0.0)
    force_resolution: float = number('N', 'force', default=0.0, minimum=0.0)
    pressure_resolution: float = number('Pa', 'all pressures', default=0.0, minimum=0.0)
    flow_resolution: float = number('m^3/s', 'source flow', default=0.0, minimum=0.0)
    seed: int = integer('seed of the noise', 0, 2**31 - 1, default=0)


@dataclass(frozen=True)
class SimulationParameters:
    """How the plant is integrated and where it starts."""

    period: float = number('s', 'time between two ticks', minimum=1e-4, maximum=0.1)
    substeps: int = integer('integration steps per tick', 1, 1000)
    initial_strain: float = number(
        '', 'strain at rest before tick 0', default=0.0, minimum=-0.1, maximum=0.25
    )


@dataclass(frozen=True)
class LagTableParameters:
    """The grid of the lag table (Figure 6)."""

    source_points: int = integer('grid points of source pressure', 2, 400)
    deslack_points: int = integer('grid points of de-slack pressure', 2, 400)
    minimum_source: float = number(
        '', 'lowest source pressure over the nominal one', minimum=0.05, maximum=0.99
    )
    maximum_lag: float = positive('s', 'a lag beyond this counts as never')


@dataclass(frozen=True)
class ReferenceParameters:
    """The strain to be tracked: which kind of waveform, and what the kinds take."""

    kind: str = choice('waveform', KINDS)
    amplitude: float = number('', 'half of the peak strain', minimum=0.0, maximum=0.15)
    frequency: float = number('Hz', 'cycles per second', minimum=1e-3, maximum=10.0)
    cycles: int = integer('cycles in a run; sets the duration of all but samples', 1, 100_000)
    final_frequency: float = number(
        'Hz', 'frequency at the end of a chirp', default=0.3, minimum=1e-3, maximum=10.0
    )
    multiples: tuple[float, ...] = series(
        '',
        'frequency of each of the sum of sines over frequency',
        default=(1.0, 1.7, 2.9),
        minimum=1e-3,
        maximum=1000.0,
    )
    weights: tuple[float, ...] = series(
        '',
        'weight of each of these sines in the amplitude; a single one serves all',
        default=(0.6, 0.25, 0.15),
        minimum=0.0,
        exclusive=True,
    )
    levels: tuple[float, ...] = series(
        '',
        'strains of steps and minimum jerk over the peak strain, in equal parts of a cycle',
        default=(0.5, 1.0, 0.5, 0.0),
        minimum=0.0,
        maximum=1.0,
    )
    strain_rate: float = number(
        '1/s',
        'largest rate of steps, of a live topic and on the way to a goal',
        default=0.1,
        minimum=1e-4,
        maximum=10.0,
    )
    strain_acceleration: float = number(
        '1/s^2',
        'largest acceleration of steps and on the way to a goal',
        default=1.0,
        minimum=1e-3,
        maximum=1e3,
    )
    seed: int = integer('seed of the random waypoints', 0, 2**31 - 1, default=0)
    times: tuple[float, ...] = series(
        's', 'times of the samples', default=(0.0,), minimum=0.0, maximum=1e6
    )
    strains: tuple[float, ...] = series(
        '',
        'strains of the samples; a live topic begins at the first',
        default=(0.0,),
        minimum=-0.1,
        maximum=0.3,
    )

    def is_cyclic(self) -> bool:
        """Return whether the waveform repeats itself with each cycle."""
        if self.kind == 'sum_of_sines':
            return all(float(m).is_integer() for m in self.multiples)
        return self.kind in CYCLIC

    def duration(self) -> float:
        """Return the length in s."""
        return self.times[-1] if self.kind == 'samples' else self.cycles / self.frequency

    def highest_frequency(self) -> float:
        """Return the highest frequency in it in Hz; zero where it has none."""
        if self.kind == 'sum_of_sines':
            return self.frequency * max(self.multiples)
        if self.kind == 'chirp':
            return max(self.frequency, self.final_frequency)
        return 0.0 if self.kind in ('samples', 'topic') else self.frequency


@dataclass(frozen=True)
class RunParameters:
    """How the graph is run; in lock-step nothing here changes a result."""

    pace: str = choice('what paces the graph: each other, or a clock', PACES, default='lockstep')
    listeners: int = integer(
        'subscriptions of bundle_state to wait for before tick 0', 1, 100, default=3
    )
    start_timeout: float = positive(
        's', 'wall time without these subscriptions that ends the plant simulator', default=300.0
    )
    answer_timeout: float = positive(
        's', 'wall time without the answer to a tick that ends a lock-step run', default=20.0
    )
    command_timeout: float = positive(
        's', 'time without commands after which a plant in real time goes safe', default=0.015
    )
    busy_tail: float = number(
        's', 'end of each real-time wait that is spent awake', default=0.0, minimum=0.0
    )


@dataclass(frozen=True)
class ProcessParameters:
    """How each node's process is run; nothing here changes a result."""

    executor: str = choice('executor of rclpy', ('events', 'single_threaded'), default='events')
    priority: int = integer(
        'SCHED_FIFO priority of all threads; 0 asks for no priority', 0, 99, default=0
    )
    cpu_mask: int = integer(
        'bit mask of the CPUs that the process may use; 0 is all', 0, 2**52, default=0
    )
    lock_memory: bool = flag('keep all memory from being paged out', default=False)
    timer_slack: float = number(
        's', 'how late the kernel may wake a sleeper; 0 keeps its own', default=1e-6, minimum=0.0
    )
    freeze_garbage: bool = flag('spare the garbage collector what start-up left', default=True)


@dataclass(frozen=True)
class BridgeParameters:
    """The hardware bridge; the card's own settings are in its hardware file."""

    backend: str = word('registered name of what drives the card', default='volts')
    hardware: str = word(
        'file of calibration, limits and options of the card', default='hardware.yaml'
    )
    start: str = choice(
        'how far it goes by itself; armed: valves move as soon as the loop has closed',
        ('unconfigured', 'inactive', 'armed'),
        default='unconfigured',
    )
    answer_share: float = number(
        '',
        'share of a period for which a command that answers its sample is waited for',
        default=0.8,
        minimum=0.0,
        maximum=1.0,
    )


@dataclass(frozen=True)
class Configuration:
    """One bundle, its rig, its controllers and its reference."""

    fam: FamParameters
    source: SourceParameters
    valve: ValveParameters
    hose: HoseParameters
    oil: OilParameters
    load: LoadParameters
    strain_loop: StrainLoopParameters
    pressure_loop: PressureLoopParameters
    recruitment: RecruitmentParameters
    allocation: AllocationParameters
    sensors: SensorParameters
    simulation: SimulationParameters
    lag_table: LagTableParameters
    reference: ReferenceParameters
    run: RunParameters
    process: ProcessParameters
    bridge: BridgeParameters

    def duration(self) -> float:
        """Return the length of the run in s."""
        return self.reference.duration()

    def cycles(self) -> list[tuple[float, float]]:
        """Return start and end in s of each cycle; the whole run where nothing repeats."""
        if not self.reference.is_cyclic():
            return [(0.0, self.duration())]
        frequency = self.reference.frequency
        return [(k / frequency, (k + 1) / frequency) for k in range(self.reference.cycles)]

    def period_ns(self) -> int:
        """Return the time between two ticks in ns: stamps count in whole nanoseconds."""
        return round(self.simulation.period * 1e9)

    def ticks(self) -> int:
        """Return the number of ticks of the run."""
        return round(self.duration() / self.simulation.period)

    def hash(self, *groups: str) -> str:  # noqa: A003
        """Return a SHA-256 over the values of the named groups, or of all that shape a result."""
        names = groups or [name for name in GROUPS if name not in ('run', 'process', 'bridge')]
        chosen = {name: dataclasses.asdict(getattr(self, name)) for name in names}
        return hashlib.sha256(json.dumps(chosen, sort_keys=True).encode()).hexdigest()


GROUPS: dict[str, type] = {
    f.name: f.type  # type: ignore[misc]
    for f in dataclasses.fields(Configuration)
}


def make_configuration(
    values: Mapping[str, Mapping[str, Any]], names: Iterable[str] = tuple(GROUPS)
) -> Configuration:
    """
    Return the configuration of ``values[group][parameter]``.

    A node that needs only the groups ``names`` gets a configuration without the others.
    Raises ConfigurationError naming the parameter, its value and the bound.
    """
    for name in values:
        if name not in GROUPS:
            raise ConfigurationError(unknown(str(name), list(GROUPS)))
        if not isinstance(values[name], Mapping):
            raise ConfigurationError(f'{name} = {values[name]}: must be a group of parameters')
    groups: dict[str, Any] = dict.fromkeys(GROUPS)
    groups |= {name: make_group(GROUPS[name], name, values.get(name, {})) for name in names}
    configuration = Configuration(**groups)
    if configuration.fam is not None:
        check_fam(configuration.fam)
        check_lengths('fam', configuration.fam, configuration.fam)
    if configuration.fam is not None and configuration.pressure_loop is not None:
        check_lengths('pressure_loop', configuration.pressure_loop, configuration.fam)
    if configuration.recruitment is not None:
        check_recruitment(configuration.recruitment)
    if configuration.reference is not None:
        check_reference(configuration.reference)
    if configuration.recruitment is not None and configuration.allocation is not None:
        check_allocation(configuration.recruitment, configuration.allocation)
    if configuration.run is not None and configuration.simulation is not None:
        check_run(configuration.run, configuration.simulation)
    return configuration


def with_values(configuration: Configuration, values: Mapping[str, Any]) -> Configuration:
    """
    Return ``configuration``, of all groups or some, with ``values['group.name']`` laid over it.

    Raises ConfigurationError naming the parameter, its value and the bound.
    """
    groups = {
        name: dataclasses.asdict(group)
        for name in GROUPS
        if (group := getattr(configuration, name)) is not None
    }
    for name, value in values.items():
        group, _, field = name.partition('.')
        if group not in groups:
            raise ConfigurationError(unknown(name, list(groups)))
        groups[group][field] = value
    return make_configuration(groups, groups)


def check_allocation(recruitment: RecruitmentParameters, allocation: AllocationParameters) -> None:
    """
    Raise ConfigurationError where the thresholds would see what the allocation does itself.

    Orderly, the older units are saturated and the newest may be near its de-slack pressure: each
    pressure would call for the opposite shift.
    """
    if allocation.policy == 'orderly' and recruitment.scheme in ('baseline', 'pressure'):
        raise ConfigurationError(
            f'allocation.policy = orderly: recruitment.scheme = {recruitment.scheme} shifts at '
            'thresholds of pressure; must be lag, lag_pressure or all'
        )


def check_run(run: RunParameters, simulation: SimulationParameters) -> None:
    """Raise ConfigurationError where every answer would come too late."""
    if run.command_timeout < 2.0 * simulation.period:
        raise ConfigurationError(
            f'run.command_timeout = {run.command_timeout:g} s: must be >= '
            f'{2.0 * simulation.period:g} s, two periods'
        )
    if run.busy_tail >= simulation.period:
        raise ConfigurationError(
            f'run.busy_tail = {run.busy_tail:g} s: must be < {simulation.period:g} s, the period'
        )


def check_reference(reference: ReferenceParameters) -> None:
    """Raise ConfigurationError where the parameters of its kind do not fit together."""
    p = reference
    if p.kind == 'sum_of_sines' and len(p.weights) not in (1, len(p.multiples)):
        raise ConfigurationError(
            f'reference.weights: {len(p.weights)} values for {len(p.multiples)} multiples; '
            f'must be 1 or {len(p.multiples)}'
        )
    if p.kind == 'samples':
        check_samples(p)
    if p.kind == 'random' and p.cycles > MOST_SAMPLES // 2:
        raise ConfigurationError(
            f'reference.cycles = {p.cycles}: must be <= {MOST_SAMPLES // 2} of random waypoints'
        )
    if p.kind == 'steps':
        share = 1.0 / (p.frequency * len(p.levels))
        moves = [abs(b - a) for a, b in zip((p.levels[-1], *p.levels[:-1]), p.levels, strict=True)]
        largest = 2.0 * p.amplitude * max(moves)
        taken = step_time(largest, p.strain_rate, p.strain_acceleration)
        if taken > share:
            raise ConfigurationError(
                f'reference.levels: a step of {largest:g} within reference.strain_rate = '
                f'{p.strain_rate:g} 1/s and reference.strain_acceleration = '
                f'{p.strain_acceleration:g} 1/s^2 takes {taken:.3g} s: must be <= {share:g} s, '
                "a level's part of a cycle"
            )


def check_samples(reference: ReferenceParameters) -> None:
    """Raise ConfigurationError unless there are two samples or more in the order of time."""
    times, strains = reference.times, reference.strains
    if len(times) != len(strains):
        raise ConfigurationError(
            f'reference.strains: {len(strains)} values for {len(times)} times; '
            f'must be {len(times)}'
        )
    if not 2 <= len(times) <= MOST_SAMPLES:
        raise ConfigurationError(
            f'reference.times: {len(times)} samples; must be >= 2 and <= {MOST_SAMPLES}'
        )
    for i, (before, time) in enumerate(pairwise(times), 1):
        if time <= before:
            raise ConfigurationError(
                f'reference.times[{i}] = {time:g} s: must be > {before:g} s, the one before'
            )
        if time - before < LEAST_PART:
            raise ConfigurationError(
                f'reference.times[{i}] = {time:g} s: must be >= {LEAST_PART:g} s after '
                f'{before:g} s, the one before'
            )


def check_period(reference: ReferenceParameters, period: float) -> None:
    """Raise ConfigurationError where ticks of ``period`` s are too far apart for a reference."""
    highest = max(reference.highest_frequency(), 1.0 / reference.duration())
    if period > 0.5 / highest:
        raise ConfigurationError(
            f'simulation.period = {period:g} s: must be <= {0.5 / highest:g} s, half a cycle of '
            'the reference'
        )


def step_time(distance: float, rate: float, acceleration: float) -> float:
    """Return the shortest time in s from rest to rest over ``distance`` within both limits."""
    if distance < rate * rate / acceleration:
        return 2.0 * math.sqrt(distance / acceleration)
    return distance / rate + rate / acceleration


def check_fam(fam: FamParameters) -> None:
    """Raise ConfigurationError unless the FAMs are equally long."""
    if len(set(fam.length)) > 1:
        raise ConfigurationError(
            f'fam.length = {list(fam.length)} m: must be equal, for all FAMs share one strain'
        )


def check_lengths(
    group: str, values: FamParameters | PressureLoopParameters, fam: FamParameters
) -> None:
    """Raise ConfigurationError unless each parameter has one value, or one per motor unit."""
    units = len(fam.count)
    for name, value in vars(values).items():
        if len(value) not in (1, units):
            raise ConfigurationError(
                f'{group}.{name}: {len(value)} values for {units} motor units; '
                f'must be 1 or {units}'
            )


def check_recruitment(recruitment: RecruitmentParameters) -> None:
    """Raise ConfigurationError where a unit would be released as soon as it is recruited."""
    if recruitment.downshift_threshold >= recruitment.upshift_threshold:
        raise ConfigurationError(
            f'recruitment.downshift_threshold = {recruitment.downshift_threshold:g}: must be < '
            f'recruitment.upshift_threshold = {recruitment.upshift_threshold:g}'
        )


def read_yaml(path: Path) -> dict[str, dict[str, Any]]:
    """
    Return the parameters in a ROS 2 parameter file, by group.

    Raises ConfigurationError when the file cannot be read or has another layout.
    """
    try:
        text = Path(path).read_text(encoding='utf-8')
    except OSError as error:
        raise ConfigurationError(f'{path}: cannot be read ({error.strerror})') from None
    except UnicodeDecodeError as error:
        raise ConfigurationError(f'{path}: not YAML ({error})') from None
    return parse_yaml(text, str(path))


def parse_yaml(text: str, source: str) -> dict[str, dict[str, Any]]:
    """
    Return the parameters in the text of a ROS 2 parameter file, by group.

    Raises ConfigurationError that begins with ``source`` when it has another layout.
    """
    import yaml

    try:
        content = yaml.safe_load(text)
    except yaml.YAMLError as error:
        raise ConfigurationError(f'{source}: not YAML ({" ".join(str(error).split())})') from None
    try:
        parameters = content['/**']['ros__parameters']
        if not isinstance(parameters, dict):
            raise TypeError
    except (KeyError, TypeError):
        raise ConfigurationError(f"{source}: must hold '/**: ros__parameters:'") from None
    return parameters


def load_configuration(
    path: Path, changes: Mapping[str, Mapping[str, Any]] | None = None
) -> Configuration:
    """
    Return the configuration in ``path`` with ``changes[group][parameter]`` laid over it.

    Raises ConfigurationError; where the file is to blame, its message starts with the path.
    """
    values = read_yaml(path)
    try:
        configuration = make_configuration(values)
    except ConfigurationError as error:
        raise ConfigurationError(f'{path}: {error}') from None
    if not changes:
        return configuration
    names = [*values, *(name for name in changes if name not in values)]
    return make_configuration(
        {name: {**values.get(name, {}), **changes.get(name, {})} for name in names}
    )


def seconds(nanoseconds: int) -> float:
    """Return a time in s; every time and ``dt`` in the loop is rounded by this one division."""
    return nanoseconds / 1e9


def yaml_text(configuration: Configuration) -> str:
    """Return ``configuration`` as a ROS 2 parameter file that reads back to the same bits."""
    import yaml

    values = {
        group: {k: list(v) if isinstance(v, tuple) else v for k, v in content.items()}
        for group, content in dataclasses.asdict(configuration).items()
    }
    return str(yaml.safe_dump({'/**': {'ros__parameters': values}}, sort_keys=False))


def write_yaml(configuration: Configuration, path: Path) -> None:
    """Write ``configuration`` to a ROS 2 parameter file; whole or not at all."""
    with whole_file(path) as file:
        file.write(yaml_text(configuration).encode())
