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

"""The thread of the card runs a loop, serves others, and always ends with the safe volts out."""

from pathlib import Path
import threading
import time
import tracemalloc

from fam_bundle_io.hardware import card_thread
from fam_bundle_io.hardware.backend import load_backend, make_setup
from fam_bundle_io.hardware.card_thread import CardThread, Hooks
from fam_bundle_io.hardware.monitor import Monitor
from fam_bundle_io.hardware.safety import Refused, State
import numpy as np
import pytest

pytestmark = pytest.mark.alone

PERIOD = 0.001
PATIENCE = 0.5  # s; long enough for every answer that is to come


class Loop:
    """A card thread on the simulated rig, answered by ``answer(tick)``, which returns spools."""

    def __init__(self, hardware, configuration, answer=lambda tick: np.full(2, 0.2)):
        self.setup = make_setup(hardware, 'volts', PERIOD, configuration)
        self.backend = load_backend('volts')
        nominal = configuration.source.nominal_pressure
        self.monitor = Monitor(self.backend, self.setup, hardware.limits, nominal, clock=None)
        self.answer, self.ticks, self.states = answer, [], []
        self.reasons, self.errors, self.done = [], [], threading.Event()
        self.idle = 0
        self.thread = CardThread(
            self.monitor,
            Hooks(self.sampled, self.idled, self.ended, self.failed),
            period=PERIOD,
            units=2,
            realtime=False,
            patience=PATIENCE,
            start_timeout=PATIENCE,
        )
        self.thread.start()

    def sampled(self, sample, tick, periods):
        self.ticks.append((tick, periods))
        self.states.append(sample.state)
        spool = self.answer(tick)
        if spool is not None:
            self.thread.command(tick, spool)

    def idled(self, sample):
        self.idle += 1

    def ended(self, reason):
        self.reasons.append(reason)
        self.done.set()

    def failed(self, error):
        self.errors.append(error)
        self.done.set()

    def run(self, periods):
        def begin(monitor):
            monitor.arm()
            self.thread.begin(periods)

        self.thread.ask(lambda monitor: (monitor.configure(), monitor.tick()))
        self.thread.ask(begin)
        assert self.done.wait(20.0)

    def is_safe(self):
        if not hasattr(self.backend, 'outputs'):
            return True  # never opened
        return np.array_equal(self.backend.outputs, self.setup.safe_volts)


@pytest.fixture
def loop(hardware, configuration):
    made = []

    def make(**options):
        made.append(Loop(hardware, configuration, **options))
        return made[-1]

    yield make
    for one in made:
        assert one.thread.stop()
        assert one.is_safe()


def test_a_run_has_every_tick_once_and_ends_safe(loop):
    one = loop()
    one.run(200)
    assert one.ticks == [(tick, tick) for tick in range(200)]
    assert one.reasons == ['']
    assert one.errors == []
    assert State.ACTIVE in one.states
    assert one.monitor.state is State.INACTIVE
    assert one.is_safe()


def test_an_answer_that_stays_away_ends_the_run_safe(loop):
    one = loop(answer=lambda tick: np.full(2, 0.2) if tick < 50 else None)
    one.run(200)
    assert one.ticks[-1] == (50, 50)
    assert one.reasons == ['valve_command: tick 50 not answered']
    assert one.is_safe()


def test_a_loop_that_never_closes_moves_nothing(loop):
    one = loop(answer=lambda tick: None)
    one.run(200)
    assert one.ticks == [(0, 0)]
    assert 'tick 0 not answered' in one.reasons[0]
    assert State.ACTIVE not in one.states


@pytest.mark.parametrize(
    'bad', [np.full(2, np.nan), np.full(2, 2.0), np.full(3, 0.1), np.array([0.0, np.inf])]
)
def test_commands_that_cannot_be_are_a_fault_and_the_run_goes_on_safe(loop, bad):
    one = loop(answer=lambda tick: bad if tick >= 100 else np.full(2, 0.2))
    one.run(200)
    assert one.ticks[-1] == (199, 199)
    assert one.states[99] is State.ACTIVE
    assert one.states[-1] is State.FAULT
    assert 'commands in a row refused' in one.monitor.fault
    assert one.is_safe()


def test_others_are_served_during_a_run(loop):
    one = loop()
    seen = []
    asker = threading.Thread(
        target=lambda: seen.extend(one.thread.ask(lambda m: m.state) for _ in range(20))
    )
    one.answer = lambda tick: (time.sleep(0.001), np.full(2, 0.2))[1]
    one.thread.ask(lambda monitor: (monitor.configure(), monitor.tick()))
    one.thread.ask(lambda monitor: (monitor.arm(), one.thread.begin(300)))
    asker.start()
    assert one.done.wait(20.0)
    asker.join(5.0)
    assert len(seen) == 20
    assert len(one.ticks) == 300


def test_what_a_request_raises_reaches_who_asked(loop):
    one = loop()
    with pytest.raises(Refused, match='arm: the bridge is unconfigured'):
        one.thread.ask(lambda monitor: monitor.arm())
    assert one.thread.ask(lambda monitor: monitor.state) is State.UNCONFIGURED


def test_a_card_that_hangs_is_told_to_who_asked(loop):
    one = loop()
    held = threading.Event()
    waiting = threading.Thread(target=lambda: one.thread.ask(lambda m: held.wait(5.0)))
    waiting.start()
    with pytest.raises(TimeoutError, match=r'the card has not answered within 0\.2 s'):
        one.thread.ask(lambda monitor: monitor.state, timeout=0.2)
    held.set()
    waiting.join(5.0)


def test_an_error_in_a_hook_ends_the_thread_with_the_safe_volts_out(loop):
    def fail(tick):
        if tick == 120:
            raise ArithmeticError('of the owner')
        return np.full(2, 0.2)

    one = loop(answer=fail)
    one.run(200)
    assert [str(error) for error in one.errors] == ['of the owner']
    assert one.states[-1] is State.ACTIVE
    end = time.monotonic() + 5.0
    while not one.is_safe() and time.monotonic() < end:
        time.sleep(0.01)
    assert one.is_safe()
    with pytest.raises(RuntimeError, match='has ended'):
        one.thread.ask(lambda monitor: monitor.state)


def test_stopping_in_the_middle_of_a_run_puts_the_safe_volts_out(loop):
    middle = threading.Event()

    def answer(tick):
        if tick == 100:
            middle.set()
        return np.full(2, 0.2)

    one = loop(answer=answer)
    one.thread.ask(lambda monitor: (monitor.configure(), monitor.tick()))
    one.thread.ask(lambda monitor: (monitor.arm(), one.thread.begin(1_000_000)))
    assert middle.wait(20.0)
    assert one.thread.stop()
    assert one.is_safe()
    assert one.monitor.state is State.UNCONFIGURED


def test_without_a_run_the_card_is_only_read(loop):
    one = loop()
    one.thread.ask(lambda monitor: monitor.configure())
    end = time.monotonic() + 5.0
    while one.idle < 3 and time.monotonic() < end:
        time.sleep(0.01)
    assert one.idle >= 3
    assert one.ticks == []
    assert one.is_safe()


def test_a_run_leaves_nothing_on_the_heap(loop):
    """Beyond the messages of its owner, who keeps none here."""
    first, last = {}, {}
    folder = str(Path(card_thread.__file__).parent)

    def measured(into):
        taken = tracemalloc.take_snapshot().filter_traces(
            [tracemalloc.Filter(True, f'{folder}/*')]
        )
        into['size'] = sum(trace.size for trace in taken.traces)

    spool = np.full(2, 0.2)

    def answer(tick):
        if tick == 500:
            tracemalloc.start()
        elif tick == 1000:
            measured(first)
        elif tick == 3000:
            measured(last)
        return spool

    one = loop(answer=answer)
    one.ticks = one.states = Forgetful()
    try:
        one.run(3001)
    finally:
        tracemalloc.stop()
    assert one.reasons == ['']
    assert last['size'] - first['size'] < 1024, 'bytes in 2000 ticks'


class Forgetful(list):
    """A list that keeps nothing."""

    def append(self, item):
        pass
