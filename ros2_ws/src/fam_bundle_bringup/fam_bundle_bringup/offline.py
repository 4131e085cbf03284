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
The whole loop in one process, without ROS: the same laws in the same order as the graph.

Its trace equals that of the graph in lock-step to the last bit; a test holds the two together.
"""

from collections.abc import Callable
import itertools

from fam_bundle_bringup.failure import RunFailed
from fam_bundle_control.pressure_loop import pressure_loop, pressure_loop_step, PressureLoop
from fam_bundle_control.recruitment import (
    Recruitment,
    recruitment,
    recruitment_start,
    recruitment_step,
    RecruitmentState,
)
from fam_bundle_control.strain_loop import (
    strain_loop,
    strain_loop_start,
    strain_loop_step,
    StrainLoop,
    StrainLoopState,
)
from fam_bundle_io.trace import empty_trace, Trace
from fam_bundle_model.bundle import motor_units, MotorUnit
from fam_bundle_model.compile import compiled
from fam_bundle_model.lag_table import cached_lag_table, LagTable
from fam_bundle_model.parameters import Configuration, seconds
from fam_bundle_model.reference import Reference, reference_law, strain_reference
from fam_bundle_sim.plant import Plant, plant, plant_step, resting_state, truth
from fam_bundle_sim.sensors import measure, noise_samples, Sensors, sensors
import numpy as np
import numpy.typing as npt

PREDICTED = (
    'time_to_saturation',
    'time_to_desaturation',
    'recruitment_lag',
    'deslack_pressure',
)
BLOCK = 5000  # ticks between two reports of progress


@compiled
def run_block(
    rig: Plant,
    units: tuple[MotorUnit, ...],
    instruments: Sensors,
    outer: StrainLoop,
    inner: PressureLoop,
    policy: Recruitment,
    table: LagTable,
    trajectory: Reference,
    period: float,
    substeps: int,
    plant_state: npt.NDArray[np.float64],
    integral: npt.NDArray[np.float64],
    outer_state: StrainLoopState,
    policy_state: RecruitmentState,
    times: npt.NDArray[np.float64],
    references: npt.NDArray[np.float64],
    noise: npt.NDArray[np.float64],
    rows: npt.NDArray[np.float64],
    mu_pressures: npt.NDArray[np.float64],
    spools: npt.NDArray[np.float64],
) -> tuple[StrainLoopState, RecruitmentState]:
    """
    Run one tick for each of ``times`` and fill ``references`` and the rows of the trace.

    ``units`` are those that the laws believe in. ``plant_state`` and ``integral`` are advanced in
    place, the other states returned.
    """
    count = integral.shape[0]
    wanted, saturated = np.empty(count), np.empty(count, dtype=np.bool_)
    for k in range(times.shape[0]):
        pressure, spool, row = mu_pressures[k], spools[k], rows[k]
        seen = measure(instruments, truth(rig, plant_state, pressure), noise[k], pressure)
        references[k] = strain_reference(trajectory, times[k])
        outer_state, asked = strain_loop_step(
            outer,
            units,
            outer_state,
            references[k],
            seen.strain,
            seen.source_pressure,
            pressure,
            period,
        )
        policy_state, decided = recruitment_step(
            policy,
            units,
            table,
            trajectory,
            policy_state,
            times[k],
            seen.strain,
            seen.force,
            seen.source_pressure,
            pressure,
            period,
        )
        pressure_loop_step(
            inner,
            units,
            integral,
            decided.recruited,
            asked.pressure,
            decided.pressure_compensation,
            seen.strain,
            seen.source_pressure,
            pressure,
            period,
            wanted,
            spool,
            saturated,
        )
        row[0] = seen.strain
        row[1] = asked.pressure
        row[2] = seen.source_pressure
        row[3] = decided.recruited
        row[4] = decided.time_to_saturation
        row[5] = decided.time_to_desaturation
        row[6] = decided.recruitment_lag
        row[7] = decided.pressure_compensation
        row[8] = decided.deslack_pressure
        row[9] = seen.force
        row[10] = seen.source_flow
        row[11] = decided.prediction_error
        plant_step(rig, plant_state, spool, period, substeps)
    return outer_state, policy_state


# The columns of ``rows`` above, by the names of the trace.
COLUMNS = (
    'strain',
    'pressure_reference',
    'source_pressure',
    'recruitment_state',
    'time_to_saturation',
    'time_to_desaturation',
    'recruitment_lag',
    'pressure_compensation',
    'deslack_pressure',
    'force',
    'source_flow',
    'prediction_error',
)


def run_offline(
    configuration: Configuration,
    progress: Callable[[int], None] | None = None,
    table: LagTable | None = None,
    actual: Configuration | None = None,
) -> Trace:
    """
    Return the trace of the whole run of ``configuration``.

    ``progress`` is called with the ticks done so far; ``table`` spares the look-up of the lag
    table where the caller has it already. With ``actual`` plant and sensors are those of another
    configuration than the laws believe in. Raises RunFailed when the plant diverges.
    """
    units, ticks = len(configuration.fam.count), configuration.ticks()
    simulation, step = configuration.simulation, configuration.period_ns()
    there = configuration if actual is None else actual
    rig = plant(there)
    plant_state = resting_state(there, rig)
    integral = np.zeros(units)
    outer_state, policy_state = strain_loop_start(), recruitment_start()
    samples = noise_samples(there.sensors, units)
    trace = empty_trace(ticks, units)
    laws = (
        rig,
        rig.units if actual is None else motor_units(configuration),
        sensors(there.sensors, units),
        strain_loop(configuration),
        pressure_loop(configuration),
        recruitment(configuration),
        cached_lag_table(configuration) if table is None else table,
        reference_law(configuration.reference),
    )
    for first in range(0, ticks, BLOCK):
        block = slice(first, min(first + BLOCK, ticks))
        times = [seconds(k * step) for k in range(block.start, block.stop)]
        rows = np.empty((len(times), len(COLUMNS)))
        trace['time'][block] = times
        outer_state, policy_state = run_block(
            *laws,
            seconds(step),
            simulation.substeps,
            plant_state,
            integral,
            outer_state,
            policy_state,
            trace['time'][block],
            trace['strain_reference'][block],
            np.array(list(itertools.islice(samples, len(times)))),
            rows,
            trace['mu_pressure'][block],
            trace['spool'][block],
        )
        for column, name in enumerate(COLUMNS):
            trace[name][block] = rows[:, column]
        _check_finite(trace, block)
        if progress is not None:
            progress(block.stop)
    return trace


def _check_finite(trace: Trace, block: slice) -> None:
    """Raise RunFailed at the first tick with a value that is not finite."""
    first: dict[str, int] = {}
    for name, column in trace.items():
        values = column[block].reshape(block.stop - block.start, -1)
        # Predicted times are infinite where they do not apply; nothing else may be.
        good = ~np.isnan(values) if name in PREDICTED else np.isfinite(values)
        bad = np.flatnonzero(~good.all(axis=1))
        if bad.size:
            first[name] = block.start + int(bad[0])
    if first:
        name, tick = min(first.items(), key=lambda item: item[1])
        raise RunFailed(
            f'{name}: tick {tick} is not finite; the plant diverges, try more '
            f'simulation.substeps ({tick} ticks are kept)',
            {signal: column[:tick] for signal, column in trace.items()},
        )
