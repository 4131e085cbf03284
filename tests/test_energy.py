# SPDX-License-Identifier: Apache-2.0
"""The energies of a run agree with mechanics and with each other."""

import dataclasses
from typing import Any

from fam_bundle_bringup.experiment import default_configuration, metrics_of
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.energy import Energy, energy, energy_by_state, powers, summary
from fam_bundle_io.metrics import ticks_in, time_at_source, time_in_state, whole_cycles, Window
from fam_bundle_io.trace import empty_trace, Trace
from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units, state_force
from fam_bundle_model.parameters import Configuration, GRAVITY, load_configuration
from fam_bundle_sim.plant import plant, plant_step, resting_state, truth, UNITS
import numpy as np
import pytest

Found = tuple[Configuration, Trace, Energy, Window]


def settled(fam: dict[str, Any] | None = None, **reference: Any) -> Found:
    changes = {'reference': {'cycles': 2, **reference}, 'fam': fam or {}}
    configuration = load_configuration(default_configuration(), changes)
    trace = run_offline(configuration)
    cycle = whole_cycles(trace, configuration)[-1]
    return configuration, trace, energy(trace, powers(trace, configuration), cycle), cycle


@pytest.fixture(scope='module', params=[0.03, 0.06])
def found(request: pytest.FixtureRequest) -> Found:
    """Settle a small reference, which one unit holds alone, and the paper's."""
    return settled(amplitude=request.param)


def test_what_goes_in_comes_out(found: Found) -> None:
    """
    What the balance leaves is what the force law of slack muscles makes or takes.

    Over a settled cycle nothing is stored, but in the compressive regions the force law has no
    energy function: the oil does the work p dV on the muscles, these F dL on the load, and both
    need not be the same. That difference is computed here from pressures and strain alone.
    """
    configuration, trace, energies, cycle = found
    inside = ticks_in(trace, cycle)
    modulus, length = configuration.oil.bulk_modulus, configuration.fam.length[0]
    given = 0.0
    for number, unit in enumerate(motor_units(configuration)):
        pressure = trace['mu_pressure'][inside, number]
        pairs = zip(pressure, trace['strain'][inside], strict=True)
        oil = np.array([unit.fams * fam.oil_of(unit.fam, p, e, modulus) for p, e in pairs])
        given += float(np.sum(0.5 * (pressure[1:] + pressure[:-1]) * np.diff(oil)))
    force, strain = trace['force'][inside], trace['strain'][inside]
    done = float(np.sum(0.5 * (force[1:] + force[:-1]) * length * np.diff(strain)))
    net = energies.output - energies.returned
    assert net == pytest.approx(done, rel=0.02)
    assert energies.unexplained == pytest.approx(given - done, abs=0.03 * net)


def test_a_unit_that_stays_taut_leaves_nothing_unexplained() -> None:
    """There the force law has an energy function."""
    _, _, energies, _ = settled(amplitude=0.03, fam={'count': [2]})
    net = energies.output - energies.returned
    assert abs(energies.unexplained) < 0.02 * net


def test_the_output_lifts_the_load_against_damping_and_friction(found: Found) -> None:
    configuration, trace, energies, cycle = found
    load, length = configuration.load, configuration.fam.length[0]
    inside = ticks_in(trace, cycle)
    strain, time = trace['strain'][inside], trace['time'][inside]
    speed = np.gradient(strain, time)
    resisting = load.damping * length * speed + load.friction_force * np.tanh(
        speed / load.friction_rate
    )
    power = resisting * length * speed
    lost_up, lost_down = (float(power[where].sum() * 1e-3) for where in (speed > 0.0, speed < 0.0))
    lifted = load.mass * GRAVITY * length * (strain.max() - strain.min())
    # Between two shifts the strain dips and is lifted again: at most a few percent more.
    assert lifted < energies.output < 1.05 * (lifted + lost_up)
    assert 0.95 * (lifted - lost_down) < energies.returned < 1.05 * lifted


def test_the_modelled_flow_is_the_measured_one(found: Found) -> None:
    _, _, energies, _ = found
    assert energies.modelled_oil == pytest.approx(1.0, abs=1e-3)


def test_the_modelled_flow_fills_the_units(found: Found) -> None:
    """Integrated, it is the oil that pressure and strain say is in the muscles."""
    configuration, trace, _, cycle = found
    flow, inside = powers(trace, configuration).flow, ticks_in(trace, cycle)
    modulus = configuration.oil.bulk_modulus
    for number, unit in enumerate(motor_units(configuration)):
        pairs = zip(trace['mu_pressure'][inside, number], trace['strain'][inside], strict=True)
        oil = np.array([unit.fams * fam.oil_of(unit.fam, p, e, modulus) for p, e in pairs])
        filled = np.cumsum(flow[inside, number]) * configuration.simulation.period
        off = filled[:-1] - (oil[1:] - oil[0])
        assert np.abs(off).max() < 0.02 * (oil.max() - oil.min())


def test_states_fill_the_cycle_and_saturation_stays_within(found: Found) -> None:
    _, trace, _, cycle = found
    length = cycle.stop - cycle.start
    assert sum(time_in_state(trace, cycle).values()) == pytest.approx(length)
    assert all(0.0 <= time <= length for time in time_at_source(trace, cycle))


def test_a_steady_source_gives_pressure_times_flow_times_time() -> None:
    configuration = load_configuration(default_configuration())
    trace = empty_trace(1000, 2)
    for values in trace.values():
        values.fill(0)
    trace['time'][:] = 1e-3 * np.arange(1000)
    trace['source_pressure'].fill(6e5)
    trace['source_flow'].fill(1e-5)
    found = energy(trace, powers(trace, configuration), Window(0.0, 1.0))
    assert found.hydraulic_input == pytest.approx(6.0)
    assert found.output == found.returned == 0.0
    assert found.efficiency == 0.0


def test_states_share_the_energies_of_the_cycle(found: Found) -> None:
    configuration, trace, energies, cycle = found
    by_state = energy_by_state(trace, powers(trace, configuration), cycle)
    assert set(by_state) == set(time_in_state(trace, cycle))
    for name in ('hydraulic_input', 'output', 'returned', 'relieved', 'unexplained'):
        shared = sum(getattr(spent, name) for spent in by_state.values())
        assert shared == pytest.approx(getattr(energies, name), abs=1e-9)
    for name in ('supply_loss', 'return_loss'):
        losses = np.sum([getattr(spent, name) for spent in by_state.values()], axis=0)
        assert losses == pytest.approx(getattr(energies, name), abs=1e-9)


def random_trace(units: int = 3, ticks: int = 2000) -> Trace:
    """Return a trace of units above and below source and tank, their spools at random."""
    random, trace = np.random.default_rng(3), empty_trace(ticks, units)
    for values in trace.values():
        values.fill(0)
    trace['time'][:] = 1e-3 * np.arange(ticks)
    trace['source_pressure'][:] = random.uniform(3e5, 7e5, ticks)
    trace['mu_pressure'][:] = random.uniform(-8e4, 9e5, (ticks, units))
    trace['spool'][:] = random.uniform(-1.0, 1.0, (ticks, units))
    trace['recruitment_state'][:] = random.integers(1, units + 1, ticks)
    return trace


def test_no_valve_makes_energy_and_what_is_not_lost_is_in_the_units() -> None:
    """
    Tellegen: at every tick the source's power is the units' and the losses'; none is negative.

    Units above the source push oil back through an open supply land, some of it into other
    units, some through the source; a unit below the tank takes oil from it.
    """
    configuration = load_configuration(default_configuration(), {'fam': {'count': [1, 1, 2]}})
    trace = random_trace()
    flow = powers(trace, configuration)
    trace['source_flow'][:] = np.where(flow.supplied, flow.flow, 0.0).sum(axis=1)
    found = powers(trace, configuration)
    assert (found.relieved > 0.0).any()
    assert (found.source > 0.0).any()
    for power in (found.source, found.relieved, found.supply_loss, found.return_loss):
        assert (power >= 0.0).all()
    assert not np.any((found.supply_loss > 0.0) & (found.return_loss > 0.0))
    into_units = (trace['mu_pressure'] * found.flow).sum(axis=1)
    lost = found.supply_loss.sum(axis=1) + found.return_loss.sum(axis=1) + found.relieved
    assert found.source == pytest.approx(into_units + lost, abs=1e-9)
    spent = energy(trace, found, Window(0.0, 2.0))
    assert spent.unexplained == pytest.approx(into_units.sum() * 1e-3)
    assert spent.modelled_oil == pytest.approx(1.0)


def test_what_a_unit_pushes_back_through_the_source_is_relieved_and_no_input() -> None:
    """The rig itself: oil trapped above the source pressure, and a supply land that opens."""
    configuration = load_configuration(default_configuration(), {'fam': {'count': [2]}})
    trapped = 1.5 * configuration.source.nominal_pressure
    mass = state_force(motor_units(configuration), 1, trapped, 0.0) / GRAVITY  # is held by it
    heavy = dataclasses.replace(configuration.load, mass=mass)
    rig = plant(dataclasses.replace(configuration, load=heavy))
    state, pressure = resting_state(configuration, rig), np.zeros(1)
    state[UNITS] = fam.oil_of(rig.units[0].fam, trapped, 0.0, configuration.oil.bulk_modulus)
    trace, spool = empty_trace(20, 1), np.array([0.1])
    for values in trace.values():
        values.fill(0)
    for k in range(20):
        seen = truth(rig, state, pressure)
        trace['time'][k], trace['spool'][k], trace['mu_pressure'][k] = 1e-3 * k, spool, pressure
        for name in ('strain', 'force', 'source_pressure', 'source_flow'):
            trace[name][k] = getattr(seen, name)
        plant_step(rig, state, spool, 1e-3, 20)
    assert (trace['mu_pressure'][:, 0] > trace['source_pressure']).all()
    assert trace['source_flow'].min() < -1e-5
    spent = energy(trace, powers(trace, configuration), Window(0.0, 0.02))
    back = -float((trace['source_pressure'] * trace['source_flow']).sum()) * 1e-3
    assert spent.hydraulic_input == 0.0
    assert spent.relieved == pytest.approx(back, rel=1e-3)
    assert spent.return_loss == [0.0]
    over = trace['mu_pressure'][:, 0] - trace['source_pressure']
    assert spent.supply_loss[0] == pytest.approx(
        -float((over * trace['source_flow']).sum()) * 1e-3, rel=1e-3
    )


def test_noise_of_the_flow_meter_is_no_input() -> None:
    configuration = load_configuration(default_configuration())
    trace = run_offline(configuration)
    cycle = whole_cycles(trace, configuration)[-1]
    ideal = energy(trace, powers(trace, configuration), cycle)
    trace['source_flow'] += 2e-6 * np.random.default_rng(1).standard_normal(len(trace['time']))
    noisy = energy(trace, powers(trace, configuration), cycle)
    # 100 ticks' worth of the noise's power; its positive half alone would be 5 J.
    assert noisy.hydraulic_input == pytest.approx(ideal.hydraulic_input, abs=0.5)


def test_cycles_are_the_same_from_parameters_and_from_valleys() -> None:
    for frequency in (0.1, 0.2, 0.3):
        configuration, trace, _, _ = settled(frequency=frequency, cycles=3)
        told, seen = whole_cycles(trace, configuration), whole_cycles(trace)
        assert len(told) == len(seen) == 3
        assert np.allclose(told, seen, atol=2e-3)
        cut = {name: values[:-500] for name, values in trace.items()}
        assert len(whole_cycles(cut, configuration)) == len(whole_cycles(cut)) == 2
        late = {name: values[500:] for name, values in trace.items()}
        assert len(whole_cycles(late, configuration)) == 2


def test_a_sample_that_is_not_finite_spoils_its_own_cycle_only() -> None:
    configuration, trace, energies, cycle = settled(frequency=0.5)
    trace['strain'][100] = np.nan
    found = powers(trace, configuration)
    assert energy(trace, found, cycle) == energies
    with pytest.raises(ValueError, match='not finite'):
        energy(trace, found, Window(0.0, 2.0))


def test_metrics_hold_the_energy_unless_a_sensor_gave_no_number() -> None:
    configuration, trace, energies, _ = settled(frequency=0.5)
    found = metrics_of(configuration, 'offline', trace)['energy']
    assert found == summary(energies)
    lost = found['throttling_loss'] + energies.relieved + energies.unexplained
    assert found['hydraulic_input'] == pytest.approx(found['output'] - found['returned'] + lost)
    trace['source_flow'].fill(np.nan)
    blind = metrics_of(configuration, 'offline', trace)
    assert blind['energy'] is None
    assert np.isfinite(blind['iae'])


def test_parts_of_a_cycle_are_no_cycles() -> None:
    _, trace, _, _ = settled(frequency=0.5)

    def part(start: float, stop: float) -> Trace:
        inside = ticks_in(trace, Window(start, stop))
        return {name: values[inside] for name, values in trace.items()}

    assert whole_cycles(part(0.0, 1.2)) == []
    assert whole_cycles(part(0.5, 1.7)) == []
    assert whole_cycles(part(1.3, 2.7)) == []
    assert len(whole_cycles(part(0.0, 2.7))) == 1
    assert len(whole_cycles(part(1.3, 4.0))) == 1
    assert len(whole_cycles(part(0.0, 2.0))) == 1
