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
One valve at a time at low pressure: does its own transducer answer? Knows no terminal.

The source must have been turned down: no motor unit can then come above it, whichever transducer,
wire or valve is wrong. A valve is opened along a slow ramp, so that it answers near its true
middle, wherever that is, and goes back to the tank as soon as any transducer has answered.
"""

from collections.abc import Callable
import math
from typing import NamedTuple

from fam_bundle_io.hardware.backend import Setup
from fam_bundle_io.hardware.calibration import (
    MU_PRESSURE,
    SOURCE_FLOW,
    SOURCE_PRESSURE,
    STRAIN,
    Values,
)
from fam_bundle_io.hardware.limits import Limits
from fam_bundle_io.hardware.monitor import Monitor, Sample
from fam_bundle_io.hardware.safety import Refused, State
from fam_bundle_model.hydraulics import TO_TANK
import numpy as np

LOWEST_SHARE = 0.5  # of the limit: a source below it is too low to tell an answer
ANSWER_SHARE = 0.15  # of the limit: a rise by so much is an answer
BESIDE_SHARE = 0.05  # of the limit: so much is too much for a unit that is open to the tank
RAMP_START, RAMP_RATE, RAMP_END = -0.1, 0.1, 0.2  # spool, spool/s, spool
PULSE_TIME = 4.0  # s, the end of a ramp that nothing answers
VENT_TIME = 10.0  # s that a unit may take to vent
REST_TIME = 1.0  # s at rest before a valve is opened
SMOOTHING_TIME = 0.01  # s of a first-order filter: noise must not answer
SOURCE_SAMPLES = 5  # above the limit in a row, and the source was turned up
MOVED_STRAIN, MOVED_OIL = 2e-3, 3e-6  # the unit fills, whatever its transducer says; m^3
REPORT_TIME = 0.1  # s between two words on what happens
VALUES_TIME = 1.0  # s in which every sensor must have measured once


class CheckFailed(RuntimeError):
    """The check cannot begin or go on; the safe volts are out."""


class Finding(NamedTuple):
    """What became of a motor unit: ``ok``, or what is wrong, in a word and in a line."""

    unit: int
    ok: bool
    word: str
    text: str


class Pulse(NamedTuple):
    """
    What a ramp of one valve did: changes from rest to its end.

    ``rise`` (units,) in Pa, ``strain``, ``oil`` from the source in m^3, the last ``spool``.
    """

    rise: Values
    strain: float
    oil: float
    spool: float


class ChannelCheck:
    """
    Checks a rig whose monitor is configured and inactive.

    ``limit`` is the highest pressure in Pa, of the source and of all units. ``tell`` gets a line
    some ten times a second. ``patience`` s are waited for the source to be set.
    """

    def __init__(
        self,
        monitor: Monitor,
        setup: Setup,
        limits: Limits,
        limit: float,
        tell: Callable[[str], None],
        patience: float,
    ) -> None:
        """Have seen nothing yet."""
        self.monitor, self.setup, self.limits, self.limit = monitor, setup, limits, limit
        self.answer, self.beside = ANSWER_SHARE * limit, BESIDE_SHARE * limit
        self._tell, self._patience = tell, patience
        self._spool = np.full(setup.outputs.size, TO_TANK)
        self._smooth: Values = np.empty(0)  # the newest values, slightly filtered
        self._share = min(setup.period / SMOOTHING_TIME, 1.0)  # of a new sample
        self._above = 0  # samples in a row with the source above the limit
        self._told = -math.inf

    # ---- Before ----

    def wait_for_rest(self) -> None:
        """
        Wait until every unit is vented and the source is set, with the safe volts out.

        A reversed sign shows here: such a unit fills at the safe volts. Raises CheckFailed for a
        unit that does not vent or that fills, and where the source is not set in time.
        """
        start = self._first_values()
        vented_at = rest_at = math.nan
        while True:
            sample = self._tick(None)
            now = (sample.time - start) * 1e-9
            filled = self._pressurised()
            if filled and (not math.isnan(vented_at) or now > VENT_TIME):
                raise CheckFailed(self._does_not_vent(filled))
            source = self._source_trouble()
            if filled or source:
                rest_at = math.nan
            elif math.isnan(rest_at):
                rest_at = now
            if not filled and math.isnan(vented_at):
                vented_at = now
            if now - rest_at >= REST_TIME:
                return
            if source and now > self._patience:
                raise CheckFailed(source)
            self._report(sample, f'{source or "waiting until every motor unit is vented"}')

    def _first_values(self) -> int:
        """Return the time in ns of the first sample with a value of every channel."""
        sample = self._tick(None)
        start = sample.time
        while not sample.valid:
            if (sample.time - start) * 1e-9 > VALUES_TIME:
                raise CheckFailed('force or source_flow does not measure')
            sample = self._tick(None)
        return sample.time

    def _source_trouble(self) -> str:
        pressure = float(self._smooth[SOURCE_PRESSURE])
        low, high = LOWEST_SHARE * self.limit, self.limit
        if low <= pressure <= high:
            return ''
        return (
            f'source_pressure = {_kpa(pressure)}: must be >= {_kpa(low)} and <= {_kpa(high)}; '
            f'{"turn it down" if pressure > high else "start the pump, turned down"}'
        )

    def _pressurised(self) -> list[int]:
        """Return the units that are not depressurised."""
        return np.flatnonzero(self._smooth[MU_PRESSURE:] >= self.limits.depressurised).tolist()

    def _does_not_vent(self, units: list[int]) -> str:
        named = ' and '.join(
            f'mu_pressure[{i}] = {_kpa(float(self._smooth[MU_PRESSURE + i]))}' for i in units
        )
        return (
            f'{named} with the safe volts out: not vented; the sign of its valve is reversed, the '
            'valve or its amplifier is dead or the spool stuck, or the way to the tank is shut'
        )

    # ---- One unit ----

    def check_unit(self, unit: int) -> Finding:
        """
        Open the valve of ``unit`` until a transducer answers, vent, and say what answered.

        Raises CheckFailed where a fault or a unit that does not vent ends the check.
        """
        finding = self.judge(unit, self._ramp(unit))
        self._vent(unit)
        return finding

    def _ramp(self, unit: int) -> Pulse:
        before, oil, spool = self._smooth.copy(), 0.0, TO_TANK
        try:
            self.monitor.arm()
        except Refused as error:
            raise CheckFailed(str(error)) from None
        sample = self._tick(self._spool)
        while sample.state is State.ARMED:
            sample = self._tick(self._spool)
        start = last = sample.time
        try:
            while (sample.time - start) * 1e-9 < PULSE_TIME:
                spool = min(RAMP_START + RAMP_RATE * (sample.time - start) * 1e-9, RAMP_END)
                self._spool[unit] = spool
                sample = self._tick(self._spool)
                oil += float(sample.values[SOURCE_FLOW] - before[SOURCE_FLOW]) * (
                    (sample.time - last) * 1e-9
                )
                last = sample.time
                change = self._smooth - before
                self._watch_source()
                self._report(
                    sample,
                    f'motor unit {unit}: spool {spool:+.3f}, rise '
                    f'{" ".join(_kpa(p) for p in change[MU_PRESSURE:].tolist())}',
                )
                if change[MU_PRESSURE:].max() >= self.answer:
                    break
        finally:
            self._spool[unit] = TO_TANK
            self.monitor.disarm()
        change = self._smooth - before
        return Pulse(change[MU_PRESSURE:], float(change[STRAIN]), oil, spool)

    def _watch_source(self) -> None:
        """Raise CheckFailed where the source was turned up meanwhile."""
        above = self._smooth[SOURCE_PRESSURE] > self.limit
        self._above = self._above + 1 if above else 0
        if self._above >= SOURCE_SAMPLES:
            raise CheckFailed(self._source_trouble())

    def _vent(self, unit: int) -> None:
        sample = self._tick(None)
        start = sample.time
        resting = 0.0
        while resting < REST_TIME:
            sample = self._tick(None)
            filled = self._pressurised()
            if filled and (sample.time - start) * 1e-9 > VENT_TIME:
                raise CheckFailed(self._does_not_vent(filled))
            resting = 0.0 if filled else resting + self.setup.period
            self._report(sample, f'motor unit {unit}: back to the tank')

    def judge(self, unit: int, pulse: Pulse) -> Finding:
        """Return what ``pulse`` of the valve of ``unit`` tells."""
        own = self._sensor(unit)
        rose = [i for i in np.flatnonzero(pulse.rise >= self.beside).tolist() if i != unit]
        others = ' and '.join(f'{self._sensor(i)} by {_kpa(float(pulse.rise[i]))}' for i in rose)
        output = f'valves[{unit}] (output {self.setup.outputs[unit]})'
        moved = f'strain {pulse.strain:+.4f}, {pulse.oil * 1e6:.1f} mL of oil'
        if pulse.rise[unit] >= self.answer and not rose:
            null = '; null_volts is off: oil flows at spool 0' if pulse.spool <= 0.0 else ''
            rise = _kpa(float(pulse.rise[unit]))
            text = f'{own} rose by {rise} at spool {pulse.spool:+.3f}, {moved}{null}'
            return Finding(unit, True, 'ok', text)
        if pulse.rise[unit] >= self.beside and rose:
            text = (
                f'{own} rose, and so did {others}: outputs or hoses are joined, or the second '
                'valve leaks and does not vent'
            )
            return Finding(unit, False, 'leak', text)
        if rose:
            text = (
                f'{output} is answered by {others}, not by {own}: two outputs, two inputs or two '
                'hoses are swapped; which muscle moved?'
            )
            return Finding(unit, False, 'swapped', text)
        fell = (pulse.rise <= -self.beside).any()
        if fell or abs(pulse.strain) >= MOVED_STRAIN or pulse.oil >= MOVED_OIL:
            text = (
                f'{output} moves oil ({moved}), but {own} rose by {_kpa(float(pulse.rise[unit]))} '
                'only: its transducer or wire is dead, or its gain is wrong'
            )
            return Finding(unit, False, 'no answer', text)
        text = (
            f'{output} moves nothing up to spool {pulse.spool:+.2f} ({moved}): valve, amplifier '
            'or wire is dead, or a hose is shut'
        )
        return Finding(unit, False, 'dead', text)

    def _sensor(self, unit: int) -> str:
        return f'mu_pressure[{unit}] (input {self.setup.inputs[MU_PRESSURE + unit]})'

    # ---- The tick ----

    def _tick(self, spool: Values | None) -> Sample:
        """Return the next sample; raises CheckFailed after a fault."""
        sample = self.monitor.tick(spool, self.monitor.now())
        if sample.fault:
            raise CheckFailed(f'{sample.fault}{self._above_source(sample)}')
        if not sample.valid:
            return sample
        if not len(self._smooth):
            self._smooth = sample.values.copy()
        self._smooth += self._share * (sample.values - self._smooth)
        return sample

    def _above_source(self, sample: Sample) -> str:
        highest, source = sample.values[MU_PRESSURE:].max(), sample.values[SOURCE_PRESSURE]
        if not sample.valid or highest <= source + self.limits.overpressure_margin:
            return ''
        return (
            '; no source feeds that: its valve traps oil under the load, or its wire is swapped '
            'with that of source_pressure'
        )

    def _report(self, sample: Sample, line: str) -> None:
        if sample.time * 1e-9 - self._told >= REPORT_TIME:
            self._told = sample.time * 1e-9
            self._tell(line)


def _kpa(pressure: float) -> str:
    return f'{pressure * 1e-3:.1f} kPa'
