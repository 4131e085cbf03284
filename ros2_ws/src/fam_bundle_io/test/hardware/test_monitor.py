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

"""The monitor around every card: it goes safe whatever happens, and says why."""

import dataclasses
import gc
import math
from pathlib import Path
import re
import tracemalloc

from benches import NOMINAL, PERIOD, SAFE_VOLTS
import fam_bundle_io.hardware
from fam_bundle_io.hardware import backend as backend_module
from fam_bundle_io.hardware.limits import Limits
from fam_bundle_io.hardware.monitor import Monitor
from fam_bundle_io.hardware.safety import Refused, State
import numpy as np
import pytest

SAFE = list(SAFE_VOLTS)
LIMITS = Limits(activation_commands=3, frozen_samples=0)
MS = 1_000_000
# The simulated rig takes it gently.
COMMAND = np.array([0.05, 0.025])


class Loop:
    """A monitor in lock-step with one who commands; every tick is a period."""

    def __init__(self, bench, limits=LIMITS, clock=None):
        self.bench = bench
        self.monitor = Monitor(bench.backend, bench.setup, limits, NOMINAL, clock)

    def start(self):
        """Return with the state inactive and sensors that measure."""
        self.monitor.configure()
        self.tick(None)
        self.tick(None)
        return self

    def run(self):
        """Return with the state active, some ticks under way."""
        self.start().monitor.arm()
        for _ in range(5):
            sample = self.tick()
        assert sample.state is State.ACTIVE
        assert self.bench.outputs() != SAFE
        return self

    def tick(self, spool=COMMAND):
        return self.monitor.tick(spool, self.monitor.now())

    def ticks(self, count, spool=COMMAND):
        return [dataclasses.replace(self.tick(spool)) for _ in range(count)]

    def silent(self, count):
        """Return the samples of ticks without a newer command."""
        stamp = self.monitor.now()
        return [
            dataclasses.replace(self.monitor.tick(COMMAND, stamp), spool=self.spool())
            for _ in range(count)
        ]

    def spool(self):
        return self.monitor._sample.spool.copy()

    def is_latched(self, words):
        """Check that valves are safe, for ``words``, and stay so whatever is commanded."""
        assert self.bench.outputs() == SAFE
        assert words in self.monitor.fault
        fault = self.monitor.fault
        for _ in range(20):
            sample = self.tick()
            assert sample.state is State.FAULT and sample.fault == fault
            assert self.bench.outputs() == SAFE
        with pytest.raises(Refused):
            self.monitor.arm()


@pytest.fixture
def loop(bench):
    return Loop(bench)


# ---- From unconfigured to active ----


def test_before_active_every_state_holds_the_safe_volts(loop):
    with pytest.raises(Refused, match='not configured'):
        loop.tick()
    loop.start()
    assert loop.monitor.state is State.INACTIVE
    loop.ticks(5)
    assert loop.bench.outputs() == SAFE
    loop.monitor.arm()
    assert loop.monitor.state is State.ARMED
    loop.ticks(20, None)
    assert loop.monitor.state is State.ARMED
    assert loop.bench.outputs() == SAFE


def test_an_armed_bridge_follows_the_third_fresh_command(loop):
    loop.start().monitor.arm()
    samples = loop.ticks(4)
    states = [sample.state for sample in samples]
    assert states == [State.ARMED, State.ARMED, State.ACTIVE, State.ACTIVE]
    wanted = [0.25 + 9.375 * 0.05, -(0.125 + 9.25 * 0.025)]
    assert loop.bench.outputs() == pytest.approx(wanted, rel=1e-12)
    assert samples[-1].spool.tolist() == COMMAND.tolist()
    assert samples[-1].valve_volts.tolist() == loop.bench.outputs()


def test_one_command_over_and_over_does_not_make_it_active(loop):
    loop.start().monitor.arm()
    assert all(sample.state is State.ARMED for sample in loop.silent(50))
    assert loop.bench.outputs() == SAFE


def test_a_sample_has_values_and_counts_ticks(loop):
    loop.start()
    before = loop.tick(None).tick
    sample = loop.tick(None)
    assert sample.tick == before + 1 and sample.valid
    assert sample.time == round(sample.tick * PERIOD * 1e9)
    assert sample.values.shape == (6,) and np.all(np.isfinite(sample.values))


def test_disarm_puts_the_safe_volts_out_and_arms_anew(loop):
    loop.run().monitor.disarm()
    assert loop.monitor.state is State.INACTIVE
    assert loop.bench.outputs() == SAFE
    loop.ticks(20)
    assert loop.bench.outputs() == SAFE
    loop.monitor.arm()
    loop.ticks(3)
    assert loop.monitor.state is State.ACTIVE


def test_nothing_is_armed_before_the_first_sample(loop):
    loop.monitor.configure()
    with pytest.raises(Refused, match='not every sensor measures'):
        loop.monitor.arm()


def test_configure_is_refused_while_valves_could_move(loop):
    loop.run()
    with pytest.raises(Refused, match='the bridge is active'):
        loop.monitor.configure()


# ---- The watchdog ----


class Spy:
    """Counts the calls of a card, and may change what it answers."""

    def __init__(self, backend):
        self.backend = backend
        self.calls = []
        self.answer = {}

    def __getattr__(self, name):
        found = getattr(self.backend, name)
        if name not in (
            'configure', 'arm', 'read', 'write', 'reload_watchdog', 'make_safe', 'close'
        ):  # fmt: skip
            return found

        def call(*arguments):
            self.calls.append(name)
            if name in self.answer:
                return self.answer[name](found, *arguments)
            return found(*arguments)

        return call


@pytest.fixture
def spied(bench):
    bench.backend = Spy(bench.backend)
    return Loop(bench)


def test_an_active_tick_is_one_write_one_read_and_then_one_reload(spied):
    spied.run()
    spied.bench.backend.calls.clear()
    spied.ticks(3)
    assert spied.bench.backend.calls == ['write', 'read', 'reload_watchdog'] * 3


def test_no_reload_without_a_fresh_command(spied):
    spied.run()
    spied.bench.backend.calls.clear()
    samples = spied.silent(60)
    stale = sum(sample.stale for sample in samples)
    reloads = spied.bench.backend.calls.count('reload_watchdog')
    assert stale and reloads == len(samples) - stale
    assert reloads == 21  # 0 to 20 ms old


def test_no_reload_after_a_sample_that_is_no_measurement(spied):
    spied.run()

    def dead(read, volts):
        read(volts)
        volts[0] = math.nan

    backend = spied.bench.backend
    backend.answer['read'] = dead
    backend.calls.clear()
    assert spied.tick().state is State.ACTIVE
    assert 'reload_watchdog' not in backend.calls
    del backend.answer['read']
    spied.tick()
    assert 'reload_watchdog' in backend.calls


def test_a_false_from_reload_is_latched_and_never_cleared_by_itself(spied):
    spied.run()
    spied.bench.backend.answer['reload_watchdog'] = lambda reload: False
    spied.tick()
    spied.bench.backend.answer.clear()
    spied.bench.backend.calls.clear()
    assert 'watchdog has expired' in spied.monitor.fault
    spied.ticks(50)
    assert spied.monitor.state is State.FAULT
    assert 'configure' not in spied.bench.backend.calls


def test_an_expired_watchdog_needs_configure_and_reset(loop):
    loop.run()
    loop.bench.let_pass(loop.bench.setup.watchdog_timeout + 2 * PERIOD)
    loop.tick()
    loop.is_latched('')
    with pytest.raises(Refused, match='the card cannot be read, configure it'):
        loop.monitor.reset_fault()
    loop.monitor.configure()
    assert loop.monitor.state is State.FAULT
    loop.ticks(2)
    if loop.bench.name == 'volts':
        loop.ticks(700)  # the first motor unit lets its oil out
    loop.monitor.reset_fault()
    assert loop.monitor.state is State.INACTIVE
    loop.monitor.arm()
    loop.ticks(3)
    assert loop.monitor.state is State.ACTIVE


# ---- What goes wrong ----


def test_a_failing_read_makes_it_safe(loop):
    loop.run().bench.fail('read', 77)
    sample = loop.tick()
    assert not sample.valid and sample.safe_out
    loop.is_latched('read: ')


def test_a_failing_write_is_made_good_by_the_watchdog(loop):
    """The safe volts cannot be written either: until the watchdog expires the valve stays open."""
    loop.run().bench.fail('write', 77)
    sample = loop.tick()
    assert sample.state is State.FAULT and not sample.safe_out
    loop.bench.let_pass(loop.bench.setup.watchdog_timeout + 2 * PERIOD)
    loop.is_latched('')


def test_the_safe_volts_are_tried_again_until_they_are_out(loop):
    loop.run().bench.fail('write', 77)
    loop.tick()
    fault = loop.monitor.fault
    assert loop.bench.outputs() != SAFE
    loop.bench.mend()
    sample = loop.tick()
    assert sample.safe_out and sample.fault == fault
    loop.is_latched(fault)


def test_a_reset_is_refused_while_the_safe_volts_are_not_out(loop):
    loop.run().bench.fail('write', 77)
    loop.tick()
    with pytest.raises(Refused, match='the safe volts are not out'):
        loop.monitor.reset_fault()


def test_the_first_error_wins_and_the_next_is_told_beside_it(loop):
    loop.run().bench.fail('write', 77)
    fault = loop.tick().fault
    sample = loop.tick()
    assert sample.fault == fault
    assert sample.trouble.startswith('make_safe: ')


@pytest.mark.parametrize('error', [TypeError('a bug'), ZeroDivisionError('x'), MemoryError()])
@pytest.mark.parametrize('call', ['read', 'write', 'reload_watchdog'])
def test_an_error_that_nobody_expected_makes_it_safe_too(spied, call, error):
    spied.run()

    def broken(*arguments):
        raise error

    spied.bench.backend.answer[call] = broken
    spied.tick()
    spied.bench.backend.answer.clear()
    spied.is_latched(type(error).__name__)


@pytest.mark.parametrize('error', [KeyboardInterrupt, SystemExit])
@pytest.mark.parametrize('call', ['read', 'write', 'reload_watchdog'])
def test_what_ends_the_process_passes_after_the_safe_volts_are_out(spied, call, error):
    spied.run()

    def interrupted(*arguments):
        raise error

    spied.bench.backend.answer[call] = interrupted
    with pytest.raises(error):
        spied.tick()
    assert spied.bench.outputs() == SAFE
    assert spied.monitor.state is State.FAULT


@pytest.mark.parametrize('error', [OSError(5, 'broken'), TypeError('a bug'), KeyboardInterrupt()])
def test_close_lets_go_of_the_card_whatever_make_safe_does(spied, error):
    spied.run()

    def broken(*arguments):
        raise error

    spied.bench.backend.answer['make_safe'] = broken
    if isinstance(error, Exception):
        spied.monitor.close()
    else:
        with pytest.raises(KeyboardInterrupt):
            spied.monitor.close()
    assert spied.bench.backend.calls[-1] == 'close'
    assert spied.monitor.state is State.UNCONFIGURED
    assert spied.bench.outputs() == SAFE  # the card's own close puts them out


@pytest.mark.parametrize('state', ['inactive', 'armed', 'active', 'fault'])
def test_every_way_out_of_the_block_puts_the_safe_volts_out(loop, state):
    with pytest.raises(ZeroDivisionError), loop.monitor as monitor:
        loop.ticks(2, None)
        if state in ('armed', 'active'):
            monitor.arm()
        if state == 'active':
            loop.ticks(5)
        if state == 'fault':
            monitor.emergency_stop('button')
            loop.tick()
        assert monitor.state.value == state
        raise ZeroDivisionError
    assert loop.bench.outputs() == SAFE
    assert loop.monitor.state is State.UNCONFIGURED


def test_a_fault_outlives_close(loop):
    loop.run().monitor.emergency_stop('button')
    loop.tick()
    loop.monitor.close()
    loop.monitor.configure()
    assert loop.monitor.state is State.FAULT
    assert loop.monitor.fault == 'button'


def test_a_card_that_cannot_be_opened_leaves_it_unconfigured(loop):
    if loop.bench.name == 'volts':
        pytest.skip('the simulated card always opens')
    loop.bench.fail('open', 108)
    with pytest.raises(OSError):
        loop.monitor.configure()
    assert loop.monitor.state is State.UNCONFIGURED
    loop.bench.mend()
    loop.start()
    assert loop.monitor.state is State.INACTIVE


def test_the_emergency_stop_acts_at_the_next_tick(loop):
    loop.run().monitor.emergency_stop('button')
    loop.tick()
    loop.is_latched('button')


def test_an_emergency_stop_is_not_lost_while_nothing_runs(loop):
    loop.monitor.emergency_stop('button')
    loop.monitor.configure()
    loop.tick(None)
    loop.is_latched('button')


# ---- Commands ----


def test_a_lost_controller_is_ramped_to_safe_then_a_fault(loop):
    """20 ms held, ramped to the tank by 40 ms, a fault after 100 ms, safe all the while."""
    loop.run()
    samples = loop.silent(110)
    age = np.arange(110)  # ms
    spools = np.array([sample.spool for sample in samples])
    assert np.all(spools[age <= 20] == COMMAND)
    assert np.all(np.diff(spools, axis=0) <= 0.0)
    assert np.all(spools[age >= 40] == -1.0)
    states = np.array([sample.state is State.ACTIVE for sample in samples])
    assert np.all(states[age <= 100]) and not np.any(states[age > 100])
    loop.is_latched('no command for 0.101 s: must be <= 0.1 s')


@pytest.mark.parametrize('bad', [math.nan, math.inf, 1.5])
def test_three_commands_that_cannot_be_are_a_fault(loop, bad):
    loop.run()
    held = loop.bench.outputs()
    for count in (1, 2):
        sample = loop.tick(np.array([bad, 0.0]))
        assert sample.rejected == count and loop.bench.outputs() == held
    loop.tick(np.array([bad, 0.0]))
    loop.is_latched('3 commands in a row refused; spool = ')


# ---- Sensors and pressures, where the fakes let us set the volts ----


@pytest.fixture
def card(hardware, configuration, monkeypatch):
    from benches import QuanserBench

    return Loop(QuanserBench('quanser', hardware, configuration, monkeypatch))


def test_an_open_wire_is_a_fault_after_four_samples(card):
    card.run().bench.board.inputs[4] = 0.0
    assert [sample.state for sample in card.ticks(3)] == [State.ACTIVE] * 3
    card.tick()
    card.is_latched('mu_pressure[0] = 0 V: must be >= 0.25 and <= 4.75 V')


def test_a_lost_load_cell_is_flagged_and_the_loop_goes_on(card):
    card.run()
    before = card.tick().values[1]
    card.bench.board.inputs[1] = 9.99
    sample = card.ticks(50)[-1]
    assert sample.state is State.ACTIVE and sample.valid
    assert sample.degraded.tolist() == [False, True, False, False, False, False]
    assert sample.values[1] == before


def test_too_much_pressure_is_vented_after_five_samples(card):
    card.run()
    for pressure in (120e3, 240e3, 360e3, 480e3, 600e3, 700e3):
        card.bench.board.inputs[5] = 0.5 + pressure / 344.75e3
        assert card.tick().state is State.ACTIVE
    card.bench.board.inputs[5] = 0.5 + 745e3 / 344.75e3
    assert [sample.state for sample in card.ticks(4)] == [State.ACTIVE] * 4
    card.tick()
    card.is_latched('mu_pressure[1] = 7.45e+05 Pa: must be <= 7.24e+05 Pa')
    with pytest.raises(Refused, match='Pa: must be < 20000 Pa'):
        card.monitor.reset_fault()


def test_zeroing_moves_the_calibration_and_what_is_read(card):
    card.bench.board.inputs[0] = 0.3
    card.start().monitor.zero()
    assert card.tick(None).values[0] == pytest.approx(0.006)
    with pytest.raises(Refused, match='zeroing is under way'):
        card.monitor.arm()
    before = card.monitor.calibration
    card.ticks(1000, None)
    assert card.monitor.zeroing.done() and card.monitor.zeroing.refusal == ''
    assert card.monitor.calibration.hash() != before.hash()
    sample = card.tick(None)
    assert sample.valid and sample.values[0] == 0.0
    card.monitor.arm()
    card.ticks(5)
    assert card.monitor.state is State.ACTIVE


def test_zeroing_is_refused_under_pressure_and_when_armed(card):
    card.bench.board.inputs[4] = 0.5 + 25e3 / 344.75e3
    card.start()
    with pytest.raises(Refused, match=r'zero: mu_pressure\[0\] = 2.5e\+04 Pa: must be < 20000'):
        card.monitor.zero()
    card.monitor.arm()
    with pytest.raises(Refused, match='zero: the bridge is armed; must be inactive'):
        card.monitor.zero()


def test_zeroing_ends_with_a_refusal_where_a_sensor_is_lost(card):
    card.start().monitor.zero()
    card.bench.board.inputs[0] = math.nan
    card.tick(None)
    assert card.monitor.zeroing.refusal == 'zero: not every sensor measures'


# ---- Time ----


def test_a_read_that_takes_too_long_is_a_fault(spied):
    clock = [0]
    loop = Loop(spied.bench, clock=lambda: clock[0])
    spied.bench.backend.answer['read'] = lambda read, volts: (
        clock.__setitem__(0, clock[0] + MS),
        read(volts),
    )
    loop.run()
    spied.bench.backend.answer['read'] = lambda read, volts: (
        clock.__setitem__(0, clock[0] + 21 * MS),
        read(volts),
    )
    loop.tick()
    loop.is_latched('read took 0.021 s: must be <= 0.02 s')


def test_a_card_that_refuses_reads_does_not_spin_the_thread(spied, monkeypatch):
    naps = []
    clock = [0]
    loop = Loop(spied.bench, clock=lambda: clock[0])
    loop.start()
    monkeypatch.setattr(backend_module.time, 'sleep', naps.append)

    def refuses(*arguments):
        raise OSError(5, 'broken')

    spied.bench.backend.answer['read'] = refuses
    loop.ticks(10, None)
    assert naps == [PERIOD] * 10


# ---- Documents ----


def test_the_example_of_the_documents_runs(monkeypatch, capsys):
    root = Path(__file__).parents[5]
    monkeypatch.chdir(root)
    document = (root / 'docs' / 'hardware.md').read_text(encoding='utf-8')
    (example,) = re.findall(r'```python\n(.*?)```', document, re.DOTALL)
    exec(example, {})
    assert capsys.readouterr().out.startswith('State.INACTIVE [')


# ---- Memory ----


def test_a_tick_leaves_nothing_behind(hardware, configuration):
    """In 3000 ticks our modules may not hold more, and no tick may need more than a little."""
    from benches import MockBench

    loop = Loop(MockBench('mock', hardware, configuration)).run()
    monitor, spool = loop.monitor, COMMAND.copy()

    def run(count):
        for k in range(count):
            spool[0] = 0.001 * (k % 900)
            monitor.tick(spool, monitor.now())

    run(200)
    ours = tracemalloc.Filter(True, fam_bundle_io.hardware.__path__[0] + '/*')
    gc.collect()
    tracemalloc.start()
    try:
        run(200)
        gc.collect()
        before = tracemalloc.take_snapshot().filter_traces([ours])
        run(3000)
        gc.collect()
        after = tracemalloc.take_snapshot().filter_traces([ours])
        grown = sum(entry.size_diff for entry in after.compare_to(before, 'filename'))
        tracemalloc.reset_peak()
        held = tracemalloc.get_traced_memory()[0]
        run(1)
        peak = tracemalloc.get_traced_memory()[1] - held
    finally:
        tracemalloc.stop()
    assert monitor.state is State.ACTIVE
    assert grown < 512  # numbers that are counted up, no array
    assert peak < 4096
