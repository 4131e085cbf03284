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
Recorded samples through the controllers' laws, and what these answer against what was recorded.

Each controller is judged on its own: the pressure controller gets the recorded references and the
supervisor the recorded lag table. The laws, their time steps and the rule when they start again
are the nodes' own. In lock-step a node answers every sample; in real time it has taken those whose
answer is in the bag, and no other: a law takes its step and the answer is published.
"""

import bisect
from collections.abc import Callable, Container, Iterable, Mapping
import dataclasses
from types import MappingProxyType
from typing import Any, NamedTuple, TYPE_CHECKING

from fam_bundle_bringup.replay_changes import Change, Changing
from fam_bundle_control.announced import Announced, Announcement, NOTICE
from fam_bundle_control.pressure_loop import pressure_loop, pressure_loop_step
from fam_bundle_control.recruitment import (
    recruitment,
    recruitment_start,
    recruitment_step,
    RecruitmentOutput,
)
from fam_bundle_control.strain_loop import (
    strain_loop,
    strain_loop_retuned,
    strain_loop_start,
    strain_loop_step,
)
from fam_bundle_io.bag_writer import BagError
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.compile import direct
from fam_bundle_model.hydraulics import TO_TANK
from fam_bundle_model.lag_table import LagTable
from fam_bundle_model.parameters import Configuration, seconds
from fam_bundle_model.reference import strain_reference
from fam_bundle_node.stamps import begins_anew, nanoseconds, StampClock
from fam_bundle_node.ticks import TickError
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pandas as pd

Columns = dict[str, npt.NDArray[Any]]
Progress = Callable[[int], None]
REFERENCE, STATE, COMMAND = 'pressure_reference', 'recruitment_state', 'valve_command'
ANSWERS = (REFERENCE, STATE, COMMAND)
# Fields of the answers and their units; those per motor unit are named once.
UNITS = {
    'strain_reference': '',
    'strain_error': '',
    'pressure': 'Pa',
    'pressure_unlimited': 'Pa',
    'recruited': '',
    'strain_rate': '1/s',
    'deslack_pressure': 'Pa',
    'recruitment_lag': 's',
    'source_pressure_drop': 'Pa',
    'time_to_saturation': 's',
    'time_to_desaturation': 's',
    'pressure_compensation': 'Pa',
    'lag_outside_table': '',
    'prediction_error': '',
    'spool': '',
    'pressure_reference': 'Pa',
    'saturated': '',
    'source_pressure': 'Pa',
}


class Stamp(NamedTuple):
    """A time in whole seconds and nanoseconds."""

    sec: int
    nanosec: int


class Samples(NamedTuple):
    """
    The ``bundle_state`` of a run, one entry for each sample; ``mu_pressure`` (n, units).

    ``published`` is a time of the system clock (ns).
    """

    tick: list[int]
    published: list[int]
    stamp: list[Stamp]
    safe: list[bool]
    strain: list[float]
    force: list[float]
    source_pressure: list[float]
    mu_pressure: npt.NDArray[np.float64]


class Run(NamedTuple):
    """
    One run: its samples, the tables of what answered them by topic and tick, and its pace.

    ``laws`` are the trajectories that were tracked, that of the beginning first; ``changes`` the
    parameters that were set meanwhile, by node. An answer on a topic in ``lossy`` which is not in
    the bag may have been lost on its way to the recorder; on the others it was never given.
    """

    samples: Samples
    answers: 'Mapping[str, pd.DataFrame]'
    realtime: bool
    laws: list[Announcement]
    changes: Mapping[str, list[Change]] = MappingProxyType({})
    lossy: frozenset[str] = frozenset()


def samples_of(table: 'pd.DataFrame') -> Samples:
    """Return the samples in a table of ``bundle_state`` by tick."""
    return Samples(
        table.index.tolist(),
        table['published'].tolist(),
        stamps_of(table),
        table['safe'].tolist(),
        table['strain'].tolist(),
        table['force'].tolist(),
        table['source_pressure'].tolist(),
        per_unit(table, 'mu_pressure'),
    )


def stamps_of(table: 'pd.DataFrame') -> list[Stamp]:
    """Return the stamps in a table of messages with a header."""
    columns = table['header.stamp.sec'].tolist(), table['header.stamp.nanosec'].tolist()
    return [Stamp(*stamp) for stamp in zip(*columns, strict=True)]


def per_unit(table: 'pd.DataFrame', field: str) -> npt.NDArray[np.float64]:
    """Return a field that has one value for each motor unit as (rows, units)."""
    names = [name for name in table if name.startswith(f'{field}[')]
    return np.ascontiguousarray(table[names].to_numpy(np.float64))


# ---- Which samples a controller took ----


class Steps(NamedTuple):
    """
    The steps that a law took: of which sample (its row), over which time (s), from where.

    ``anew`` tells that it started again there. Whether the record determines the law's state is
    ``known``: not before its first start, nor between a step that the bag does not show, or
    perhaps does not, and the next start.
    """

    row: list[int]
    dt: list[float]
    anew: list[bool]
    known: list[bool]


def steps_of(
    samples: Samples,
    taken: Iterable[int],
    usable: Container[int],
    configuration: Configuration,
    *,
    sure: bool = True,
) -> Steps:
    """
    Return the steps of a law that took the ticks ``taken``, of which the bag has ``usable``.

    Unless ``sure``, it may have taken those between them too.

    Raises TickError when time stands still.
    """
    steps = Steps([], [], [], [])
    row_of = {tick: row for row, tick in enumerate(samples.tick)}
    ticks = sorted(samples.tick)
    clock = StampClock(configuration.period_ns())
    timeout = configuration.run.command_timeout
    known, last = False, None
    for tick in taken:
        unseen = last is not None and _lacks(ticks, last, tick)
        if not sure and last is not None and tick > last + 1:
            known = False
            clock.restart()  # a gap in the record is none that the node saw
        last = tick
        if unseen or tick not in usable:
            known = False
            clock.restart()
        if tick not in usable:
            continue
        row = row_of[tick]
        stamp = samples.stamp[row]
        anew = begins_anew(tick, samples.safe[row], clock.gap(stamp), timeout)
        if anew:
            known = True
            clock.restart()
        steps.row.append(row)
        steps.dt.append(clock.since_last(stamp))
        steps.anew.append(anew)
        steps.known.append(known)
    return steps


def _lacks(ticks: list[int], last: int, tick: int) -> bool:
    """Return whether one between ``last`` and ``tick`` is not among the sorted ``ticks``."""
    between = bisect.bisect_left(ticks, tick) - bisect.bisect_right(ticks, last)
    return between < tick - last - 1


def _taken(run: Run, topic: str) -> list[int]:
    return run.answers[topic].index.tolist() if run.realtime else run.samples.tick


# ---- The three laws ----


def announced(laws: list[Announcement], notice: int) -> Announced:
    """Return the trajectories of a run, each of which counts ``notice`` ns after its time."""
    found = Announced(laws[0], notice)
    for law in laws[1:]:
        found.add(law)
    return found


def strain_answers(
    configuration: Configuration, run: Run, steps: Steps, progress: Progress
) -> Columns:
    """Return what the strain controller answers: its message's fields, one entry for each step."""
    law, state = strain_loop(configuration), strain_loop_start()
    samples, units = run.samples, motor_units(configuration)
    tracked = announced(run.laws, notice=0)
    measured = (0.0, 0.0, 0.0, np.zeros(len(units)), 1.0)
    step = direct(strain_loop_step, law, units, state, *measured)
    rows = []
    changing, error = Changing(configuration, run.changes.get('strain_controller', [])), 0.0
    for row, dt, anew, _ in zip(*steps, strict=True):
        now = nanoseconds(samples.stamp[row])
        if changing.at(samples.tick[row]):
            before, law = law, strain_loop(changing.now)
            state = strain_loop_retuned(state, error, before, law)
        reference = strain_reference(tracked.at(now).law, seconds(now))
        state, output = step(
            law,
            units,
            strain_loop_start() if anew else state,
            reference,
            samples.strain[row],
            samples.source_pressure[row],
            samples.mu_pressure[row],
            dt,
        )
        error = output.error
        rows.append((reference, *output))
        progress(len(rows))
    fields = ('strain_reference', 'strain_error', 'pressure', 'pressure_unlimited')
    return _columns(fields, rows)


def supervisor_answers(
    configuration: Configuration,
    table: LagTable,
    run: Run,
    steps: Steps,
    progress: Progress,
) -> Columns:
    """Return what the recruitment supervisor answers with the lag table ``table``."""
    changing = Changing(configuration, run.changes.get('recruitment_supervisor', []))
    laws = [recruitment(changing.now, live=live) for live in (False, True)]
    samples, units, memory = run.samples, motor_units(configuration), recruitment_start()
    foreseen = announced(run.laws, NOTICE)
    none = np.zeros(len(units))
    model = (laws[False], units, table, run.laws[0].law, recruitment_start())
    decide = direct(recruitment_step, *model, 0.0, 0.0, 0.0, 0.0, none, 1.0)
    rows = []
    for row, dt, anew, _ in zip(*steps, strict=True):
        now = nanoseconds(samples.stamp[row])
        known = foreseen.at(now)
        if changing.at(samples.tick[row]):
            laws = [recruitment(changing.now, live=live) for live in (False, True)]
        memory, output = decide(
            laws[known.live],
            units,
            table,
            known.law,
            recruitment_start() if anew else memory,
            seconds(now),
            samples.strain[row],
            samples.force[row],
            samples.source_pressure[row],
            samples.mu_pressure[row],
            dt,
        )
        rows.append(tuple(output))
        progress(len(rows))
    return _columns(RecruitmentOutput._fields, rows)


def pressure_answers(
    configuration: Configuration, run: Run, steps: Steps, progress: Progress
) -> Columns:
    """
    Return what the pressure controller answers to the recorded references.

    Whether it asked for the safe state is taken from the record: it did where three of its inputs
    could not be used, and such ones are not in the bag as it saw them.
    """
    samples = run.samples
    law, bundle = pressure_loop(configuration), motor_units(configuration)
    units = len(bundle)
    integral = np.zeros(units)
    wanted, spool, saturated = np.zeros(units), np.zeros(units), np.zeros(units, dtype=np.bool_)
    filled, none = (wanted, spool, saturated), (0, 0.0, 0.0, 0.0, 0.0, np.zeros(units), 1.0)
    step = direct(pressure_loop_step, law, bundle, integral, *none, *filled)
    ticks = [samples.tick[row] for row in steps.row]
    given = [
        run.answers[REFERENCE]['pressure'].loc[ticks].tolist(),
        run.answers[STATE]['recruited'].loc[ticks].tolist(),
        run.answers[STATE]['pressure_compensation'].loc[ticks].tolist(),
        run.answers[COMMAND]['vent'].reindex(ticks, fill_value=False).tolist(),
    ]
    rows = []
    for row, dt, anew, _, reference, recruited, added, vent in zip(*steps, *given, strict=True):
        if anew:
            integral[:] = 0.0
        demand = (recruited, reference, added)
        seen = (samples.strain[row], samples.source_pressure[row], samples.mu_pressure[row])
        step(law, bundle, integral, *demand, *seen, dt, *filled)
        if vent:
            spool[:] = TO_TANK
        rows.append((*spool.tolist(), *wanted.tolist(), *saturated.tolist()))
        progress(len(rows))
    fields = [f'{name}[{i}]' for name in ('spool', REFERENCE, 'saturated') for i in range(units)]
    return _columns(fields, rows)


def _columns(fields: Iterable[str], rows: list[tuple[Any, ...]]) -> Columns:
    names = tuple(fields)
    values = zip(*rows, strict=True) if rows else ([] for _ in names)
    return {name: np.array(column) for name, column in zip(names, values, strict=True)}


# ---- What was recorded beside it ----


@dataclasses.dataclass(frozen=True)
class Comparison:
    """
    One signal: how many values were compared, and how many are equal to the last bit.

    ``largest`` is the largest absolute difference in ``unit``; ``tick`` that of the first, and
    there ``replayed`` and ``recorded`` the values. Ticks at which the record does not determine
    the law's state are counted apart.
    """

    topic: str
    signal: str
    unit: str
    compared: int
    equal: int
    largest: float = 0.0
    tick: int | None = None
    replayed: float | None = None
    recorded: float | None = None
    unknown: int = 0
    unknown_equal: int = 0


def compare(
    topic: str,
    replayed: Columns,
    table: 'pd.DataFrame',
    ticks: npt.NDArray[np.int64],
    known: npt.NDArray[np.bool_],
) -> list[Comparison]:
    """
    Return the comparison of each of the ``replayed`` columns with those of ``table``.

    ``ticks`` and ``known`` belong to the rows of ``replayed``; those without an answer in
    ``table`` are not compared, nor are fields that messages did not have when it was recorded.
    """
    answered = np.isin(ticks, table.index.to_numpy(np.int64))
    rows = table.loc[ticks[answered]]
    found = []
    for signal, values in replayed.items():
        if signal not in table:
            continue
        recorded = rows[signal].to_numpy()
        mine = values[answered].astype(recorded.dtype)
        unit = UNITS[signal.partition('[')[0]]
        here = known[answered]
        rest = same_bits(mine[~here], recorded[~here])
        one = compared(topic, signal, unit, mine[here], recorded[here], ticks[answered][here])
        one = dataclasses.replace(one, unknown=rest.size, unknown_equal=int(rest.sum()))
        found.append(one)
    return found


def compared(
    topic: str,
    signal: str,
    unit: str,
    mine: npt.NDArray[Any],
    recorded: npt.NDArray[Any],
    ticks: npt.NDArray[np.int64] | None = None,
) -> Comparison:
    """Return the comparison of two arrays of one type and shape."""
    same = same_bits(mine, recorded)
    one = Comparison(topic, signal, unit, same.size, int(same.sum()))
    if same.all():
        return one
    a, b = mine[~same].astype(np.float64), recorded[~same].astype(np.float64)
    with np.errstate(invalid='ignore'):
        difference = np.nan_to_num(np.abs(a - b), nan=np.inf)
    return dataclasses.replace(
        one,
        largest=float(difference.max()),
        tick=None if ticks is None else int(ticks[~same][0]),
        replayed=float(a[0]),
        recorded=float(b[0]),
    )


def same_bits(one: npt.NDArray[Any], other: npt.NDArray[Any]) -> npt.NDArray[np.bool_]:
    """Return where two arrays of one type hold the same bits."""
    if one.dtype.kind == 'f':
        bits = f'u{one.dtype.itemsize}'
        one, other = one.view(bits), other.view(bits)
    return np.asarray(one == other, dtype=np.bool_)


def compare_tables(mine: LagTable, recorded: LagTable) -> list[Comparison]:
    """Return the comparison of two lag tables of one grid."""
    units = ('Pa', 'Pa', 's', 'Pa')
    names = ('source_pressure', 'deslack_pressure', 'recruitment_lag', 'source_pressure_drop')
    pairs = zip(names, units, mine, recorded, strict=True)
    return [compared('lag_table', n, u, a.ravel(), b.ravel()) for n, u, a, b in pairs]


def replay_controllers(
    configuration: Configuration, run: Run, table: LagTable, progress: Progress
) -> list[Comparison]:
    """
    Return the comparison of all that the controllers answered in ``run``.

    Topics that are not in the bag are left out, as is the pressure controller without the
    references that it follows. ``progress`` is called with the steps done so far. Raises BagError
    where stamps stand still.
    """
    samples, found, done = run.samples, list[Comparison](), 0
    for topic in run.answers:
        usable = set(samples.tick)
        if topic == COMMAND:
            if not {REFERENCE, STATE} <= set(run.answers):
                continue
            usable &= set(run.answers[REFERENCE].index) & set(run.answers[STATE].index)
        try:
            taken = _taken(run, topic)
            steps = steps_of(samples, taken, usable, configuration, sure=topic not in run.lossy)
        except TickError as error:
            raise BagError(f'stamps of bundle_state: {error}') from None

        def report(steps_done: int, before: int = done) -> None:
            if steps_done % 1000 == 0:
                progress(before + steps_done)

        if topic == REFERENCE:
            answers = strain_answers(configuration, run, steps, report)
        elif topic == STATE:
            answers = supervisor_answers(configuration, table, run, steps, report)
        else:
            answers = pressure_answers(configuration, run, steps, report)
        ticks = np.array(samples.tick, dtype=np.int64)[steps.row]
        known = np.array(steps.known, dtype=np.bool_)
        found += compare(topic, answers, run.answers[topic], ticks, known)
        done += len(steps.row)
    return found
