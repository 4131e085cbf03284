# SPDX-License-Identifier: Apache-2.0
"""How punctual a recorded loop was: times between samples, and from a sample to its answers.

From the publishers' times in the bag. All nodes must have run on one machine, or on several whose
clocks agree; a bag without publishers' times (SQLite) gives the recorder's instead.
"""

from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
import numpy.typing as npt

from fam_bundle_io.bag import LOOP, STATE, Bag, one_run

if TYPE_CHECKING:
    import pandas as pd

Array = npt.NDArray[np.float64]
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
    """Times of one run.

    ``interval`` (n - 1,) is the time in s between two samples, ``answers`` by topic the time in s
    from a sample to what answers it, ``answered`` by topic how many of the ``samples`` have an
    answer in the bag. ``nodes`` are the last reports of the nodes.
    """

    samples: int
    interval: Array
    answers: dict[str, Array]
    answered: dict[str, int]
    nodes: list[dict[str, Any]]


def timing(bag: Bag, namespace: str = '', run: int = -1) -> Timing:
    """Return the times of a run; ``bundle_state`` must be in the bag."""
    samples = one_run(bag.tables[f'{namespace}/{LOOP[STATE]}'], run)
    answers, answered = {}, {}
    for short in LOOP.values():
        table = bag.tables.get(f'{namespace}/{short}')
        if short == LOOP[STATE] or table is None or 'tick' not in table:
            continue
        found = one_run(table, run)['published']
        both = samples.index.intersection(found.index)
        answered[short] = len(both)
        answers[short] = _seconds(found.loc[both] - samples['published'].loc[both])
    interval = _seconds(samples['published'].diff().iloc[1:])
    return Timing(len(samples), interval, answers, answered, _reports(bag, namespace))


def spread(times: Array) -> Spread | None:
    """Return what summarizes ``times``, None where there are none."""
    if not len(times):
        return None
    median, p99 = np.percentile(times, (50.0, 99.0))
    return Spread(float(median), float(p99), float(times.max()))


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
