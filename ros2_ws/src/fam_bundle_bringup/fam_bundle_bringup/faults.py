# SPDX-License-Identifier: Apache-2.0
"""What goes wrong with a loop in real time, done to it on purpose: one row and verdict each."""

import contextlib
import dataclasses
import itertools
import signal
import time
from collections import Counter
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any, NamedTuple

from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.progress import progress_bar
from fam_bundle_bringup.rig import PACKAGES, Rig
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.checks import CHECKS

SAFE_WITHIN = 0.02  # s of real time
STOPPED = 0.5  # s that a node is held up
AFTER = 1.5  # s of watching; a report comes once a second
STRIKES = 3  # that are a fault
REALTIME_DEPTH = 100  # samples that a controller which joins is still given
FLOOD = 30  # bad messages in a row, one each millisecond
LONG = 100_000  # cycles; no row waits for the end of the run
VENTED = 0.05  # of the nominal pressure
BUMP = 0.01  # of the nominal pressure, largest step when a controller sets in again


class Row(NamedTuple):
    """One fault: what must happen, what happened, and whether that will do."""

    fault: str
    expected: str
    observed: str
    passed: bool


class Fault(NamedTuple):
    """A fault by name, what must happen, and how it is done; ``hurt`` returns observed, passed."""

    name: str
    expected: str
    hurt: Callable[[Rig], tuple[str, bool]]
    start: Callable[[Rig], None] = Rig.start_all


IN_TIME = f'safe within {SAFE_WITHIN * 1e3:g} ms, reason on /diagnostics'
HARMLESS = f'harmless, or safe while commands are {SAFE_WITHIN * 1e3:g} ms old, then goes on'


def safe_and_said(rig: Rig, since: int, *words: str, backlog: float = 0.0) -> tuple[str, bool]:
    """Return whether the plant was safe in time and somebody said one of ``words``.

    ``backlog`` (s) is what may pass from ``since`` until the fault reaches the loop.
    """
    rig.wait_for(lambda: rig.safe_after(since) is not None, 'the safe state', 5.0)
    rig.listen(AFTER)
    took, reason = rig.safe_after(since) or 0.0, rig.reason(since, *words)
    said = f'"{reason}"' if reason else 'no reason on /diagnostics'
    low = rig.vented_to(since) / rig.configuration.source.nominal_pressure
    of_which = f' (of them up to {backlog * 1e3:g} ms a backlog)' if backlog else ''
    observed = f'safe after {took * 1e3:.1f} ms{of_which}, vented to {low:.1%} of nominal; {said}'
    return observed, took <= SAFE_WITHIN + backlog and bool(reason) and low < VENTED


def goes_on(rig: Rig) -> tuple[str, bool]:
    """Return whether the loop runs again by itself, and sets in without a bump."""
    took = rig.wait_for(rig.runs, 'the run to go on')
    joined = rig.first_tick_of_this_stretch()
    bump = first_bump(rig, joined)
    nominal = rig.configuration.source.nominal_pressure
    words = f'goes on after {took:.1f} s, first reference {bump / nominal:.2%} of nominal off'
    return words, bump <= BUMP * nominal


def first_bump(rig: Rig, tick: int) -> float:
    """Return how far the first applied reference from ``tick`` on is from the pressure (Pa)."""
    commands = (s.message for s in rig.seen['valve_command'])
    references = {command.tick: command.pressure_reference[0] for command in commands}
    measured = {s.message.tick: s.message.mu_pressure[0] for s in rig.seen['bundle_state']}
    first = min((t for t in references if t >= tick and t in measured), default=None)
    if first is None:
        raise RuntimeError(f'no pressure reference from tick {tick} on')
    return float(abs(references[first] - measured[first]))


def both(*found: tuple[str, bool]) -> tuple[str, bool]:
    """Join observations; all must pass."""
    return '; '.join(words for words, _ in found), all(passed for _, passed in found)


def harmless_or_safe(rig: Rig, since: int, seconds: float = AFTER) -> tuple[str, bool]:
    """Return whether for a while nothing happened, or the plant was safe while it had to be.

    A process that comes or goes costs the others time in the middleware and on the cores.
    """
    found, undisturbed = harmless(rig, since, seconds)
    if undisturbed:
        return found, True
    stale = rig.stale_but_not_safe(since, SAFE_WITHIN)
    return both((f'{found}; {stale} samples neither safe nor commanded', stale == 0), goes_on(rig))


def harmless(rig: Rig, since: int, seconds: float = AFTER) -> tuple[str, bool]:
    """Return whether for a while the plant was never safe and answered without a gap."""
    rig.listen(seconds)
    answered = {s.message.tick for s in rig.seen['valve_command']}
    states = rig.messages('bundle_state', since)
    lost = sum(s.tick not in answered for s in states[:-20])
    safe = sum(s.safe for s in states)
    why = f' ("{rig.reason(since, "safe", "fault")}")' if safe else ''
    words = f'{len(states)} samples, {lost} without a command, {safe} safe{why}'
    if rig.ended():
        words += f', ended: {", ".join(rig.ended())}'
    enough = len(states) > 0.8 * seconds / rig.configuration.simulation.period
    alive = enough and rig.runs() and not rig.ended()
    return words, alive and lost == 0 and safe == 0


# ---- Killed, restarted, held up ----

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
    """Let the plant stand still: it integrates the time it missed, vented from 20 ms on."""
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


def two_supervisors(rig: Rig) -> tuple[str, bool]:
    """Start a second supervisor; ticks tell when its first message came and the plant was safe."""
    begin = time.monotonic_ns()
    rig.watch('recruitment_state')
    rig.start('recruitment_supervisor', alias='second_supervisor')
    rig.wait_for(lambda: rig.safe_after(begin) is not None, 'the safe state')
    rig.listen(AFTER)
    counts = Counter(s.message.tick for s in rig.seen['recruitment_state'])
    doubled = min((tick for tick, count in counts.items() if count > 1), default=None)
    states = [s.message for s in rig.seen['bundle_state']]
    due = {state.tick: state.steady_time for state in states}
    if doubled is None or doubled not in due:
        return 'the second supervisor was not seen', False
    # It begins with the samples that it is still given, which are done with.
    late = REALTIME_DEPTH * rig.configuration.simulation.period
    found = safe_and_said(rig, due[doubled], 'came twice', 'asks for', backlog=late)
    rig.signal('second_supervisor', signal.SIGKILL)
    rig.listen(0.5)
    return both(found, reset(rig))


def reset(rig: Rig) -> tuple[str, bool]:
    """Reset the latched fault, without which nothing goes on."""
    from std_srvs.srv import Trigger

    latched = not rig.runs()
    client = rig.node.create_client(Trigger, 'plant_simulator/reset_fault')
    rig.wait_for(client.service_is_ready, 'reset_fault')
    future = client.call_async(Trigger.Request())
    rig.wait_for(future.done, 'the answer of reset_fault')
    words = f'latched: {"yes" if latched else "no"}, reset: {future.result().success}'
    return both((words, latched and future.result().success), goes_on(rig))


# ---- Bad messages ----


def not_finite(message: Any) -> None:
    """Make a value of a message NaN."""
    for name in ('strain', 'pressure', 'pressure_compensation'):
        if hasattr(message, name):
            setattr(message, name, float('nan'))
            return
    message.spool = [float('nan')] * len(message.spool)


def wrong_length(message: Any) -> None:
    """Give a message one motor unit too many."""
    for name in ('mu_pressure', 'spool'):
        if hasattr(message, name):
            setattr(message, name, [*getattr(message, name), 0.0])
            return
    message.recruited = 99


def replayed(message: Any) -> None:
    """Take a message back by half a second."""
    message.tick -= 500
    if hasattr(message, 'steady_time'):
        message.steady_time -= 500_000_000


def from_the_future(message: Any) -> None:
    """Put a message half a second ahead."""
    message.tick += 500


Damage = Callable[[Any], None]
DAMAGES: dict[str, Damage] = {
    'NaN': not_finite,
    'wrong length': wrong_length,
    'replayed tick': replayed,
    'future tick': from_the_future,
}


def counters(topic: str, kind: str) -> tuple[str, ...]:
    """Return the counters of the consumer that must rise, and that nothing else raises."""
    if kind in ('NaN', 'wrong length'):
        return ('refused',)
    if topic == 'valve_command':
        return ('out_of_order',) if kind == 'replayed tick' else ('refused',)
    if topic == 'bundle_state' and kind == 'future tick':
        return ('out_of_order',)
    return ('late',)


def injected(topic: str, kind: str, times: int) -> Fault:
    """Return the fault that bad messages come on ``topic`` beside the good ones."""

    def hurt(rig: Rig) -> tuple[str, bool]:
        names = counters(topic, kind)
        before = rig.counted(consumer(topic), names)
        since = inject(rig, topic, DAMAGES[kind], times)
        rig.listen(AFTER)
        counted = rig.counted(consumer(topic), names) - before
        number = f'{times} sent, {counted} counted by {consumer(topic)}'
        if times == 1:
            return both((number, counted >= 1), harmless(rig, since, 0.5))
        if rig.safe_after(since) is None:
            return both((number, counted >= times), harmless(rig, since, 0.5))
        reason = topic if topic != 'valve_command' else 'fault'
        return both((number, True), safe_and_said(rig, since, reason), reset(rig))

    expected = 'counted and harmless' if times == 1 else f'harmless, or {IN_TIME} and latched'
    how = 'one' if times == 1 else f'{times} in a row'
    return Fault(f'{kind} on {topic}, {how}', expected, hurt)


def consumer(topic: str) -> str:
    """Return the node that must notice bad messages on ``topic``."""
    return 'plant_simulator' if topic == 'valve_command' else 'pressure_controller'


def inject(rig: Rig, topic: str, damage: Damage, times: int) -> int:
    """Publish damaged copies of the newest message; return when that was a fault (ns, steady).

    That is with the third, or with the only one.
    """
    from copy import deepcopy

    from fam_bundle_io.trace_recorder_node import TOPICS
    from fam_bundle_node.qos import LOOP_PUBLISHER

    rig.watch(topic)
    rig.wait_for(lambda: bool(rig.seen[topic]), topic)
    publisher = rig.node.create_publisher(TOPICS[topic], topic, LOOP_PUBLISHER)
    readers = rig.node.count_subscribers(topic)
    rig.wait_for(lambda: rig.seen[topic][-1].message.tick > 1000, 'ticks to replay')
    rig.wait_for(lambda: publisher.get_subscription_count() >= readers, f'readers of {topic}')
    rig.listen(0.2)
    since = 0
    for number in range(times):
        if number < STRIKES:
            since = time.monotonic_ns()
        message = deepcopy(rig.seen[topic][-1].message)
        damage(message)
        publisher.publish(message)
        rig.listen(0.001)
    return since


# ---- The system around the nodes ----


def stepped_clock(library: Path, folder: Path, seconds: int) -> Fault:
    """Return the fault that the system clock of all nodes jumps by ``seconds``."""
    offset = folder / 'clock_offset'

    def start(rig: Rig) -> None:
        offset.write_text('+0')
        rig.start_all(
            {
                'LD_PRELOAD': str(library),
                'FAKETIME_TIMESTAMP_FILE': str(offset),
                'FAKETIME_NO_CACHE': '1',
                'FAKETIME_DONT_FAKE_MONOTONIC': '1',
            }
        )

    def hurt(rig: Rig) -> tuple[str, bool]:
        since = time.monotonic_ns()
        offset.write_text(f'{seconds:+d}')
        found = harmless(rig, since, 2.0 * AFTER)
        jump = rig.reports[-1].stamp - time.time()
        jumped = abs(jump - seconds) < 60.0
        return both(found, (f"the nodes' clocks jumped by {jump:.0f} s", jumped))

    return Fault(f'system clock steps by {seconds:+d} s', 'harmless', hurt, start)


# Both take shared memory from one process only, in a mount namespace of its own.
WITHOUT_SHARED_MEMORY = {
    'read-only': 'mount -o remount,bind,ro /dev/shm',
    'of its own': 'mount -t tmpfs tmpfs /dev/shm',
}


def without_shared_memory(name: str, kind: str) -> Fault:
    """Return the fault that one node cannot use the shared memory of the others."""
    mount = f'mount --bind /dev/shm /dev/shm && {WITHOUT_SHARED_MEMORY[kind]} && exec "$@"'
    prefix = ('unshare', '--mount', '--propagation', 'private', 'sh', '-c', mount, 'sh')

    def start(rig: Rig) -> None:
        for other in PACKAGES:
            rig.start(other, prefix=prefix if other == name else ())

    def hurt(rig: Rig) -> tuple[str, bool]:
        begin = time.monotonic_ns()
        with contextlib.suppress(RuntimeError):
            rig.wait_for(rig.runs, 'the loop to run', 40.0)
        if rig.runs():
            return harmless(rig, time.monotonic_ns(), 5.0)
        plant = rig.nodes['plant_simulator']
        reason = rig.reason(begin, 'waiting for')
        last = rig.last_line('plant_simulator')
        words = f'never ran, plant ended with status {plant.poll()}: {last}; "{reason}"'
        told = 'has not come within' in last or 'listeners after' in last
        return words, plant.poll() == 1 and told and bool(reason)

    expected = 'harmless, or the plant never leaves rest and ends with a reason'
    return Fault(f'shared memory {kind}: {name}', expected, hurt, start)


def all_faults(library: Path | None, folder: Path) -> Iterator[Fault]:
    """Yield every fault; the step of the clock needs libfaketime."""
    for name in WAITS:
        yield killed(name)
    yield Fault('kill -9 and restart: lag_table_server', HARMLESS, killed_server)
    yield Fault(
        'kill -9 and restart: plant_simulator',
        'commands stop within 20 ms; a new run starts with the same controllers',
        killed_plant,
    )
    for name in WAITS:
        yield held_up(name)
    yield Fault(f'SIGSTOP for {STOPPED:g} s: lag_table_server', HARMLESS, held_up_server)
    yield Fault(
        f'SIGSTOP for {STOPPED:g} s: plant_simulator',
        'vented from 20 ms of plant time on, reason on /diagnostics; the run goes on',
        held_up_plant,
    )
    yield Fault('two supervisors at once', f'{IN_TIME}, latched', two_supervisors)
    for topic in CHECKS:
        for kind in DAMAGES:
            if (topic, kind) == ('pressure_reference', 'wrong length'):
                continue  # it holds no list
            yield injected(topic, kind, 1)
            yield injected(topic, kind, FLOOD)
    if library is None:
        yield Fault('system clock steps by an hour', 'harmless', no_library, lambda rig: None)
    else:
        yield stepped_clock(library, folder, 3600)
        yield stepped_clock(library, folder, -3600)
    for kind in WITHOUT_SHARED_MEMORY:
        for name in ('pressure_controller', 'plant_simulator'):
            yield without_shared_memory(name, kind)


def no_library(rig: Rig) -> tuple[str, bool]:
    """Say what is missing for the step of the clock."""
    return 'not tried: libfaketime is missing (apt-get install faketime)', False


def find_faketime() -> Path | None:
    """Return the library that fakes a process's clock, if it is installed."""
    found = sorted(Path('/usr/lib').glob('*/faketime/libfaketime.so.1'))
    return found[0] if found else None


def tried(fault: Fault, configuration: Configuration, folder: Path) -> Row:
    """Do one fault to a graph of its own, and return its row."""
    try:
        with Rig(configuration, folder) as rig:
            fault.start(rig)
            observed, passed = fault.hurt(rig)
    except (RuntimeError, OSError, ValueError) as error:  # one row must not cost the others
        observed, passed = f'{error}', False
    return Row(fault.name, fault.expected, observed, passed)


def run_faults(configuration: Configuration, folder: Path, only: str = '') -> bool:
    """Try every fault whose name contains ``only``; write ``faults.json``, print the table.

    Returns whether all passed.
    """
    reference = dataclasses.replace(configuration.reference, cycles=LONG)
    run = dataclasses.replace(configuration.run, pace='realtime')
    long_run = dataclasses.replace(configuration, reference=reference, run=run)
    chosen = [f for f in all_faults(find_faketime(), folder) if only in f.name]
    if not chosen:
        raise ConfigurationError(f'--only {only}: no such fault')
    rows = []
    with progress_bar('faults', len(chosen)) as progress:
        for number, fault in enumerate(chosen):
            rows.append(tried(fault, long_run, folder / f'fault_{number:02d}'))
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
