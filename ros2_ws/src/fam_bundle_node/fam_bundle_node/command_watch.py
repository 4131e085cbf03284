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
Decides whether the valves may follow the newest command. Pure Python.

Owned by whoever has the valves, the plant simulator or the hardware bridge.
"""

from collections import deque


class CommandWatch:
    """
    Safe while commands stay away; latched after a fault.

    Counts samples first, so that a schedule which was itself held up does not blame the
    controllers; but valves that stay on one command for twice the time are safe in any case.
    """

    def __init__(self, limit: int) -> None:
        """
        Go safe when the newest answer is ``limit`` samples old; ``limit`` is 2 or more.

        Answers that keep coming for as many samples, never a fifth of it apart, end it. Not safe
        at first: its owner begins when the loop has closed.
        """
        self.limit = limit
        self.fault = ''
        self.reason = ''
        self._news = ''
        self._answered = self._answered_before = -1
        self._regular = self._silent = 0
        self._period = 0
        # Tick and period of the newest answered sample, and of those that wait for an answer.
        self._samples: deque[tuple[int, int]] = deque([(-1, 0)], maxlen=4 * limit)

    @property
    def safe(self) -> bool:
        """Whether the valves must be open to the tank."""
        return bool(self.fault or self.reason)

    def state(self) -> str:
        """Return 'running', or why it is safe."""
        if self.fault:
            return f'fault: {self.fault}; reset with ~/reset_fault'
        return f'safe: {self.reason}' if self.reason else 'running'

    def answer(self, tick: int) -> None:
        """Note the answer to sample ``tick``, the newest so far."""
        self._answered = tick

    def next_sample(self, tick: int, periods: int) -> None:
        """Decide before sample ``tick`` is taken, ``periods`` periods after the last one."""
        self._period += periods
        while len(self._samples) > 1 and self._samples[1][0] <= self._answered:
            self._samples.popleft()
        self._samples.append((tick, self._period))
        answered = tick - self._answered < self.limit and self.held_for() < 2 * self.limit
        came = self._answered > self._answered_before
        self._silent = 0 if came else self._silent + 1
        # An answer may come just after the next sample: a few silent ones are still regular.
        self._regular = self._regular + 1 if self._silent <= self.limit // 5 else 0
        self._answered_before = self._answered
        if periods > self.limit:
            self._go_safe(f'the schedule was held up for {periods} periods before tick {tick}')
        elif not answered:
            self._go_safe(f'valve_command: no answer since tick {self._answered}')
        elif self._regular >= self.limit:
            self.reason = ''

    def held_for(self) -> int:
        """Return for how many periods the newest command has been held, by the newest sample."""
        return self._period - self._samples[0][1]

    def latch(self, reason: str) -> None:
        """Go safe for good; the first reason stays."""
        self.fault = self.fault or reason

    def reset(self) -> None:
        """End a latched fault; the next answers in a row end the safe state."""
        if self.fault:
            self._go_safe(f'{self.fault}; reset, waiting for commands')
        self.fault = ''

    def take_news(self) -> str:
        """Return why it has gone safe since the last call, or nothing: it may be over again."""
        news, self._news = self._news, ''
        return f'safe: {news}' if news else ''

    def _go_safe(self, reason: str) -> None:
        if not self.reason:
            self._news = reason
        self.reason = reason
        self._regular = self._silent = 0
