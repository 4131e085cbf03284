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

"""How late this machine wakes a process that only sleeps: the floor of a real-time pace."""

import json
import os
import sys
import time
from typing import NamedTuple

from fam_bundle_bringup.floor import rank, run_roles, START_TIMEOUT, tune_process
from fam_bundle_node.pacing import Schedule, wait_until

MODULE = 'fam_bundle_bringup.jitter'
ROLE = 'sleeper'


class Jitter(NamedTuple):
    """How late a sleeper woke: share of periods in time (1), lateness (s), periods skipped."""

    in_time_share: float  # woken before the next period's time
    p50: float
    p99: float
    maximum: float
    skipped: int  # not in time either


def wake_up_jitter(
    seconds: float, period: float, busy_tail: float = 0.0, priority: int = 0
) -> Jitter:
    """
    Return how late a new process wakes that sleeps every ``period`` s, for ``seconds`` s.

    It spends the last ``busy_tail`` s of each wait awake, and has the process settings of the
    loop's nodes in real time, with ``priority`` as theirs. A wake-up later than the next
    period's time skips to the next one in the future.

    Raises RuntimeError, with the last line of its log, when it fails or hangs.
    """
    arguments = [str(round(value * 1e9)) for value in (seconds, period, busy_tail)]
    arguments.append(str(priority))
    found = run_roles(MODULE, (ROLE,), arguments, os.environ, START_TIMEOUT + 2.0 * seconds)
    return Jitter(**found)


def wake_ups(periods: int, period: int, busy_tail: int) -> tuple[list[int], int]:
    """
    Sleep through ``periods`` periods; return the lateness of each wake-up, and periods skipped.

    All times are in ns. The last wake-up may skip beyond the last period.
    """
    schedule = Schedule(time.monotonic_ns(), period)
    lateness: list[int] = []
    passed = 0
    while passed < periods:
        due = schedule.next_due()
        now = wait_until(due, busy_tail, time.monotonic_ns, time.sleep)
        lateness.append(now - due)
        passed += schedule.take(now)
    return lateness, passed - len(lateness)


def summary(lateness: list[int], skipped: int, period: int) -> Jitter:
    """Return what a run of ``wake_ups`` with ``period`` (ns) comes to; it woke at least once."""
    ordered = sorted(late * 1e-9 for late in lateness)
    in_time = sum(late < period for late in lateness)
    return Jitter(
        in_time_share=in_time / (len(lateness) + skipped),
        p50=rank(ordered, 0.5),
        p99=rank(ordered, 0.99),
        maximum=ordered[-1],
        skipped=skipped,
    )


def main() -> None:
    """Sleep, and print how late the wake-ups were."""
    duration, period, busy_tail, priority = (int(argument) for argument in sys.argv[2:])
    tune_process('realtime', priority)
    lateness, skipped = wake_ups(max(duration // period, 1), period, busy_tail)
    print(json.dumps(summary(lateness, skipped, period)._asdict()), flush=True)


if __name__ == '__main__':
    main()
