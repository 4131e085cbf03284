# SPDX-License-Identifier: Apache-2.0
"""The energies of a run agree with mechanics and with each other."""

from typing import Any

import numpy as np
import pytest

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.energy import Energy, energy, powers
from fam_bundle_io.metrics import Window, ticks_in, time_at_source, time_in_state, whole_cycles
from fam_bundle_io.trace import Trace, empty_trace
from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.parameters import GRAVITY, Configuration, load_configuration

Found = tuple[Configuration, Trace, Energy, Window]


def settled(**reference: Any) -> Found:
    changes = {'reference': {'cycles': 2, **reference}}
    configuration = load_configuration(default_configuration(), changes)
    trace = run_offline(configuration)
    cycle = whole_cycles(trace, configuration)[-1]
    return configuration, trace, energy(trace, powers(trace, configuration), cycle), cycle


@pytest.fixture(scope='module', params=[0.03, 0.06])
def found(request: pytest.FixtureRequest) -> Found:
    """A small reference, which one unit holds alone, and the paper's, which needs both."""
    return settled(amplitude=request.param)


def test_what_goes_in_comes_out(found: Found) -> None:
    """Over a settled cycle nothing is stored: input is net work and losses.

    In the compressive regions force and volume are not of one energy function (docs/model.md), so
    the balance need not close better than that.
    """
    _, _, energies, _ = found
    assert abs(energies.unexplained) < 0.01 * energies.hydraulic_input


def test_the_output_lifts_the_load_against_damping_and_friction(found: Found) -> None:
    configuration, trace, energies, cycle = found
    load, length = configuration.load, configuration.fam.length[0]
    inside = ticks_in(trace, cycle)
    strain, time = trace['strain'][inside], trace['time'][inside]
    speed = np.gradient(strain, time)
    resisting = load.damping * length * speed + load.friction_force * np.tanh(
        speed / load.friction_rate
    )
    lost = float(np.sum(np.clip(resisting * length * speed, 0.0, None)[speed > 0.0]) * 1e-3)
    lifted = load.mass * GRAVITY * length * (strain.max() - strain.min())
    # Between two shifts the strain dips and is lifted again: at most a few percent more.
    assert lifted < energies.output < 1.05 * (lifted + lost)
    given_back = load.mass * GRAVITY * length * (strain.max() - strain.min())
    assert energies.returned < 1.05 * given_back


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
