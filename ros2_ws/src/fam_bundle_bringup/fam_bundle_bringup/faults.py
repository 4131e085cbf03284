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

"""What goes wrong with a loop in real time, done to it on purpose: one row and verdict each."""

from collections.abc import Iterator
import dataclasses
from pathlib import Path
from typing import NamedTuple

from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.message_faults import DAMAGES, FLOOD, injected
from fam_bundle_bringup.process_faults import (
    held_up,
    held_up_plant,
    held_up_server,
    killed,
    killed_plant,
    killed_server,
    STOPPED,
    two_supervisors,
    WAITS,
)
from fam_bundle_bringup.progress import progress_bar
from fam_bundle_bringup.rig import Rig
from fam_bundle_bringup.system_faults import (
    stepped_clock,
    without_shared_memory,
)
from fam_bundle_bringup.verdicts import Fault, HARMLESS, SAFE_WITHIN
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.checks import CHECKS

LONG = 100_000  # cycles; no row waits for the end of the run
TRIES = 5  # of a fault of the bridge


class Row(NamedTuple):
    """One fault: what must happen, what happened, and whether that will do."""

    fault: str
    expected: str
    observed: str
    passed: bool


def all_faults(folder: Path) -> Iterator[Fault]:
    """Yield every fault; ``folder`` is for what they need."""
    for name in WAITS:
        yield killed(name)
    yield Fault('kill -9 and restart: lag_table_server', HARMLESS, killed_server)
    yield Fault(
        'kill -9 and restart: plant_simulator',
        f'commands stop within {SAFE_WITHIN * 1e3:g} ms; the controllers take a new run',
        killed_plant,
    )
    for name in WAITS:
        yield held_up(name)
    yield Fault(f'SIGSTOP for {STOPPED:g} s: lag_table_server', HARMLESS, held_up_server)
    yield Fault(
        f'SIGSTOP for {STOPPED:g} s: plant_simulator',
        'vented from the time-out on (its own time), reason on /diagnostics; goes on',
        held_up_plant,
    )
    expected = 'safe as soon as both are heard, reason on /diagnostics, latched'
    yield Fault('two supervisors at once', expected, two_supervisors)
    for topic in CHECKS:
        for kind in DAMAGES:
            if (topic, kind) == ('pressure_reference', 'wrong length'):
                continue  # it holds no list
            yield injected(topic, kind, 1)
            yield injected(topic, kind, FLOOD)
    for seconds in (3600, -3600):
        yield stepped_clock(folder, seconds)
    for name in ('pressure_controller', 'plant_simulator'):
        yield without_shared_memory(name)


def faults_of_bridge(folder: Path) -> Iterator[Fault]:
    """Yield every fault of the hardware bridge; ``folder`` is for what they need."""
    from fam_bundle_bringup.bridge_faults import bridge_faults

    yield from bridge_faults(folder)


def tried(fault: Fault, configuration: Configuration, folder: Path) -> Row:
    """Do one fault to a graph of its own, and return its row."""
    try:
        with Rig(configuration, folder) as rig:
            fault.start(rig)
            observed, passed = fault.hurt(rig)
    except (RuntimeError, OSError, ValueError) as error:  # one row must not cost the others
        observed, passed = f'{error}', False
    return Row(fault.name, fault.expected, observed, passed)


def tried_at_bridge(fault: Fault, configuration: Configuration, folder: Path) -> Row:
    """Do one fault to a hardware bridge, anew where the machine disturbed it."""
    from fam_bundle_bringup.bridge_rig import BridgeRig, NotQuietError

    tries, disturbed = 0, True
    while disturbed and tries < TRIES:
        tries, disturbed = tries + 1, False
        try:
            with BridgeRig(configuration, folder) as rig:
                fault.start(rig)
                observed, passed = fault.hurt(rig)
                disturbed = not passed and rig.was_disturbed()
        except NotQuietError as error:
            observed, passed, disturbed = f'{error}', False, True
        except (RuntimeError, OSError, ValueError) as error:
            observed, passed = f'{error}', False
    if tries > 1:
        observed += f' (try {tries}: the machine disturbed those before)'
    return Row(fault.name, fault.expected, observed, passed)


def run_faults(
    configuration: Configuration, folder: Path, only: str = '', *, bridge: bool = False
) -> bool:
    """
    Try every fault whose name contains ``only``; write ``faults.json``, print the table.

    ``bridge`` asks for those of the hardware bridge, on the simulated rig in volts. Returns
    whether all passed. Raises ConfigurationError where ``only`` is in no name.
    """
    reference = dataclasses.replace(configuration.reference, cycles=LONG)
    run = dataclasses.replace(configuration.run, pace='realtime')
    long_run = dataclasses.replace(configuration, reference=reference, run=run)
    attempt = tried_at_bridge if bridge else tried
    chosen = [f for f in (faults_of_bridge if bridge else all_faults)(folder) if only in f.name]
    if not chosen:
        raise ConfigurationError(f'--only {only}: no such fault')
    rows = []
    with progress_bar('faults', len(chosen)) as progress:
        for number, fault in enumerate(chosen):
            rows.append(attempt(fault, long_run, folder / f'fault_{number:02d}'))
            write_json([row._asdict() for row in rows], folder / 'faults.json')
            progress(number + 1)
    print_rows(rows)
    print(f'{sum(row.passed for row in rows)} of {len(rows)} passed; in {folder}/faults.json')
    return all(row.passed for row in rows)


def print_rows(rows: list[Row]) -> None:
    """Print the table."""
    from rich.console import Console
    from rich.table import Table

    table = Table(show_lines=True)
    for title in ('Fault', 'Expected', 'Observed', ''):
        table.add_column(title, overflow='fold')
    for row in rows:
        table.add_row(
            row.fault,
            row.expected,
            row.observed,
            'passed' if row.passed else 'FAILED',
            style='' if row.passed else 'red',
        )
    Console().print(table)
