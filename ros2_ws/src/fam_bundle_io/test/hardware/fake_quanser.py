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
The vendor's module ``quanser.hardware`` without hardware, stricter than the vendor's.

It refuses what the vendor's takes and reads as garbage: wrong types, arrays with gaps, calls out
of order. Its card has volts at its terminals, a clock that ``read`` or ``advance`` moves, and a
watchdog. Names, codes and the order of calls are those of the vendor's documents.
"""

import sys
import types

import numpy as np

OVERFLOW, NOT_FOUND, EXPIRATION_UNSUPPORTED, EXPIRED, NOT_EXPIRED = -111, -108, -592, -598, -599


class HILError(Exception):
    """What a call of the card raises."""

    def __init__(self, error_code, words):
        super().__init__(words)
        self.error_code = error_code
        self._words = words

    def get_error_message(self):
        return self._words


class Clock:
    HARDWARE_CLOCK_0 = 0


class BufferOverflowMode:
    ERROR = 0


class Misuse(AssertionError):
    """What the vendor's module would not notice."""


def check(array, size, dtype):
    if not isinstance(array, np.ndarray) or array.dtype != dtype:
        raise Misuse(f'{getattr(array, "dtype", type(array))} instead of {dtype}')
    if array.shape != (size,) or not array.flags.c_contiguous:
        raise Misuse(f'shape {array.shape}, contiguous: {array.flags.c_contiguous}')


class Board:
    """The hardware; there is one, ``board``, and it outlives every handle."""

    def __init__(self):
        self.outputs, self.inputs = {}, {}
        self.input_range, self.output_range, self.expiration = {}, {}, {}
        self.expired = False
        self.timeout = None  # of the running watchdog, s
        self.left = 0.0
        self.time = 0.0  # s
        self.open = False
        self.calls = []
        self.broken = {}  # by call: what it raises
        self.late = 0  # samples that come in while nobody reads
        self.supports_expiration = True

    def advance(self, seconds):
        """Let time pass; the watchdog may expire."""
        self.time += seconds
        if self.timeout is not None and not self.expired:
            self.left -= seconds
            if self.left < 0.0:
                self.expired = True
                self.outputs.update(self.expiration)


board = Board()


class HIL:
    INFINITE = -1

    def __init__(self, card_type=None, card_identifier='0'):
        self._note('open')
        if card_type != 'fake':
            raise HILError(NOT_FOUND, f'no board {card_type} {card_identifier}')
        if board.open:
            raise HILError(-109, 'the board is in use')
        board.open = True
        self._task = None

    def _note(self, call):
        board.calls.append(call)
        if call in board.broken:
            raise board.broken[call]

    def _use(self, call):
        self._note(call)
        if not board.open:
            raise Misuse(f'{call} on a closed card')
        if board.expired:
            raise HILError(EXPIRED, 'the watchdog has expired')

    def close(self):
        self._note('close')
        if self._task is not None:
            raise Misuse('closed with a task')
        board.open = False
        if not board.expired:
            board.timeout = None  # the worst case: who goes takes the watchdog along

    def set_card_specific_options(self, options, length):
        self._use('set_card_specific_options')

    def set_analog_input_ranges(self, channels, count, minima, maxima):
        self._use('set_analog_input_ranges')
        self._channels(channels, count, minima, maxima)
        board.input_range = dict(
            zip(channels.tolist(), zip(minima, maxima, strict=True), strict=True)
        )

    def set_analog_output_ranges(self, channels, count, minima, maxima):
        self._use('set_analog_output_ranges')
        self._channels(channels, count, minima, maxima)
        board.output_range = dict(
            zip(channels.tolist(), zip(minima, maxima, strict=True), strict=True)
        )

    def _channels(self, channels, count, *arrays):
        check(channels, count, np.uint32)
        for array in arrays:
            check(array, count, np.float64)

    def write_analog(self, channels, count, volts):
        self._use('write_analog')
        self._channels(channels, count, volts)
        for channel, value in zip(channels.tolist(), volts.tolist(), strict=True):
            low, high = board.output_range[channel]
            if not low <= value <= high:
                raise Misuse(f'{value} V on an output of {low} to {high} V')
            board.outputs[channel] = value

    def task_create_analog_reader(self, samples_in_buffer, channels, count):
        self._use('task_create_analog_reader')
        check(channels, count, np.uint32)
        self._task = {'buffer': samples_in_buffer, 'channels': channels.tolist(), 'period': None}
        return self._task

    def task_set_buffer_overflow_mode(self, task, mode):
        self._use('task_set_buffer_overflow_mode')
        if mode != BufferOverflowMode.ERROR:
            raise Misuse('an overflow must be an error')

    def task_start(self, task, clock, frequency, samples):
        self._use('task_start')
        if samples != HIL.INFINITE or clock != Clock.HARDWARE_CLOCK_0:
            raise Misuse('the task must go on')
        task['period'] = 1.0 / frequency

    def task_read_analog(self, task, samples, volts):
        self._use('task_read_analog')
        if task['period'] is None or samples != 1:
            raise Misuse('one sample of a task that runs')
        check(volts, len(task['channels']), np.float64)
        if board.late > task['buffer']:
            raise HILError(OVERFLOW, 'samples were lost')
        board.late = 0
        board.advance(task['period'])
        volts[:] = [board.inputs[channel] for channel in task['channels']]
        return 1

    def task_stop(self, task):
        self._note('task_stop')
        task['period'] = None

    def task_delete(self, task):
        self._note('task_delete')
        if task['period'] is not None:
            raise Misuse('deleted while it runs')
        self._task = None

    def watchdog_set_analog_expiration_state(self, channels, count, volts):
        self._use('watchdog_set_analog_expiration_state')
        self._channels(channels, count, volts)
        if board.timeout is not None:
            raise Misuse('expiration states come before the start')
        if not board.supports_expiration:
            raise HILError(EXPIRATION_UNSUPPORTED, 'no such expiration state')
        board.expiration = dict(zip(channels.tolist(), volts.tolist(), strict=True))

    def watchdog_start(self, timeout):
        self._use('watchdog_start')
        if not board.expiration:
            raise Misuse('started without expiration states')
        board.timeout = board.left = timeout

    def watchdog_reload(self):
        self._note('watchdog_reload')
        if board.timeout is None:
            raise HILError(-597, 'the watchdog does not run')
        if board.expired:
            return False
        board.left = board.timeout
        return True

    def watchdog_is_expired(self):
        return board.expired

    def watchdog_clear(self):
        self._note('watchdog_clear')
        if not board.expired:
            raise HILError(NOT_EXPIRED, 'the watchdog has not expired')
        board.expired, board.timeout = False, None

    def watchdog_stop(self):
        self._use('watchdog_stop')
        board.timeout = None


def install(monkeypatch):
    """Put the module where it is imported from, with a new board, and return the board."""
    global board
    board = Board()
    package, hardware = types.ModuleType('quanser'), types.ModuleType('quanser.hardware')
    enumerations = types.ModuleType('quanser.hardware.enumerations')
    enumerations.BufferOverflowMode = BufferOverflowMode
    hardware.HIL, hardware.HILError, hardware.Clock = HIL, HILError, Clock
    hardware.MAX_STRING_LENGTH = 256
    for module in (package, hardware, enumerations):
        monkeypatch.setitem(sys.modules, module.__name__, module)
    return board
