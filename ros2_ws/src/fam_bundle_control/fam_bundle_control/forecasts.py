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
What was expected for now, some time ago: the measure of a predictor.

Ours: the paper does not say how far its prediction (equation 14) was off.
"""

from typing import NamedTuple

from fam_bundle_model.compile import compiled
import numpy as np
import numpy.typing as npt

ROWS = 512
KEPT = 500  # rows that a horizon fills at most; where it has more ticks some are left out


class Forecasts(NamedTuple):
    """
    A ring of expectations; each row: the time at which it was made (s), and its columns.

    ``oldest`` and ``newest`` count the rows that were ever written. ``clock`` is the time since
    the start in s.
    """

    rows: npt.NDArray[np.float64]
    oldest: int
    newest: int
    clock: float


def forecasts_start(columns: int) -> Forecasts:
    """Return an empty ring of ``columns`` expectations a row."""
    return Forecasts(np.zeros((ROWS, 1 + columns)), 0, -1, 0.0)


@compiled
def forecasts_step(state: Forecasts, horizon: float, dt: float) -> Forecasts:
    """Return the ring ``dt`` s later: rows older than what is due now are given up."""
    clock = state.clock + dt
    oldest = state.oldest
    while oldest < state.newest and state.rows[(oldest + 1) % ROWS, 0] <= clock - horizon:
        oldest += 1
    return Forecasts(state.rows, oldest, state.newest, clock)


@compiled
def is_due(state: Forecasts, horizon: float) -> bool:
    """Return whether something was expected ``horizon`` s ago."""
    due = state.clock - horizon
    return state.oldest < state.newest and state.rows[state.oldest % ROWS, 0] <= due


@compiled
def due(state: Forecasts, column: int, horizon: float) -> float:
    """Return what was expected ``horizon`` s ago, where it ``is_due``; linear between rows."""
    row, following = state.oldest % ROWS, (state.oldest + 1) % ROWS
    start, stop = state.rows[row, 0], state.rows[following, 0]
    share = (state.clock - horizon - start) / (stop - start)
    before, after = state.rows[row, 1 + column], state.rows[following, 1 + column]
    return float(before + (after - before) * share)


@compiled
def next_row(state: Forecasts, horizon: float) -> tuple[Forecasts, int]:
    """
    Return the ring with a row for this tick, and its number; -1 where none is wanted.

    The row is written in place.
    """
    if state.newest >= state.oldest:
        since = state.clock - state.rows[state.newest % ROWS, 0]
        if since < horizon / KEPT:
            return state, -1
    newest = state.newest + 1
    state.rows[newest % ROWS, 0] = state.clock
    return Forecasts(state.rows, state.oldest, newest, state.clock), newest % ROWS
