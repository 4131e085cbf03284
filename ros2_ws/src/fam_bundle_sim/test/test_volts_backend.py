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

"""The simulated rig in volts: what wires, converters, amplifiers and valves make of it."""

import dataclasses
import itertools
from pathlib import Path
import time

from fam_bundle_io.hardware.backend import make_setup
from fam_bundle_io.hardware.calibration import load_hardware
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_sim.volts_backend import FAULTS, VoltsBackend
import numpy as np
import pytest
from scipy import stats

PERIOD = 0.001
SAFE = -9.375
STRAIN, FORCE, SOURCE, FLOW, FIRST, SECOND = range(6)


CONFIG = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config'


@pytest.fixture(scope='session')
def hardware():
    return load_hardware(CONFIG / 'volts_calibration.yaml')


class Card:
    """A simulated card that is configured; volts unless said otherwise."""

    def __init__(self, configuration, hardware, **options):
        options = {'bits': 0, **options}
        hardware = dataclasses.replace(hardware, options={'volts': options})
        self.setup = make_setup(hardware, 'volts', PERIOD, configuration)
        self.card = VoltsBackend()
        self.card.configure(self.setup)

    def read(self, count=1):
        """Return the volts of ``count`` samples, (count, 6), looking after the watchdog."""
        rows = np.empty((count, 6))
        for row in rows:
            self.card.read(row)
            if self.card.armed:
                assert self.card.reload_watchdog()
        return rows

    def command(self, *volts):
        if not self.card.armed:
            self.card.arm()
        self.card.write(np.array(volts))
        return self

    def values(self, count=1):
        """Return the newest sample in SI units."""
        values = np.empty(6)
        self.setup.scaling.to_values(self.read(count)[-1], values)
        return values

    def spools(self, *volts, count=1):
        """Return where the valves are told to go under ``volts``."""
        self.command(*volts).read(count)
        return self.card._spool.tolist()


@pytest.fixture
def make(configuration, hardware):
    return lambda **options: Card(configuration, hardware, **options)


# ---- The way out ----


def test_volts_move_the_valves_as_the_calibration_says(make):
    card = make()
    for spool in (0.0, 0.5, -0.25, 1.0, -1.0):
        assert card.spools(9.375 * spool, -9.375 * spool) == pytest.approx([spool, -spool])


def test_safe_volts_let_the_oil_out_and_zero_volts_keep_it_in(make):
    """0 V is a closed valve: it traps the pressure, and only full spool to the tank vents."""
    trapped, vented = make(), make()
    before = trapped.command(0.0, 0.0).values(50)[FIRST]
    trapped.command(0.0, 0.0)
    assert trapped.values(1000)[FIRST] == pytest.approx(before, rel=0.05)
    assert before > 150e3
    assert vented.values(1000)[FIRST] < 20e3


def test_converters_know_only_their_steps(make):
    card = make(bits=16)
    step = 20.0 / 2**16
    rows = card.read(30)
    assert np.array_equal(rows / step, np.rint(rows / step))
    card.command(1.0, -0.3337)
    assert np.array_equal(card.card.outputs / step, np.rint(card.card.outputs / step))
    assert card.card.outputs == pytest.approx([1.0, -0.3337], abs=0.5 * step)
    card.command(10.0, -10.0)
    assert card.card.outputs.tolist() == [10.0 - step, -10.0]


def test_a_null_that_has_moved_lets_a_closed_valve_creep(make):
    card = make(null_offset=0.05)
    assert card.spools(0.0, 0.0) == pytest.approx([0.05, 0.05])
    assert card.spools(-9.375, 9.375) == pytest.approx([-0.95, 1.0])


def test_the_amplifier_gives_no_more_than_its_current(make):
    card = make(current_limit=0.6)
    assert card.spools(9.375, -9.375) == pytest.approx([0.6, -0.6])
    assert card.spools(4.6875, -4.6875) == pytest.approx([0.5, -0.5])


def test_hysteresis_depends_on_where_the_valve_comes_from(make):
    """Backlash of width 0.02: going up it lags by half of that, going down it leads by it."""
    card = make(hysteresis=0.02)
    up = [card.spools(9.375 * s, 0.0)[0] for s in np.linspace(0.0, 0.5, 11)]
    down = [card.spools(9.375 * s, 0.0)[0] for s in np.linspace(0.5, 0.0, 11)]
    assert up[1:] == pytest.approx(np.linspace(0.0, 0.5, 11)[1:] - 0.01)
    assert down[1:] == pytest.approx(np.linspace(0.5, 0.0, 11)[1:] + 0.01)
    still = card.spools(0.0, 0.0)
    assert card.spools(9.375 * 0.019, 0.0) == pytest.approx(still)


# ---- The way in ----


def test_noise_is_that_of_the_sensors_seeded_and_white(configuration, hardware):
    sensors = dataclasses.replace(configuration.sensors, pressure_noise=500.0, seed=4)
    noisy = dataclasses.replace(configuration, sensors=sensors)
    rows = [Card(noisy, hardware, hold=True).read(2000) for _ in range(2)]
    assert np.array_equal(*rows)
    normal = (rows[0][:, FIRST] - rows[0][:, FIRST].mean()) * 344.75e3 / 500.0
    assert stats.kstest(normal, 'norm').pvalue > 1e-6
    assert np.ptp(rows[0][:, STRAIN]) == 0.0


def test_the_same_calls_give_the_same_volts(make):
    first, second = (
        make(bits=16, hysteresis=0.01, null_offset=0.01).command(2.0, 1.0).read(200)
        for _ in range(2)
    )
    assert np.array_equal(first, second)


def test_a_held_plant_rests_until_the_first_command(make):
    card = make(hold=True)
    rows = card.read(50)
    assert np.all(rows == rows[0])
    card.command(SAFE, SAFE)
    assert np.all(card.read(5) == rows[0])
    card.command(1.0, SAFE)
    assert not np.all(card.read(5)[-1] == rows[0])


def test_the_rig_goes_on_when_the_card_is_closed_and_opened(make):
    card = make()
    card.command(0.5, 0.5).read(300)
    strain = card.read()[-1, STRAIN]
    card.card.close()
    card.card.configure(card.setup)
    assert card.read()[-1, STRAIN] == pytest.approx(strain, abs=0.05)


# ---- What breaks ----


def test_every_fault_is_explained_and_no_other_is_known(make):
    card = make()
    assert all(FAULTS.values())
    with pytest.raises(ValueError, match='oops: no such fault; there are: input_open'):
        card.card.inject('oops')
    for channels in ((), (6,), (-1,), (0, 1)):
        with pytest.raises(ValueError, match=r'input_open: .*; must be 1 of 0 to 5'):
            card.card.inject('input_open', *channels)
    with pytest.raises(ValueError, match=r'outputs_swapped: \[0\]; must be 2 of 0 to 1'):
        card.card.inject('outputs_swapped', 0)


@pytest.mark.parametrize('channel', range(6))
@pytest.mark.parametrize(('fault', 'volts'), [('input_open', 0.0), ('input_rail', 10.0)])
def test_a_broken_input_reads_its_volts_and_the_others_read_on(make, channel, fault, volts):
    card, other = make(), make()
    card.card.inject(fault, channel)
    row, well = card.read(5)[-1], other.read(5)[-1]
    assert row[channel] == volts
    assert np.array_equal(np.delete(row, channel), np.delete(well, channel))
    card.card.heal()
    assert np.array_equal(card.read(), other.read())


def test_a_frozen_input_keeps_its_volts(make):
    card = make()
    before = card.read(3)[-1]
    card.card.inject('input_frozen', FIRST)
    rows = card.read(100)
    assert np.all(rows[:, FIRST] == before[FIRST])
    assert np.ptp(rows[:, STRAIN]) > 0.0


def test_swapped_wires_are_swapped(make):
    card, other = make(), make()
    card.card.inject('inputs_swapped', FIRST, SECOND)
    row, well = card.read(5)[-1], other.read(5)[-1]
    assert (row[FIRST], row[SECOND]) == (well[SECOND], well[FIRST])
    card.card.inject('outputs_swapped', 0, 1)
    assert card.spools(9.375, -9.375) == pytest.approx([-1.0, 1.0])


@pytest.mark.parametrize('channel', [0, 1])
@pytest.mark.parametrize(
    ('fault', 'spool'), [('output_open', 0.0), ('output_rail', 1.0), ('valve_dead', 0.0)]
)
def test_a_broken_output_or_valve_goes_its_own_way(make, channel, fault, spool):
    card = make()
    card.card.inject(fault, channel)
    found = card.spools(4.6875, 4.6875)
    assert found[channel] == pytest.approx(spool)
    assert found[1 - channel] == pytest.approx(0.5)


def test_a_frozen_output_keeps_its_volts_also_when_it_is_made_safe(make):
    card = make()
    card.spools(4.6875, 4.6875)
    card.card.inject('output_frozen', 1)
    card.card.make_safe()
    card.read()
    assert card.card._spool.tolist() == pytest.approx([-1.0, 0.5])


def test_a_source_that_is_off_gives_no_pressure(make):
    card = make()
    card.card.inject('source_off')
    assert card.values(500)[SOURCE] == pytest.approx(0.0, abs=100.0)
    card.card.heal()
    assert card.values(500)[SOURCE] == pytest.approx(689.5e3, rel=1e-3)


@pytest.mark.parametrize(('fault', 'code'), [('read_timeout', 110), ('read_error', 5)])
def test_a_failing_read_has_a_code_and_the_rig_goes_on(make, fault, code):
    card = make()
    pressure = card.values(2)[FIRST]
    card.card.inject(fault)
    for _ in range(300):
        with pytest.raises(OSError) as caught:
            card.card.read(np.empty(6))
        assert caught.value.errno == code
    card.card.heal()
    assert card.values()[FIRST] < 0.5 * pressure


def test_a_write_that_fails_leaves_what_was_out(make):
    card = make().command(1.0, 2.0)
    card.card.inject('write_error')
    with pytest.raises(OSError):
        card.card.write(np.array([3.0, 3.0]))
    assert card.card.outputs.tolist() == [1.0, 2.0]


def test_the_watchdog_counts_the_time_of_the_samples(make):
    card = make().command(1.0, 1.0)
    row = np.empty(6)
    for _ in range(100):
        card.card.read(row)
    assert card.card.outputs.tolist() == [1.0, 1.0]
    with pytest.raises(OSError, match='watchdog has expired'):
        card.card.read(row)
    assert card.card.outputs.tolist() == [SAFE, SAFE]
    assert card.card.reload_watchdog() is False


def test_an_injected_expiry_takes_an_armed_card_only(make):
    card = make()
    card.card.inject('watchdog')
    card.read()
    card.command(1.0, 1.0).card.inject('watchdog')
    assert card.card.outputs.tolist() == [SAFE, SAFE]
    with pytest.raises(OSError, match='watchdog has expired'):
        card.card.write(np.array([1.0, 1.0]))


# ---- Time, options ----


def test_a_steady_card_gives_a_sample_every_period(make):
    card = make(pace='steady')
    card.read(3)
    begun = time.monotonic()
    card.read(50)
    assert time.monotonic() - begun > 0.9 * 50 * PERIOD


def test_a_steady_card_leaves_out_what_was_missed(configuration, hardware, monkeypatch):
    now = [0]
    card = Card.__new__(Card)
    options = dataclasses.replace(hardware, options={'volts': {'pace': 'steady', 'bits': 0}})
    card.setup = make_setup(options, 'volts', PERIOD, configuration)
    card.card = VoltsBackend(clock=lambda: now[0])
    monkeypatch.setattr(
        time, 'sleep', lambda seconds: now.__setitem__(0, now[0] + round(seconds * 1e9))
    )
    card.card.configure(card.setup)
    times = []
    for held_up in (0, 0, 2_500_000, 0, 400_000, 0):
        now[0] += held_up
        card.read()
        times.append(now[0])
    assert list(itertools.accumulate(np.diff([0, *times]))) == times
    assert times == [t * 1_000_000 for t in (1, 2, 5, 6, 7, 8)]


def test_options_that_cannot_be_are_named(make):
    with pytest.raises(ConfigurationError) as caught:
        make(bits=25)
    assert str(caught.value) == 'backends.volts.bits = 25: must be >= 0 and <= 24'


def test_a_period_that_is_not_the_plants_is_refused(configuration, hardware):
    setup = make_setup(hardware, 'volts', 0.002, configuration)
    with pytest.raises(OSError, match=r'period 0\.002 s; the plant has 0\.001 s'):
        VoltsBackend().configure(setup)
    with pytest.raises(OSError, match='needs the configuration of the plant'):
        VoltsBackend().configure(make_setup(hardware, 'volts', PERIOD))
