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
The simulated rig behind a simulated card in a process of its own, which outlives the bridge.

The process runs plant and watchdog on the steady clock, whether or not anybody reads, and keeps a
log of what is out. ``VoltsCard`` is the backend ``volts_card``: it talks to that process through
a Unix socket, whose path is its option ``socket``; all others are those of the backend ``volts``.
What goes through the socket is pickled: it belongs in a folder of the user's own.
"""

import argparse
import dataclasses
import itertools
import os
from pathlib import Path
import pickle
import select
import socket
import sys
import time
from typing import Any

from fam_bundle_model.schema import ConfigurationError
from fam_bundle_sim.sensors import CHANNELS
from fam_bundle_sim.volts_backend import check_volts, VoltsBackend
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

LARGEST = 1 << 17  # bytes of a message
ANSWER_TIMEOUT = 30.0  # s; a rig that is built compiles its laws
NO_SAMPLE = 110  # code of a read that times out


def log_type(units: int) -> np.dtype[np.void]:
    """
    Return the type of a row of the log: what was so from ``time`` on (ns, steady).

    ``event`` is ``sample`` for each period, ``read`` where a sample was taken, ``expire`` for the
    watchdog, ``gone`` for a client that is no more, else the call. ``outputs`` (units,) and
    ``inputs`` (4 + units,) are in V, ``pressure`` (units,) is the true one in Pa.
    """
    return np.dtype(
        [
            ('time', np.int64),
            ('event', 'S24'),
            ('outputs', np.float64, (units,)),
            ('inputs', np.float64, (CHANNELS + units,)),
            ('pressure', np.float64, (units,)),
        ]
    )


def read_log(path: Path, units: int) -> npt.NDArray[np.void]:
    """Return all whole rows that a card has written to ``path`` so far."""
    kind = log_type(units)
    size = path.stat().st_size // kind.itemsize
    return np.memmap(path, kind, 'r', shape=(size,)) if size else np.zeros(0, kind)


# ---- The backend ----


class VoltsCard:
    """See ``fam_bundle_io.hardware.backend.Backend``; ``inject`` and ``heal`` as VoltsBackend."""

    def __init__(self) -> None:
        """Know no card yet."""
        self._socket: socket.socket | None = None
        self._numbers = itertools.count()
        self._setup: Any = None

    def configure(self, setup: Any) -> None:
        """
        Connect to the card and open it.

        Raises ConfigurationError for options that cannot be, OSError where no card listens.
        """
        self.close()
        options = {**setup.options}
        path = options.pop('socket', None)
        if not isinstance(path, str):
            raise ConfigurationError(
                f'backends.volts_card.socket = {path}: must be the path of a volts_card'
            )
        options['pace'] = 'lockstep'  # the card is its own pace
        self._setup = dataclasses.replace(setup, options=options)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self._socket.settimeout(ANSWER_TIMEOUT)
        try:
            self._socket.connect(path)
            self._ask('configure', self._setup)
        except BaseException:
            self._disconnect()
            raise

    def arm(self) -> None:
        """Start the watchdog."""
        self._ask('arm')

    def read(self, volts: Array) -> None:
        """Wait for the next sample; raises OSError when none comes within the time-out."""
        self._check('read', volts, 'inputs')
        try:
            np.copyto(volts, self._ask('read', timeout=self._setup.read_timeout))
        except TimeoutError:
            raise OSError(NO_SAMPLE, 'no sample within the time-out') from None

    def write(self, volts: Array) -> None:
        """Put ``volts`` (outputs,) out."""
        self._check('write', volts, 'outputs')
        self._ask('write', volts)

    def reload_watchdog(self) -> bool:
        """Give the watchdog its full time again; False: it had expired before."""
        return bool(self._ask('reload_watchdog'))

    def make_safe(self) -> None:
        """Put the safe volts out, then stop the watchdog."""
        self._ask('make_safe')

    def close(self) -> None:
        """Put the safe volts out, or wait for the watchdog to do it, and let go of the card."""
        if self._socket is None:
            return
        try:
            self._ask('make_safe')
        except OSError:
            time.sleep(1.5 * self._setup.watchdog_timeout)
        finally:
            self._disconnect()

    def inject(self, fault: str, *channels: int) -> None:
        """Break the rig; raises ValueError for a fault or a channel that does not exist."""
        self._ask('inject', fault, *channels)

    def heal(self) -> None:
        """Mend everything."""
        self._ask('heal')

    def _disconnect(self) -> None:
        if self._socket is not None:
            self._socket.close()
        self._socket = None

    def _check(self, call: str, volts: Array, side: str) -> None:
        self._ready(call)
        check_volts(call, volts, len(getattr(self._setup, side)))

    def _ready(self, call: str) -> socket.socket:
        if self._socket is None:
            raise OSError(0, f'{call}: the card is not configured')
        return self._socket

    def _ask(self, call: str, *arguments: Any, timeout: float = ANSWER_TIMEOUT) -> Any:
        """Return the card's answer, or raise it; an answer to an earlier question is dropped."""
        card, number = self._ready(call), next(self._numbers)
        card.settimeout(timeout)
        card.send(pickle.dumps((number, call, arguments)))
        while True:
            message = card.recv(LARGEST)
            if not message:
                raise OSError(0, f'{call}: the process of the card has ended')
            answered, answer = pickle.loads(message)
            if answered == number:
                break
        if isinstance(answer, Exception):
            raise answer
        return answer


# ---- The process ----


class CardProcess:
    """Owns the rig; one client at a time tells it what to do."""

    def __init__(self, listener: socket.socket, log: int, priority: int) -> None:
        """Listen at ``listener``, log to the descriptor ``log``; ``priority`` 0 asks for none."""
        self.card = VoltsBackend()
        self._listener, self._log, self._priority = listener, log, priority
        self._client: socket.socket | None = None
        self._reader: int | None = None  # number of the read that waits for a sample
        self._due = 0  # when the next period ends, ns
        self._expired = False
        self._row = np.zeros(0, log_type(0))

    def run(self) -> None:
        """Serve until the process is told to end."""
        while True:
            ends = [self._listener] if self._client is None else [self._client]
            left = (self._due - time.monotonic_ns()) * 1e-9 if self.card.configured else None
            ready, _, _ = select.select(ends, [], [], left if left is None else max(left, 0.0))
            # What has come belongs to the period that ends now, however late it is.
            if ready:
                self._receive()
            if self.card.configured and time.monotonic_ns() >= self._due:
                self._pass_period()

    def _receive(self) -> None:
        if self._client is None:
            self._client, _ = self._listener.accept()
            return
        try:
            message = self._client.recv(LARGEST)
        except OSError:
            message = b''
        if not message:
            self._client.close()
            self._client = self._reader = None
            self._note('gone')
            return
        number, call, arguments = pickle.loads(message)
        if call == 'read':
            self._reader = number
            return
        try:
            answer = self._call(call, arguments)
        except Exception as error:
            answer = error
        self._answer(number, answer)

    def _call(self, call: str, arguments: tuple[Any, ...]) -> Any:
        answer = getattr(self.card, call)(*arguments)
        if call == 'configure':
            self._hurry()
            self._row = np.zeros(1, log_type(len(self.card.outputs)))
            self._due = time.monotonic_ns() + self._period()
        self._note(call, *(a for a in arguments if isinstance(a, str | int)))
        return answer

    def _hurry(self) -> None:
        if self._priority == 0:
            return
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(self._priority))
        except OSError as error:
            print(f'--priority {self._priority}: refused ({error.strerror})', file=sys.stderr)

    def _answer(self, number: int, answer: Any) -> None:
        if self._client is None:
            return
        try:
            self._client.send(pickle.dumps((number, answer)))
        except OSError:
            self._client.close()
            self._client = None

    def _period(self) -> int:
        return round(float(self.card.setup.period) * 1e9)

    def _pass_period(self) -> None:
        """Let a period pass; those that were missed are left out."""
        period = self._period()
        self._due += max((time.monotonic_ns() - self._due) // period + 1, 1) * period
        volts = np.empty(len(self.card.volts))
        answer: Any = volts
        try:
            self.card.read(volts)
        except OSError as error:
            answer = error
        self._note('sample')
        silent = isinstance(answer, OSError) and answer.errno == NO_SAMPLE
        if self._reader is not None and not silent:
            number, self._reader = self._reader, None
            self._answer(number, answer)
            self._note('read')

    def _note(self, event: str, *details: str | int) -> None:
        """Write a row of the log, and one before it where the watchdog has expired."""
        card, row = self.card, self._row
        if not row.size:
            return
        row['time'] = time.monotonic_ns()
        row['outputs'], row['inputs'], row['pressure'] = card.outputs, card.volts, card.pressures()
        if card.expired and not self._expired:
            row['event'] = b'expire'
            os.write(self._log, row.tobytes())
        self._expired = card.expired
        row['event'] = ' '.join(map(str, (event, *details))).encode()
        os.write(self._log, row.tobytes())


def main() -> None:
    """Run the process of a card until it is told to end."""
    options = argparse.ArgumentParser(
        prog='volts_card', description=(__doc__ or '').split('\n')[0]
    )
    options.add_argument('--socket', type=Path, required=True, help='path to listen at')
    options.add_argument('--log', type=Path, required=True, help='file of what is out, and when')
    options.add_argument(
        '--priority', type=int, default=0, help='SCHED_FIFO priority once it runs'
    )
    given = options.parse_args()
    log = os.open(given.log, os.O_WRONLY | os.O_CREAT | os.O_TRUNC, 0o600)
    try:
        with socket.socket(socket.AF_UNIX, socket.SOCK_SEQPACKET) as listener:
            listener.bind(str(given.socket))
            listener.listen(1)
            CardProcess(listener, log, given.priority).run()
    except KeyboardInterrupt:
        sys.exit(130)
    finally:
        os.close(log)


if __name__ == '__main__':
    main()
