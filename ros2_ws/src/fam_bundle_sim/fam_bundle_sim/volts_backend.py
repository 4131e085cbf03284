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
The simulated rig behind a simulated card: the plant, seen and moved in volts only.

It fulfils the protocol of the hardware bridge (``fam_bundle_io.hardware.backend``) by structure:
errors are OSError with a code and words. Deterministic: the same calls give the same volts.
"""

from collections.abc import Callable
import dataclasses
import time
from typing import Any, Protocol

from fam_bundle_model.compile import direct
from fam_bundle_model.hydraulics import TO_TANK
from fam_bundle_model.schema import choice, flag, integer, make_group, number
from fam_bundle_sim.plant import Plant, plant, plant_step, resting_state, truth
from fam_bundle_sim.sensors import CHANNELS, measure, noise_samples, sensors
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

FAULTS = {
    'input_open': 'the wire of an input is broken: it reads 0 V',
    'input_rail': 'an input is shorted to the upper end of its range',
    'input_frozen': 'an input keeps its volts',
    'input_jumping': 'an input is anywhere in its live range, another place each sample',
    'input_glitch': 'one sample of an input is 0 V',
    'inputs_swapped': 'the wires of two inputs are exchanged',
    'output_open': 'the wire of an output is broken: the amplifier sees 0 V',
    'output_rail': 'an output is shorted to the upper end of its range',
    'output_frozen': 'an output keeps its volts',
    'outputs_swapped': 'the wires of two outputs are exchanged',
    'valve_dead': 'the coil of a valve is dead: its spool goes to its own middle',
    'source_off': 'the source gives no pressure any more',
    'source_high': 'the regulator of the source fails: it gives a quarter more',
    'read_timeout': 'no sample comes',
    'read_error': 'a read fails',
    'write_error': 'a write fails',
    'watchdog': "the card's watchdog expires if it runs",
}
OF_INPUTS = (
    'input_open',
    'input_rail',
    'input_frozen',
    'input_jumping',
    'input_glitch',
    'inputs_swapped',
)
SOURCE = {'source_off': 0.0, 'source_high': 1.25}  # over the nominal pressure
OF_CARD = (*SOURCE, 'read_timeout', 'read_error', 'write_error', 'watchdog')


class Scaling(Protocol):
    """What turns SI values into volts and volts into spools: the calibration's, by structure."""

    def to_volts(self, values: Array, volts: Array) -> None:
        """Fill ``volts`` with what the sensors give at ``values``; both (4 + units,)."""

    def to_spool(self, volts: Array, spool: Array) -> None:
        """Fill ``spool`` with what ``volts`` command; both (units,)."""


@dataclasses.dataclass(frozen=True)
class VoltsOptions:
    """What lies between the plant and the bridge. Noise of the sensors is in ``sensors``."""

    pace: str = choice('read at once, or every period', ('lockstep', 'steady'), default='lockstep')
    bits: int = integer('resolution of the converters; 0 is ideal', 0, 24, default=16)
    null_offset: float = number(
        '', 'spool of a valve at its calibrated middle', default=0.0, minimum=-0.2, maximum=0.2
    )
    hysteresis: float = number(
        '', "width of the valves' backlash in spool", default=0.0, minimum=0.0, maximum=0.2
    )
    current_limit: float = number(
        '', 'largest coil current over that of full spool', default=1.0, minimum=0.1, maximum=2.0
    )
    hold: bool = flag(
        'keep the plant at rest until the first write that is not safe', default=False
    )


class VoltsBackend:
    """See ``fam_bundle_io.hardware.backend.Backend``. ``inject`` breaks it on purpose."""

    setup: Any
    options: VoltsOptions
    outputs: Array
    volts: Array
    rig: Plant
    state: Array  # of the plant, which outlives the card

    def __init__(self, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """Hold no card yet; ``clock`` (ns) paces the reads where they are to be steady."""
        self.configured = self.armed = self.expired = False
        self._built = False
        self._clock = clock

    # ---- The protocol ----

    def configure(self, setup: Any) -> None:
        """
        Open the card and put the safe volts out; the plant goes on from where it is.

        Raises ConfigurationError for options that cannot be, OSError without a configuration.
        """
        self.close()
        if setup.configuration is None:
            raise OSError(0, 'backend volts: needs the configuration of the plant')
        options = make_group(VoltsOptions, 'backends.volts', setup.options)
        self.setup, self.options = setup, options
        if not self._built:
            self._build()
        self.outputs = setup.safe_volts.copy()
        self.expired, self.configured = False, True
        self._unwatched = 0  # periods since the watchdog was reloaded
        self._due = self._clock()

    def arm(self) -> None:
        """Start the watchdog; from here on ``write`` is allowed."""
        self._ready('arm')
        self.armed, self._unwatched = True, 0

    def read(self, volts: Array) -> None:
        """
        Let a period pass, and fill ``volts`` (inputs,) with what the card then sees.

        Raises OSError where the card has been told to fail, or is not ready.
        """
        self._ready('read', usable=False)
        check_volts('read', volts, len(self.volts))
        self._pass_period()
        self._ready('read')
        for fault, code, words in (
            ('read_timeout', 110, 'no sample within the time-out'),
            ('read_error', 5, 'the converter does not answer'),
        ):
            if fault in self.faults:
                raise OSError(code, words)
        self._sense()
        np.copyto(volts, self.volts)

    def write(self, volts: Array) -> None:
        """Put ``volts`` (outputs,) out; refused unless armed."""
        self._ready('write', armed=True)
        check_volts('write', volts, len(self.outputs))
        self._put_out(volts)

    def reload_watchdog(self) -> bool:
        """Give the watchdog its full time again; False: it had expired before."""
        if self.expired and self.armed:
            return False
        self._ready('reload_watchdog', armed=True)
        self._unwatched = 0
        return True

    def make_safe(self) -> None:
        """Put the safe volts out, then stop the watchdog."""
        self._ready('make_safe')
        self._put_out(self.setup.safe_volts)
        self.armed = False

    def close(self) -> None:
        """Put the safe volts out and let go of the card."""
        try:
            if self.configured:
                self.make_safe()
        except OSError:
            self._expire()  # as who waits for the watchdog would see
        finally:
            self.configured = self.armed = False

    # ---- What breaks ----

    def inject(self, fault: str, *channels: int) -> None:
        """
        Break it: one of FAULTS, at input or output ``channels`` in the setup's order.

        Raises ValueError for a fault or a channel that does not exist.
        """
        if fault not in FAULTS:
            raise ValueError(f'{fault}: no such fault; there are: {", ".join(FAULTS)}')
        wanted = 0 if fault in OF_CARD else 2 if fault.endswith('swapped') else 1
        count = len(self.volts) if fault in OF_INPUTS else len(self.outputs)
        if len(channels) != wanted or any(not 0 <= c < count for c in channels):
            raise ValueError(f'{fault}: {list(channels)}; must be {wanted} of 0 to {count - 1}')
        if fault == 'watchdog':
            self._expire()
            return
        if fault in SOURCE:
            self._set_source(SOURCE[fault])
        self.faults[fault] = channels
        self._frozen_inputs, self._frozen_outputs = self.volts.copy(), self.outputs.copy()

    def heal(self) -> None:
        """Mend everything; an expired watchdog is cleared by ``configure``."""
        self.faults.clear()
        self._set_source(1.0)

    # ---- Inside ----

    def pressures(self) -> Array:
        """Return the true pressure of each motor unit now, (units,) in Pa."""
        found = np.empty(len(self.outputs))
        self._truth(self.rig, self.state, found)
        return found

    def _set_source(self, share: float) -> None:
        pressure = share * self.setup.configuration.source.nominal_pressure
        hydraulics = self.rig.hydraulics._replace(nominal_pressure=pressure)
        self.rig = self.rig._replace(hydraulics=hydraulics)

    def _build(self) -> None:
        configuration = self.setup.configuration
        units, period = len(configuration.fam.count), configuration.simulation.period
        if len(self.setup.outputs) != units:
            raise OSError(0, f'{len(self.setup.outputs)} valves for {units} motor units')
        if abs(self.setup.period - period) > 1e-12:
            raise OSError(0, f'period {self.setup.period:g} s; the plant has {period:g} s')
        self._built = True
        self.faults: dict[str, tuple[int, ...]] = {}
        self.scaling: Scaling = self.setup.scaling
        self.rig = plant(configuration)
        self.state = resting_state(configuration, self.rig)
        self.instruments = sensors(configuration.sensors, units)
        self.noise = noise_samples(configuration.sensors, units)
        self.values, self.volts = np.zeros(CHANNELS + units), np.zeros(CHANNELS + units)
        self._pressures = self.values[CHANNELS:]
        self._current, self._spool = np.zeros(units), np.zeros(units)
        self._holds = self.options.hold
        self._jumps = np.random.default_rng(configuration.sensors.seed)
        self._frozen_inputs, self._frozen_outputs = self.volts.copy(), np.zeros(units)
        self._substeps = configuration.simulation.substeps
        step = (self.rig, self.state.copy(), self._spool, period, self._substeps)
        self._plant_step = direct(plant_step, *step)
        true = truth(self.rig, self.state, self._pressures)
        sample = np.zeros(CHANNELS + units)
        self._truth = direct(truth, self.rig, self.state, self._pressures)
        self._measure = direct(measure, self.instruments, true, sample, self._pressures)

    def _pass_period(self) -> None:
        period = self.setup.period
        if self.options.pace == 'steady':
            self._wait(round(period * 1e9))
        if self.armed and not self.expired:
            self._unwatched += 1
            if self._unwatched > round(self.setup.watchdog_timeout / period):
                self._expire()
        if not self._holds:
            self._move_spools()
            self._plant_step(self.rig, self.state, self._spool, period, self._substeps)

    def _wait(self, period: int) -> None:
        """Sleep until the next multiple of ``period`` ns; what was missed is left out."""
        now = self._clock()
        self._due += max((now - self._due) // period + 1, 1) * period
        while now < self._due:
            time.sleep((self._due - now) * 1e-9)
            now = self._clock()

    def _move_spools(self) -> None:
        """Fill ``_spool`` with what wires, amplifiers and valves make of the outputs."""
        seen, faults = self.outputs.copy(), self.faults
        if 'outputs_swapped' in faults:
            a, b = faults['outputs_swapped']
            seen[[a, b]] = seen[[b, a]]
        for channel in faults.get('output_open', ()):
            seen[channel] = 0.0
        for channel in faults.get('output_rail', ()):
            seen[channel] = self.setup.output_maximum[channel]
        for channel in faults.get('output_frozen', ()):
            seen[channel] = self._frozen_outputs[channel]
        options, current = self.options, self._current
        self.scaling.to_spool(seen, self._spool)
        np.clip(self._spool, -options.current_limit, options.current_limit, out=self._spool)
        for channel in faults.get('valve_dead', ()):
            self._spool[channel] = 0.0
        half = 0.5 * options.hysteresis
        np.clip(current, self._spool - half, self._spool + half, out=current)
        np.clip(current + options.null_offset, TO_TANK, -TO_TANK, out=self._spool)

    def _sense(self) -> None:
        """Fill ``volts`` with what the card sees."""
        faults, setup = self.faults, self.setup
        true = self._truth(self.rig, self.state, self._pressures)
        seen = self._measure(self.instruments, true, next(self.noise), self._pressures)
        self.values[:CHANNELS] = seen
        before = self._frozen_inputs
        self.scaling.to_volts(self.values, self.volts)
        if 'inputs_swapped' in faults:
            a, b = faults['inputs_swapped']
            self.volts[[a, b]] = self.volts[[b, a]]
        for channel in faults.get('input_open', ()):
            self.volts[channel] = 0.0
        for channel in faults.get('input_rail', ()):
            self.volts[channel] = setup.input_maximum[channel]
        for channel in faults.get('input_frozen', ()):
            self.volts[channel] = before[channel]
        for channel in faults.get('input_jumping', ()):
            self.volts[channel] = self._jumped(channel)
        for channel in faults.pop('input_glitch', ()):
            self.volts[channel] = 0.0
        self._convert(self.volts, setup.input_minimum, setup.input_maximum)

    def _jumped(self, channel: int) -> float:
        sensor = self.setup.calibration.sensors()[channel]
        return float(self._jumps.uniform(sensor.live_minimum, sensor.live_maximum))

    def _put_out(self, volts: Array) -> None:
        if 'write_error' in self.faults:
            raise OSError(5, 'the converter does not answer')
        np.copyto(self.outputs, volts)
        self._convert(self.outputs, self.setup.output_minimum, self.setup.output_maximum)
        if not np.array_equal(volts, self.setup.safe_volts):
            self._holds = False

    def _convert(self, volts: Array, low: Array, high: Array) -> None:
        """Round ``volts`` to what a converter over its range knows, in place."""
        np.clip(volts, low, high, out=volts)
        if self.options.bits:
            step = (high - low) / 2.0**self.options.bits
            volts[:] = np.minimum(low + np.rint((volts - low) / step) * step, high - step)

    def _expire(self) -> None:
        if self.armed:
            self.expired = True
            np.copyto(self.outputs, self.setup.safe_volts)

    def _ready(self, call: str, *, armed: bool = False, usable: bool = True) -> None:
        """Raise OSError where ``call`` is out of order."""
        if not self.configured:
            raise OSError(0, f'{call}: the card is not configured')
        if usable and self.expired:
            raise OSError(0, f'{call}: the watchdog has expired; configure clears it')
        if armed and not self.armed:
            raise OSError(0, f'{call}: the card is not armed')


def check_volts(call: str, volts: Array, size: int) -> None:
    """Raise OSError unless ``volts`` is what a vendor's wrapper would take."""
    good = volts.dtype == np.float64 and volts.shape == (size,) and volts.flags.c_contiguous
    if not good:
        raise OSError(0, f'{call}: volts must be float64, ({size},) and contiguous')
