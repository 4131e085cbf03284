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
What goes wrong with a rig behind the hardware bridge, done on purpose: one row each.

Bounds are those of ``limits.py``, and margins of ``bridge_verdicts.py`` for a machine that wakes
late. Where nothing else is said a stand-in takes the place of the controllers.
"""

from collections.abc import Callable, Iterator
from pathlib import Path
import signal
import time
from typing import Any

from fam_bundle_bringup.bridge_rig import BridgeRig
from fam_bundle_bringup.bridge_verdicts import (
    AFTER,
    beyond_limit,
    degraded,
    depressurised,
    ended,
    faulted,
    Found,
    goes_on,
    latched,
    listen_for,
    MARGIN,
    PROMPT,
    reset_and_armed,
    said,
    vented_to,
    went_safe,
)
from fam_bundle_bringup.faulty_bridge import SHUTDOWN
from fam_bundle_bringup.graph import BRIDGE
from fam_bundle_bringup.process_faults import STOPPED, WAITS
from fam_bundle_bringup.verdicts import both, Fault, VENTED
from fam_bundle_io.hardware.calibration import (
    FORCE,
    MU_PRESSURE,
    SOURCE_FLOW,
    SOURCE_PRESSURE,
    STRAIN,
)
from fam_bundle_io.hardware.limits import Limits
from fam_bundle_node.loop_node import LOOK_PERIOD
import numpy as np

NAME = BRIDGE[1]
LIMITS = Limits()  # the defaults, which the rig has too
STALE, LOST = LIMITS.command_stale, LIMITS.command_lost
AT_TANK = STALE + LIMITS.ramp_time
MS = 1e3
CHANNELS = {
    'strain': STRAIN,
    'source pressure': SOURCE_PRESSURE,
    'pressure of unit 1': MU_PRESSURE,
    'pressure of unit 2': MU_PRESSURE + 1,
}
FORCE_OR_FLOW = {'force': FORCE, 'flow': SOURCE_FLOW}
SILENT = 0.06  # s without commands: stale, not lost
RAMP = 3  # steps that tell a ramp from a step
SLOW = 0.02  # spool that fills a unit without haste
TRANSITIONS = ('deactivate', 'shutdown')
OVERTAKEN = 5  # bad commands that may be, each by a good one
MANY = 30  # bad commands in a row


def at_once(what: str) -> str:
    """Return the expectation that a fault makes valves safe at once."""
    return f'{what}: safe volts within {PROMPT * MS:g} ms, latched, reason shown'


RUNS_ON = 'nothing happens'
BY_WATCHDOG = f'the watchdog puts the safe volts out within {LIMITS.watchdog_timeout * MS:g} ms'

Hurt = Callable[[Any], Found]


def alone(name: str, expected: str, hurt: Hurt) -> Fault:
    """Return a fault of bridge and card, with the stand-in for controllers."""
    return Fault(name, expected, hurt, BridgeRig.start_alone)


def in_graph(name: str, expected: str, hurt: Hurt) -> Fault:
    """Return a fault of the whole graph."""
    return Fault(name, expected, hurt, BridgeRig.start_all)


def bridge_faults(folder: Path) -> Iterator[Fault]:
    """Yield every fault; ``folder`` is for what they need."""
    yield from of_controllers()
    yield from of_commands()
    yield from of_sensors()
    yield from of_pressure()
    yield from of_card()
    yield from of_process()
    yield from of_callbacks(folder)
    yield from of_operation()
    yield from unseen()


# ---- Controllers ----


def of_controllers() -> Iterator[Fault]:
    """Yield controllers that are killed or held up."""
    expected = (
        f'at the tank within {AT_TANK * MS:g} ms of the last command, '
        f'fault after {LOST * MS:g} ms, latched, reason shown'
    )
    for name in WAITS:
        yield in_graph(
            f'kill -9 and restart: {name}',
            f'{expected}; after its restart nothing moves before reset and arm',
            killed(name),
        )
    for name in WAITS:
        yield in_graph(f'SIGSTOP for {STOPPED:g} s: {name}', expected, held_up(name))


def commands_lost(rig: BridgeRig, since: int) -> Found:
    """Return whether valves went to the tank in time, and the fault came in time."""
    safe = went_safe(rig, since, AT_TANK + 2.0 * MARGIN)
    at = rig.first('make_safe', since)
    took = np.inf if at is None else (at - since) * 1e-9
    if at is not None:
        rig.hurt = since, at
    in_time = LOST - MARGIN <= took <= LOST + 2.0 * MARGIN
    return both(safe, (f'fault after {took * MS:.0f} ms', in_time), said(rig, since, 'no command'))


def killed(name: str) -> Hurt:
    """Return how to kill a controller, and to start it again."""

    def hurt(rig: BridgeRig) -> Found:
        since = rig.signal(name, signal.SIGKILL)
        lost = commands_lost(rig, since)
        rig.start(name)
        rig.listen(AFTER)
        return both(lost, latched(rig), reset_and_armed(rig))

    return hurt


def held_up(name: str) -> Hurt:
    """Return how to hold a controller up."""

    def hurt(rig: BridgeRig) -> Found:
        since = rig.signal(name, signal.SIGSTOP)
        rig.listen(STOPPED)
        rig.signal(name, signal.SIGCONT)
        return both(commands_lost(rig, since), latched(rig))

    return hurt


# ---- Commands ----


def of_commands() -> Iterator[Fault]:
    """Yield commands that stay away or cannot be."""
    yield alone(
        f'no command for {SILENT * MS:g} ms',
        f'held for {STALE * MS:g} ms, at the tank within {AT_TANK * MS:g} ms; '
        'then goes on, no fault',
        silent,
    )
    bad = {
        'NaN': [float('nan'), 0.0],
        'infinite': [0.0, float('inf')],
        'beyond 1': [0.0, 1.5],
        'wrong length': [0.0],
    }
    for name, spool in bad.items():
        yield alone(f'{name} command, one', f'refused and counted; {RUNS_ON}', one_bad(spool))
        yield alone(
            f'{name} command, {LIMITS.rejected_commands} in a row',
            at_once('refused and counted'),
            many_bad(spool),
        )
    yield alone('pressure controller asks for the safe state', at_once('vent'), asks_for_safe)


def silent(rig: BridgeRig) -> Found:
    """Give no command for a while; valves are open at their middle then."""
    rig.command = lambda sample: [0.0] * len(sample.mu_pressure)
    rig.listen(0.1)
    rig.answers = False
    since = rig.answered_at
    rig.listen(SILENT)
    rig.answers = True
    rig.listen(AFTER)
    rows = rig.log(since)
    rows = rows[rows['time'] < since + round(SILENT * 1e9)]
    times = (rows['time'] - since) * 1e-9
    middle = np.all(np.abs(rows['outputs']) < 1e-3, axis=1)
    left, tank = times[~middle].min(initial=np.inf), times[rig.is_safe(rows)].min(initial=np.inf)
    rig.hurt = since, int(rows['time'][-1])
    steps = len(np.unique(rows['outputs'][(left <= times) & (times < tank)], axis=0))
    words = f'held for {left * MS:.1f} ms, at the tank {steps} steps later, {tank * MS:.1f} ms'
    good = STALE <= left <= STALE + MARGIN and steps >= RAMP and tank <= AT_TANK + MARGIN
    on = rig.log(since + round((SILENT + 0.3) * 1e9))
    followed = not rig.is_safe(on).any() and not rig.fault(since)
    return both((words, bool(good)), ('goes on' if followed else rig.fault(since), followed))


def refused(rig: BridgeRig) -> int:
    """Return how many commands were refused, by what was seen of each kind of count."""
    return int(rig.newest().rejected) + rig.counted(NAME, ('refused',))


def one_bad(spool: list[float]) -> Hurt:
    """
    Return how to send one bad command among good ones.

    One that a newer one overtakes within the period is never looked at, so it is sent again.
    """

    def hurt(rig: BridgeRig) -> Found:
        rig.listen(1.2)  # for the first counts
        before, since, sent, counted = refused(rig), time.monotonic_ns(), 0, 0
        while not counted and sent < OVERTAKEN:
            rig.orders.append(spool)
            alive = goes_on(rig, since, 1.5)
            counted, sent = refused(rig) - before, sent + 1
        return both(alive, (f'{sent} sent, {counted} counted', counted == 1))

    return hurt


def many_bad(spool: list[float]) -> Hurt:
    """Return how to send bad commands only; the third that is seen is a fault."""

    def hurt(rig: BridgeRig) -> Found:
        rig.listen(1.2)
        before, since = refused(rig), time.monotonic_ns()
        rig.orders += [spool] * MANY
        found = faulted(rig, since, 'spool' if len(spool) > 1 and spool[1] == 1.5 else 'holds')
        rig.listen(1.2)
        counted = refused(rig) - before
        enough = counted >= LIMITS.rejected_commands
        return both(found, (f'{counted} counted', enough))

    return hurt


def asks_for_safe(rig: BridgeRig) -> Found:
    """Let the controller ask for the safe state."""
    rig.vent = True
    return faulted(rig, time.monotonic_ns(), 'asks for the safe state')


# ---- Sensors ----


def of_sensors() -> Iterator[Fault]:
    """Yield sensors that are dead, frozen or jumping."""
    bad, frozen = LIMITS.sensor_samples, LIMITS.frozen_samples + LIMITS.sensor_samples
    for name, channel in CHANNELS.items():
        expected = at_once(f'{bad} samples')
        if channel == STRAIN:
            expected = f'0 V is within its range: a jump, or frozen after {frozen} samples'
            yield alone(
                f'{name}: open wire', expected, lost('input_open', channel, frozen + 1, 4.0)
            )
        else:
            yield alone(f'{name}: open wire', expected, lost('input_open', channel, bad))
        expected = at_once(f'{bad} samples')
        yield alone(f'{name}: shorted', expected, lost('input_rail', channel, bad))
        yield alone(
            f'{name}: jumping', at_once('a few samples'), lost('input_jumping', channel, 5 * bad)
        )
        yield alone(
            f'{name}: frozen',
            f'{frozen} samples: safe volts, latched, reason shown',
            lost('input_frozen', channel, frozen + 1, 4.0),
        )
        yield alone(f'{name}: one bad sample', RUNS_ON, glitch(channel))
    marked = 'marked as degraded with its last good value; the run goes on'
    for name, channel in FORCE_OR_FLOW.items():
        yield alone(f'{name}: shorted', marked, flagged('input_rail', channel))
    yield alone('force: jumping', marked, flagged('input_jumping', FORCE))
    yield alone('force: frozen', marked, flagged('input_frozen', FORCE))
    yield alone('force: open wire (0 V is within its range)', marked, flagged('input_open', FORCE))
    for name, fault in (
        ('flow: open wire, which reads as no flow', 'input_open'),
        ('flow: frozen, as a meter without flow is', 'input_frozen'),
        ('flow: jumping, no faster than flow can', 'input_jumping'),
    ):
        yield alone(name, 'cannot be told by the bridge; the run goes on', not_seen(fault))


def lost(fault: str, channel: int, samples: int, within: float = PROMPT) -> Hurt:
    """Return how to lose a sensor that the loop cannot do without."""

    def hurt(rig: BridgeRig) -> Found:
        since = rig.inject(fault, channel)
        name = rig.calibration.names()[channel]
        found = faulted(rig, since, name, within, samples)
        rig.inject('')
        return both(found, reset_and_armed(rig))

    return hurt


def glitch(channel: int) -> Hurt:
    """Return how to spoil one sample."""

    def hurt(rig: BridgeRig) -> Found:
        since = rig.inject('input_glitch', channel)
        alive = goes_on(rig, since)
        reads = rig.log(since)
        zeros = int(
            np.count_nonzero(reads['inputs'][reads['event'] == b'sample'][:, channel] == 0)
        )
        return both(alive, (f'{zeros} sample of 0 V', zeros == 1))

    return hurt


def flagged(fault: str, channel: int) -> Hurt:
    """Return how to lose a sensor that the loop can do without."""

    def hurt(rig: BridgeRig) -> Found:
        return degraded(rig, rig.inject(fault, channel), channel)

    return hurt


def not_seen(fault: str) -> Hurt:
    """Return how to break the flow meter so that nobody can tell."""

    def hurt(rig: BridgeRig) -> Found:
        return goes_on(rig, rig.inject(fault, SOURCE_FLOW), 1.2)

    return hurt


# ---- Pressure ----


def of_pressure() -> Iterator[Fault]:
    """Yield pressures beyond their limits."""
    samples = LIMITS.overpressure_samples
    beyond = f'safe volts at sample {samples} in a row beyond it, latched, reason shown'
    yield alone(
        f'source fails, valves in the middle: unit above source + '
        f'{LIMITS.overpressure_margin * 1e-3:g} kPa',
        beyond,
        source_fails,
    )
    yield alone(
        'source a quarter too high, valves open: '
        f'unit above {LIMITS.overpressure_ratio:g} nominal',
        beyond,
        too_high,
    )


def too_much(rig: BridgeRig, since: int) -> Found:
    """Return whether the right sample ended it."""
    found = faulted(rig, since, 'Pa: must be <=', 5.0)
    beyond = beyond_limit(rig, since)
    if beyond is None:
        return both(found, ('never beyond it so often', False))
    at, more = beyond
    took = ((rig.safe_since(since) or 0) - at) * 1e-9
    words = f'of which {took * MS:.1f} ms and {more} samples after it was so'
    return both(found, (words, 0.0 <= took <= PROMPT and more == 0))


def source_fails(rig: BridgeRig) -> Found:
    """Turn the source off while the valves keep the oil in the units."""
    rig.command = lambda sample: [0.0] * len(sample.mu_pressure)
    return too_much(rig, rig.inject('source_off'))


def too_high(rig: BridgeRig) -> Found:
    """Let the source's regulator fail and the controller open everything."""
    rig.inject('source_high')
    rig.command = lambda sample: [1.0] * len(sample.mu_pressure)
    return too_much(rig, time.monotonic_ns())


# ---- The card ----


def of_card() -> Iterator[Fault]:
    """Yield what a card can do to us."""
    shown = 'latched, reason shown'
    yield alone('watchdog of the card expires', at_once('by the card'), watchdog)
    yield alone('a read fails', at_once(''), card('read_error', 'does not answer', PROMPT))
    late = LIMITS.read_timeout + PROMPT
    yield alone(
        'no sample comes',
        f'safe volts within {late * MS:g} ms, {shown}',
        card('read_timeout', 'no sample', late),
    )
    yield alone(
        'no write works, nor that of the safe volts',
        f'{BY_WATCHDOG}, {shown}',
        write_error,
    )
    yield alone(
        'no write works for 30 ms',
        f'the bridge tries again and puts the safe volts out before the watchdog, {shown}',
        write_error_mended,
    )


def watchdog(rig: BridgeRig) -> Found:
    """Let the watchdog expire; the card is opened anew by a reset."""
    found = faulted(rig, rig.inject('watchdog'), 'watchdog')
    return both(found, reset_and_armed(rig))


def card(fault: str, word: str, within: float) -> Hurt:
    """Return how to let a call of the card fail, and to mend it."""

    def hurt(rig: BridgeRig) -> Found:
        found = faulted(rig, rig.inject(fault), word, within)
        rig.inject('')
        return both(found, reset_and_armed(rig))

    return hurt


def write_error(rig: BridgeRig) -> Found:
    """Let every write fail: only the card itself can put the safe volts out."""
    since = rig.inject('write_error')
    found = faulted(rig, since, 'does not answer', LIMITS.watchdog_timeout + MARGIN)
    expired = rig.first('expire', since) is not None
    rig.inject('')
    return both(found, (f'by the watchdog: {expired}', expired), reset_and_armed(rig))


def write_error_mended(rig: BridgeRig) -> Found:
    """Let every write fail for a while."""
    rig.inject('')  # so that the call is quick when it counts
    since = rig.inject('write_error')
    rig.listen(0.03)
    mended = rig.inject('')
    found = faulted(rig, since, 'does not answer', (mended - since) * 1e-9 + PROMPT)
    expired = rig.first('expire', since) is not None
    return both(found, (f'by the watchdog: {expired}', not expired), reset_and_armed(rig))


# ---- The process of the bridge ----


def of_process() -> Iterator[Fault]:
    """Yield what ends the bridge, or holds it up."""
    for number in (signal.SIGINT, signal.SIGTERM):
        yield in_graph(
            f'{number.name} of the bridge',
            f'safe volts within {AT_TANK * MS:g} ms; the process ends with status 130',
            told_to_end(number),
        )
    yield in_graph(
        'kill -9 of the bridge', f'{BY_WATCHDOG}; a new bridge moves nothing before arm', kill
    )
    yield in_graph(
        f'SIGSTOP of the bridge for {STOPPED:g} s',
        f'{BY_WATCHDOG}; the bridge then latches that it expired, reason shown',
        stop,
    )


def told_to_end(number: signal.Signals) -> Hurt:
    """Return how to end the bridge by a signal."""

    def hurt(rig: BridgeRig) -> Found:
        rig.may_end.add(NAME)
        since = rig.signal(NAME, number)
        return both(went_safe(rig, since, AT_TANK), ended(rig, 130))

    return hurt


def kill(rig: BridgeRig) -> Found:
    """Kill the bridge, and start another."""
    since = rig.signal(NAME, signal.SIGKILL)
    found = went_safe(rig, since, LIMITS.watchdog_timeout + MARGIN)
    expired = rig.first('expire', since) is not None
    rig.seen['bridge_state'].clear()
    rig.start_bridge()
    again = time.monotonic_ns()
    rig.listen(AFTER)
    still = bool(rig.is_safe(rig.log(since=again)).all())
    rig.wait_for(lambda: depressurised(rig), 'a depressurised rig')
    rig.arm()
    words = f'by the watchdog: {expired}; new bridge still until armed: {still}'
    return both(found, (words, expired and still))


def stop(rig: BridgeRig) -> Found:
    """Hold the bridge up."""
    since = rig.signal(NAME, signal.SIGSTOP)
    rig.listen(STOPPED)
    rig.signal(NAME, signal.SIGCONT)
    found = went_safe(rig, since, LIMITS.watchdog_timeout + MARGIN)
    rig.hurt = since, since  # the bridge was held up on purpose
    expired = rig.first('expire', since) is not None
    reason = said(rig, since, 'read took', 'watchdog')
    return both(found, (f'by the watchdog: {expired}', expired), reason, latched(rig))


# ---- Errors in the bridge itself ----


def of_callbacks(folder: Path) -> Iterator[Fault]:
    """Yield errors that nobody expects, in every callback and in the thread of the card."""
    yield in_broken_bridge(
        "ROS's context is shut down",
        f'safe volts within {AT_TANK * MS:g} ms; the process ends with status 130',
        folder / f'break_{SHUTDOWN}',
        shut_down_under_it(folder / f'break_{SHUTDOWN}'),
    )
    for method, name in (
        ('on_valve_command', 'error in on_valve_command'),
        ('Monitor._read', 'error within a tick'),
        ('on_arm', 'error in on_arm'),
        ('on_disarm', 'error in on_disarm'),
        ('on_zero', 'error in on_zero'),
        ('on_reset_fault', 'error in on_reset_fault'),
        ('on_emergency_stop', 'error in on_emergency_stop'),
        ('on_deactivate', 'error in on_deactivate'),
        ('on_shutdown', 'error in on_shutdown'),
    ):
        trigger = folder / f'break_{method}'
        expected = at_once('the error is a fault')
        yield in_broken_bridge(name, expected, trigger, is_a_fault(method, trigger))
    for method, name, within in (
        ('publish_state', 'error in the thread of the card', PROMPT),
        ('look_after', 'error in the timer of the reports', LOOK_PERIOD + PROMPT),
    ):
        trigger = folder / f'break_{method}'
        expected = (
            f'safe volts within {within * MS:g} ms, reason in bridge_state; '
            'the process ends with status 1'
        )
        yield in_broken_bridge(name, expected, trigger, ends_it(trigger, within))


def in_broken_bridge(name: str, expected: str, trigger: Path, hurt: Hurt) -> Fault:
    """Return the fault that the method in the name of ``trigger`` breaks when that exists."""

    def start(rig: BridgeRig) -> None:
        trigger.unlink(missing_ok=True)
        rig.start_alone(trigger.name.removeprefix('break_'), str(trigger))

    return Fault(name, expected, hurt, start)


def shut_down_under_it(trigger: Path) -> Hurt:
    """Return how to shut ROS down in the process of the bridge."""

    def hurt(rig: BridgeRig) -> Found:
        rig.may_end.add(NAME)
        since = time.monotonic_ns()
        trigger.touch()
        return both(went_safe(rig, since, AT_TANK), ended(rig, 130))

    return hurt


def is_a_fault(method: str, trigger: Path) -> Hurt:
    """Return how to let a method raise; what calls it is called once."""

    def hurt(rig: BridgeRig) -> Found:
        since = time.monotonic_ns()
        trigger.touch()
        name = method.removeprefix('on_')
        if name in TRANSITIONS:
            rig.change(name)
            since = rig.called_at
        elif method.startswith('on_') and name != 'valve_command':
            rig.trigger(name)
            since = rig.called_at
        found = went_safe(rig, since, PROMPT)
        word = 'transition' if name in TRANSITIONS else 'raised on purpose'
        reason = said(rig, since, word)
        trigger.unlink()
        if name in TRANSITIONS:  # which let go of the card; the fault outlives that
            rig.change('configure')
            rig.change('activate')
        return both(found, reason, latched(rig))

    return hurt


def ends_it(trigger: Path, within: float) -> Hurt:
    """Return how to let a method raise without which the node cannot go on."""

    def hurt(rig: BridgeRig) -> Found:
        rig.may_end.add(NAME)
        since = time.monotonic_ns()
        trigger.touch()
        found = both(went_safe(rig, since, within), ended(rig, 1))
        reason = rig.fault(since)
        return both(found, (f'"{reason}"', 'raised on purpose' in reason))

    return hurt


# ---- Operation ----


def of_operation() -> Iterator[Fault]:
    """Yield what an operator may do at any time."""
    yield alone('~/emergency_stop', at_once(''), emergency_stop)
    prompt = f'safe volts within {PROMPT * MS:g} ms'
    yield alone('~/disarm', f'{prompt}; nothing moves before arm', disarm)
    yield alone(
        'lifecycle: deactivate', f'{prompt}; nothing moves before activate, arm', deactivate
    )
    yield alone('lifecycle: cleanup while active', f'not allowed there; {RUNS_ON}', cleanup)
    yield alone(
        'lifecycle: deactivate, cleanup',
        f'{prompt}; the card is let go; nothing moves before configure, activate, arm',
        cleanup_in_order,
    )
    yield alone('lifecycle: shutdown', f'{prompt}; the process ends with status 0', shut_down)
    yield alone('~/reset_fault while active', f'refused; {RUNS_ON}', reset_while_active)
    yield alone(
        '~/reset_fault while pressurised',
        f'refused, {LIMITS.depressurised * 1e-3:g} kPa named; granted below it; '
        'then nothing moves before arm',
        reset_under_pressure,
    )


def emergency_stop(rig: BridgeRig) -> Found:
    """Stop everything."""
    rig.trigger('emergency_stop')
    since = rig.called_at
    return faulted(rig, since, 'emergency stop')


def disarm(rig: BridgeRig) -> Found:
    """Disarm, and arm again."""
    rig.trigger('disarm')
    since = rig.called_at
    found = went_safe(rig, since, PROMPT)
    rig.arm()
    return both(found, ('runs again after arm', True))


def deactivate(rig: BridgeRig) -> Found:
    """Deactivate, and go back."""
    done = rig.change('deactivate')
    since = rig.called_at
    found = went_safe(rig, since, PROMPT)
    refused, _ = rig.trigger('arm')
    rig.change('activate')
    rig.arm()
    return both(found, (f'done: {done}, armed before activate: {refused}', done and not refused))


def cleanup(rig: BridgeRig) -> Found:
    """Ask for what a managed node does not allow from here."""
    since = time.monotonic_ns()
    done = rig.change('cleanup')
    return both((f'done: {done}', not done), goes_on(rig, since))


def cleanup_in_order(rig: BridgeRig) -> Found:
    """Deactivate, let go of the card, and begin anew."""
    rig.change('deactivate')
    since = rig.called_at
    done = rig.change('cleanup')
    found = went_safe(rig, since, PROMPT)
    listen_for(rig, lambda: rig.state() == 'unconfigured', 2.0)
    state = rig.state()
    rig.change('configure')
    rig.wait_for(lambda: rig.state() == 'inactive', 'the inactive state')
    rig.change('activate')
    still = bool(rig.is_safe(rig.log(since + round(PROMPT * 1e9))).all())
    rig.arm()
    words = f'state {state}, still until armed: {still}'
    return both(found, (words, done and still and state == 'unconfigured'))


def shut_down(rig: BridgeRig) -> Found:
    """Shut the node down."""
    rig.may_end.add(NAME)
    rig.change('shutdown')
    since = rig.called_at
    return both(went_safe(rig, since, PROMPT), ended(rig, 0))


def reset_while_active(rig: BridgeRig) -> Found:
    """Ask for a reset where there is no fault."""
    done, words = rig.trigger('reset_fault')
    return both((f'"{words}"', not done), goes_on(rig, rig.called_at))


def reset_under_pressure(rig: BridgeRig) -> Found:
    """Try to reset at once."""
    rig.trigger('reset_fault')  # of no fault; so that the call is quick when it counts
    rig.trigger('emergency_stop')
    since = rig.called_at
    early, words = rig.trigger('reset_fault')
    pressure = float(rig.log()['pressure'][-1].max())
    found = faulted(rig, since, 'emergency stop')
    named = f'{LIMITS.depressurised:g}' in words
    refused = (f'at {pressure * 1e-3:.0f} kPa: "{words}"', not early and named)
    return both(found, refused, reset_and_armed(rig))


# ---- What no bridge can see ----


def unseen() -> Iterator[Fault]:
    """Yield faults that only a test of each channel finds."""
    come = 'cannot be told by the bridge (check-channels does); the safe volts come all the same'
    for name, fault in (
        ('coil of valve 1 dead: its spool in the middle', 'valve_dead'),
        ('wire of valve 1 open: its spool in the middle', 'output_open'),
        ('output of valve 1 frozen', 'output_frozen'),
        ('wire of valve 1 shorted: unit 1 open to the source', 'output_rail'),
    ):
        expected = f'{come}; unit 1 is not vented by them: the dump valve is for that'
        yield alone(name, expected, stuck(fault))
    for name, fault, channels in (
        ('valves 1 and 2 swapped', 'outputs_swapped', (0, 1)),
        ('pressures 1 and 2 swapped', 'inputs_swapped', (MU_PRESSURE, MU_PRESSURE + 1)),
    ):
        yield alone(name, come, swapped(fault, channels))


def stuck(fault: str) -> Hurt:
    """Return how to let valve 1 stick; what the rig does then may be a fault of its own."""

    def hurt(rig: BridgeRig) -> Found:
        since = rig.inject(fault, 0)
        rig.listen(AFTER)
        seen = rig.fault(since) or 'nothing'
        named = 'valve' in seen
        rig.trigger('emergency_stop')
        safe = went_safe(rig, rig.called_at, PROMPT, vents=False)
        full = vented_to(rig, rig.called_at)
        words = f'unit 1 at {full:.0%} of nominal'
        return both((f'the bridge sees: {seen}', not named), safe, (words, full > VENTED))

    return hurt


def swapped(fault: str, channels: tuple[int, ...]) -> Hurt:
    """Return how to swap wires of a rig that is disarmed and vented, and to run it then."""

    def hurt(rig: BridgeRig) -> Found:
        rig.trigger('disarm')
        rig.wait_for(lambda: depressurised(rig), 'a depressurised rig')
        rig.inject(fault, *channels)
        # The wrong unit fills: slowly, for it is not the one whose pressure is looked at.
        rig.command = lambda sample: [min(spool, SLOW) for spool in rig.gentle(sample)]
        rig.arm()
        alive = goes_on(rig, time.monotonic_ns())
        rig.trigger('emergency_stop')
        return both(alive, went_safe(rig, rig.called_at, PROMPT))

    return hurt
