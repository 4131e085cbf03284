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

"""One case of a study: its run offline and what is measured; and the rivals of its schemes."""

from collections.abc import Callable
import dataclasses
import functools
from typing import Any, NamedTuple

from fam_bundle_bringup.experiment import check_feasible, last_cycle
from fam_bundle_bringup.failure import RunFailed
from fam_bundle_bringup.hindsight import best_threshold, THRESHOLDS, with_threshold
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.energy import energy, powers, summary
from fam_bundle_io.metrics import (
    needless_shifts,
    NotMeasurable,
    shift_times,
    shortest_interval,
    ticks_in,
    tracking,
    Window,
)
from fam_bundle_io.trace import Trace
from fam_bundle_model.lag_table import cached_lag_table, LagTable, PHYSICS
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError
import numpy as np

Row = dict[str, Any]


class Setting(NamedTuple):
    """What a run is given: what its laws believe in, and the rig, where that is another."""

    believed: Configuration
    actual: Configuration | None = None

    def rig(self) -> Configuration:
        """Return the configuration of the rig that is there."""
        return self.believed if self.actual is None else self.actual

    def hash(self) -> str:  # noqa: A003
        """Return a hash of all that shapes a result."""
        return ' '.join(c.hash() for c in self if c is not None)

    def check(self) -> None:
        """Raise ConfigurationError where the rig cannot do what is asked, or is thought not to."""
        for configuration in filter(None, self):
            check_feasible(configuration)


# What a run is measured by; None where it could not be. The window is that of every metric.
MEASURED = (
    'iae',
    'max_error',
    'rms_error',
    'upshifts',
    'downshifts',
    'needless_shifts',
    'shortest_interval',
    'hydraulic_input',
    'output',
    'returned',
    'throttling_loss',
    'efficiency',
)


def measured(setting: Setting, trace: Trace) -> Row:
    """
    Return the numbers of a whole run, in SI units.

    Tracking and energy are taken over the window of the metrics, the last cycle; shifts over the
    whole run. Raises NotMeasurable where the trace does not reach that far or is not finite.
    """
    window = Window(*last_cycle(setting.believed))
    tracked = tracking(trace, *window)
    inside = ticks_in(trace, window)
    error = (trace['strain_reference'] - trace['strain'])[inside]
    up, down = shift_times(trace)
    interval = shortest_interval(trace)
    spent = energy(trace, powers(trace, setting.rig()), window)
    return {
        **tracked._asdict(),
        'rms_error': float(np.sqrt(np.mean(error**2))),
        'upshifts': len(up),
        'downshifts': len(down),
        'needless_shifts': needless_shifts(trace),
        'shortest_interval': interval if np.isfinite(interval) else None,
        **summary(spent),
    }


def not_run(status: str, reason: str) -> Row:
    """Return the row of a case without numbers."""
    return {'status': status, 'reason': reason, **dict.fromkeys(MEASURED)}


def run_case(setting: Setting) -> Row:
    """
    Return the row of one case: ``status``, ``reason`` and what it is measured by.

    ``status`` is ``ok``; ``unreachable`` where the rig cannot do it, which is then not tried;
    ``diverged`` where the run ended early or gave nothing that can be measured.
    """
    try:
        setting.check()
        table = lag_table_of(setting.believed)
        trace = run_offline(setting.believed, table=table, actual=setting.actual)
        return {'status': 'ok', 'reason': '', **measured(setting, trace)}
    except ConfigurationError as error:
        return not_run('unreachable', str(error))
    except (RunFailed, NotMeasurable) as error:
        return not_run('diverged', str(error))


def lag_table_of(configuration: Configuration) -> LagTable:
    """Return the lag table of ``configuration``; the last ones stay in memory."""
    return _lag_table(_Table(configuration.hash(*PHYSICS, 'lag_table'), configuration))


@dataclasses.dataclass(frozen=True)
class _Table:
    """A configuration that is told apart only by what its lag table depends on."""

    key: str
    configuration: Configuration = dataclasses.field(compare=False)


@functools.lru_cache(maxsize=16)
def _lag_table(wanted: _Table) -> LagTable:
    return cached_lag_table(wanted.configuration)


# ---- Rivals ----


def run_best_threshold(setting: Setting) -> Row:
    """
    Return the row of the best fixed threshold for this very reference, by hindsight.

    ``threshold`` is the one with the least IAE among those that do not chatter, ``steady`` how
    many of those tried do not. ``unreachable`` where all do.
    """
    found = None
    try:
        setting.check()
        found = best_threshold(setting.believed, actual=setting.actual)
    except ConfigurationError as error:
        reason = str(error)
    else:
        reason = 'every threshold chatters'
    if found is None:
        return {**not_run('unreachable', reason), 'threshold': None, 'steady': 0}
    tuned = with_threshold(setting.believed, found.threshold)
    row = run_case(setting._replace(believed=tuned))
    return {**row, 'threshold': found.threshold, 'steady': found.steady}


def run_always_recruited(setting: Setting) -> Row:
    """Return the row of the same bundle with all motor units recruited from the first tick on."""
    recruitment = dataclasses.replace(setting.believed.recruitment, scheme='all')
    believed = dataclasses.replace(setting.believed, recruitment=recruitment)
    return run_case(setting._replace(believed=believed))


class Rival(NamedTuple):
    """A rival: what runs it, how many runs that takes, and its numbers beside those of a run."""

    run: Callable[[Setting], Row]
    runs: int
    extra: tuple[str, ...]


RIVALS = {
    'best_threshold': Rival(run_best_threshold, len(THRESHOLDS) + 1, ('threshold', 'steady')),
    'always_recruited': Rival(run_always_recruited, 1, ()),
}
