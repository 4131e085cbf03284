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
What is asked of the hardware bridge after a fault: observations in words, each with a verdict.

Whether valves are safe is read from the card's log, in time and in samples that were taken.
"""

from collections.abc import Callable
import contextlib
import math

from fam_bundle_bringup.bridge_rig import BridgeRig
from fam_bundle_bringup.graph import BRIDGE
from fam_bundle_bringup.verdicts import both, VENTED
from fam_bundle_io.hardware.calibration import MU_PRESSURE, Scaling, SOURCE_PRESSURE
import numpy as np

Found = tuple[str, bool]

MARGIN = 0.01  # s for a machine that is not disturbed: cycles under way, wake-ups
PROMPT = 0.02  # s: at once, for a loop of 1 ms whose reads may come late
AFTER = 0.8  # s of watching that nothing moves
VENTING = 3.0  # s that a full rig gets to vent
LAST = 100  # reports; a channel that jumps about is right now and then
REPORT = 3.0  # s in which a reason must stand on /diagnostics; a report comes once a second


def went_safe(
    rig: BridgeRig, since: int, within: float, samples: float = math.inf, *, vents: bool = True
) -> Found:
    """
    Return whether the safe volts were out in time, and stayed, and the rig vented.

    ``within`` is in s from ``since`` (ns) on, ``samples`` how many may be taken before.
    """
    rig.wait_for(lambda: rig.safe_since(since) is not None, 'the safe volts', 5.0)
    rig.listen(AFTER)
    at = rig.safe_since(since)
    if at is None:
        return 'valves moved again', False
    took, reads = (at - since) * 1e-9, reads_between(rig, since, at)
    rig.hurt = since, at
    if vents:
        listen_for(rig, lambda: vented_to(rig, at) < VENTED, VENTING)
    share = vented_to(rig, at)
    words = f'safe volts out after {took * 1e3:.1f} ms, {reads} samples; vented to {share:.1%}'
    passed = took <= within and reads <= samples
    return words, passed and (share < VENTED or not vents)


def vented_to(rig: BridgeRig, since: int) -> float:
    """Return the lowest that the fullest motor unit came to since then (ns), over nominal."""
    low = float(rig.log(since)['pressure'].max(axis=1).min())
    return low / rig.configuration.source.nominal_pressure


def reads_between(rig: BridgeRig, since: int, until: int) -> int:
    """Return how many samples were taken in that time (ns)."""
    rows = rig.log(since)
    return int(np.count_nonzero((rows['event'] == b'read') & (rows['time'] < until)))


def said(rig: BridgeRig, since: int, *words: str) -> Found:
    """Return whether the bridge says one of ``words``, in bridge_state and on /diagnostics."""
    listen_for(rig, lambda: bool(rig.fault(since) and rig.reason(since, *words)), REPORT)
    fault, report = rig.fault(since), rig.reason(since, *words)
    if not any(word in fault for word in words):
        return f'bridge_state says "{fault}"', False
    return f'"{fault}"' + ('' if report else ', not on /diagnostics'), bool(report)


def listen_for(rig: BridgeRig, true: Callable[[], bool], patience: float) -> None:
    """Listen until ``true``, or for so long (s)."""
    with contextlib.suppress(RuntimeError):
        rig.wait_for(true, 'it', patience)


def latched(rig: BridgeRig) -> Found:
    """Return whether the fault stays, valves too, and arming is refused for it."""
    since = rig.log()['time'][-1]
    rig.trigger('disarm')
    done, words = rig.trigger('arm')
    rig.listen(0.2)
    stays = rig.state() == 'fault' and rig.is_safe(rig.log(since)).all()
    good = not done and 'the bridge is fault' in words and bool(stays)
    return f'latched: {"yes" if good else "no"}', good


def faulted(
    rig: BridgeRig,
    since: int,
    word: str,
    within: float = PROMPT,
    samples: float = math.inf,
    *,
    vents: bool = True,
) -> Found:
    """Return whether valves went safe in time, and the fault is said and latched."""
    safe = went_safe(rig, since, within, samples, vents=vents)
    return both(safe, said(rig, since, word), latched(rig))


def goes_on(rig: BridgeRig, since: int, seconds: float = AFTER) -> Found:
    """Return whether nothing happens for a while: valves follow commands all the time."""
    rig.listen(seconds)
    rows = rig.log(since)
    safe = int(np.count_nonzero(rig.is_safe(rows)))
    states = {str(s.message.state) for s in rig.reported(since)}
    rig.hurt = since, int(rows['time'][-1])
    words = f'{reads_between(rig, since, 1 << 62)} samples, none safe' if not safe else 'went safe'
    if rig.fault(since):
        words += f': {rig.fault(since)}'
    return words, not safe and states == {'active'} and not rig.ended()


def reset_and_armed(rig: BridgeRig) -> Found:
    """Return whether the fault ends by a reset only, and valves move by a new arm only."""
    rig.wait_for(lambda: depressurised(rig), 'a depressurised rig')
    rig.listen(0.2)
    done, words = rig.trigger('reset_fault')
    since = int(rig.log()['time'][-1])
    rig.listen(0.5)
    still = bool(rig.is_safe(rig.log(since)).all())
    rig.arm()
    good = done and still
    return ('after reset and arm it runs' if good else f'reset: {words}, still: {still}'), good


def depressurised(rig: BridgeRig) -> bool:
    """Return whether every motor unit is so."""
    return bool(rig.log()['pressure'][-1].max() < rig.limits.depressurised / 2.0)


def ended(rig: BridgeRig, status: int) -> Found:
    """Return whether the bridge has ended with ``status``."""
    process = rig.nodes[BRIDGE[1]]
    listen_for(rig, lambda: process.poll() is not None, 10.0)
    found = process.poll()
    return f'exit status {found}', found == status


def degraded(rig: BridgeRig, since: int, channel: int) -> Found:
    """Return whether a channel, and no other, is marked as lost, and the run goes on."""
    alive = goes_on(rig, since, 1.2)
    marks = np.array([s.message.degraded for s in rig.reported(since)])
    others = np.delete(marks, channel, axis=1).any()
    share = float(marks[-LAST:, channel].mean())
    words = f'marked as degraded in {share:.0%} of the last {LAST} reports'
    return both(alive, (words, share > 0.5 and not others))


def beyond_limit(rig: BridgeRig, since: int) -> tuple[int, int] | None:
    """
    Return when the last of too many samples beyond a limit of pressure was taken (ns).

    And how many more were taken before the safe volts were out. None: never so many.
    """
    limits, nominal = rig.limits, rig.configuration.source.nominal_pressure
    rows = rig.log(since)
    reads = rows[rows['event'] == b'read']
    values = np.empty_like(reads['inputs'])
    scaling = Scaling(rig.calibration)
    for volts, value in zip(reads['inputs'], values, strict=True):
        scaling.to_values(np.ascontiguousarray(volts), value)
    source = values[:, SOURCE_PRESSURE, None] + limits.overpressure_margin
    bound = np.minimum(limits.overpressure_ratio * nominal, source)
    above = values[:, MU_PRESSURE:] > bound
    streak = np.zeros(above.shape[1], dtype=int)
    for i, flags in enumerate(above):
        streak = (streak + 1) * flags
        if streak.max() >= limits.overpressure_samples:
            at = int(reads['time'][i])
            safe = rig.safe_since(since) or 1 << 62
            return at, reads_between(rig, at + 1, safe)
    return None
