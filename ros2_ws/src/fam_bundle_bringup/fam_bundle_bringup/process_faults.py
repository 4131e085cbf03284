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

"""Nodes that are killed, held up, restarted or there twice."""

import itertools
import signal
import time

from fam_bundle_bringup.rig import Rig
from fam_bundle_bringup.verdicts import (
    AFTER,
    both,
    Fault,
    goes_on,
    harmless_or_safe,
    IN_TIME,
    reset,
    safe_and_said,
    SAFE_WITHIN,
    VENTED,
)

STOPPED = 0.5  # s that a node is held up

WAITS = {
    'recruitment_supervisor': 'recruitment_state',
    'strain_controller': 'pressure_reference',
    'pressure_controller': 'no answer',
}


def killed(name: str) -> Fault:
    """Return the fault that a controller is killed, and started again."""

    def hurt(rig: Rig) -> tuple[str, bool]:
        since = rig.signal(name, signal.SIGKILL)
        stopped = safe_and_said(rig, since, WAITS[name])
        rig.start(name)
        return both(stopped, goes_on(rig))

    expected = f'{IN_TIME}; after its restart the run goes on without a bump'
    return Fault(f'kill -9 and restart: {name}', expected, hurt)


def killed_server(rig: Rig) -> tuple[str, bool]:
    """Kill the lag table's server, and start it again."""
    since = rig.signal('lag_table_server', signal.SIGKILL)
    alone = harmless_or_safe(rig, since)
    since = time.monotonic_ns()
    rig.start('lag_table_server')
    return both(alone, harmless_or_safe(rig, since, 5.0))


def killed_plant(rig: Rig) -> tuple[str, bool]:
    """Kill the plant, and start a new run with the same controllers."""
    since = rig.signal('plant_simulator', signal.SIGKILL)
    rig.listen(2.0 * AFTER)
    late = len(rig.messages('valve_command', since + round(SAFE_WITHIN * 1e9)))
    reason = rig.reason(since, 'waiting for bundle_state')
    words = f'{late} commands after {SAFE_WITHIN * 1e3:g} ms; "{reason}"'
    rig.start('plant_simulator')
    return both((words, late == 0 and bool(reason)), goes_on(rig))


def held_up(name: str) -> Fault:
    """Return the fault that a controller stands still for half a second."""

    def hurt(rig: Rig) -> tuple[str, bool]:
        since = rig.signal(name, signal.SIGSTOP)
        rig.listen(STOPPED)
        rig.signal(name, signal.SIGCONT)
        return both(safe_and_said(rig, since, 'no answer', WAITS[name]), goes_on(rig))

    return Fault(f'SIGSTOP for {STOPPED:g} s: {name}', f'{IN_TIME}; the run goes on', hurt)


def held_up_server(rig: Rig) -> tuple[str, bool]:
    """Let the lag table's server stand still for half a second."""
    since = rig.signal('lag_table_server', signal.SIGSTOP)
    rig.listen(STOPPED)
    rig.signal('lag_table_server', signal.SIGCONT)
    return harmless_or_safe(rig, since)


def held_up_plant(rig: Rig) -> tuple[str, bool]:
    """Let the plant stand still: it integrates the time it missed, vented from the time-out on."""
    since = rig.signal('plant_simulator', signal.SIGSTOP)
    rig.listen(STOPPED)
    rig.signal('plant_simulator', signal.SIGCONT)
    rig.wait_for(lambda: rig.safe_after(since) is not None, 'the safe state', 5.0)
    rig.listen(AFTER)
    reason = rig.reason(since, 'held up')
    ticks = [s.tick for s in rig.messages('bundle_state', since)]
    gaps = sum(b - a != 1 for a, b in itertools.pairwise(ticks))
    first = next(s for s in rig.messages('bundle_state', since) if s.safe)
    low = first.mu_pressure[0] / rig.configuration.source.nominal_pressure
    words = f'"{reason}"; MU1 at {low:.1%} of nominal then, {gaps} gaps in ticks'
    return both((words, bool(reason) and gaps == 0 and low < VENTED), goes_on(rig))


def doubled(rig: Rig) -> int | None:
    """Return when the second answer to one sample came from a supervisor (ns, steady)."""
    ticks = set()
    for seen in rig.seen['recruitment_state']:
        if seen.message.tick in ticks:
            return seen.at
        ticks.add(seen.message.tick)
    return None


def two_supervisors(rig: Rig) -> tuple[str, bool]:
    """Start a second supervisor; until the pressure controller hears it, there is only one."""
    rig.watch('recruitment_state')
    rig.start('recruitment_supervisor', alias='second_supervisor')
    rig.wait_for(lambda: doubled(rig) is not None, 'the second supervisor')
    since = doubled(rig) or 0
    rig.wait_for(lambda: bool(rig.reason(since, 'asks for')), 'the fault')
    rig.listen(AFTER)
    reason = rig.reason(since, 'came twice', 'asks for')
    low = rig.vented_to(since) / rig.configuration.source.nominal_pressure
    stale = rig.stale_but_not_safe(since, SAFE_WITHIN)
    found = f'"{reason}", vented to {low:.1%} of nominal, {stale} samples on an old command'
    rig.signal('second_supervisor', signal.SIGKILL)
    rig.listen(0.5)
    return both((found, low < VENTED and stale == 0), reset(rig))
