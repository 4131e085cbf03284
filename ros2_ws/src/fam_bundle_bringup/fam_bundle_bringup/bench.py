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
How fast and how punctual the loop is on this machine, beside what it could be at best.

Every candidate runs once in each round, so that a machine whose speed drifts treats all alike;
ratios are taken within a round. Medians and spread are over the rounds.
"""

from collections.abc import Callable, Mapping
import dataclasses
import importlib.util
import os
from pathlib import Path
import re
import statistics
import subprocess
import sys
import tempfile
import time
from typing import Any, NamedTuple

from fam_bundle_bringup.experiment import versions
from fam_bundle_bringup.graph import (
    drain,
    drain_patience,
    LOOP_LISTENERS,
    nodes_in,
    own_domain,
    recording,
    start_nodes,
)
from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.progress import progress_bar
from fam_bundle_model.lag_table import build_lag_table, cached_lag_table
from fam_bundle_model.parameters import (
    Configuration,
    ProcessParameters,
    RunParameters,
    write_yaml,
)

Values = dict[str, float]
Measurement = Callable[[Configuration], Values]

TICKS = 4000  # of a lock-step run
TURNS = 3  # within a round, of what is set against each other
SLOW_TICKS = 1000  # of one on the default executor
SOCKET_TICKS = 50_000  # a few of them would last a tenth of a second
REAL_TIME = 60.0  # s of the two main runs on a clock
SHORT_REAL_TIME = 10.0  # s of the others
PRIORITY = 20  # SCHED_FIFO of everything on a clock, where the system grants it
UNITS = (2, 4, 8, 16)
BUNDLES = (1, 2, 4)
FIRST_TICK_TIMEOUT = 120.0  # s
BUNDLE_TICKS = 4000  # of each bundle side by side, each node a process
COMPOSED_BUNDLE_TICKS = 10_000  # and each bundle one process
RAN = re.compile(
    r'\[([\d.]+)\] \[[^\]]+\]: ran (\d+) ticks in ([\d.]+) s; (\d+) answered, '
    r'(\d+) within a period, (\d+) periods skipped; '
    r'latency p50 (\d+) us, p99 (\d+) us, max (\d+) us'
)


class Run(NamedTuple):
    """What the plant's node says of a run; latencies and times of the system clock in s."""

    ticks_per_second: float
    arrived_share: float
    in_time_share: float
    p50: float
    p99: float
    maximum: float
    ticks: int = 0
    began: float = 0.0
    ended: float = 0.0

    def values(self, name: str) -> Values:
        """Return rate and latencies under ``name``."""
        return {
            f'{name}_ticks_per_second': self.ticks_per_second,
            f'{name}_latency_p50_us': self.p50 * 1e6,
            f'{name}_latency_p99_us': self.p99 * 1e6,
            f'{name}_latency_max_us': self.maximum * 1e6,
        }


def read_run(log: Path) -> Run:
    """Return what the plant's node has printed at its end; raises RuntimeError if nothing."""
    found = RAN.search(log.read_text(errors='replace'))
    if found is None:
        raise RuntimeError(f'{log.name}: the plant simulator did not say how fast it ran')
    ended, elapsed = float(found[1]), float(found[3])
    ticks, answered, in_time, skipped = (int(found[i]) for i in (2, 4, 5, 6))
    p50, p99, largest = (int(found[i]) * 1e-6 for i in (7, 8, 9))
    # A period that was skipped is one in which no command came in time.
    in_time_share = in_time / (ticks - 1 + skipped)  # tick 0 waits until the loop has closed
    return Run(
        ticks / elapsed,
        answered / ticks,
        in_time_share,
        p50,
        p99,
        largest,
        ticks,
        ended - elapsed,
        ended,
    )


def with_ticks(configuration: Configuration, ticks: int) -> Configuration:
    """Return ``configuration`` with a run of about ``ticks`` ticks, one cycle of the reference."""
    frequency = 1.0 / (ticks * configuration.simulation.period)
    reference = dataclasses.replace(configuration.reference, frequency=frequency, cycles=1)
    return dataclasses.replace(configuration, reference=reference)


def with_units(configuration: Configuration, units: int) -> Configuration:
    """Return ``configuration`` with ``units`` motor units like its first."""
    fam = {
        name: (values[0],) * units
        for name, values in dataclasses.asdict(configuration.fam).items()
    }
    return dataclasses.replace(configuration, fam=type(configuration.fam)(**fam))


def on_a_clock(configuration: Configuration, seconds: float) -> Configuration:
    """Return ``configuration`` paced by a clock for ``seconds`` s, with priority."""
    ticks = round(seconds / configuration.simulation.period)
    return dataclasses.replace(
        with_ticks(configuration, ticks),
        run=dataclasses.replace(configuration.run, pace='realtime'),
        process=dataclasses.replace(configuration.process, priority=PRIORITY),
    )


def on_the_default_executor(configuration: Configuration) -> Configuration:
    """Return ``configuration`` on rclpy's SingleThreadedExecutor."""
    process = dataclasses.replace(configuration.process, executor='single_threaded')
    return dataclasses.replace(configuration, process=process)


def graph_runs(
    configuration: Configuration,
    *,
    composed: bool = False,
    recorded: bool = False,
    bundles: int = 1,
) -> list[Run]:
    """
    Return what the plants of one run said, one for each of ``bundles`` side by side.

    Raises RuntimeError when a node ends early.
    """
    names = [f'bundle_{i}' for i in range(bundles)]
    with tempfile.TemporaryDirectory() as name, own_domain():
        folder = Path(name)
        write_yaml(configuration, folder / 'parameters.yaml')
        listeners = LOOP_LISTENERS + recorded
        watched = names if recorded else []
        with recording(watched) as (recorders, listen), nodes_in(folder) as group:
            owners = [
                start_nodes(
                    group,
                    folder / 'parameters.yaml',
                    listeners,
                    composed=composed,
                    bundle=bundle,
                )
                for bundle in names
            ]
            while not group.finished(*owners):
                listen(0.05)
            for recorder in recorders:
                drain(recorder, listen, drain_patience(configuration))
        return [read_run(folder / 'log' / f'{owner}.log') for owner in owners]


# ---- Measurements; each returns its values by name ----


def offline(configuration: Configuration) -> Values:
    """Measure the loop in one process without ROS, its set-up included."""
    table = cached_lag_table(configuration)
    begin = time.perf_counter()
    run_offline(configuration, table=table)
    elapsed = time.perf_counter() - begin
    return {'offline_real_time_factor': configuration.duration() / elapsed}


def lag_table(configuration: Configuration) -> Values:
    """Measure how long a 40 x 40 lag table takes."""
    grid = dataclasses.replace(configuration.lag_table, source_points=40, deslack_points=40)
    begin = time.perf_counter()
    build_lag_table(dataclasses.replace(configuration, lag_table=grid))
    return {'lag_table_seconds': time.perf_counter() - begin}


def first_tick(configuration: Configuration) -> Values:
    """
    Measure from the start of the Python command line to the plant's first tick.

    ``./fam`` itself takes a few tenths of a second before that.
    """
    with tempfile.TemporaryDirectory() as name:
        config, out = Path(name) / 'parameters.yaml', Path(name) / 'out'
        write_yaml(configuration, config)
        command = [sys.executable, '-m', 'fam_bundle_bringup.cli', 'experiment']
        command += ['--config', str(config), '--out', str(out)]
        begin = time.perf_counter()
        process = subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            env=os.environ,
        )
        try:
            log = out / 'log' / 'plant_simulator.log'
            return {'first_tick_seconds': _wait_for_first_tick(log, process, begin)}
        finally:
            process.terminate()
            process.wait()


def _wait_for_first_tick(log: Path, process: 'subprocess.Popen[bytes]', begin: float) -> float:
    while time.perf_counter() - begin < FIRST_TICK_TIMEOUT and process.poll() is None:
        if log.exists() and 'in lock-step' in log.read_text(errors='replace'):
            return time.perf_counter() - begin
        time.sleep(0.01)
    raise RuntimeError('the experiment did not come to its first tick')


def lockstep(configuration: Configuration) -> Values:
    """Measure the graph in lock-step, five processes."""
    return graph_runs(with_ticks(configuration, TICKS))[0].values('lockstep')


def lockstep_default_executor(configuration: Configuration) -> Values:
    """Measure the same graph on rclpy's default executor."""
    slow = on_the_default_executor(with_ticks(configuration, SLOW_TICKS))
    return graph_runs(slow)[0].values('lockstep_default_executor')


def floor(configuration: Configuration) -> Values:
    """Measure bare relays: same topology, messages and quality of service, no computation."""
    from fam_bundle_bringup.floor import relay_loop

    return _relayed('floor', relay_loop(TICKS, len(configuration.fam.count)))


def ping(configuration: Configuration) -> Values:
    """Measure two processes, one message there and one back."""
    from fam_bundle_bringup.floor import relay_ping

    return _relayed('ping', relay_ping(TICKS, len(configuration.fam.count)))


def unix_socket(configuration: Configuration) -> Values:
    """Measure the same payload and topology through Unix-domain sockets."""
    from fam_bundle_bringup.floor_other import socket_loop

    return _relayed('unix_socket', socket_loop(SOCKET_TICKS, len(configuration.fam.count)))


def cyclone(configuration: Configuration) -> Values:
    """Measure the same payload and topology through Cyclone DDS's own Python."""
    from fam_bundle_bringup.floor_other import cyclone_loop

    return _relayed('cyclone', cyclone_loop(TICKS, len(configuration.fam.count)))


def _relayed(name: str, measured: Any) -> Values:
    found = Run(measured.ticks_per_second, 1.0, measured.in_time_share, *measured[1:4])
    return found.values(name)


def floor_on_a_clock(configuration: Configuration) -> Values:
    """Measure the bare relays on a clock."""
    from fam_bundle_bringup.floor import relay_on_a_clock

    units, period = len(configuration.fam.count), configuration.simulation.period
    measured = relay_on_a_clock(REAL_TIME, units, period, PRIORITY)
    return {
        **_relayed('realtime_floor', measured),
        'realtime_floor_in_time_share': measured.in_time_share,
    }


def composed_default_executor(configuration: Configuration) -> Values:
    """Measure the composed graph on rclpy's default executor."""
    slow = on_the_default_executor(with_ticks(configuration, SLOW_TICKS))
    return graph_runs(slow, composed=True)[0].values('composed_default_executor')


def lockstep_recorded(configuration: Configuration) -> Values:
    """Measure the graph in lock-step with every message recorded."""
    run = graph_runs(with_ticks(configuration, TICKS), recorded=True)[0]
    return run.values('lockstep_recorded')


def composed(configuration: Configuration) -> Values:
    """Measure the graph in lock-step, all nodes in one process."""
    return graph_runs(with_ticks(configuration, TICKS), composed=True)[0].values('composed')


def composed_recorded(configuration: Configuration) -> Values:
    """Measure the composed graph in lock-step with every message recorded."""
    run = graph_runs(with_ticks(configuration, TICKS), composed=True, recorded=True)[0]
    return run.values('composed_recorded')


def in_turn(*measures: Measurement) -> Measurement:
    """Return the measurement of several in turn, the median of each over ``TURNS``."""

    def measure(configuration: Configuration) -> Values:
        found: dict[str, list[float]] = {}
        for _ in range(TURNS):
            for one in measures:
                for name, value in one(configuration).items():
                    found.setdefault(name, []).append(value)
        return {name: statistics.median(values) for name, values in found.items()}

    return measure


def units_of(units: int, *, composed: bool) -> Measurement:
    """Return the measurement of lock-step with ``units`` motor units."""
    name = f'{"composed" if composed else "lockstep"}_{units}_units_tick_us'

    def measure(configuration: Configuration) -> Values:
        one = with_units(with_ticks(configuration, TICKS), units)
        return {name: 1e6 / graph_runs(one, composed=composed)[0].ticks_per_second}

    return measure


def bundles_of(bundles: int, *, composed: bool) -> Measurement:
    """Return the measurement of lock-step with ``bundles`` in namespaces, all ticks together."""
    name = f'{"composed" if composed else "lockstep"}_{bundles}_bundles_ticks_per_second'
    ticks = COMPOSED_BUNDLE_TICKS if composed else BUNDLE_TICKS

    def measure(configuration: Configuration) -> Values:
        runs = graph_runs(with_ticks(configuration, ticks), composed=composed, bundles=bundles)
        # They do not start at the same moment: from the first start to the last end.
        elapsed = max(run.ended for run in runs) - min(run.began for run in runs)
        return {name: sum(run.ticks for run in runs) / elapsed}

    return measure


def real_time(name: str, seconds: float, **how: Any) -> Measurement:
    """Return the measurement of the graph on a clock."""

    def measure(configuration: Configuration) -> Values:
        run = graph_runs(on_a_clock(configuration, seconds), **how)[0]
        return {
            **run.values(name),
            f'{name}_arrived_share': run.arrived_share,
            f'{name}_in_time_share': run.in_time_share,
        }

    return measure


def real_time_default_executor(configuration: Configuration) -> Values:
    """Measure the graph on a clock and on rclpy's default executor."""
    measure = real_time('realtime_default_executor', SHORT_REAL_TIME)
    return measure(on_the_default_executor(configuration))


def machine(configuration: Configuration) -> Values:
    """Measure how punctually the machine wakes one process that does nothing else."""
    from fam_bundle_bringup.jitter import wake_up_jitter

    found = wake_up_jitter(REAL_TIME, configuration.simulation.period, priority=PRIORITY)
    return {
        'machine_in_time_share': found.in_time_share,
        'machine_latency_p50_us': found.p50 * 1e6,
        'machine_latency_p99_us': found.p99 * 1e6,
        'machine_latency_max_us': found.maximum * 1e6,
    }


def measurements() -> list[Measurement]:
    """
    Return all candidates in the order in which each round runs them.

    Cyclone DDS is one only where its Python package is installed.
    """
    others = [cyclone] if importlib.util.find_spec('cyclonedds') else []
    return [
        offline,
        lag_table,
        # These are set against each other: one by one in turn.
        in_turn(lockstep, floor, lockstep_recorded),
        composed,
        composed_recorded,
        lockstep_default_executor,
        composed_default_executor,
        ping,
        unix_socket,
        *others,
        *(units_of(units, composed=one) for units in UNITS for one in (False, True)),
        *(bundles_of(bundles, composed=one) for bundles in BUNDLES for one in (False, True)),
        machine,
        floor_on_a_clock,
        real_time('realtime', REAL_TIME),
        real_time('realtime_composed', REAL_TIME, composed=True),
        real_time('realtime_recorded', SHORT_REAL_TIME, recorded=True),
        real_time_default_executor,
        first_tick,
    ]


# ---- What follows from them, within one round ----


def derived(found: Values) -> Values:
    """Return the ratios of one round."""
    v = found
    ratios = {
        'lockstep_vs_default_executor': v['lockstep_ticks_per_second']
        / v['lockstep_default_executor_ticks_per_second'],
        'composed_vs_default_executor': v['composed_ticks_per_second']
        / v['composed_default_executor_ticks_per_second'],
        'floor_vs_default_executor': v['floor_ticks_per_second']
        / v['lockstep_default_executor_ticks_per_second'],
        'lockstep_latency_vs_floor': v['lockstep_latency_p50_us'] / v['floor_latency_p50_us'],
        'recording_cost_share': 1.0
        - v['lockstep_recorded_ticks_per_second'] / v['lockstep_ticks_per_second'],
        'composed_recording_cost_share': 1.0
        - v['composed_recorded_ticks_per_second'] / v['composed_ticks_per_second'],
    }
    for kind in ('lockstep', 'composed'):
        times = [v[f'{kind}_{units}_units_tick_us'] for units in UNITS]
        prefix = '' if kind == 'lockstep' else 'composed_'
        ratios[f'{prefix}cost_per_motor_unit_us'] = statistics.linear_regression(
            UNITS, times
        ).slope
    return ratios


def run_bench(configuration: Configuration, folder: Path, rounds: int) -> None:
    """
    Run every candidate once in each of ``rounds``, and write ``bench.json`` and a figure.

    Raises RuntimeError when a candidate fails.
    """
    from fam_bundle_bringup.bench_figure import bench_figure
    from fam_bundle_io.figures import save_figures

    configuration = dataclasses.replace(
        configuration, run=RunParameters(), process=ProcessParameters()
    )
    warm_up(configuration)
    values: dict[str, list[float]] = {}
    candidates = measurements()
    with progress_bar('bench', rounds * len(candidates)) as progress:
        for done in range(rounds):
            found: Values = {}
            for number, measure in enumerate(candidates):
                found |= measure(configuration)
                progress(done * len(candidates) + number + 1)
            for name, value in {**found, **derived(found)}.items():
                values.setdefault(name, []).append(value)
            medians, spread = write_results(values, done + 1, folder)
    save_figures({'bench': bench_figure(medians, spread)}, folder)
    print_values(medians, spread, rounds)
    print(f'written to {folder / "bench.json"} and {folder / "bench.png"}')


def write_results(
    values: Mapping[str, list[float]], rounds: int, folder: Path
) -> tuple[Values, dict[str, list[float]]]:
    """Write ``bench.json`` of the rounds until now; return medians and spread."""
    medians = {name: statistics.median(all_of) for name, all_of in values.items()}
    spread = {name: [min(all_of), max(all_of)] for name, all_of in values.items()}
    content = {
        **medians,
        'spread': spread,
        'values': values,
        'rounds': rounds,
        'cores': os.cpu_count(),
        'priority_granted': is_priority_granted(),
        'versions': versions(),
    }
    write_json(content, folder / 'bench.json')
    return medians, spread


def warm_up(configuration: Configuration) -> None:
    """Compile the laws for every number of motor units, once per machine."""
    from fam_bundle_bringup.warm import warm

    with progress_bar('compiled functions', len(UNITS)) as progress:
        for done, units in enumerate(UNITS, 1):
            warm(with_units(configuration, units))
            progress(done)


def is_priority_granted() -> bool:
    """Return whether a process may take the real-time priority, tried in one of its own."""
    tried = f'import os; os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param({PRIORITY}))'
    command = [sys.executable, '-c', tried]
    return subprocess.run(command, capture_output=True, check=False).returncode == 0


def print_values(
    medians: Mapping[str, float], spread: Mapping[str, list[float]], rounds: int
) -> None:
    """Print each median with its spread."""
    for name, median in medians.items():
        low, high = spread[name]
        print(f'{name:44s} {median:10.4g}   ({low:.4g} to {high:.4g}, {rounds} rounds)')
