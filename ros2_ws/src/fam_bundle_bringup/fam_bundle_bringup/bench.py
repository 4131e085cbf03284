# SPDX-License-Identifier: Apache-2.0
"""How fast the loop runs on this machine: medians of repeated runs, with their spread."""

import dataclasses
import os
import re
import statistics
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from pathlib import Path

from fam_bundle_bringup.experiment import versions
from fam_bundle_bringup.graph import LOOP_LISTENERS, nodes_in, own_domain, start_nodes
from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.progress import progress_bar
from fam_bundle_model.lag_table import build_lag_table, cached_lag_table
from fam_bundle_model.parameters import Configuration, write_yaml

REPEATS = 5
FIRST_TICK_TIMEOUT = 120.0  # s


def offline_real_time_factor(configuration: Configuration) -> float:
    """Return simulated over elapsed time of an offline run, its set-up included."""
    table = cached_lag_table(configuration)
    begin = time.perf_counter()
    run_offline(configuration, table=table)
    return configuration.duration() / (time.perf_counter() - begin)


def lag_table_seconds(configuration: Configuration) -> float:
    """Return the time to build a 40 x 40 lag table."""
    grid = dataclasses.replace(configuration.lag_table, source_points=40, deslack_points=40)
    begin = time.perf_counter()
    build_lag_table(dataclasses.replace(configuration, lag_table=grid))
    return time.perf_counter() - begin


def lockstep_ticks_per_second(configuration: Configuration) -> float:
    """Return the rate of the graph without a recorder, as the plant's node counts it."""
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        write_yaml(configuration, folder / 'parameters.yaml')
        with own_domain(), nodes_in(folder) as group:
            start_nodes(group, folder / 'parameters.yaml', LOOP_LISTENERS)
            while not group.finished('plant_simulator'):
                time.sleep(0.05)
        log = (folder / 'log' / 'plant_simulator.log').read_text(errors='replace')
    found = re.search(r'ran (\d+) ticks in ([\d.]+) s', log)
    if found is None:
        raise RuntimeError('the plant simulator did not say how fast it ran')
    return int(found[1]) / float(found[2])


def first_tick_seconds(configuration: Configuration) -> float:
    """Return the time from the start of the Python command line to the plant's first tick.

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
            return _wait_for_first_tick(out / 'log' / 'plant_simulator.log', process, begin)
        finally:
            process.terminate()
            process.wait()


def _wait_for_first_tick(log: Path, process: 'subprocess.Popen[bytes]', begin: float) -> float:
    while time.perf_counter() - begin < FIRST_TICK_TIMEOUT and process.poll() is None:
        if log.exists() and 'in lock-step' in log.read_text(errors='replace'):
            return time.perf_counter() - begin
        time.sleep(0.01)
    raise RuntimeError('the experiment did not come to its first tick')


MEASUREMENTS: dict[str, Callable[[Configuration], float]] = {
    'offline_real_time_factor': offline_real_time_factor,
    'lockstep_ticks_per_second': lockstep_ticks_per_second,
    'lag_table_seconds': lag_table_seconds,
    'first_tick_seconds': first_tick_seconds,
}


def run_bench(configuration: Configuration, folder: Path) -> None:
    """Repeat each measurement, in turn, and write ``bench.json``: medians, spread, raw values.

    The first round warms up and is not counted.
    """
    values: dict[str, list[float]] = {name: [] for name in MEASUREMENTS}
    total = (REPEATS + 1) * len(MEASUREMENTS)
    with progress_bar('bench', total) as progress:
        done = 0
        for repeat in range(REPEATS + 1):
            for name, measure in MEASUREMENTS.items():
                value = measure(configuration)
                if repeat > 0:
                    values[name].append(value)
                done += 1
                progress(done)
    medians = {name: statistics.median(found) for name, found in values.items()}
    spread = {name: [min(found), max(found)] for name, found in values.items()}
    content = {
        **medians,
        'spread': spread,
        'values': values,
        'cores': os.cpu_count(),
        'versions': versions(),
    }
    write_json(content, folder / 'bench.json')
    for name, median in medians.items():
        low, high = spread[name]
        print(f'{name:28s} {median:10.4g}   ({low:.4g} to {high:.4g}, {REPEATS} runs)')
    print(f'written to {folder / "bench.json"}')
