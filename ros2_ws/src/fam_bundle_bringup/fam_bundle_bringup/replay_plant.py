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
Recorded valve commands through the simulated plant: how far it is from what was measured.

Once from the start of the run to its end, and once set to the measured state each second. A
command is held from the sample that it answers; in real time, if it was published after the next
one, from the last sample before it. When the plant took it is not recorded, so that in real time
the replay is not exact. While the plant was safe, every unit is open to the tank.
"""

import bisect
from collections.abc import Callable, Mapping
from typing import NamedTuple, TYPE_CHECKING

from fam_bundle_bringup.experiment import LARGEST_RUN
from fam_bundle_bringup.replay_controllers import COMMAND, per_unit, Run, Samples, stamps_of
from fam_bundle_io.bag_writer import BagError
from fam_bundle_model import fam
from fam_bundle_model.compile import direct
from fam_bundle_model.hydraulics import TO_TANK
from fam_bundle_model.parameters import Configuration, seconds
from fam_bundle_node.stamps import nanoseconds
from fam_bundle_sim.plant import (
    Plant,
    plant,
    plant_step,
    resting_state,
    SOURCE_PRESSURE,
    STRAIN,
    STRAIN_RATE,
    truth,
    UNITS,
)
from fam_bundle_sim.sensors import CHANNELS, measure, sensors
import numpy as np
import numpy.typing as npt

if TYPE_CHECKING:
    import pandas as pd

Array = npt.NDArray[np.float64]
Progress = Callable[[int], None]
RESTART_PERIOD = 1.0  # s between two times that the plant is set to what was measured
FIT = 5  # samples to either side, from which the strain rate is estimated
STAMPS = 'stamps of bundle_state'
SIGNAL_UNITS = {'strain': '', 'force': 'N', 'source_pressure': 'Pa', 'mu_pressure': 'Pa'}


class Course(NamedTuple):
    """
    What the plant was told, one entry for each tick of which the bag has anything.

    ``row`` is that of the sample, -1 where the bag has none. ``command`` (n, units) holds from
    there for ``periods`` steps of ``dt`` (s). ``held`` counts the samples whose answer is not in
    the bag, ``late`` the commands that came after the next sample.
    """

    row: list[int]
    periods: list[int]
    dt: list[float]
    command: Array
    vented: list[bool]
    held: int
    late: int


class Deviation(NamedTuple):
    """Simulated minus measured of one signal, over the run: root mean square and largest."""

    rms: float
    largest: float


class Simulated(NamedTuple):
    """The simulated signals, one row for each sample, from the start and set anew each second."""

    open_loop: dict[str, Array]
    restarted: dict[str, Array]
    notes: list[str]


def measured(samples: Samples) -> dict[str, Array]:
    """Return the measured signals that the plant is compared in, one entry for each sample."""
    found = {
        'strain': np.array(samples.strain),
        'force': np.array(samples.force),
        'source_pressure': np.array(samples.source_pressure),
    }
    units = range(samples.mu_pressure.shape[1])
    return found | {f'mu_pressure[{i}]': samples.mu_pressure[:, i] for i in units}


def deviations(seen: Mapping[str, Array], simulated: Mapping[str, Array]) -> dict[str, Deviation]:
    """Return how far the simulated signals are from those measured; not finite if they diverge."""
    found = {}
    with np.errstate(over='ignore', invalid='ignore'):
        for name, values in simulated.items():
            off = np.abs(values - seen[name])
            found[name] = Deviation(float(np.sqrt(np.mean(off * off))), float(off.max()))
    return found


def replay_plant(configuration: Configuration, run: Run, progress: Progress) -> Simulated:
    """
    Return what the plant of ``configuration`` does under the commands of ``run``.

    ``progress`` is called with the ticks done so far, of twice those of the run. Raises BagError
    where the bag has no commands, or stamps that do not rise.
    """
    samples, course, rig = run.samples, course_of(configuration, run), plant(configuration)
    notes = []
    if course.held:
        notes.append(f'{course.held} samples have no command in the bag: the one before is held')
    if course.late:
        notes.append(f'{course.late} commands came after the next sample, and act from then on')
    first = samples.tick[0]
    if first == 0:
        start = resting_state(configuration, rig)
    else:
        notes.append(f'the bag begins at tick {first}: the plant starts from what it measured')
        start = measured_state(rig, samples, 0, course.command[0])

    def simulate(state: Array, marks: list[int], done: int) -> dict[str, Array]:
        return _simulate(
            configuration, rig, course, samples, state, marks, lambda n: progress(done + n)
        )

    open_loop = simulate(start.copy(), [], 0)
    marks = restart_rows(samples)
    return Simulated(open_loop, simulate(start, marks, len(course.row)), notes)


def course_of(configuration: Configuration, run: Run) -> Course:
    """Return what the plant was told; raises BagError where that is not known."""
    samples, table = run.samples, run.answers.get(COMMAND)
    sampled = np.array(samples.tick, dtype=np.int64)
    if table is not None:
        inside = (table.index >= sampled[0]) & (table.index <= sampled[-1])
        table = table[inside].sort_index()
    if table is None or table.empty:
        raise BagError(f'{COMMAND}: none of the run is in the bag: the plant is not compared')
    answered = table.index.to_numpy(np.int64)
    ticks = np.union1d(sampled, answered)
    at, own = np.searchsorted(ticks, sampled), np.searchsorted(ticks, answered)
    row = np.full(len(ticks), -1)
    row[at] = np.arange(len(sampled))
    begin = np.maximum(own, _since(run, table, len(ticks), at)) if run.realtime else own
    newest = np.searchsorted(np.maximum.accumulate(begin), np.arange(len(ticks)), 'right') - 1
    newest = np.maximum(newest, 0)
    safe = np.array(samples.safe)[np.maximum.accumulate(np.maximum(row, 0))]
    times = np.zeros(len(ticks), dtype=np.int64)
    times[own] = [nanoseconds(stamp) for stamp in stamps_of(table)]
    times[at] = [nanoseconds(stamp) for stamp in samples.stamp]
    periods, dt = _steps(configuration, ticks, times)
    return Course(
        row.tolist(),
        periods,
        dt,
        np.clip(per_unit(table, 'spool'), -1.0, 1.0)[newest],
        (safe | table['vent'].to_numpy(bool)[newest]).tolist(),
        int(np.isin(sampled[:-1], answered, invert=True).sum()),
        int((begin > own).sum()),
    )


def _since(
    run: Run, table: 'pd.DataFrame', ticks: int, at: npt.NDArray[np.intp]
) -> npt.NDArray[np.intp]:
    """Return for each command the last of the ticks whose sample was published before it."""
    came = np.zeros(ticks, dtype=np.int64)
    came[at] = run.samples.published
    return np.searchsorted(np.maximum.accumulate(came), table['published'], 'right') - 1


def _steps(
    configuration: Configuration, ticks: npt.NDArray[np.int64], times: npt.NDArray[np.int64]
) -> tuple[list[int], list[float]]:
    """Return number and length (s) of the steps after each tick, none after the last."""
    gaps = np.diff(times)
    if (gaps <= 0).any():
        tick = ticks[int(np.argmax(gaps <= 0)) + 1]
        raise BagError(f'{STAMPS}: that of tick {tick} does not rise: the plant is not compared')
    periods = np.maximum(np.rint(gaps / configuration.period_ns()).astype(int), 1)
    if periods.sum() > LARGEST_RUN:
        raise BagError(f'{STAMPS}: they reach over {periods.sum()} periods, too many to simulate')
    dt = [seconds(gap) for gap in (gaps / periods).tolist()]
    return [*periods.tolist(), 0], [*dt, 0.0]


def restart_rows(samples: Samples) -> list[int]:
    """Return the first sample of each second after that of the first sample."""
    times = [seconds(nanoseconds(stamp)) for stamp in samples.stamp]
    count = int((times[-1] - times[0]) / RESTART_PERIOD)
    marks = [times[0] + k * RESTART_PERIOD for k in range(1, count + 1)]
    return sorted({bisect.bisect_left(times, mark - 1e-9) for mark in marks})


def measured_state(rig: Plant, samples: Samples, row: int, spool: Array) -> Array:
    """
    Return the plant's state that fits what was measured at a sample, with the ``spool`` given.

    The strain rate is that of a parabola through the samples around; the oil of each unit follows
    from its pressure and the strain.
    """
    units = len(rig.units)
    strain = samples.strain[row]
    state = np.zeros(UNITS + 2 * units)
    state[STRAIN] = strain
    state[STRAIN_RATE] = strain_rate(samples, row)
    state[SOURCE_PRESSURE] = samples.source_pressure[row]
    for i, unit in enumerate(rig.units):
        pressure = float(samples.mu_pressure[row, i])
        state[UNITS + i] = fam.oil_of(unit.fam, pressure, strain, rig.hydraulics.bulk_modulus)
    state[UNITS + units :] = spool  # noqa: E203
    return state


def strain_rate(samples: Samples, row: int) -> float:
    """Return the strain rate in 1/s at a sample, by a parabola through it and those around."""
    near = slice(max(row - FIT, 0), row + FIT + 1)
    origin = nanoseconds(samples.stamp[row])
    times = np.array([seconds(nanoseconds(s) - origin) for s in samples.stamp[near]])
    if len(times) < 2:
        return 0.0
    fit = np.polynomial.Polynomial.fit(times, samples.strain[near], min(2, len(times) - 1))
    return float(fit.deriv()(0.0))


def _simulate(
    configuration: Configuration,
    rig: Plant,
    course: Course,
    samples: Samples,
    state: Array,
    marks: list[int],
    progress: Progress,
) -> dict[str, Array]:
    """
    Return what ideal sensors read while the plant takes its course from ``state``.

    It is set to what was measured at the rows ``marks`` of the samples; its spools go on, for they
    follow from the commands alone.
    """
    units, substeps = len(rig.units), configuration.simulation.substeps
    limit = round(configuration.run.command_timeout * 1e9 / configuration.period_ns())
    instruments, quiet = sensors(configuration.sensors, units), np.zeros(CHANNELS + units)
    pressure, to_tank = np.zeros(units), np.full(units, TO_TANK)
    look = direct(truth, rig, state, pressure)
    read = direct(measure, instruments, truth(rig, state, pressure), quiet, pressure.copy())
    step = direct(plant_step, rig, state.copy(), to_tank, 1e-3, substeps)
    rows = np.empty((len(samples.tick), 3 + units))
    anew = set(marks)
    for k, row in enumerate(course.row):
        if row in anew:
            spool = state[UNITS + units :].copy()  # noqa: E203
            state[:] = measured_state(rig, samples, row, spool)
        if row >= 0:
            seen = read(instruments, look(rig, state, pressure), quiet, pressure)
            rows[row, :3] = seen.strain, seen.force, seen.source_pressure
            rows[row, 3:] = pressure
        for passed in range(course.periods[k]):
            # A hold-up longer than the time-out: as a rig's watchdog would do.
            held = not course.vented[k] and passed < limit
            step(rig, state, course.command[k] if held else to_tank, course.dt[k], substeps)
        if k % 1000 == 0:
            progress(k)
    names = ['strain', 'force', 'source_pressure', *(f'mu_pressure[{i}]' for i in range(units))]
    return {name: np.ascontiguousarray(rows[:, i]) for i, name in enumerate(names)}
