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

"""Anticipatory recruitment (equations 12-16, Figure 8): shift when the lag is all that is left."""

import math

from fam_bundle_control.predictors import (
    CONSTANT_RATE,
    expected_strain,
    Predictor,
    predictor_start,
    time_to_fall,
    time_to_rise,
)
from fam_bundle_control.recruitment import recruitment_start, recruitment_step
from fam_bundle_model import fam
from fam_bundle_model.reference import still
import numpy as np
import pytest
from scipy.optimize import brentq
from scipy.signal import lfilter

DT = 0.001
STILL = still()
RATE = 0.03  # 1/s


def reach(units, pressures, load):
    """Return the strain at which the units at ``pressures`` hold ``load``: an independent root."""

    def surplus(strain):
        forces = (
            u.fams * fam.force(u.fam, p, strain) for u, p in zip(units, pressures, strict=True)
        )
        return sum(forces) - load

    return brentq(surplus, -0.05, 0.4, xtol=1e-15)


def rising(supervisor, ticks=400):
    """Move up through the saturation strain; return the outputs."""
    supervisor.step(strain=0.08, pressures=(5e5, 0.0))
    return [supervisor.move(RATE, 1) for _ in range(ticks)]


def recruited_and_armed(supervisor):
    """Shift up, arm the downshift at rest at a strain of 0.14; return the supervisor."""
    rising(supervisor, 2000)
    assert supervisor.state.recruited == 2
    supervisor.step(400, strain=0.14, pressures=(5e5, 6e5))
    assert supervisor.state.recruited == 2
    assert supervisor.state.armed
    return supervisor


def falling(supervisor, ticks):
    return [supervisor.move(-RATE, 1) for _ in range(ticks)]


def test_time_to_saturation_solves_equation_15(supervise, units, law, constant_table):
    drop, force, source = 4e4, 170.0, 640e3
    for scheme in ('lag', 'lag_pressure'):
        supervisor = supervise(law(scheme), constant_table(math.inf, drop))
        supervisor.step(force=force, source=source)
        output = rising(supervisor)[-1]
        strain = supervisor.seen['strain']
        assert output.source_pressure_drop == pytest.approx(drop)
        assert (output.pressure_compensation > 0.0) == (scheme == 'lag_pressure')
        effective = source - drop - output.pressure_compensation  # equations 12 and 13
        limit = reach(units, (effective, 0.0), force)
        expected = (limit - strain) / output.strain_rate
        assert output.time_to_saturation == pytest.approx(expected, abs=1e-7)
        assert output.time_to_desaturation == math.inf


def test_expected_strain_is_linear_in_time():
    """Equation 14, at the time of equation 15, is the strain sought."""
    for strain, rate in ((0.05, 0.02), (0.09, -0.01)):
        law = Predictor(CONSTANT_RATE, 0.03, 1e-3, 0.3)
        state = predictor_start()._replace(strain=strain, strain_rate=rate, started=True)
        reach = time_to_rise if rate > 0.0 else time_to_fall
        t = reach(law, state, STILL, 0.07)
        assert expected_strain(law, state, STILL, t) == pytest.approx(0.07)


def test_the_upshift_comes_exactly_when_the_time_left_is_the_lag(supervise, law, constant_table):
    never = supervise(law('lag'), constant_table(math.inf))
    times = [o.time_to_saturation for o in rising(never)]
    tick = next(k for k in range(300, 400) if times[k] > 0.0 and times[k] < times[k - 1])
    for factor, expected in ((1.0 + 1e-9, tick), (1.0 - 1e-9, tick + 1)):
        supervisor = supervise(law('lag'), constant_table(factor * times[tick]))
        outputs = rising(supervisor)
        shifted = next(k for k, o in enumerate(outputs) if o.recruited == 2)
        assert shifted == min(k for k, t in enumerate(times) if t <= factor * times[tick])
        assert shifted == expected


def test_a_lag_of_never_holds_the_state(supervise, law, constant_table):
    outputs = rising(supervise(law('lag'), constant_table(math.inf)), 3000)
    assert outputs[-1].time_to_saturation < 0.0
    assert {o.recruited for o in outputs} == {1}


@pytest.mark.parametrize('rate', [0.0, 0.9e-3, -0.03])
def test_only_a_rising_strain_saturates(supervise, law, constant_table, rate):
    supervisor = supervise(law('lag'), constant_table(1e6))
    output = supervisor.move(rate, 300)
    assert (output.time_to_saturation, output.recruited) == (math.inf, 1)


def test_a_unit_in_reserve_is_needed_to_shift_up(supervise, law, constant_table):
    supervisor = recruited_and_armed(supervise(law('lag'), constant_table(0.3)))
    outputs = [supervisor.move(RATE, 1) for _ in range(300)]
    assert {o.recruited for o in outputs} == {2}
    assert outputs[-1].time_to_saturation == math.inf


def test_time_to_desaturation_solves_equation_16_for_the_lower_state(
    supervise, units, law, constant_table
):
    supervisor = recruited_and_armed(supervise(law('lag'), constant_table(0.3)))
    output = falling(supervisor, 300)[-1]
    source, force = supervisor.seen['source'], supervisor.seen['force']
    limit = reach(units, (source - output.source_pressure_drop, 0.0), force)
    expected = (limit - supervisor.seen['strain']) / output.strain_rate
    assert output.strain_rate < 0.0
    assert output.time_to_desaturation == pytest.approx(expected, abs=1e-7)


def test_the_downshift_comes_a_lag_after_the_lower_state_suffices(
    supervise, units, law, constant_table
):
    lag = 0.2
    supervisor = recruited_and_armed(supervise(law('lag'), constant_table(lag)))
    outputs = falling(supervisor, 2000)
    shifted = next(k for k, o in enumerate(outputs) if o.recruited == 1)
    assert shifted > 0
    assert (
        outputs[shifted].time_to_desaturation <= -lag < outputs[shifted - 1].time_to_desaturation
    )
    limit = reach(units, (supervisor.seen['source'], 0.0), supervisor.seen['force'])
    strain = 0.14 - RATE * DT * (shifted + 1)
    assert (limit - strain) / RATE == pytest.approx(lag, abs=2 * DT)


def test_the_downshift_waits_until_the_unit_has_been_taut(supervise, units, law, constant_table):
    supervisor = supervise(law('lag'), constant_table(0.2))
    rising(supervisor, 2000)
    slack = 0.9 * fam.deslack_pressure(units[1].fam, 0.05)
    supervisor.step(strain=0.08, pressures=(5e5, slack))
    assert {o.recruited for o in falling(supervisor, 900)} == {2}
    taut = fam.deslack_pressure(units[1].fam, supervisor.seen['strain'])
    supervisor.step(pressures=(5e5, taut))
    assert supervisor.state.armed
    assert falling(supervisor, 5)[-1].recruited == 1


def test_a_dwell_separates_the_shifts(supervise, law, constant_table):
    supervisor = supervise(law('lag', minimum_dwell=0.25), constant_table(0.3))
    supervisor.step(260, strain=0.02, pressures=(5e5, 0.0))
    ticks_up = next(k for k in range(5000) if supervisor.move(RATE, 1).recruited == 2)
    assert ticks_up > 0
    supervisor.seen.update(pressures=(5e5, 6e5), strain=0.0)  # all that a downshift asks for
    since = next(k for k in range(5000) if supervisor.move(-1e-2, 1).recruited == 1)
    assert since * DT == pytest.approx(0.25, abs=2 * DT)


def test_noise_at_the_border_does_not_chatter(supervise, law, constant_table):
    """A strain that rocks about the shift by 1e-4 shifts no more often than the dwell allows."""
    supervisor = supervise(law('lag', minimum_dwell=0.3), constant_table(0.2))
    supervisor.step(400, strain=0.1, pressures=(5e5, 6e5))
    states = [
        supervisor.step(strain=0.1 + 0.02 * math.sin(3.0 * k * DT)).recruited for k in range(10000)
    ]
    shifts = np.flatnonzero(np.diff(states))
    assert len(shifts) > 2
    assert np.all(np.diff(shifts) * DT >= 0.3 - 2 * DT)


def test_strain_rate_and_force_filters_are_first_order(units, law, constant_table):
    random = np.random.default_rng(0)
    strain = 0.05 + 0.01 * np.cumsum(random.standard_normal(300)) * DT
    force = 180.0 + random.standard_normal(300)
    policy = law('lag', strain_rate_time_constant=0.02, force_time_constant=0.05)
    state, rates, loads = recruitment_start(), [], []
    for e, f in zip(strain, force, strict=True):
        state, output = recruitment_step(
            policy,
            units,
            constant_table(0.2),
            STILL,
            state,
            0.0,
            e,
            f,
            6e5,
            np.array([4e5, 0.0]),
            DT,
        )
        rates.append(output.strain_rate)
        loads.append(state.force)
    share = DT / (0.02 + DT)
    difference = np.diff(strain, prepend=strain[0]) / DT
    assert rates == pytest.approx(lfilter([share], [1.0, share - 1.0], difference), rel=1e-9)
    share = DT / (0.05 + DT)
    expected = lfilter([share], [1.0, share - 1.0], force - force[0]) + force[0]
    assert loads == pytest.approx(expected, rel=1e-12)


def test_units_that_have_no_more_to_give_get_help_even_if_nothing_moves(
    supervise, law, constant_table
):
    """A load too heavy for the first unit: no strain rate will ever say so."""
    supervisor = supervise(law('lag'), constant_table(0.2))
    assert supervisor.step(400, strain=0.0, pressures=(6e5, 0.0)).recruited == 1
    assert supervisor.step(strain=0.0, pressures=(6.4e5, 0.0)).recruited == 2
    hopeless = supervise(law('lag'), constant_table(math.inf))
    assert hopeless.step(400, strain=0.0, pressures=(6.4e5, 0.0)).recruited == 1


@pytest.mark.parametrize('source', [0.0, 200.0, 1e5])
def test_a_source_that_is_off_recruits_nothing(supervise, law, constant_table, source):
    """A unit at the pressure of such a source is not at its end: no state would help."""
    table = constant_table(0.2)
    table = table._replace(source_pressure=np.linspace(2e5, 7e5, 2))
    supervisor = supervise(law('lag'), table)
    assert supervisor.step(400, strain=0.0, source=source, pressures=(source, 0.0)).recruited == 1


def test_by_force_a_release_is_called_for_during_a_whole_lag(supervise, law, constant_table):
    """A noisy strain rate calls for it now and then; then the time begins anew."""
    for by_force in (False, True):
        supervisor = supervise(law('lag', by_force=by_force), constant_table(0.2))
        supervisor.step(400, strain=0.14, pressures=(5e5, 6e5))
        supervisor.state = supervisor.state._replace(recruited=2, armed=True, dwell=9.0)
        called = released = 0
        for tick in range(4000):
            output = supervisor.move(-RATE, 1)
            if not called and output.time_to_desaturation <= -0.2:
                called = tick
            if output.recruited == 1:
                released = tick
                break
        assert called
        expected = 0.2 if by_force else 0.0
        assert (released - called) * DT == pytest.approx(expected, abs=2 * DT)
