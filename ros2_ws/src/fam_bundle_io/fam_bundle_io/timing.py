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
How punctual a recorded loop was: time from sample to sample and to its answers.

From the publishers' times in the bag. All nodes must have run on one machine, or on several whose
clocks agree; a bag without publishers' times (SQLite) gives the recorder's instead.
"""

from collections.abc import Iterator, Mapping
from typing import Any, NamedTuple, TYPE_CHECKING

from fam_bundle_io.bag import Bag, LOOP, Run, run_tables, STATE
from fam_bundle_io.metrics import Window
from fam_bundle_model.hydraulics import TO_TANK
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pandas as pd

COMMAND = 'fam_bundle_msgs/msg/ValveCommand'
Array = npt.NDArray[np.float64]
Flags = npt.NDArray[np.bool_]
COUNTS = (
    'ticks',
    'skipped_periods',
    'overruns',
    'missing',
    'duplicate',
    'out_of_order',
    'late',
    'refused',
)


class Spread(NamedTuple):
    """Median, 99th percentile and largest of some times in s."""

    median: float
    p99: float
    largest: float


class Timing(NamedTuple):
    """
    Times of one run.

    ``interval`` (n - 1,) is the time in s between two samples, ``answers`` by topic the time in s
    from a sample to what answers it, ``answered`` by topic how many of the ``samples`` have an
    answer in the bag. ``safe`` are the stretches of the run in which the plant did not follow
    commands, None where the bag does not tell. ``doubts`` say why the times are no such times;
    ``nodes`` are the last reports of the nodes.
    """

    samples: int
    interval: Array
    answers: dict[str, Array]
    answered: dict[str, int]
    safe: list[Window] | None
    doubts: list[str]
    nodes: list[dict[str, Any]]


def timing(bag: Bag, found: Run, namespace: str = '', run: int = -1) -> Timing:
    """Return the times of the run ``found`` in the bag."""
    tables, _ = run_tables(bag, namespace, run)
    samples = tables.pop(STATE)
    answers, answered = {}, {}
    for name, table in tables.items():
        both = samples.index.intersection(table.index)
        answered[LOOP[name]] = len(both)
        answers[LOOP[name]] = _seconds(
            table['published'].loc[both] - samples['published'].loc[both]
        )
    interval = _seconds(samples['published'].diff().iloc[1:])
    return Timing(
        len(samples),
        interval,
        answers,
        answered,
        _safe(samples),
        list(_doubts(samples, tables)),
        _reports(bag, namespace),
    )


def _safe(samples: 'pd.DataFrame') -> list[Window] | None:
    """Return when the plant was safe, from all samples: it is when controllers do not answer."""
    needed = ('safe', 'header.stamp.sec', 'header.stamp.nanosec')
    if any(name not in samples for name in needed):
        return None
    time = samples['header.stamp.sec'].to_numpy(float)
    time = time + 1e-9 * samples['header.stamp.nanosec'].to_numpy(float)
    ends = np.append(time[1:], time[-1])
    found = phases(samples['safe'].to_numpy(bool))
    return [Window(float(time[first]), float(ends[last])) for first, last in found]


def _doubts(samples: 'pd.DataFrame', answers: 'Mapping[str, pd.DataFrame]') -> Iterator[str]:
    """Yield why the times of publishing do not tell how long anything took."""
    tables = [samples, *answers.values()]
    if any((table['published'].diff() < 0).any() for table in tables):
        yield 'the system clock was set back during the run: times of answers are no such times'
    if all((table['published'] == table['received']).all() for table in tables):
        yield (
            "the bag holds no publishers' times: those of answers are from one receipt to another"
        )


def phases(flags: Flags) -> list[tuple[int, int]]:
    """Return first and last place of every stretch of ``flags`` that is true."""
    edges = np.flatnonzero(np.diff(np.concatenate([[False], flags, [False]]).astype(int)))
    return [(int(a), int(z) - 1) for a, z in edges.reshape(-1, 2)]


def spread(times: Array) -> Spread | None:
    """Return what summarizes ``times``, None where there are none."""
    if not len(times):
        return None
    median, p99 = np.percentile(times, (50.0, 99.0))
    return Spread(float(median), float(p99), float(times.max()))


def applied_spool(bag: Bag, found: Run, namespace: str = '', run: int = -1) -> Array:
    """
    Return the spool commands that act from each tick of a run to the next (ticks, units).

    That is the newest command that was published before the next sample, one of an earlier tick
    where the answer came late; and open to the tank while the plant was safe. Where times of
    publishing cannot tell, each command acts from its own tick.
    """
    tables, _ = run_tables(bag, namespace, run)
    samples, commands = tables[STATE], tables[COMMAND]
    if any((table['published'].diff() < 0).any() for table in (samples, commands)):
        return np.asarray(found.trace['spool'])
    units = found.trace['spool'].shape[1]
    spool = commands[[f'spool[{unit}]' for unit in range(units)]].to_numpy(float)
    spool = np.vstack([np.full(units, TO_TANK), spool])  # before the first command
    ends = [*samples['published'].to_numpy()[1:], np.inf]
    acting = spool[np.searchsorted(commands['published'].to_numpy(), ends)]
    if 'safe' in samples:
        acting[samples['safe'].to_numpy(bool)] = TO_TANK
    return np.asarray(acting[samples.index.get_indexer(found.ticks)])


def _seconds(nanoseconds: 'pd.Series') -> Array:
    return np.asarray(nanoseconds.to_numpy(float) * 1e-9)


def _reports(bag: Bag, namespace: str) -> list[dict[str, Any]]:
    table = bag.tables.get(f'{namespace}/loop_statistics')
    if table is None or 'node' not in table:
        return []
    last = table.drop_duplicates('node', keep='last')
    wanted = ['node', *COUNTS, 'latency_p50', 'latency_p99', 'latency_max', 'cpu_share']
    return [
        {name: getattr(value, 'item', lambda v=value: v)() for name, value in row.items()}
        for _, row in last[[name for name in wanted if name in last]].iterrows()
    ]
