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

"""The paper's controllers through volts: the same Table 2 as without."""

import dataclasses

from benches import CONFIG
from fam_bundle_bringup.offline import run_offline
from fam_bundle_control.pressure_loop import pressure_loop, pressure_loop_step
from fam_bundle_control.recruitment import recruitment, recruitment_start, recruitment_step
from fam_bundle_control.strain_loop import strain_loop, strain_loop_start, strain_loop_step
from fam_bundle_io.hardware.backend import load_backend, make_setup
from fam_bundle_io.hardware.calibration import load_hardware
from fam_bundle_io.hardware.monitor import Monitor
from fam_bundle_io.hardware.safety import State
from fam_bundle_io.metrics import tracking
from fam_bundle_io.trace import empty_trace
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.lag_table import cached_lag_table
from fam_bundle_model.parameters import load_configuration, seconds
from fam_bundle_model.reference import reference_law, strain_reference
import numpy as np
import pytest


def paper(scheme, **changes):
    return load_configuration(
        CONFIG / 'lhacd.yaml', {'recruitment': {'scheme': scheme}, **changes}
    )


def rig(power_of_two=False, **limits):
    """Return the shipped simulated rig; with powers of two as gains no scaling rounds."""
    found = load_hardware(CONFIG / 'volts_calibration.yaml')
    limits = dataclasses.replace(found.limits, activation_commands=1, **limits)
    calibration = found.calibration
    if power_of_two:
        exact = {'strain': 2.0**-5, 'force': 2.0**6, 'source_pressure': 2.0**18}
        sensors = {
            name: dataclasses.replace(getattr(calibration, name), gain=gain, offset=0.0)
            for name, gain in exact.items()
        }
        pressures = tuple(
            dataclasses.replace(sensor, gain=2.0**18, offset=0.0, live_minimum=-5.0)
            for sensor in calibration.mu_pressure
        )
        valves = tuple(
            dataclasses.replace(valve, full_scale_volts=8.0) for valve in calibration.valves
        )
        calibration = dataclasses.replace(
            calibration, mu_pressure=pressures, valves=valves, **sensors
        )
    return dataclasses.replace(found, calibration=calibration, limits=limits)


def through_volts(configuration, hardware, **options):
    """Return the trace of a whole run: every sample and every command goes through volts."""
    hardware = dataclasses.replace(hardware, options={'volts': {'hold': True, **options}})
    c, units = configuration, motor_units(configuration)
    setup = make_setup(hardware, 'volts', c.simulation.period, c)
    monitor = Monitor(
        load_backend('volts'), setup, hardware.limits, c.source.nominal_pressure, clock=None
    )
    laws = strain_loop(c), recruitment(c), cached_lag_table(c), pressure_loop(c)
    outer, policy, table, inner = laws
    outer_state, policy_state, integral = strain_loop_start(), recruitment_start(), np.zeros(2)
    wanted, spool, saturated = np.empty(2), np.empty(2), np.empty(2, dtype=np.bool_)
    period, trajectory = seconds(c.period_ns()), reference_law(c.reference)
    trace = empty_trace(c.ticks(), len(units))
    with monitor:
        sample = monitor.tick()
        monitor.arm()
        for k in range(c.ticks()):
            strain, force, source = (float(value) for value in sample.values[:3])
            pressure = sample.values[4:].copy()
            time = seconds(k * c.period_ns())
            reference = strain_reference(trajectory, time)
            outer_state, asked = strain_loop_step(
                outer, units, outer_state, reference, strain, source, pressure, period
            )
            policy_state, decided = recruitment_step(
                policy,
                units,
                table,
                trajectory,
                policy_state,
                time,
                strain,
                force,
                source,
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
                strain,
                source,
                pressure,
                period,
                wanted,
                spool,
                saturated,
            )
            for name, value in (
                ('time', time),
                ('strain_reference', reference),
                ('strain', strain),
                ('mu_pressure', pressure),
                ('spool', spool),
                ('recruitment_state', decided.recruited),
            ):
                trace[name][k] = value
            sample = monitor.tick(spool, monitor.now())
            assert sample.state is State.ACTIVE, sample.fault
    return trace


def table_2(configuration, trace):
    period = 1.0 / configuration.reference.frequency
    return tracking(trace, period, configuration.reference.cycles * period)


@pytest.fixture(scope='module')
def direct():
    return {scheme: run_offline(paper(scheme)) for scheme in ('baseline', 'lag_pressure')}


@pytest.mark.parametrize('scheme', ['baseline', 'lag_pressure'])
def test_ideal_volts_change_the_run_by_nothing_but_rounding(direct, scheme):
    """Roundings of 1e-16 at each tick, which a stable loop does not let grow."""
    trace = through_volts(paper(scheme), rig(), bits=0)
    assert np.max(np.abs(trace['strain'] - direct[scheme]['strain'])) < 1e-12
    assert np.array_equal(trace['recruitment_state'], direct[scheme]['recruitment_state'])


def test_where_no_scaling_rounds_the_run_is_the_same_bit_for_bit(direct):
    """Gains and full scale of powers of two, offsets of zero: volts are the values' own digits."""
    trace = through_volts(paper('baseline'), rig(power_of_two=True), bits=0)
    for name in ('strain', 'mu_pressure', 'spool', 'recruitment_state'):
        assert np.array_equal(trace[name], direct['baseline'][name]), name


@pytest.mark.parametrize('scheme', ['baseline', 'lag_pressure'])
def test_table_2_through_16_bits_is_within_5_percent(direct, scheme):
    configuration = paper(scheme)
    wanted = table_2(configuration, direct[scheme])
    found = table_2(configuration, through_volts(configuration, rig(), bits=16))
    assert found.iae == pytest.approx(wanted.iae, rel=0.05)
    assert found.max_error == pytest.approx(wanted.max_error, rel=0.05)


NOISE = {
    'strain_noise': 2e-5,
    'force_noise': 0.5,
    'pressure_noise': 300.0,
    'flow_noise': 2e-7,
    'seed': 3,
}
REAL = {'bits': 16, 'null_offset': 0.02, 'hysteresis': 0.02}


def test_with_noise_hysteresis_and_a_null_that_has_moved_the_schemes_keep_their_order():
    """About one digit of noise, the valve's 2 %; and no sensor is taken for frozen or jumping."""
    found = {}
    for scheme in ('baseline', 'lag_pressure'):
        configuration = paper(scheme, sensors=NOISE)
        trace = through_volts(configuration, rig(frozen_samples=500), **REAL)
        found[scheme] = table_2(configuration, trace)
    assert found['lag_pressure'].iae < 0.8 * found['baseline'].iae
    assert found['lag_pressure'].max_error < 0.8 * found['baseline'].max_error
