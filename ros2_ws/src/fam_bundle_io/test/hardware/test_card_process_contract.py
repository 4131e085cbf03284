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

"""The contract of every card, kept by one that is a process of its own and has its own time."""

import dataclasses
from pathlib import Path
import subprocess
import sys
import tempfile
import time

from benches import Bench, PERIOD
from fam_bundle_io.hardware.backend import load_backend
from fam_bundle_sim.volts_card import read_log
import numpy as np
import pytest
from test_backend_contract import *  # noqa  the same sentences
from test_backend_contract import OPEN

pytestmark = pytest.mark.alone

SLEEP = time.sleep  # the benches of other cards replace it
WATCHDOG = 0.4  # s: the tests share a machine with others


@pytest.fixture(scope='session')
def process():
    """Run a card; return its socket and its log."""
    with tempfile.TemporaryDirectory() as folder:
        place, log = Path(folder) / 'card', Path(folder) / 'log'
        command = [sys.executable, '-m', 'fam_bundle_sim.volts_card', '--socket', str(place)]
        running = subprocess.Popen([*command, '--log', str(log)])
        try:
            while not place.exists():
                assert running.poll() is None
                SLEEP(0.05)
            yield place, log
        finally:
            running.terminate()
            running.wait()


class CardBench(Bench):
    """The card that is a process of its own."""

    def __init__(self, process, hardware, configuration):
        place, self.log = process
        options = {'volts_card': {'socket': str(place), 'bits': 0}}
        super().__init__(
            'volts_card', dataclasses.replace(hardware, options=options), configuration
        )
        self.setup = dataclasses.replace(self.setup, watchdog_timeout=WATCHDOG)

    def outputs(self):
        return read_log(self.log, 2)['outputs'][-1].tolist()

    def let_pass(self, seconds):
        """Wait until the card has let so much of its own time pass."""
        wanted = self.samples() + round(seconds / PERIOD) + 2
        while self.samples() < wanted:
            SLEEP(PERIOD)

    def samples(self):
        return int((read_log(self.log, 2)['event'] == b'sample').sum())

    def fail(self, call, code):
        self.backend.inject(f'{call}_error')

    def mend(self):
        """Mend the card, which stays broken also while nobody is connected."""
        try:
            self.backend.heal()
        except OSError:
            other = load_backend('volts_card')
            other.configure(self.setup)
            other.heal()
            other.close()


@pytest.fixture
def bench(process, hardware, configuration):
    """Return the card, not configured yet."""
    found = CardBench(process, hardware, configuration)
    found.mend()  # what the test before has broken
    yield found
    found.backend.close()


def test_a_card_outlives_the_one_who_opened_it_and_its_watchdog_too(bench):
    """The process that had it is gone without a word, with a valve open."""
    bench.backend.configure(bench.setup)
    bench.backend.arm()
    bench.backend.write(np.array(OPEN))
    bench.backend._disconnect()
    assert bench.outputs() == OPEN
    bench.let_pass(WATCHDOG)
    assert bench.outputs() == bench.setup.safe_volts.tolist()
    rows = read_log(bench.log, 2)
    gone, expired = (rows['time'][rows['event'] == e][-1] for e in (b'gone', b'expire'))
    assert gone < expired
