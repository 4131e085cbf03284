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
A card of National Instruments through nidaqmx. It has not run on hardware.

Samples come by hardware-timed single point where the device has it, else one by one out of a
continuous acquisition, the newest first. Outputs are written on demand.
"""

from dataclasses import dataclass
import importlib
from typing import Any

from fam_bundle_io.hardware.backend import BackendError, Card, Setup, Volts
from fam_bundle_model.schema import make_group, word

MODULES = (
    'constants',
    'errors',
    'stream_readers',
    'stream_writers',
    'system.watchdog',
    'types',
)
# What a device without hardware-timed single point says.
NO_SINGLE_POINT = (-209857, -200821)
EXPIRED = -200644  # what a timer that is reset too late says


@dataclass(frozen=True)
class NidaqmxOptions:
    """Which card."""

    input_device: str = word('device or module of the inputs: "Dev1" or "cDAQ1Mod1", say')
    output_device: str = word('device or module of the outputs')
    watchdog_device: str = word('device or chassis that has the watchdog: "Dev1" or "cDAQ1", say')


class NidaqmxBackend(Card):
    """See Backend; errors carry the codes of DaqError."""

    def __init__(self) -> None:
        """Hold no card yet."""
        super().__init__()
        self._ni: Any = None
        self._input: Any = None
        self._output: Any = None
        self._reader: Any = None
        self._writer: Any = None
        self._watchdog: Any = None
        self._failure: type[Exception] = OSError

    def _open(self) -> None:
        setup = self.setup
        options = make_group(NidaqmxOptions, 'backends.nidaqmx', setup.options)
        self._ni = import_vendor()
        self._failure = self._ni.errors.Error
        try:
            self._open_watchdog(setup, options)
            self._open_outputs(setup, options.output_device)
            self._open_inputs(setup, options.input_device)
        except self._failure as error:
            raise _backend_error(error) from error

    def _open_watchdog(self, setup: Setup, options: NidaqmxOptions) -> None:
        ni, device = self._ni, options.output_device
        self._watchdog = ni.system.watchdog.WatchdogTask(
            options.watchdog_device, timeout=setup.watchdog_timeout
        )
        states = [
            ni.types.AOExpirationState(
                f'{device}/ao{channel}', volts, ni.constants.WatchdogAOExpirState.VOLTAGE
            )
            for channel, volts in zip(
                setup.outputs.tolist(), setup.safe_volts.tolist(), strict=True
            )
        ]
        self._watchdog.cfg_watchdog_ao_expir_states(states)
        self._watchdog.clear_expiration()

    def _open_outputs(self, setup: Setup, device: str) -> None:
        self._output = self._ni.Task()
        ranges = zip(
            setup.outputs.tolist(),
            setup.output_minimum.tolist(),
            setup.output_maximum.tolist(),
            strict=True,
        )
        for channel, low, high in ranges:
            self._output.ao_channels.add_ao_voltage_chan(
                f'{device}/ao{channel}', min_val=low, max_val=high
            )
        self._writer = self._ni.stream_writers.AnalogMultiChannelWriter(
            self._output.out_stream, auto_start=True
        )
        self._writer.write_one_sample(setup.safe_volts, timeout=setup.read_timeout)

    def _open_inputs(self, setup: Setup, device: str) -> None:
        try:
            self._start_inputs(setup, device, single_point=True)
        except self._ni.errors.DaqError as error:
            if error.error_code not in NO_SINGLE_POINT:
                raise
            self._input.close()
            self._start_inputs(setup, device, single_point=False)

    def _start_inputs(self, setup: Setup, device: str, *, single_point: bool) -> None:
        ni = self._ni
        self._input = ni.Task()
        ranges = zip(
            setup.inputs.tolist(),
            setup.input_minimum.tolist(),
            setup.input_maximum.tolist(),
            strict=True,
        )
        for channel, low, high in ranges:
            self._input.ai_channels.add_ai_voltage_chan(
                f'{device}/ai{channel}', min_val=low, max_val=high
            )
        modes = ni.constants.AcquisitionType
        mode = modes.HW_TIMED_SINGLE_POINT if single_point else modes.CONTINUOUS
        self._input.timing.cfg_samp_clk_timing(1.0 / setup.period, sample_mode=mode)
        if not single_point:
            # A loop that was held up goes on with the next sample, not with a backlog.
            stream = self._input.in_stream
            stream.relative_to = ni.constants.ReadRelativeTo.MOST_RECENT_SAMPLE
            stream.offset = 0
            stream.overwrite = ni.constants.OverwriteMode.OVERWRITE_UNREAD_SAMPLES
        self._reader = ni.stream_readers.AnalogMultiChannelReader(self._input.in_stream)
        self._input.start()

    def _start_watchdog(self) -> None:
        try:
            self._watchdog.start()
        except self._failure as error:
            raise _backend_error(error) from error

    def _read(self, volts: Volts) -> None:
        try:
            self._reader.read_one_sample(volts, timeout=self.setup.read_timeout)
        except self._failure as error:
            raise _backend_error(error) from error

    def _write(self, volts: Volts) -> None:
        try:
            self._writer.write_one_sample(volts, timeout=self.setup.read_timeout)
        except self._failure as error:
            raise _backend_error(error) from error

    def _reload(self) -> bool:
        try:
            self._watchdog.reset_timer()
        except self._failure as error:
            if getattr(error, 'error_code', 0) == EXPIRED:
                return False
            raise _backend_error(error) from error
        return True

    def _stop_watchdog(self) -> None:
        try:
            self._watchdog.stop()
        except self._failure as error:
            raise _backend_error(error) from error

    def _let_go(self) -> None:
        tasks = (self._input, self._output, self._watchdog)
        self._input = self._output = self._watchdog = self._reader = self._writer = None
        for task in tasks:
            try:
                if task is not None:
                    task.close()
            except Exception:  # the next one must be tried whatever this one says
                continue


def import_vendor() -> Any:
    """
    Return the vendor's package with all modules of it that are used.

    Raises BackendError where it is not installed.
    """
    try:
        for module in MODULES:
            importlib.import_module(f'nidaqmx.{module}')
        return importlib.import_module('nidaqmx')
    except (ImportError, OSError) as error:
        raise BackendError(
            0, f'backend nidaqmx: pip install nidaqmx, and the NI-DAQmx driver ({error})'
        ) from error


def _backend_error(error: Any) -> BackendError:
    if type(error).__name__ in ('DaqNotFoundError', 'DaqNotSupportedError'):
        return BackendError(0, f'backend nidaqmx: install the NI-DAQmx driver ({error})')
    return BackendError(int(getattr(error, 'error_code', 0)), ' '.join(str(error).split()))
