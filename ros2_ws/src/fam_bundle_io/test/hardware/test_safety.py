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

"""When valves may move, what is a measurement, what becomes of a command; each law alone."""

import dataclasses
import itertools
import math
import re

from benches import NOMINAL, PERIOD
from fam_bundle_io.hardware.calibration import MU_PRESSURE, Scaling, SOURCE_PRESSURE, STRAIN
from fam_bundle_io.hardware.command_gate import CommandGate
from fam_bundle_io.hardware.limits import Limits
from fam_bundle_io.hardware.safety import Refused, Safety, State
from fam_bundle_io.hardware.sensor_watch import SensorWatch
from fam_bundle_io.hardware.zeroing import Zeroing
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

LIMITS = Limits()
MS = 1_000_000  # ns
NAMES = ('strain', 'force', 'source_pressure', 'source_flow', 'mu_pressure[0]', 'mu_pressure[1]')
ESSENTIAL = (0, 2, 4, 5)
EXPENDABLE = (1, 3)
WELL = (0.1, 180.0, 680e3, 1e-5, 400e3, 3e3)


# ---- States ----


def safety(hardware, **limits):
    return Safety(hardware.calibration, dataclasses.replace(LIMITS, **limits), NOMINAL)


def brought_to(found, state):
    """Return ``found`` by the way that its documents draw."""
    if state is State.UNCONFIGURED:
        return found
    found.configured()
    if state in (State.ARMED, State.ACTIVE):
        found.arm(measuring=True)
    if state is State.ACTIVE:
        found.activate()
    if state is State.FAULT:
        found.latch('broken')
    assert found.state is state
    return found


VENTED = np.array([0.0, 0.0, NOMINAL, 0.0, 100.0, 19e3])
STEPS = {
    'configured': lambda found: found.configured(),
    'arm': lambda found: found.arm(measuring=True),
    'activate': lambda found: found.activate(),
    'reset': lambda found: found.reset(VENTED, measuring=True),
}
ALLOWED = {
    ('configured', State.UNCONFIGURED): State.INACTIVE,
    ('configured', State.FAULT): State.FAULT,
    ('arm', State.INACTIVE): State.ARMED,
    ('activate', State.ARMED): State.ACTIVE,
    ('reset', State.FAULT): State.INACTIVE,
}


@pytest.mark.parametrize(('step', 'state'), list(itertools.product(STEPS, State)))
def test_only_the_drawn_transitions_are_allowed(hardware, step, state):
    found = brought_to(safety(hardware), state)
    if (step, state) in ALLOWED:
        STEPS[step](found)
        assert found.state is ALLOWED[step, state]
    else:
        with pytest.raises(Refused, match=f'the bridge is {state.value}'):
            STEPS[step](found)
        assert found.state is state


@pytest.mark.parametrize('state', State)
def test_a_fault_latches_from_every_state_and_the_first_one_stays(hardware, state):
    found = brought_to(safety(hardware), state)
    first = found.fault or 'first'
    found.latch('first')
    found.latch('second')
    assert found.fault == first
    assert found.state is (state if state is State.UNCONFIGURED else State.FAULT)
    found.disarm()
    assert found.fault == first


def test_a_fault_outlives_the_card(hardware):
    found = brought_to(safety(hardware), State.ACTIVE)
    found.latch('broken wire')
    found.released()
    found.configured()
    assert (found.state, found.fault) == (State.FAULT, 'broken wire')


@pytest.mark.parametrize('unit', [0, 1])
@pytest.mark.parametrize(
    ('pressure', 'reset'), [(19.99e3, True), (20e3, False), (math.nan, False)]
)
def test_a_fault_ends_only_when_every_unit_is_depressurised(hardware, unit, pressure, reset):
    found = brought_to(safety(hardware), State.FAULT)
    values = VENTED.copy()
    values[MU_PRESSURE + unit] = pressure
    if reset:
        found.reset(values, measuring=True)
        assert (found.state, found.fault) == (State.INACTIVE, '')
    else:
        with pytest.raises(Refused, match=rf'mu_pressure\[{unit}\] = .* Pa: must be < 20000 Pa'):
            found.reset(values, measuring=True)
        assert found.state is State.FAULT


def test_nothing_begins_without_measurements(hardware):
    with pytest.raises(Refused, match='not every sensor measures'):
        brought_to(safety(hardware), State.INACTIVE).arm(measuring=False)
    with pytest.raises(Refused, match='not every sensor measures; the fault was: broken'):
        brought_to(safety(hardware), State.FAULT).reset(VENTED, measuring=False)


# ---- Pressure ----


def over(found, pressures, source=NOMINAL, unit=0):
    """Return what each sample of one unit's pressure leads to."""
    values = np.array([0.0, 0.0, source, 0.0, 0.0, 0.0])
    told = []
    for pressure in pressures:
        values[MU_PRESSURE + unit] = pressure
        told.append(found.watch_pressure(values))
    return told


@pytest.mark.parametrize('unit', [0, 1])
@pytest.mark.parametrize(
    ('source', 'bound'), [(NOMINAL, 1.05 * NOMINAL), (600e3, 650e3), (0.0, 50e3)]
)
def test_five_samples_above_the_limit_are_one_too_many(hardware, unit, source, bound):
    """1.05 times nominal, or 50 kPa above the source, whichever is lower."""
    if source == NOMINAL:
        bound = min(bound, source + 50e3)
    told = over(safety(hardware), [bound + 1.0] * 5, source, unit)
    assert told[:4] == [''] * 4
    assert told[4].startswith(f'mu_pressure[{unit}] = ') and ': must be <= ' in told[4]
    assert over(safety(hardware), [bound - 1.0] * 50, source, unit) == [''] * 50


def test_samples_above_the_limit_must_come_in_a_row(hardware):
    told = over(safety(hardware), ([8e5] * 4 + [1e5]) * 10)
    assert told == [''] * 50


def test_the_ratio_to_nominal_holds_where_the_source_is_higher_still(hardware):
    told = over(safety(hardware), [1.05 * NOMINAL + 1.0] * 5, source=2.0 * NOMINAL)
    assert told[-1]


# ---- Sensors ----


class Sensors:
    """The watch of the shipped sensors, fed by values; noise in the last bits unless frozen."""

    def __init__(self, hardware, **limits):
        chosen = {'frozen_samples': 50, **limits}
        self.watch = SensorWatch(hardware.calibration, dataclasses.replace(LIMITS, **chosen))
        self.scaling = Scaling(hardware.calibration)
        self.k = 0

    def look(self, changes=None, volts=None, elapsed=PERIOD, still=()):
        """Return why the loop ends, and what the values became."""
        self.k += 1
        wanted, seen = np.array(WELL), np.empty(6)
        for i, value in (changes or {}).items():
            wanted[i] = value
        self.scaling.to_volts(wanted, seen)
        for i in set(range(6)) - set(still):
            seen[i] += 1e-9 * (self.k % 2)
        for i, value in (volts or {}).items():
            seen[i] = value
        values = np.empty(6)
        with np.errstate(invalid='ignore'):
            self.scaling.to_values(seen, values)
        return self.watch.look(seen, values, elapsed), values


@pytest.fixture
def sensors(hardware):
    found = Sensors(hardware)
    for _ in range(3):
        assert found.look()[0] == ''
    assert found.watch.measuring
    return found


DEAD = dict(zip(ESSENTIAL, (9.95, 0.2, 4.8, 0.0), strict=True))


@pytest.mark.parametrize('channel', ESSENTIAL)
@pytest.mark.parametrize('volts', [None, math.nan, math.inf, -math.inf])
def test_a_channel_outside_its_live_range_is_lost_after_four_samples(sensors, channel, volts):
    dead = {channel: DEAD[channel] if volts is None else volts}
    for _ in range(3):
        reason, values = sensors.look(volts=dead)
        assert reason == ''
        assert values == pytest.approx(WELL, rel=1e-6)  # the last good one is held
        assert not sensors.watch.measuring
    reason, values = sensors.look(volts=dead)
    assert reason.startswith(f'{NAMES[channel]} = ') and ' V: must be >= ' in reason
    assert values == pytest.approx(WELL, rel=1e-6)


@pytest.mark.parametrize('channel', EXPENDABLE)
def test_a_lost_load_cell_or_flow_meter_is_flagged_and_keeps_its_last_value(sensors, channel):
    for k in range(20):
        reason, values = sensors.look(volts={channel: 9.99 if channel == 1 else math.nan})
        assert reason == '' and sensors.watch.measuring
        assert values == pytest.approx(WELL, rel=1e-6)
        assert sensors.watch.degraded.tolist() == [i == channel and k >= 3 for i in range(6)]
    sensors.look()
    assert not sensors.watch.degraded.any()


@pytest.mark.parametrize('samples', [1, 2, 3])
@pytest.mark.parametrize('channel', ESSENTIAL)
def test_a_shorter_disturbance_is_bridged(sensors, channel, samples):
    for _ in range(20):
        for _ in range(samples):
            assert sensors.look(volts={channel: DEAD[channel]})[0] == ''
        for _ in range(samples):
            assert sensors.look()[0] == ''
            assert sensors.watch.measuring


@pytest.mark.parametrize('channel', ESSENTIAL)
def test_a_loose_contact_adds_up(sensors, channel):
    """Two of three samples are lost, never four in a row."""
    reasons = [
        sensors.look(volts={channel: DEAD[channel]} if k % 3 else {})[0] for k in range(1, 20)
    ]
    assert any(reasons)


JUMPS = {0: 0.006, 2: -160e3, 4: 160e3, 5: 160e3}


@pytest.mark.parametrize('channel', ESSENTIAL)
def test_a_value_that_moves_faster_than_the_rig_is_a_jump(sensors, channel):
    """And stays one, if it stays where it is: the last good value is what it is held against."""
    reasons = [sensors.look({channel: WELL[channel] + JUMPS[channel]})[0] for _ in range(4)]
    assert reasons[:3] == [''] * 3
    assert reasons[3].startswith(f'{NAMES[channel]}: jumped by ')


@pytest.mark.parametrize('channel', ESSENTIAL)
def test_a_channel_that_comes_back_elsewhere_measures_again_once_it_is_steady(sensors, channel):
    """Else no fault of a sensor could be reset after the rig has vented."""
    for _ in range(100):
        reason, _ = sensors.look(volts={channel: DEAD[channel]})
    assert reason
    elsewhere = {channel: WELL[channel] + 2.0 * JUMPS[channel]}
    measuring = []
    for _ in range(20):
        _, values = sensors.look(elsewhere)
        measuring.append(sensors.watch.measuring)
    # 8 samples without a step after the one that came back.
    assert measuring == [False] * 8 + [True] * 12
    assert values[channel] == pytest.approx(elsewhere[channel], rel=1e-6)
    assert sensors.look(elsewhere)[0] == ''


@pytest.mark.parametrize('channel', ESSENTIAL)
def test_one_spike_is_left_out_and_the_loop_goes_on(sensors, channel):
    reason, values = sensors.look({channel: WELL[channel] + JUMPS[channel]})
    assert reason == '' and values == pytest.approx(WELL, rel=1e-6)
    assert sensors.look() == ('', pytest.approx(WELL, rel=1e-6))


def test_fast_but_possible_changes_are_measurements(sensors):
    """The quickest changes of the paper's run: 48 kPa and 3e-4 in strain within a tick."""
    for k in range(1, 8):
        changes = {0: 0.1 + 3e-4 * k, 5: 3e3 + 48e3 * k, 2: 680e3 - 10e3 * k}
        reason, values = sensors.look(changes)
        assert reason == ''
        assert values[5] == pytest.approx(changes[5], rel=1e-4)


def test_after_a_hold_up_a_value_may_have_come_farther(sensors):
    assert sensors.look({0: 0.1 + 0.04}, elapsed=0.01)[0] == ''
    assert sensors.watch.measuring


@pytest.mark.parametrize('channel', ESSENTIAL)
def test_a_channel_that_does_not_change_in_the_last_bit_is_frozen(sensors, channel):
    reasons = [sensors.look(still=[channel])[0] for _ in range(60)]
    first = next(k for k, reason in enumerate(reasons) if reason)
    assert 50 <= first <= 55
    assert reasons[first].startswith(f'{NAMES[channel]}: frozen at ')


def test_a_flow_meter_without_pulses_is_not_frozen(sensors):
    for _ in range(200):
        assert sensors.look({3: 0.0}, still=[3])[0] == ''
        assert not sensors.watch.degraded.any()


def test_frozen_channels_can_be_left_unchecked(hardware):
    found = Sensors(hardware, frozen_samples=0)
    assert all(found.look(still=range(6))[0] == '' for _ in range(2000))


def test_before_its_first_good_value_a_channel_does_not_measure(hardware):
    found = Sensors(hardware)
    for _ in range(2):
        assert found.look(volts={STRAIN: math.nan})[0] == ''
        assert not found.watch.measuring and not found.watch.has_values
    found.look()
    assert found.watch.measuring and found.watch.has_values


def test_what_is_forgotten_is_no_base_for_a_jump(sensors):
    sensors.watch.forget()
    assert not sensors.watch.measuring
    assert sensors.look({STRAIN: -0.15})[0] == ''
    assert sensors.watch.measuring


# ---- Commands ----


class Gate:
    """A gate with a clock in ms, of slow or quick valves."""

    def __init__(self, hardware, slew=1e9, **limits):
        valves = tuple(
            dataclasses.replace(valve, slew_limit=slew) for valve in hardware.calibration.valves
        )
        calibration = dataclasses.replace(hardware.calibration, valves=valves)
        self.gate = CommandGate(calibration, dataclasses.replace(LIMITS, **limits))
        self.now = 1000 * MS

    def take(self, *spool, stamp=None):
        return self.gate.take(np.array(spool), self.now if stamp is None else stamp, self.now)

    def pass_ms(self, ms=1):
        """Return what each ms leads to, and the spools then."""
        self.now += ms * MS
        return self.gate.apply(self.now, ms * 1e-3)


@pytest.fixture
def gate(hardware):
    return Gate(hardware)


def test_a_fresh_command_is_applied_to_the_bit(gate):
    for spool in ([0.1, -0.7], [1.0, -1.0], [1 / 3, 0.0]):
        assert gate.take(*spool) == ''
        assert gate.pass_ms() == ''
        assert gate.gate.applied.tolist() == spool
        assert not gate.gate.limited and not gate.gate.stale


def test_without_a_command_the_spools_are_at_the_tank(gate):
    assert gate.gate.applied.tolist() == [-1.0, -1.0]
    assert not gate.gate.is_fresh(gate.now)
    assert gate.pass_ms().startswith('no command for inf s')


def test_a_command_is_held_for_20_ms_then_ramped_to_the_tank_and_lost_after_100(gate):
    gate.take(1.0, 0.5)
    for ms in range(1, 21):
        assert gate.pass_ms() == ''
        assert gate.gate.applied.tolist() == [1.0, 0.5], ms
    ramp = []
    for _ in range(21, 101):
        assert gate.pass_ms() == ''
        assert gate.gate.stale
        ramp.append(gate.gate.applied.copy())
    first = np.array([spool[0] for spool in ramp])
    # From one end to the other in 20 ms, a tenth in every ms, and there it stays.
    assert first[:20] == pytest.approx(1.0 - 0.1 * np.arange(1, 21))
    assert np.all(first[20:] == -1.0)
    assert np.all(np.diff(ramp, axis=0) <= 0.0)
    assert gate.pass_ms() == 'no command for 0.101 s: must be <= 0.1 s'


def test_a_command_that_comes_again_ends_the_ramp(gate):
    gate.take(1.0, 1.0)
    for _ in range(25):
        gate.pass_ms()
    assert gate.gate.stale
    gate.take(0.2, 0.3)
    gate.pass_ms()
    assert gate.gate.applied.tolist() == [0.2, 0.3] and not gate.gate.stale


def test_the_same_command_again_is_not_a_newer_one(gate):
    stamp = gate.now
    gate.take(0.3, 0.3, stamp=stamp)
    for _ in range(30):
        gate.pass_ms()
        gate.take(0.3, 0.3, stamp=stamp)
    assert gate.gate.stale
    assert gate.gate.fresh == 1


@pytest.mark.parametrize(
    ('spool', 'words'),
    [
        ([math.nan, 0.0], 'spool = nan: must be >= -1 and <= 1'),
        ([0.0, math.inf], 'spool = inf: must be >= -1 and <= 1'),
        ([0.0, -math.inf], 'spool = -inf: must be >= -1 and <= 1'),
        ([1.0000001, 0.0], 'spool = 1: must be >= -1 and <= 1'),
        ([0.0, -1.5], 'spool = -1.5: must be >= -1 and <= 1'),
        ([0.1], 'spool of type float64 and shape (1,): must be float64 (2,)'),
        ([0.1, 0.2, 0.3], 'spool of type float64 and shape (3,): must be float64 (2,)'),
    ],
)
def test_a_command_that_cannot_be_is_rejected_counted_and_the_third_is_a_fault(gate, spool, words):
    gate.take(0.4, 0.4)
    for count in (1, 2):
        gate.pass_ms()
        assert gate.take(*spool) == ''
        assert gate.gate.rejected == count
    assert gate.gate.applied.tolist() == [0.4, 0.4]
    gate.pass_ms()
    assert gate.take(*spool) == f'3 commands in a row refused; {words}'
    assert gate.gate.applied.tolist() == [0.4, 0.4]


def test_rejected_commands_must_come_in_a_row(gate):
    for _ in range(10):
        for spool in ([math.nan, 0.0], [2.0, 0.0], [0.1, 0.1]):
            gate.pass_ms()
            assert gate.take(*spool) == ''
    assert gate.gate.rejected == 20


def test_a_rejected_command_does_not_refresh_the_last_good_one(gate):
    gate.take(0.5, 0.5)
    for _ in range(2):
        for _ in range(11):
            gate.pass_ms()
        gate.take(math.nan, 0.5)
    assert gate.gate.stale


def test_a_command_from_the_future_would_stay_fresh_and_is_rejected(gate):
    assert gate.take(0.1, 0.1, stamp=gate.now + 1) == ''
    assert gate.gate.rejected == 1
    assert not gate.gate.is_fresh(gate.now)


def test_a_command_older_than_the_last_one_is_rejected(gate):
    gate.take(0.1, 0.1)
    gate.take(0.9, 0.9, stamp=gate.now - MS)
    gate.pass_ms()
    assert gate.gate.applied.tolist() == [0.1, 0.1]
    assert gate.gate.rejected == 1


def test_whole_numbers_are_rejected(gate):
    gate.gate.take(np.array([1, 0]), gate.now, gate.now)
    assert gate.gate.rejected == 1


def test_the_callers_array_is_copied(gate):
    spool = np.array([0.2, 0.2])
    gate.gate.take(spool, gate.now, gate.now)
    spool[:] = 1.0
    gate.pass_ms()
    assert gate.gate.applied.tolist() == [0.2, 0.2]


@settings(deadline=None, max_examples=60)
@given(
    st.lists(st.tuples(st.floats(-1.0, 1.0), st.floats(-1.0, 1.0)), min_size=1, max_size=30),
    st.floats(1.0, 1000.0),
)
def test_no_spool_moves_faster_than_its_limit_and_what_is_limited_says_so(spools, slew):
    found = Gate(shipped(), slew)
    before = found.gate.applied.copy()
    for spool in spools:
        found.take(*spool)
        found.pass_ms()
        after = found.gate.applied.copy()
        assert np.all(np.abs(after - before) <= slew * 1e-3 * (1.0 + 1e-12))
        assert np.all(np.abs(after) <= 1.0)
        assert found.gate.limited == (after.tolist() != list(spool))
        before = after


def shipped():
    from benches import CONFIG
    from fam_bundle_io.hardware.calibration import load_hardware

    return load_hardware(CONFIG / 'volts_calibration.yaml')


def test_only_fresh_commands_in_a_row_count(gate):
    for _ in range(3):
        gate.take(0.1, 0.1)
        gate.pass_ms()
    assert gate.gate.fresh == 3
    gate.pass_ms(21)
    gate.take(0.1, 0.1)
    assert gate.gate.fresh == 1


# ---- Zeroing ----


def zeroing(hardware, values=VENTED, **limits):
    chosen = dataclasses.replace(LIMITS, zero_time=0.5, **limits)
    return Zeroing(hardware.calibration, chosen, PERIOD, values)


def feed(found, hardware, noise, shift, seed=1):
    """Feed vented sensors with a shift and noise in SI units by channel."""
    generator = np.random.default_rng(seed)
    volts = np.empty(6)
    while not found.done():
        values = np.array(shift) + generator.standard_normal(6) * np.array(noise)
        Scaling(hardware.calibration).to_volts(values, volts)
        found.take(volts)


NOISE = (2e-5, 0.5, 300.0, 1e-7, 300.0, 300.0)
SHIFT = (0.011, 2.0, NOMINAL, 0.0, 4e3, -3e3)


def test_zeroing_takes_the_mean_away(hardware):
    found = zeroing(hardware)
    feed(found, hardware, NOISE, SHIFT)
    assert found.taken == 500 and found.refusal == ''
    values, volts = np.empty(6), np.empty(6)
    Scaling(hardware.calibration).to_volts(np.array(SHIFT), volts)
    Scaling(found.result).to_values(volts, values)
    error = 5.0 / math.sqrt(500)  # five standard deviations of a mean
    assert abs(values[0]) < error * NOISE[0]
    assert np.all(np.abs(values[4:]) < error * 300.0)
    assert values[1] == pytest.approx(SHIFT[1])  # nobody knows that the load is off
    assert values[2] == pytest.approx(NOMINAL)  # the source is on


def test_the_source_is_zeroed_when_it_is_off(hardware):
    off = VENTED.copy()
    off[SOURCE_PRESSURE] = 2e3
    found = zeroing(hardware, off)
    feed(found, hardware, NOISE, (0.0, 0.0, 2e3, 0.0, 0.0, 0.0))
    offset = found.result.source_pressure.offset
    assert offset == pytest.approx(0.5 + 2e3 / 344.75e3, abs=5e-4)


@pytest.mark.parametrize(
    ('noise', 'shift', 'words'),
    [
        ((2e-3, 0, 0, 0, 0, 0), SHIFT, r'strain: standard deviation 0\.00\d+; must be <= 0.001'),
        (
            (0, 0, 0, 0, 0, 3e3),
            SHIFT,
            r'mu_pressure\[1\]: standard deviation \d+ Pa; must be <= 2000',
        ),
        (NOISE, (0.06, 0, NOMINAL, 0, 0, 0), r'strain: shift 0\.06\d*; must be <= 0.05'),
        (NOISE, (0, 0, NOMINAL, 0, 25e3, 0), r'mu_pressure\[0\]: shift 2\.5\d*e\+04 Pa; must be'),
    ],
)
def test_what_moves_or_is_far_off_is_not_zeroed(hardware, noise, shift, words):
    found = zeroing(hardware)
    feed(found, hardware, noise, shift)
    assert found.result is None
    assert re.match('zero: ' + words, found.refusal), found.refusal


def test_the_deviation_is_that_of_the_noise(hardware):
    """A bound just above and just below: 500 samples know a deviation to 3 % (one sigma)."""
    for bound, refused in ((300.0 * 1.25, False), (300.0 * 0.75, True)):
        found = zeroing(hardware, zero_pressure_deviation=bound)
        feed(found, hardware, NOISE, SHIFT)
        assert bool(found.refusal) == refused
