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
A card of Quanser through its HIL interface for Python. It has not run on hardware.

The board's clock paces the reads. The wrapper checks neither type nor order of its arrays:
channels must be uint32 and volts float64, both contiguous, which Card and Setup see to.
"""

from collections.abc import Callable
from dataclasses import dataclass
import importlib
from typing import Any

from fam_bundle_io.hardware.backend import BackendError, Card, Volts
from fam_bundle_model.schema import make_group, word

NOT_EXPIRED = -599  # what watchdog_clear says of a watchdog that has not expired


@dataclass(frozen=True)
class QuanserOptions:
    """Which card."""

    board_type: str = word('name of the card type, as in the vendor\'s documents: "qpid_e", say')
    identifier: str = word('which card of that type', default='0')
    card_options: str = word("options of this card in the vendor's words", default='')


class QuanserBackend(Card):
    """See Backend; errors carry the codes of HILError."""

    def __init__(self) -> None:
        """Hold no card yet."""
        super().__init__()
        self._card: Any = None
        self._task: Any = None
        self._failure: type[Exception] = OSError

    def _call(self, function: Callable[..., Any], *arguments: Any) -> Any:
        try:
            return function(*arguments)
        except self._failure as error:
            raise _backend_error(error) from error

    def _open(self) -> None:
        setup = self.setup
        options = make_group(QuanserOptions, 'backends.quanser', setup.options)
        hardware, overflow = import_vendor()
        self._failure = hardware.HILError
        self._card = self._call(hardware.HIL, options.board_type, options.identifier)
        card, call = self._card, self._call
        inputs, outputs = setup.inputs, setup.outputs
        if options.card_options:
            words = options.card_options
            call(card.set_card_specific_options, words, hardware.MAX_STRING_LENGTH)
        self._clear_watchdog()
        ranges = (setup.input_minimum, setup.input_maximum)
        call(card.set_analog_input_ranges, inputs, inputs.size, *ranges)
        ranges = (setup.output_minimum, setup.output_maximum)
        call(card.set_analog_output_ranges, outputs, outputs.size, *ranges)
        call(card.write_analog, outputs, outputs.size, setup.safe_volts)
        expiry = card.watchdog_set_analog_expiration_state
        call(expiry, outputs, outputs.size, setup.safe_volts)
        # A loop that is held up for longer than its time-out finds the buffer overrun: an error,
        # never a backlog of old samples.
        samples = max(round(setup.read_timeout / setup.period), 2)
        self._task = call(card.task_create_analog_reader, samples, inputs, inputs.size)
        call(card.task_set_buffer_overflow_mode, self._task, overflow.ERROR)
        clock = hardware.Clock.HARDWARE_CLOCK_0
        frequency = 1.0 / setup.period
        call(card.task_start, self._task, clock, frequency, hardware.HIL.INFINITE)

    def _clear_watchdog(self) -> None:
        try:
            self._call(self._card.watchdog_clear)
        except BackendError as error:
            if error.errno != NOT_EXPIRED:
                raise

    def _start_watchdog(self) -> None:
        self._call(self._card.watchdog_start, self.setup.watchdog_timeout)

    def _read(self, volts: Volts) -> None:
        # The vendor's call has no time-out: if the board's clock stops, the watchdog is left.
        samples = self._call(self._card.task_read_analog, self._task, 1, volts)
        if samples != 1:
            raise BackendError(0, f'task_read_analog gave {samples} samples; must be 1')

    def _write(self, volts: Volts) -> None:
        outputs = self.setup.outputs
        self._call(self._card.write_analog, outputs, outputs.size, volts)

    def _reload(self) -> bool:
        return bool(self._call(self._card.watchdog_reload))

    def _stop_watchdog(self) -> None:
        self._call(self._card.watchdog_stop)

    def _let_go(self) -> None:
        card, task = self._card, self._task
        self._card = self._task = None
        steps: list[tuple[Any, ...]] = []
        if task is not None:
            steps += [(card.task_stop, task), (card.task_delete, task)]
        if card is not None:
            steps.append((card.close,))
        for function, *arguments in steps:
            try:
                self._call(function, *arguments)
            except Exception:  # the next step must be tried whatever this one says
                continue


def import_vendor() -> tuple[Any, Any]:
    """
    Return the vendor's module and its overflow modes, which it does not re-export.

    Raises BackendError where it is not installed.
    """
    try:
        hardware: Any = importlib.import_module('quanser.hardware')
        enumerations: Any = importlib.import_module('quanser.hardware.enumerations')
    except (ImportError, OSError) as error:
        raise BackendError(
            0,
            "backend quanser: install the Python packages of the vendor's SDK (quanser_api, with "
            f'its HIL library); they are in no package index ({error})',
        ) from error
    return hardware, enumerations.BufferOverflowMode


def _backend_error(error: Any) -> BackendError:
    code = int(getattr(error, 'error_code', getattr(error, 'errno', 0)) or 0)
    words = getattr(error, 'get_error_message', lambda: str(error))
    return BackendError(code, str(words()))
