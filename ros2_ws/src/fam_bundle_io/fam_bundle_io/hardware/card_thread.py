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

"""The one thread that owns the card: ticks, runs, and what others ask of it. No ROS."""

from collections.abc import Callable
from concurrent.futures import Future
from concurrent.futures import TimeoutError as NoAnswer  # another one than TimeoutError in 3.10
import queue
import threading
import time
from typing import Any, NamedTuple, TypeVar

from fam_bundle_io.hardware.monitor import Monitor, Sample
from fam_bundle_io.hardware.safety import State
import numpy as np
import numpy.typing as npt

T = TypeVar('T')

IDLE_PERIOD = 0.05  # s between two samples outside of a run in lock-step
SLICE = 0.2  # s after which a wait looks around


class Hooks(NamedTuple):
    """
    What the thread tells its owner; each is called in the thread.

    ``sampled(sample, tick, periods)``: a sample of the run, so many periods after its first one;
    ``idle(sample)``: one outside of a run, or what stands where none could be read;
    ``ended(reason)``: the run is over, with a reason where it ended early; ``failed(error)``: the
    thread ends after an error that nobody expected.
    """

    sampled: Callable[[Sample, int, int], None]
    idle: Callable[[Sample], None]
    ended: Callable[[str], None]
    failed: Callable[[BaseException], None]


class CardThread:
    """
    Runs a monitor from its configuration to its end, which always closes the card.

    A run begins with tick 0, whose answer proves the loop closed. From then on the newest command
    is written once it answers the newest sample, or when ``patience`` s have passed since that
    sample: in real time a part of the period, in lock-step long enough to be an error.
    """

    def __init__(
        self,
        monitor: Monitor,
        hooks: Hooks,
        *,
        period: float,
        units: int,
        realtime: bool,
        patience: float,
        start_timeout: float,
    ) -> None:
        """Own ``monitor``; times in s, ``start_timeout`` is for the answer to tick 0."""
        self._monitor, self._hooks = monitor, hooks
        self._period_ns, self._realtime = round(period * 1e9), realtime
        self._patience, self._start_timeout = patience, start_timeout
        self._changed = threading.Condition()  # guards all that follows but the requests
        self._spool = np.zeros(units)
        self._stamp, self._answered = 0, -1
        self._requests: queue.SimpleQueue[tuple[Callable[[Monitor], Any], Future[Any]]] = (
            queue.SimpleQueue()
        )
        self._stopped = False
        self._ticks = 0  # periods of the run, 0: no run
        self._tick = self._first = self._newest = self._passed = 0
        self._next_spool, self._next_stamp = np.zeros(units), 0
        self._thread = threading.Thread(target=self._run, name='card', daemon=True)

    # ---- From other threads ----

    def start(self) -> None:
        """Start the thread; the card is opened by a request."""
        self._thread.start()

    def stop(self, timeout: float = 5.0) -> bool:
        """End the thread, which closes the card; return whether it has ended in time (s)."""
        self._stopped = True
        self._wake()
        if self._thread.is_alive() and self._thread is not threading.current_thread():
            self._thread.join(timeout)
        return not self._thread.is_alive()

    def ask(self, request: Callable[[Monitor], T], timeout: float = 5.0) -> T:
        """
        Run ``request`` in the thread and return what it returns, or raise what it raises.

        Raises TimeoutError when the card has kept the thread for ``timeout`` s, and RuntimeError
        when the thread has ended.
        """
        if self._stopped or not self._thread.is_alive():
            raise RuntimeError('the thread of the card has ended')
        answer: Future[T] = Future()
        self._requests.put((request, answer))
        self._wake()
        try:
            return answer.result(timeout)
        except NoAnswer:
            if answer.done():  # what was asked for has raised it
                raise
            raise TimeoutError(f'the card has not answered within {timeout:g} s') from None

    def command(self, tick: int, spool: npt.NDArray[np.float64]) -> None:
        """Take the answer to sample ``tick``: ``spool`` (units,), in -1 to 1 if it is good."""
        with self._changed:
            if spool.shape == self._spool.shape:
                np.copyto(self._spool, spool)
            else:
                self._spool.fill(np.nan)  # the monitor refuses and counts it
            self._stamp, self._answered = self._monitor.now(), tick
            self._changed.notify_all()

    def begin(self, periods: int) -> None:
        """Begin a run of ``periods``; to be called in the thread, by a request."""
        with self._changed:
            self._answered, self._stamp = -1, 0
            self._spool.fill(np.nan)
        self._ticks, self._tick, self._passed = periods, -1, 0

    def end(self) -> None:
        """End the run; to be called in the thread, by a request."""
        self._ticks = 0

    @property
    def running(self) -> bool:
        """Whether there is a run."""
        return self._ticks > 0

    # ---- In the thread ----

    def _wake(self) -> None:
        with self._changed:
            self._changed.notify_all()

    def _run(self) -> None:
        try:
            while not self._stopped:
                self._serve()
                if self._monitor.state is State.UNCONFIGURED:
                    self._hooks.idle(self._monitor.sample)
                    self._wait(SLICE, lambda: False)
                elif self.running:
                    self._run_tick()
                else:
                    self._idle_tick()
        except BaseException as error:  # a thread must not die silently
            self._hooks.failed(error)
        finally:
            self._monitor.close()
            self._stopped = True
            self._serve()

    def _serve(self) -> None:
        """Do what others ask for."""
        while True:
            try:
                request, answer = self._requests.get_nowait()
            except queue.Empty:
                return
            try:
                answer.set_result(request(self._monitor))
            except BaseException as error:
                answer.set_exception(error)

    def _wait(self, timeout: float, done: Callable[[], bool]) -> bool:
        """Wait until ``done``, served requests aside, for at most ``timeout`` s."""
        end = time.monotonic() + timeout
        with self._changed:
            while not (done() or self._stopped or not self._requests.empty()):
                left = end - time.monotonic()
                if left <= 0.0 or not self._changed.wait(left):
                    break
            return done()

    def _idle_tick(self) -> None:
        self._hooks.idle(self._monitor.tick())
        if not self._realtime:  # no clock paces the reads
            self._wait(IDLE_PERIOD, lambda: False)

    def _run_tick(self) -> None:
        if self._tick < 0:
            self._begin_run(self._monitor.tick())
        elif self._answered < 0:
            self._wait_for_loop()
        else:
            self._next_tick()

    def _begin_run(self, sample: Sample) -> None:
        if not sample.valid:
            self._end_run(sample.fault or 'the sensors do not measure')
            return
        self._tick, self._first, self._newest = 0, sample.time, sample.time
        self._hooks.sampled(sample, 0, 0)

    def _wait_for_loop(self) -> None:
        """Go on reading, as the card asks for, until tick 0 is answered."""
        if not self._realtime:
            self._wait(self._start_timeout, lambda: self._answered == 0)
        else:
            # Tick 1 is one period old when it is taken, however long tick 0 waited.
            self._first = self._monitor.tick().time
        waits = self._answered < 0 and self._requests.empty() and not self._stopped
        waited = (self._first - self._newest) * 1e-9
        if waits and (not self._realtime or waited > self._start_timeout):
            self._end_run(f'valve_command: tick 0 not answered for {self._start_timeout:g} s')

    def _next_tick(self) -> None:
        came = self._wait(self._time_left(), lambda: self._answered == self._tick)
        if not self._requests.empty() or self._stopped:
            return
        if not came and not self._realtime:
            self._end_run(f'valve_command: tick {self._tick} not answered')
            return
        with self._changed:
            np.copyto(self._next_spool, self._spool)
            self._next_stamp = self._stamp
        sample = self._monitor.tick(self._next_spool, self._next_stamp)
        self._newest = sample.time
        since = round((sample.time - self._first) / self._period_ns)
        self._passed = max(self._passed + 1, since if self._realtime else 0)
        if self._passed >= self._ticks:
            self._end_run('')
            return
        if sample.valid:
            self._tick += 1
            self._hooks.sampled(sample, self._tick, self._passed)
        else:
            self._hooks.idle(sample)

    def _time_left(self) -> float:
        """Return how long (s) the answer to the newest sample may still take."""
        if not self._realtime:
            return self._patience
        return self._patience - (self._monitor.now() - self._newest) * 1e-9

    def _end_run(self, reason: str) -> None:
        self._ticks = 0
        self._monitor.disarm()
        self._hooks.ended(reason)
