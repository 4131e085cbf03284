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

"""What the paper's text says of the shapes in its Figures 11-14, checked on traces."""

from collections.abc import Mapping
from typing import NamedTuple

from fam_bundle_io.metrics import SATURATED, shift_times
from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration
import numpy as np
import numpy.typing as npt

AFTER = 1.5  # s after an upshift that count as immediately following it


class Claim(NamedTuple):
    """One statement of the paper on a figure, whether it holds here, and what was measured."""

    figure: str
    statement: str
    holds: bool
    measured: str


class _Run(NamedTuple):
    """A trace with the ticks of its last upshift and of the downshift after it."""

    trace: Trace
    up: int
    down: int

    def signal(self, name: str) -> npt.NDArray[np.float64]:
        return self.trace[name]

    def error(self) -> npt.NDArray[np.float64]:
        return self.signal('strain_reference') - self.signal('strain')

    def after(self) -> slice:
        return slice(self.up, self.up + round(AFTER / self.period()))

    def before(self) -> slice:
        return slice(max(self.up - round(AFTER / self.period()), 0), self.up)

    def period(self) -> float:
        time = self.signal('time')
        return float(time[1] - time[0])

    def largest_error_after(self) -> float:
        return float(np.abs(self.error()[self.after()]).max())

    def overshoot(self) -> float:
        return float(-self.error()[self.up : self.down + 1].min())  # noqa: E203

    def saturation_after(self) -> float:
        """Return the share of the ticks after the upshift at which MU1 is at the source."""
        first = self.signal('mu_pressure')[self.after(), 0]
        return float(np.mean(first >= SATURATED * self.signal('source_pressure')[self.after()]))


def _last_shift(trace: Trace) -> _Run | None:
    time = trace['time']
    up, down = shift_times(trace)
    if not up:
        return None
    end = min((t for t in down if t > up[-1]), default=float(time[-1]))
    return _Run(trace, int(np.searchsorted(time, up[-1])), int(np.searchsorted(time, end)))


def paper_claims(configuration: Configuration, traces: Mapping[str, Trace]) -> list[Claim]:
    """
    Return each statement that the text makes on Figures 11-14, checked on the last cycle.

    ``traces`` holds the schemes ``baseline``, ``lag`` and ``lag_pressure``. Where one of them
    never shifts, nothing can hold.
    """
    runs = [_last_shift(traces[name]) for name in ('baseline', 'lag', 'lag_pressure')]
    baseline, lag, both = runs
    if baseline is None or lag is None or both is None:
        return [Claim('11-14', 'each controller shifts up', False, 'a scheme never shifts')]
    return [
        *_baseline_claims(configuration, baseline),
        *_lag_claims(baseline, lag),
        *_pressure_claims(configuration, lag, both),
        _comparison_claim(baseline, lag, both),
    ]


def _baseline_claims(configuration: Configuration, run: _Run) -> list[Claim]:
    recruitment, nominal = configuration.recruitment, configuration.source.nominal_pressure
    pressure, source = run.signal('mu_pressure'), run.signal('source_pressure')
    error = run.error()
    at_up = pressure[run.up, 0] / nominal
    at_down = pressure[run.down, 1] / nominal
    drop = source[run.before()].mean() - source[run.after()].min()
    return [
        Claim(
            '11',
            f'upshift once MU1 reaches {recruitment.upshift_threshold:.0%} of nominal',
            bool(abs(at_up - recruitment.upshift_threshold) < 0.02),
            f'{at_up:.1%}',
        ),
        Claim(
            '11',
            f'downshift once MU2 falls to {recruitment.downshift_threshold:.0%}',
            bool(abs(at_down - recruitment.downshift_threshold) < 0.02),
            f'{at_down:.1%}',
        ),
        Claim(
            '11',
            'the strain lags further behind right after the upshift',
            bool(run.largest_error_after() > 1.5 * abs(error[run.up])),
            f'error {error[run.up]:.4f} -> {run.largest_error_after():.4f}',
        ),
        Claim(
            '11',
            'this results in overshoot',
            run.overshoot() > 0.001,
            f'overshoot {max(run.overshoot(), 0.0):.4f}',
        ),
        Claim(
            '11',
            'MU1 saturates at the source pressure',
            run.saturation_after() > 0.05,
            f'{run.saturation_after() * AFTER:.2f} s of the first {AFTER} s',
        ),
        Claim(
            '11',
            'recruiting MU2 drops the source pressure',
            bool(drop > 0.05 * nominal),
            f'{drop / 1e3:.0f} kPa',
        ),
    ]


def _lag_claims(baseline: _Run, run: _Run) -> list[Claim]:
    times = run.signal('time')
    saturation, lag = run.signal('time_to_saturation'), run.signal('recruitment_lag')
    coming = saturation[run.before()]
    rising = np.corrcoef(lag[run.before()], run.signal('strain')[run.before()])[0, 1]
    earlier = float(baseline.signal('time')[baseline.up] - times[run.up])
    ratio = run.largest_error_after() / baseline.largest_error_after()
    return [
        Claim(
            '12',
            'time to saturation falls towards the shift',
            bool(np.all(np.isfinite(coming)) and coming[-1] < coming[0]),
            f'{coming[0]:.2f} s -> {coming[-1]:.2f} s',
        ),
        Claim(
            '12',
            'recruitment lag grows with strain',
            bool(rising > 0.9),
            f'correlation {rising:.3f}',
        ),
        Claim(
            '12',
            'upshift when time to saturation drops below the lag',
            bool(saturation[run.up] <= lag[run.up] and saturation[run.up - 1] > lag[run.up - 1]),
            f'{saturation[run.up]:.3f} s <= {lag[run.up]:.3f} s',
        ),
        Claim(
            '12', 'upshift earlier than the baseline', earlier > 0.0, f'{earlier:.2f} s earlier'
        ),
        Claim(
            '12',
            'MU1 is not saturated after the upshift',
            run.saturation_after() < 0.05,
            f'{run.saturation_after() * AFTER:.2f} s of the first {AFTER} s',
        ),
        Claim(
            '12',
            'the lag after the shift is significantly reduced',
            ratio < 0.5,
            f'{ratio:.2f} of the baseline',
        ),
    ]


def _pressure_claims(configuration: Configuration, lag: _Run, both: _Run) -> list[Claim]:
    window = round(0.3 / both.period())
    compensation = both.signal('pressure_compensation')[both.after()].max()

    def raised(run: _Run) -> float:
        first = run.signal('mu_pressure')[:, 0]
        return float(first[run.up : run.up + window].mean() - first[run.up])  # noqa: E203

    gain = raised(both) - raised(lag)
    noticeable = 0.01 * configuration.source.nominal_pressure
    ratio = both.largest_error_after() / lag.largest_error_after()
    return [
        Claim(
            '13',
            'compensation raises the pressure of MU1 after the shift',
            gain > noticeable,
            f'{gain / 1e3:+.1f} kPa; at most {compensation / 1e3:.1f} kPa asked for',
        ),
        Claim(
            '13',
            'tracking after the shift is better than with lag compensation alone',
            ratio < 1.0,
            f'largest error {ratio:.2f} of it',
        ),
    ]


def _comparison_claim(baseline: _Run, lag: _Run, both: _Run) -> Claim:
    errors = [run.largest_error_after() for run in (baseline, lag, both)]
    return Claim(
        '14',
        'right after the shift: baseline worst, then lag, then both',
        errors[0] > errors[1] > errors[2],
        ', '.join(f'{e:.4f}' for e in errors),
    )
