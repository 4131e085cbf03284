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
Where the hydraulic energy of a run goes: into the load, and into the valves, by state.

Our derivation. The source gives ``p_s Q_s``. Of that, the oil that enters unit i at its pressure
carries ``p_i Q_i`` into the muscles; ``(p_s - p_i) Q_i`` is lost in valve and hose on the way, and
``p_i Q_i`` of what leaves on its way to the tank. A unit above the source gives oil back through
an open supply land: ``(p_s - p_i) Q_i`` is a loss then, too, for both factors are negative. What
no other unit takes of it (``Q_s < 0``) the source relieves to the tank, and ``-p_s Q_s`` is lost.
The load gets ``F L0`` per unit strain.

Force, strain, pressures and the source's flow are measured; the flow of each unit is not: it comes
from the spool commands and pressures by equations 5 and 6.
"""

import math
from typing import NamedTuple

from fam_bundle_io.metrics import NotMeasurable, steps, ticks_in, Window
from fam_bundle_io.trace import Trace
from fam_bundle_model.compile import compiled
from fam_bundle_model.hydraulics import hydraulic_law, HydraulicLaw, unit_flow
from fam_bundle_model.parameters import Configuration
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

SMOOTHING = 0.05  # s over which the strain is averaged to tell contraction from lengthening


class Powers(NamedTuple):
    """
    Powers in W at every tick: (ticks,), or (ticks, units) for those of motor units.

    ``load`` is what the bundle does on the load, negative where the load drives it;
    ``source`` is what it gives, ``relieved`` what comes back to it. ``contracting`` tells at which
    ticks the bundle shortens. ``flow`` (ticks, units) is the modelled flow into each unit
    (m^3/s), negative out of it; ``supplied`` (ticks, units) tells where it comes from the source
    or goes back to it, not to the tank.
    """

    source: Array
    relieved: Array
    load: Array
    contracting: npt.NDArray[np.bool_]
    supply_loss: Array
    return_loss: Array
    flow: Array
    supplied: npt.NDArray[np.bool_]


class Energy(NamedTuple):
    """
    Energies in J over a window, or what of it was spent in one state; of motor units as lists.

    ``output`` is done on the load while the bundle contracts, ``returned`` is what the load gives
    back while it lengthens. ``supply_loss`` and ``return_loss`` are throttled in each unit's valve
    and hose, between source and unit and on the way to the tank; ``relieved`` is what units push
    back into the source. ``efficiency`` is ``output / hydraulic_input``. ``unexplained`` is what
    the input leaves after work and losses: change of stored energy, errors of sensors and model,
    and what the force law of slack FAMs makes or takes, which has no energy function
    (docs/model.md). ``modelled_oil`` is the modelled flow out of the source over the measured one.
    """

    hydraulic_input: float
    output: float
    returned: float
    supply_loss: list[float]
    return_loss: list[float]
    relieved: float
    unexplained: float
    efficiency: float
    modelled_oil: float


@compiled
def _spool_and_flow(
    law: HydraulicLaw,
    step: Array,
    command: Array,
    source: Array,
    pressure: Array,
    flow: Array,
    supplied: npt.NDArray[np.bool_],
) -> None:
    """
    Fill ``flow`` and ``supplied`` (ticks, units).

    Each command acts from its tick on, behind the spool's lag.
    """
    for unit in range(command.shape[1]):
        spool = 0.0
        for tick in range(command.shape[0]):
            flow[tick, unit] = unit_flow(law, spool, source[tick], pressure[tick, unit])
            supplied[tick, unit] = spool > 0.0
            decay = math.exp(-step[tick] / law.spool_time_constant)
            spool = command[tick, unit] + (spool - command[tick, unit]) * decay


def powers(
    trace: Trace, configuration: Configuration, applied_spool: Array | None = None
) -> Powers:
    """
    Return all powers of a run that begins with the valves at rest.

    ``applied_spool`` (ticks, units) are the commands that acted from each tick to the next, where
    they are not those of the trace: in real time they may come late.
    """
    command = trace['spool'] if applied_spool is None else applied_spool
    law, step = hydraulic_law(configuration), steps(trace)
    source, pressure = trace['source_pressure'], trace['mu_pressure']
    flow, supplied = np.zeros_like(pressure), np.zeros(pressure.shape, dtype=np.bool_)
    _spool_and_flow(law, step, command, source, pressure, flow, supplied)
    drawn = np.where(supplied, flow, 0.0).sum(axis=1)
    length = configuration.fam.length[0]
    speed = np.gradient(trace['strain'], trace['time'])
    return Powers(
        # By the model's direction, for the positive part of a noisy flow would be too much.
        source=np.where(drawn >= 0.0, source * trace['source_flow'], 0.0),
        relieved=np.where(drawn < 0.0, -source * drawn, 0.0),
        load=trace['force'] * length * speed,
        contracting=_contracting(trace['strain'], float(np.median(step))),
        supply_loss=np.where(supplied, flow * (source[:, None] - pressure), 0.0),
        return_loss=np.where(supplied, 0.0, -flow * pressure),
        flow=flow,
        supplied=supplied,
    )


def _contracting(strain: Array, step: float) -> npt.NDArray[np.bool_]:
    from scipy.ndimage import uniform_filter1d

    known = np.flatnonzero(np.isfinite(strain))
    if not known.size:
        return np.zeros(len(strain), dtype=np.bool_)
    # A running mean would hand one gap on to all that follows.
    filled = np.interp(np.arange(len(strain)), known, strain[known])
    smooth = uniform_filter1d(filled, max(round(SMOOTHING / step), 1))
    return np.asarray(np.gradient(smooth) > 0.0, dtype=np.bool_)


def energy(trace: Trace, found: Powers, window: Window, state: int | None = None) -> Energy:
    """
    Return what the powers ``found`` in ``trace`` come to within ``window``.

    Only of the ticks with ``state`` units recruited, if that is given. Raises NotMeasurable where
    something in it is not finite.
    """
    inside = ticks_in(trace, window)
    if state is not None:
        inside &= trace['recruitment_state'] == state
    step = steps(trace)[inside]
    for power in (found.source, found.load, found.relieved, found.supply_loss, found.return_loss):
        if not np.isfinite(power[inside]).all():
            raise NotMeasurable('a power is not finite')

    def total(power: Array) -> float:
        return float((power[inside] * step).sum())

    def of_units(power: Array) -> list[float]:
        return [float(e) for e in (power[inside] * step[:, None]).sum(axis=0)]

    given, relieved = total(found.source), total(found.relieved)
    output = total(np.where(found.contracting, found.load, 0.0))
    returned = -total(np.where(found.contracting, 0.0, found.load))
    supply, back = of_units(found.supply_loss), of_units(found.return_loss)
    oil = total(trace['source_flow'])
    return Energy(
        hydraulic_input=given,
        output=output,
        returned=returned,
        supply_loss=supply,
        return_loss=back,
        relieved=relieved,
        unexplained=given - (output - returned) - sum(supply) - sum(back) - relieved,
        efficiency=output / given if given > 0.0 else math.nan,
        modelled_oil=(
            total(np.where(found.supplied, found.flow, 0.0).sum(axis=1)) / oil if oil else math.nan
        ),
    )


def summary(spent: Energy) -> dict[str, float | None]:
    """Return the few numbers of ``spent`` that a run is compared by; an undefined one is None."""
    return {
        'hydraulic_input': spent.hydraulic_input,
        'output': spent.output,
        'returned': spent.returned,
        'throttling_loss': sum(spent.supply_loss) + sum(spent.return_loss),
        'efficiency': spent.efficiency if math.isfinite(spent.efficiency) else None,
    }


def energy_by_state(trace: Trace, found: Powers, window: Window) -> dict[int, Energy]:
    """
    Return ``energy`` of each number of recruited units that occurs within ``window``.

    Energies add up to those of the window. What is stored in one state and spent in another
    stands in ``unexplained`` of both. Raises NotMeasurable where something is not finite.
    """
    states = np.unique(trace['recruitment_state'][ticks_in(trace, window)])
    return {int(state): energy(trace, found, window, int(state)) for state in states}
