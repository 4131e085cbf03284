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
The package ``nidaqmx`` without hardware, stricter than the vendor's: see fake_quanser.py.

Names, codes and what a call raises are those of nidaqmx 1.x.
"""

import collections
import enum
import sys
import types

import numpy as np

NO_SINGLE_POINT, WRITE_EXPIRED, RESET_EXPIRED, READ_EXPIRED = -209857, -200678, -200644, -200712
AOExpirationState = collections.namedtuple(
    'AOExpirationState', ['physical_channel', 'expiration_state', 'output_type']
)


class Error(Exception):
    pass


class DaqNotFoundError(Error):
    pass


class DaqError(Error):
    """What a call of the driver raises."""

    def __init__(self, message, error_code):
        super().__init__(message)
        self.error_code = error_code


class Misuse(AssertionError):
    """What the vendor's package would not notice."""


class AcquisitionType(enum.Enum):
    FINITE = 10178
    CONTINUOUS = 10123
    HW_TIMED_SINGLE_POINT = 12522


class WatchdogAOExpirState(enum.Enum):
    VOLTAGE = 10322


class ReadRelativeTo(enum.Enum):
    CURRENT_READ_POSITION = 10425
    MOST_RECENT_SAMPLE = 10428


class OverwriteMode(enum.Enum):
    OVERWRITE_UNREAD_SAMPLES = 10252
    DO_NOT_OVERWRITE_UNREAD_SAMPLES = 10159


class Device:
    """The hardware; there is one, ``device``, and it outlives every task."""

    def __init__(self):
        self.outputs, self.inputs, self.expiration = {}, {}, {}
        self.expired = False
        self.timeout = None
        self.left = 0.0
        self.tasks = 0  # that are open
        self.calls = []
        self.broken = {}
        self.driver = True
        self.single_point = True

    def advance(self, seconds):
        if self.timeout is not None and not self.expired:
            self.left -= seconds
            if self.left < 0.0:
                self.expired = True
                self.outputs.update(self.expiration)

    def note(self, call):
        self.calls.append(call)
        if call in self.broken:
            raise self.broken[call]


device = Device()


def number(channel, kind):
    name, _, rest = channel.partition('/')
    if name not in ('Fake1Mod1', 'Fake1Mod2'):
        raise DaqError(f'device {name} not found', -200220)
    if not rest.startswith(kind):
        raise Misuse(f'{channel} is not one of {kind}')
    return int(rest.removeprefix(kind))


class Channels:
    """The channels of a task, of one kind."""

    def __init__(self, kind):
        self.kind, self.ranges = kind, {}

    def _add(self, channel, min_val, max_val):
        self.ranges[number(channel, self.kind)] = (min_val, max_val)

    def add_ai_voltage_chan(self, channel, min_val=-5.0, max_val=5.0):
        self._add(channel, min_val, max_val)

    def add_ao_voltage_chan(self, channel, min_val=-10.0, max_val=10.0):
        self._add(channel, min_val, max_val)


class Timing:
    """The sample clock of a task."""

    def __init__(self):
        self.rate, self.mode = None, None

    def cfg_samp_clk_timing(self, rate, sample_mode=AcquisitionType.FINITE):
        self.rate, self.mode = rate, sample_mode


class Stream:
    """The data of a task on their way in."""

    def __init__(self, task):
        self.task = task
        self.relative_to = ReadRelativeTo.CURRENT_READ_POSITION
        self.offset = 0
        self.overwrite = OverwriteMode.DO_NOT_OVERWRITE_UNREAD_SAMPLES


class Task:
    """A task: channels, clock and state."""

    def __init__(self):
        if not device.driver:
            raise DaqNotFoundError('Could not find an installation of NI-DAQmx.')
        device.tasks += 1
        self.open = True
        self.runs = False
        self.ai_channels, self.ao_channels = Channels('ai'), Channels('ao')
        self.timing = Timing()
        self.in_stream, self.out_stream = Stream(self), Stream(self)

    def start(self):
        device.note('start')
        if self.timing.mode is AcquisitionType.HW_TIMED_SINGLE_POINT and not device.single_point:
            raise DaqError('the device does not support it', NO_SINGLE_POINT)
        if self.timing.mode is AcquisitionType.FINITE:
            raise Misuse('a loop does not end after so many samples')
        if self.timing.mode is AcquisitionType.CONTINUOUS:
            stream = self.in_stream
            newest = stream.relative_to is ReadRelativeTo.MOST_RECENT_SAMPLE
            if not newest or stream.overwrite is not OverwriteMode.OVERWRITE_UNREAD_SAMPLES:
                raise Misuse('a backlog of old samples')
        self.runs = True

    def close(self):
        device.note('close')
        if not self.open:
            raise Misuse('closed twice')
        self.open = False
        device.tasks -= 1


def check(data, size):
    if data.dtype != np.float64 or data.shape != (size,) or not data.flags.c_contiguous:
        raise Misuse(f'{data.dtype} {data.shape}, contiguous: {data.flags.c_contiguous}')


class AnalogMultiChannelReader:
    """Reads from the stream of a task."""

    def __init__(self, stream):
        self.task = stream.task

    def read_one_sample(self, data, timeout=10):
        device.note('read')
        if not self.task.runs or timeout > 1.0:
            raise Misuse('read of a task that does not run, or without time-out')
        check(data, len(self.task.ai_channels.ranges))
        if device.expired:
            raise DaqError('the watchdog has expired', READ_EXPIRED)
        device.advance(1.0 / self.task.timing.rate)
        data[:] = [device.inputs[channel] for channel in self.task.ai_channels.ranges]


class AnalogMultiChannelWriter:
    """Writes to the stream of a task."""

    def __init__(self, stream, auto_start=False):
        self.task, self.auto_start = stream.task, auto_start

    def write_one_sample(self, data, timeout=10):
        device.note('write')
        ranges = self.task.ao_channels.ranges
        check(data, len(ranges))
        if not self.auto_start:
            raise Misuse('nobody starts the task')
        if device.expired:
            raise DaqError('the watchdog has expired', WRITE_EXPIRED)
        for (channel, (low, high)), value in zip(ranges.items(), data.tolist(), strict=True):
            if not low <= value <= high:
                raise Misuse(f'{value} V on an output of {low} to {high} V')
            device.outputs[channel] = value


class WatchdogTask(Task):
    """Puts the expiration states out when it is not reset in time."""

    def __init__(self, device_name, task_name='', timeout=10):
        super().__init__()
        if device_name != 'Fake1':
            raise DaqError(f'device {device_name} not found', -200220)
        self.timeout = timeout

    def clear_expiration(self):
        device.note('clear_expiration')
        if not device.expiration:
            raise Misuse('cleared before the expiration states are known')
        device.expired, device.timeout = False, None

    def cfg_watchdog_ao_expir_states(self, states):
        device.note('expiration')
        if device.timeout is not None and not device.expired:
            raise Misuse('expiration states come before the start')
        for state in states:
            if state.output_type is not WatchdogAOExpirState.VOLTAGE:
                raise Misuse('volts')
            device.expiration[number(state.physical_channel, 'ao')] = state.expiration_state

    def close(self):
        super().close()
        if not device.expired:
            device.timeout = None

    def start(self):
        device.note('watchdog_start')
        if not device.expiration:
            raise Misuse('started without expiration states')
        device.timeout = device.left = self.timeout

    def reset_timer(self):
        device.note('reset_timer')
        if device.timeout is None:
            raise Misuse('reset before the start')
        if device.expired:
            raise DaqError('the timer has expired', RESET_EXPIRED)
        device.left = device.timeout

    def stop(self):
        device.note('watchdog_stop')
        device.timeout = None


def install(monkeypatch):
    """Put the package where it is imported from, with a new device, and return the device."""
    global device
    device = Device()
    contents = {
        'nidaqmx': {'Task': Task, 'DaqError': DaqError},
        'nidaqmx.constants': {
            kind.__name__: kind
            for kind in (AcquisitionType, WatchdogAOExpirState, ReadRelativeTo, OverwriteMode)
        },
        'nidaqmx.errors': {kind.__name__: kind for kind in (Error, DaqError, DaqNotFoundError)},
        'nidaqmx.stream_readers': {'AnalogMultiChannelReader': AnalogMultiChannelReader},
        'nidaqmx.stream_writers': {'AnalogMultiChannelWriter': AnalogMultiChannelWriter},
        'nidaqmx.system': {},
        'nidaqmx.system.watchdog': {'WatchdogTask': WatchdogTask},
        'nidaqmx.types': {'AOExpirationState': AOExpirationState},
    }
    for name, members in contents.items():
        module = types.ModuleType(name)
        vars(module).update(members)
        monkeypatch.setitem(sys.modules, name, module)
        parent, _, child = name.rpartition('.')
        if parent:
            setattr(sys.modules[parent], child, module)
    return device
