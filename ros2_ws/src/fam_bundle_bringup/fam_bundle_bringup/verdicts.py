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

"""What is asked of the loop after a fault: observations in words, each with a verdict."""

from collections.abc import Callable
from typing import NamedTuple

from fam_bundle_bringup.rig import Rig

SAFE_WITHIN = 0.02  # s of real time
AFTER = 1.5  # s of watching; a report comes once a second
VENTED = 0.05  # of the nominal pressure
BUMP = 0.01  # of the nominal pressure, largest step when a controller sets in again


class Fault(NamedTuple):
    """A fault by name, what must happen, and how it is done; ``hurt`` returns observed, passed."""

    name: str
    expected: str
    hurt: Callable[[Rig], tuple[str, bool]]
    start: Callable[[Rig], None] = Rig.start_all


IN_TIME = f'safe within {SAFE_WITHIN * 1e3:g} ms, reason on /diagnostics'
HARMLESS = f'harmless, or safe while commands are {SAFE_WITHIN * 1e3:g} ms old, then goes on'


def safe_and_said(rig: Rig, since: int, *words: str) -> tuple[str, bool]:
    """Return whether the plant was safe in time and somebody said one of ``words``."""
    rig.wait_for(lambda: rig.safe_after(since) is not None, 'the safe state', 5.0)
    rig.listen(AFTER)
    took, reason = rig.safe_after(since) or 0.0, rig.reason(since, *words)
    said = f'"{reason}"' if reason else 'no reason on /diagnostics'
    low = rig.vented_to(since) / rig.configuration.source.nominal_pressure
    before = ' (it was before)' if rig.was_safe_at(since) else ''
    observed = f'safe after {took * 1e3:.1f} ms{before}, vented to {low:.1%} of nominal; {said}'
    return observed, took <= SAFE_WITHIN and bool(reason) and low < VENTED


def goes_on(rig: Rig) -> tuple[str, bool]:
    """Return whether the loop runs again by itself, and sets in without a bump."""
    rig.wait_for(rig.runs, 'the run to go on')
    joined = rig.first_tick_of_this_stretch()
    bump = first_bump(rig, joined)
    nominal = rig.configuration.source.nominal_pressure
    words = f'goes on, first reference {bump / nominal:.2%} of nominal off'
    return words, bump <= BUMP * nominal


def first_bump(rig: Rig, tick: int) -> float:
    """
    Return how far the first applied reference from ``tick`` on is from the pressure (Pa).

    That is the pressure of its sample or of the last one answered before, at which the law was
    kept until then: a unit that is being vented loses some percent in a millisecond. The law's
    proportional action on what the strain has moved since is no bump. Raises RuntimeError
    where no reference has come.
    """
    commands = (s.message for s in rig.seen['valve_command'])
    references = {command.tick: command.pressure_reference[0] for command in commands}
    states = {s.message.tick: s.message for s in rig.seen['bundle_state']}
    first = min((t for t in references if t >= tick and t in states), default=None)
    if first is None:
        raise RuntimeError(f'no pressure reference from tick {tick} on')
    last = max((t for t in references if t < first and t in states), default=first)
    now, before = states[first], states[last]
    gain = rig.configuration.strain_loop.proportional_gain
    moved = gain * abs(now.strain - before.strain)
    low, high = sorted((now.mu_pressure[0], before.mu_pressure[0]))
    return float(max(low - moved - references[first], references[first] - high - moved, 0.0))


def both(*found: tuple[str, bool]) -> tuple[str, bool]:
    """Join observations; all must pass."""
    return '; '.join(words for words, _ in found), all(passed for _, passed in found)


def harmless_or_safe(rig: Rig, since: int, seconds: float = AFTER) -> tuple[str, bool]:
    """
    Return whether for a while nothing happened, or the plant was safe while it had to be.

    A process that comes or goes costs the others time in the middleware and on the cores.
    """
    found, undisturbed = harmless(rig, since, seconds)
    if undisturbed:
        return found, True
    stale = rig.stale_but_not_safe(since, SAFE_WITHIN)
    words = f'{found}; {stale} samples neither safe nor commanded'
    safe = any(state.safe for state in rig.messages('bundle_state', since))
    said = not safe or bool(rig.reason(since, 'safe'))
    return both((words, stale == 0 and said and not rig.ended()), goes_on(rig))


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
