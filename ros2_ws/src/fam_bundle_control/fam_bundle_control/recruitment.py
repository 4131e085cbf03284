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
When to recruit and when to release a motor unit, and what to add meanwhile.

Threshold recruitment is the paper's Figure 4; anticipatory recruitment its equations 12-16 and
Figure 8; pressure compensation its equations 9-11. The two switches are independent. All
predictions are computed in every scheme, so that they can be seen in every trace.

The paper leaves the anticipatory downshift open; ``docs/recruitment.md`` argues for ours.
"""

import math
from typing import NamedTuple

from fam_bundle_control.allocation import BATCH, is_compensated
from fam_bundle_control.filters import filtered
from fam_bundle_control.predictors import (
    may_fall,
    may_rise,
    Predictor,
    predictor,
    predictor_start,
    predictor_step,
    PredictorState,
    stays_above,
    time_to_fall,
    time_to_rise,
)
from fam_bundle_model import fam
from fam_bundle_model.bundle import modelled_strain, MotorUnit
from fam_bundle_model.compile import compiled
from fam_bundle_model.hydraulics import hydraulic_law, HydraulicLaw, line_loss
from fam_bundle_model.lag_table import LagTable, look_up
from fam_bundle_model.parameters import ALLOCATIONS, Configuration
from fam_bundle_model.reference import Reference
import numpy as np
import numpy.typing as npt

TAUT_SHARE = 0.05  # of the measured force; less is not told from noise
SATURATED = 0.97  # of the source pressure: a unit there has no more to give


class Recruitment(NamedTuple):
    """
    Settings of the recruitment law; pressures in Pa, times in s.

    ``hold_all`` keeps every unit recruited. ``by_force`` is our allocation: predictions then
    reckon with what the recruited units' own flow loses on its way from the source, and a release
    has to be called for during a whole lag.
    """

    predictor: Predictor
    lag_compensation: bool
    pressure_compensation: bool
    upshift_pressure: float
    downshift_pressure: float
    force_time_constant: float
    minimum_dwell: float
    hold_all: bool
    reserve: float
    by_force: bool
    supply: HydraulicLaw


class RecruitmentState(NamedTuple):
    """
    What the law remembers: units recruited, filters, time in the state, downshift armed.

    ``below`` is for how long, in s, a release has been called for.
    """

    recruited: int
    expected: PredictorState
    force: float
    dwell: float
    armed: bool
    below: float
    started: bool


class RecruitmentOutput(NamedTuple):
    """What the law decided and what it predicted; infinite times do not apply."""

    recruited: int
    strain_rate: float
    deslack_pressure: float
    recruitment_lag: float
    source_pressure_drop: float
    time_to_saturation: float
    time_to_desaturation: float
    pressure_compensation: float
    lag_outside_table: bool
    prediction_error: float


def recruitment(configuration: Configuration, *, live: bool | None = None) -> Recruitment:
    """Return the law of ``configuration``; ``live`` is as for ``predictor``."""
    p, nominal = configuration.recruitment, configuration.source.nominal_pressure
    return Recruitment(
        predictor=predictor(configuration, live=live),
        lag_compensation=p.scheme in ('lag', 'lag_pressure'),
        pressure_compensation=p.scheme in ('pressure', 'lag_pressure'),
        upshift_pressure=p.upshift_threshold * nominal,
        downshift_pressure=p.downshift_threshold * nominal,
        force_time_constant=p.force_time_constant,
        minimum_dwell=p.minimum_dwell,
        hold_all=p.scheme == 'all',
        reserve=p.reserve,
        by_force=configuration.allocation.policy != ALLOCATIONS[BATCH],
        supply=hydraulic_law(configuration),
    )


def recruitment_start() -> RecruitmentState:
    """
    Return the state before the first tick, which finds the recruited units by pressure.

    Each run needs its own: the law writes in the predictor's forecasts.
    """
    return RecruitmentState(1, predictor_start(), 0.0, math.inf, False, 0.0, False)


@compiled
def compensating_pressure(
    units: tuple[MotorUnit, ...],
    recruited: int,
    mu_pressure: npt.NDArray[np.float64],
    strain: float,
) -> float:
    """
    Return P_comp in Pa of equations 10 and 11 at the measured pressures and strain.

    The resistance of every unit below its de-slack pressure, over the force per pressure of the
    compensated units that are above theirs. Zero where none is slack, or none could help.
    """
    resistance = stiffness = 0.0
    for i in range(len(units)):
        unit = units[i]
        if mu_pressure[i] < fam.deslack_pressure(unit.fam, strain):
            pressure = max(mu_pressure[i], 0.0)
            resistance -= unit.fams * min(fam.force(unit.fam, pressure, strain), 0.0)
        elif is_compensated(i, recruited):
            stiffness += unit.fams * fam.mesh_coefficient(unit.fam, strain)
    return resistance / stiffness if stiffness > 0.0 else 0.0


@compiled
def taut_units(
    units: tuple[MotorUnit, ...],
    mu_pressure: npt.NDArray[np.float64],
    strain: float,
    force: float,
) -> int:
    """
    Return how many units in a row, from the first on, are taut and carry of the ``force`` (N).

    By their pressure, for below strain zero an empty FAM carries by its bladder. At least 1. So a
    supervisor that joins a running loop goes on with what is recruited.
    """
    count = 1
    while count < len(units):
        pressure, unit = mu_pressure[count], units[count]
        carried = unit.fams * fam.mesh_coefficient(unit.fam, strain) * pressure
        slack = pressure <= max(fam.deslack_pressure(unit.fam, strain), 0.0)
        if slack or carried <= TAUT_SHARE * force:
            break
        count += 1
    return count


@compiled
def saturated(
    recruited: int, mu_pressure: npt.NDArray[np.float64], source_pressure: float
) -> bool:
    """Return whether every recruited unit is at the source pressure (Pa), if there is any."""
    for i in range(recruited):
        if mu_pressure[i] < SATURATED * source_pressure:
            return False
    return source_pressure > 0.0


@compiled
def attainable_pressure(
    law: Recruitment,
    units: tuple[MotorUnit, ...],
    recruited: int,
    source_pressure: float,
    drop: float,
    compensation: float,
    strain: float,
    rate: float,
) -> float:
    """
    Return the pressure in Pa that the recruited units can hold: equation 13 and what it omits.

    ``drop`` and ``compensation`` are the margin of equation 12. The paper leaves out what the
    units' own flow loses between source and muscle while the bundle moves at ``rate`` (1/s);
    where the law reckons with it, the unit that loses most counts. A contraction takes k(e) L0 e'
    of oil into each FAM (equations 1 and 8: virtual work).
    """
    loss = 0.0
    if law.by_force:
        for i in range(recruited):
            unit = units[i]
            area = unit.fams * unit.fam.length * fam.mesh_coefficient(unit.fam, strain)
            loss = max(loss, line_loss(law.supply, area * abs(rate)))
    return source_pressure - drop - compensation - law.reserve - loss


@compiled
def recruitment_step(
    law: Recruitment,
    units: tuple[MotorUnit, ...],
    table: LagTable,
    reference: Reference,
    state: RecruitmentState,
    time: float,
    strain: float,
    force: float,
    source_pressure: float,
    mu_pressure: npt.NDArray[np.float64],
    dt: float,
) -> tuple[RecruitmentState, RecruitmentOutput]:
    """
    Return the next state and the output from one tick's measurements; SI units.

    ``mu_pressure`` holds each unit's pressure in recruitment order; ``time`` is that of the
    measurement, for ``reference``.
    """
    recruited, load = state.recruited, force
    expected = predictor_step(law.predictor, state.expected, reference, time, strain, dt)
    if not state.started:
        recruited = taut_units(units, mu_pressure, strain, force)
    else:
        load = filtered(state.force, force, law.force_time_constant, dt)

    if law.hold_all:
        recruited = len(units)
    newest = recruited - 1
    next_unit = min(recruited, len(units) - 1)
    deslack = fam.deslack_pressure(units[next_unit].fam, strain)
    lag = look_up(table, next_unit, source_pressure, deslack)
    compensation = compensating_pressure(units, recruited, mu_pressure, strain)
    if not law.pressure_compensation:
        compensation = 0.0

    saturation = desaturation = math.inf
    lasts = comes_back = False
    if recruited < len(units) and may_rise(law.predictor, expected):
        given = (source_pressure, lag.drop, compensation, strain, expected.strain_rate)
        effective = attainable_pressure(law, units, recruited, *given)
        limit = modelled_strain(units, recruited, effective, load)
        saturation = time_to_rise(law.predictor, expected, reference, limit)
        # A lag of never: filling the next unit would take pressure and give nothing. And a peak
        # that is over before the unit is taut needs none.
        if lag.lag < math.inf:
            lasts = stays_above(law.predictor, expected, reference, limit, lag.lag)
    # Where the load does not move, no prediction says that the units are at their end. A source
    # below the table is off or failing: no state will help.
    at_end = recruited < len(units) and saturated(recruited, mu_pressure, source_pressure)
    at_end = at_end and source_pressure >= table.source_pressure[0]
    if at_end:
        saturation, lasts = 0.0, lag.lag < math.inf
    release = lag
    if recruited > 1 and may_fall(law.predictor, expected):
        newest_deslack = fam.deslack_pressure(units[newest].fam, strain)
        release = look_up(table, newest, source_pressure, newest_deslack)
        given = (source_pressure, release.drop, compensation, strain, expected.strain_rate)
        effective = attainable_pressure(law, units, recruited - 1, *given)
        limit = modelled_strain(units, recruited - 1, effective, load)
        desaturation = time_to_fall(law.predictor, expected, reference, limit)
        # The unit could not be recruited again before the dwell is over, nor be taut a lag later.
        again = release.lag + law.minimum_dwell
        comes_back = time_to_rise(law.predictor, expected, reference, limit) <= again

    armed, below = state.armed, 0.0
    if law.lag_compensation:
        armed = armed or mu_pressure[newest] >= fam.deslack_pressure(units[newest].fam, strain)
        up = saturation <= lag.lag and lasts
        # At rest nothing is released, whatever is expected: a reference may be about to go on.
        falls = expected.strain_rate < -law.predictor.minimum_strain_rate
        down = desaturation <= -release.lag and falls and not comes_back
        below = state.below + dt if down else 0.0
        # A noisy strain rate calls for a release now and then; not for a whole lag.
        down = down and (not law.by_force or below > release.lag)
    else:
        armed = armed or mu_pressure[newest] > law.downshift_pressure
        up = recruited < len(units) and mu_pressure[0] >= law.upshift_pressure
        down = mu_pressure[newest] <= law.downshift_pressure
    dwell = state.dwell + dt
    # A shift disturbs the very strain rate that the next decision rests on.
    if law.hold_all:
        dwell = 0.0
    elif up and dwell >= law.minimum_dwell:
        recruited, dwell, armed = recruited + 1, 0.0, False
    elif recruited > 1 and down and armed and dwell >= law.minimum_dwell:
        # Below the top state the newest unit has been taut already.
        recruited, dwell, armed = recruited - 1, 0.0, True
    output = RecruitmentOutput(
        recruited,
        expected.strain_rate,
        deslack,
        lag.lag,
        lag.drop,
        saturation,
        desaturation,
        compensation,
        lag.outside,
        expected.error,
    )
    return RecruitmentState(recruited, expected, load, dwell, armed, below, True), output
