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

"""The report says how fast, how late and how dear the ticks of an interval were."""

import math

from fam_bundle_node.loop_meter import LoopMeter
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

LONG_AGO = 10**15  # ns, on the fake clock
MS = 1_000_000  # ns


class Clock:
    """Shows what it is set to."""

    def __init__(self):
        self.now = LONG_AGO

    def __call__(self):
        return self.now


@pytest.fixture
def clock():
    return Clock()


@pytest.fixture
def cpu():
    return Clock()


@pytest.fixture
def meter(clock, cpu):
    return LoopMeter(clock, cpu)


def answer(meter, clock, *latencies):
    """Answer one sample every millisecond, each ``latencies`` ns after it was taken."""
    for latency in latencies:
        clock.now += MS
        meter.answered(meter.ticks + 1, clock.now - latency)


@settings(deadline=None)
@given(st.lists(st.integers(0, 5_000 * MS - 1), min_size=1, max_size=50))
def test_percentiles_are_those_of_the_latencies(latencies):
    clock = Clock()
    meter = LoopMeter(clock, Clock())
    answer(meter, clock, *latencies)
    report = meter.report()
    found = report.latency_p50, report.latency_p99, report.latency_max
    assert found == pytest.approx(np.percentile(latencies, (50, 99, 100)) * 1e-9, rel=1e-12)


def test_a_known_spread_has_known_percentiles(meter, clock):
    answer(meter, clock, *(us * 1000 for us in reversed(range(101))))
    report = meter.report()
    assert report.latency_p50 == pytest.approx(50e-6)
    assert report.latency_p99 == pytest.approx(99e-6)
    assert report.latency_max == pytest.approx(100e-6)


def test_rate_is_ticks_over_elapsed_time(meter, clock):
    answer(meter, clock, *[0] * 500)
    clock.now += 1500 * MS
    report = meter.report()
    assert report.interval == pytest.approx(2.0)
    assert report.rate == pytest.approx(250.0)


def test_cpu_time_is_told_per_tick_and_as_a_share(meter, clock, cpu):
    answer(meter, clock, *[0] * 1000)
    cpu.now += 250 * MS
    report = meter.report()
    assert report.cpu_time_per_tick == pytest.approx(250e-6)
    assert report.cpu_share == pytest.approx(0.25)


def test_each_report_is_of_the_time_since_the_one_before(meter, clock, cpu):
    answer(meter, clock, *[900_000] * 1000)
    cpu.now += 900 * MS
    meter.report()
    answer(meter, clock, *[100_000] * 500)
    cpu.now += 50 * MS
    report = meter.report()
    assert report.interval == pytest.approx(0.5)
    assert report.rate == pytest.approx(1000.0)
    assert report.latency_max == pytest.approx(100e-6)
    assert report.cpu_time_per_tick == pytest.approx(100e-6)
    assert report.cpu_share == pytest.approx(0.1)
    assert report.ticks == 1500  # since the start


def test_an_interval_without_ticks_has_no_latencies(meter, clock, cpu):
    clock.now += 1000 * MS
    cpu.now += 10 * MS
    report = meter.report()
    assert (report.ticks, report.rate, report.cpu_time_per_tick) == (0, 0.0, 0.0)
    assert report.cpu_share == pytest.approx(0.01)
    assert all(map(math.isnan, (report.latency_p50, report.latency_p99, report.latency_max)))


def test_two_reports_at_once_are_no_error(meter):
    meter.report()
    assert meter.report().rate == 0.0


def test_tick_0_counts_but_has_no_latency(meter, clock):
    clock.now += 1000 * MS
    meter.answered(0, clock.now - 900 * MS)
    assert math.isnan(meter.report().latency_max)
    answer(meter, clock, 50_000)
    report = meter.report()
    assert report.ticks == 2
    assert report.latency_max == pytest.approx(50e-6)


@pytest.mark.parametrize('offset', [-(10**12), -10 * MS, 60_000 * MS, LONG_AGO])
def test_samples_of_another_machines_clock_are_counted_but_have_no_latency(meter, clock, offset):
    answer(meter, clock, *[offset] * 100)
    assert meter.age(clock.now - offset) is None
    report = meter.report()
    assert (report.ticks, report.rate) == (100, pytest.approx(1000.0))
    assert all(map(math.isnan, (report.latency_p50, report.latency_p99, report.latency_max)))


def test_old_sample_of_a_known_clock_keeps_its_age(meter, clock):
    assert meter.age(clock.now - MS) == MS
    assert meter.age(clock.now - 60_000 * MS) == 60_000 * MS


def test_overruns_and_the_periods_they_skipped_are_counted(meter):
    for periods in (1, 1, 3, 1, 51, 2, 1):
        meter.skipped(periods)
    assert (meter.overruns, meter.skipped_periods) == (3, 2 + 50 + 1)
    meter.report()
    assert (meter.overruns, meter.skipped_periods) == (3, 53)


def test_a_whole_run_is_summed_over_its_reports():
    now = [0]
    meter = LoopMeter(clock=lambda: now[0], cpu=lambda: 0)
    generator = np.random.default_rng(1)
    latencies = generator.integers(100_000, 3_000_000, 5000)
    for tick, latency in enumerate(latencies, 1):
        now[0] += 1_000_000
        meter.answered(tick, now[0] - int(latency))
        if tick % 1000 == 0:
            meter.report()
    whole = meter.whole_run(1_000_000)
    assert whole.answered == 5000
    assert whole.in_time == np.count_nonzero(latencies < 1_000_000)
    assert whole.latency_p50 == pytest.approx(np.median(latencies) * 1e-9, abs=2e-6)
    assert whole.latency_p99 == pytest.approx(np.percentile(latencies, 99) * 1e-9, abs=2e-6)
    assert whole.latency_max == pytest.approx(latencies.max() * 1e-9, abs=2e-6)
