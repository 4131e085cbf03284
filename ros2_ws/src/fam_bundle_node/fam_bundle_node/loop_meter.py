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

"""How well a node keeps up: rate, latencies, CPU time, and what went wrong. No ROS."""

from collections import Counter
from collections.abc import Callable
import math
import time
from typing import NamedTuple

from fam_bundle_node.ticks import TickCounts

NANOSECONDS = 1e-9
SHARES = (0.5, 0.99, 1.0)
# A first sample of another age was stamped by another machine's clock.
OLDEST_FIRST_SAMPLE = 5_000_000_000  # ns


class LoopReport(NamedTuple):
    """One interval of a node; times in s, counts since its start."""

    interval: float
    ticks: int
    rate: float
    latency_p50: float
    latency_p99: float
    latency_max: float
    cpu_time_per_tick: float
    cpu_share: float


class WholeRun(NamedTuple):
    """All latencies of a node since its start (s), and how many answers came within a period."""

    answered: int
    in_time: int
    skipped_periods: int
    latency_p50: float
    latency_p99: float
    latency_max: float

    def words(self) -> str:
        """Return the same in words, for a log."""
        if not self.answered or math.isnan(self.latency_p50):
            return 'none answered'
        p50, p99, largest = (round(1e6 * latency) for latency in self[3:])
        return (
            f'{self.answered} answered, {self.in_time} within a period, '
            f'{self.skipped_periods} periods skipped; '
            f'latency p50 {p50} us, p99 {p99} us, max {largest} us'
        )


class LoopMeter:
    """Takes the time of each answer; ``report`` sums up since the report before."""

    def __init__(
        self,
        clock: Callable[[], int] = time.monotonic_ns,
        cpu: Callable[[], int] = time.process_time_ns,
    ) -> None:
        """Use ``clock`` and ``cpu`` (both ns)."""
        self.counts = TickCounts()
        self.ticks = self.overruns = self.skipped_periods = 0
        self._clock, self._cpu = clock, cpu
        self._latencies: list[int] = []
        self._begin, self._cpu_begin, self._ticks_begin = clock(), cpu(), 0
        self._comparable: bool | None = None
        # Counts by whole microseconds: a run may last for days.
        self._histogram: Counter[int] = Counter()

    def age(self, steady_time: int) -> int | None:
        """Return how long ago ``steady_time`` was (ns), or None if it is another machine's."""
        age = self._clock() - steady_time
        if self._comparable is None:
            self._comparable = 0 <= age < OLDEST_FIRST_SAMPLE
        return age if self._comparable else None

    def answered(self, tick: int, steady_time: int) -> None:
        """
        Count a tick whose sample was taken at ``steady_time`` (ns).

        Tick 0 has no latency: it waits until the loop has closed.
        """
        self.ticks += 1
        age = self.age(steady_time) if tick > 0 else None
        if age is not None:
            self._latencies.append(age)

    def skipped(self, periods: int) -> None:
        """Note that a step came ``periods`` periods after the last; more than 1 is an overrun."""
        if periods > 1:
            self.overruns += 1
            self.skipped_periods += periods - 1

    def report(self) -> LoopReport:
        """Return the sums since the last report and begin anew."""
        latencies, self._latencies = self._latencies, []
        now, cpu, ticks = self._clock(), self._cpu(), self.ticks
        interval = max(now - self._begin, 1) * NANOSECONDS
        done = ticks - self._ticks_begin
        spent = (cpu - self._cpu_begin) * NANOSECONDS
        self._begin, self._cpu_begin, self._ticks_begin = now, cpu, ticks
        self._histogram.update(latency // 1000 for latency in latencies)
        latencies.sort()
        p50, p99, largest = (quantile(latencies, share) * NANOSECONDS for share in SHARES)
        return LoopReport(
            interval,
            ticks,
            done / interval,
            p50,
            p99,
            largest,
            spent / done if done else 0.0,
            spent / interval,
        )

    def forget_clock(self) -> None:
        """Find out anew whether the samples are stamped by this machine's clock."""
        self._comparable = None

    def whole_run(self, period: int) -> WholeRun:
        """Return the sums over all reports, latencies to 1 us; ``period`` in ns."""
        found = sorted(self._histogram.items())
        in_time = sum(count for latency, count in found if latency * 1000 < period)
        total, reached = sum(self._histogram.values()), 0
        ranks = [share * total for share in SHARES]
        latencies = [math.nan] * len(SHARES)
        for latency, count in found:
            for i, rank in enumerate(ranks):
                if reached < rank <= reached + count:
                    latencies[i] = latency * 1e-6
            reached += count
        return WholeRun(self.ticks, in_time, self.skipped_periods, *latencies)


def quantile(ordered: list[int], share: float) -> float:
    """
    Return the value that ``share`` of the ``ordered`` ones do not exceed, or NaN of none.

    Interpolates linearly between two ranks.
    """
    if not ordered:
        return math.nan
    rank = share * (len(ordered) - 1)
    low = math.floor(rank)
    high = min(low + 1, len(ordered) - 1)
    return ordered[low] + (rank - low) * (ordered[high] - ordered[low])
