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
Runs any card safely: one call per tick, and every way out puts the safe volts out.

All calls but ``emergency_stop`` and ``now`` belong to the one thread that owns the card.
"""

from collections.abc import Callable
import dataclasses
import time
from types import TracebackType

from fam_bundle_io.hardware.backend import Backend, Setup, Volts
from fam_bundle_io.hardware.calibration import Calibration, Scaling, Values
from fam_bundle_io.hardware.command_gate import CommandGate
from fam_bundle_io.hardware.limits import Limits
from fam_bundle_io.hardware.safety import Refused, Safety, State
from fam_bundle_io.hardware.sensor_watch import SensorWatch
from fam_bundle_io.hardware.zeroing import Zeroing
import numpy as np
import numpy.typing as npt


@dataclasses.dataclass(slots=True)
class Sample:
    """
    What a tick gave. One object, filled anew by every tick: copy what is to be kept.

    ``values`` (4 + units,) are strain, force (N), source pressure (Pa), source flow (m^3/s) and
    the pressure of each motor unit (Pa), with the last good value where a channel does not
    measure; ``degraded`` (4 + units,) marks those that are lost and can be done without.
    ``spool`` (units,) is what was applied and ``valve_volts`` (units,) what it was in volts.
    """

    values: Values
    volts: Volts
    degraded: npt.NDArray[np.bool_]
    spool: Values
    valve_volts: Volts
    tick: int = 0  # samples read so far
    time: int = 0  # when it was read, ns of the monitor's clock
    valid: bool = False  # read at this tick, and every channel has or had a measurement
    state: State = State.UNCONFIGURED
    fault: str = ''
    stale: bool = False  # the command is old and ramps to safe
    limited: bool = False  # the spool is not the one that was asked for
    rejected: int = 0  # commands that could not be used, in all
    safe_out: bool = False  # the safe volts are known to be out
    trouble: str = ''  # what else went wrong since the first fault, the newest


class Monitor:
    """
    Wraps a card: time-outs, limits, the watchdog, the state, and the way to safe.

    ``clock`` gives ns and never steps; None counts samples instead, for a loop in lock-step.
    """

    def __init__(
        self,
        backend: Backend,
        setup: Setup,
        limits: Limits,
        nominal_pressure: float,
        clock: Callable[[], int] | None = time.monotonic_ns,
    ) -> None:
        """Hold the card, unopened. ``nominal_pressure`` is the source's set value in Pa."""
        calibration, channels = setup.calibration, setup.inputs.size
        self._backend, self._setup, self._limits = backend, setup, limits
        self._clock = clock
        self._period_ns = round(setup.period * 1e9)
        self.calibration: Calibration = calibration
        self.zeroing: Zeroing | None = None
        self._safety = Safety(calibration, limits, nominal_pressure)
        self._sensors = SensorWatch(calibration, limits)
        self._gate = CommandGate(calibration, limits)
        self._scaling = Scaling(calibration)
        self._sample = Sample(
            values=np.zeros(channels),
            volts=np.zeros(channels),
            degraded=self._sensors.degraded,
            spool=self._gate.applied,
            valve_volts=setup.safe_volts.copy(),
        )
        self._stop = ''
        self._read_at = self._moved_at = 0
        self._readable = False

    @property
    def state(self) -> State:
        """Return the state: valves follow commands when it is active, and in no other."""
        return self._safety.state

    @property
    def fault(self) -> str:
        """Why the fault is latched, or nothing."""
        return self._safety.fault

    @property
    def sample(self) -> Sample:
        """Return what the newest tick gave, with the state of now."""
        return self._report()

    @property
    def readable(self) -> bool:
        """Whether the newest sample could be read."""
        return self._readable

    def now(self) -> int:
        """Return the time in ns by which commands are to be stamped when they come."""
        return self._sample.tick * self._period_ns if self._clock is None else self._clock()

    # ---- Transitions ----

    def configure(self) -> None:
        """
        Open the card; again after an expired watchdog, which this clears. A fault stays.

        Raises Refused in another state, BackendError or ConfigurationError; the card is then
        closed.
        """
        if self.state not in (State.UNCONFIGURED, State.FAULT):
            raise Refused(f'configure: the bridge is {self.state.value}; close it first')
        try:
            self._backend.configure(self._setup)
        except BaseException:
            self.close()
            raise
        self._sensors.forget()
        self._gate.reset()
        self._safe_is_out()
        self._readable = False
        self._read_at = self._moved_at = self.now()
        self._safety.configured()
        self._report()

    def arm(self) -> None:
        """
        Follow commands as soon as ``limits.activation_commands`` fresh ones have come.

        Raises Refused unless the bridge is inactive and every sensor measures.
        """
        if self.zeroing is not None and not self.zeroing.done():
            raise Refused('arm: zeroing is under way')
        self._safety.arm(measuring=self._readable and self._sensors.measuring)
        self._gate.reset()

    def disarm(self) -> None:
        """Put the safe volts out and follow commands no more; a fault stays."""
        self._safety.disarm()
        if self.state is not State.UNCONFIGURED:
            self._make_safe()

    def zero(self) -> None:
        """
        Begin to zero; ``zeroing`` tells when it is done, ``calibration`` is then the new one.

        Raises Refused unless the bridge is inactive and every motor unit depressurised.
        """
        if self.state is not State.INACTIVE:
            raise Refused(f'zero: the bridge is {self.state.value}; must be inactive')
        if not (self._readable and self._sensors.measuring):
            raise Refused('zero: not every sensor measures')
        pressurised = self._safety.pressurised(self._sample.values)
        if pressurised:
            raise Refused(f'zero: {pressurised}')
        period, values = self._setup.period, self._sample.values
        self.zeroing = Zeroing(self.calibration, self._limits, period, values)

    def reset_fault(self) -> None:
        """End a fault. Raises Refused unless every motor unit is depressurised and seen to be."""
        if self.state is State.FAULT and not self._readable:
            raise Refused(f'reset_fault: the card cannot be read, configure it: {self.fault}')
        if self.state is State.FAULT and not self._sample.safe_out:
            raise Refused(f'reset_fault: the safe volts are not out: {self.fault}')
        measuring = self._sensors.measuring
        self._safety.reset(self._sample.values, measuring=measuring)
        self._sample.trouble = ''

    def emergency_stop(self, reason: str) -> None:
        """Latch a fault at the next tick; may be called from any thread."""
        self._stop = self._stop or reason

    def close(self) -> None:
        """
        Put the safe volts out and let go of the card; a latched fault stays.

        Raises nothing but what ends the process; what went wrong is in ``fault``.
        """
        self._safety.disarm()
        if self._stop:
            self._safety.latch(self._stop)
            self._stop = ''
        interruption: BaseException | None = None
        try:
            if self.state is not State.UNCONFIGURED:
                self._make_safe()
        except BaseException as error:
            interruption = error
        try:
            self._backend.close()
        except Exception as error:
            self._safety.latch(f'close: {_words(error)}')
        finally:
            self._readable = False
            self._safety.released()
            self._report()
        if interruption is not None:
            raise interruption

    def __enter__(self) -> 'Monitor':
        """Configure."""
        self.configure()
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """Close, whatever came before."""
        self.close()

    # ---- The tick ----

    def tick(self, spool: npt.NDArray[np.float64] | None = None, stamp: int = 0) -> Sample:
        """
        Put the newest command out, wait for the next sample, and return it.

        ``spool`` (units,) is in -1 to 1, ``stamp`` the time by ``now()`` at which it came; give
        the same two again while there is no newer one. Whatever goes wrong is a latched fault
        with the safe volts out, told in the sample. Raises Refused while unconfigured, and
        nothing else but what ends the process, after the safe volts are out.
        """
        if self.state is State.UNCONFIGURED:
            raise Refused('tick: the bridge is not configured')
        try:
            self._tick(spool, stamp)
        except Exception as error:
            self._fail(_words(error))
            self._pause()
        except BaseException as error:
            self._fail(_words(error))
            raise
        return self._report()

    def _tick(self, spool: npt.NDArray[np.float64] | None, stamp: int) -> None:
        now = self.now()
        fresh = False
        if self._stop:
            self._fail(self._stop)
            self._stop = ''
        elif self.state in (State.ARMED, State.ACTIVE):
            fresh = self._command(spool, stamp, now)
        if not self._sample.safe_out and self.state is not State.ACTIVE:
            self._make_safe()
        self._moved_at = now
        self._read()
        if fresh and self.state is State.ACTIVE and self._sensors.measuring:
            self._reload()

    def _command(self, spool: npt.NDArray[np.float64] | None, stamp: int, now: int) -> bool:
        """Write what becomes of the command; return whether it is fresh and was written."""
        gate, sample = self._gate, self._sample
        refused = gate.take(spool, stamp, now)
        if refused:
            self._fail(refused)
            return False
        if self.state is State.ARMED:
            if not gate.is_fresh(now) or gate.fresh < self._limits.activation_commands:
                return False
            sample.safe_out = False
            self._backend.arm()
            self._safety.activate()
        lost = gate.apply(now, max(now - self._moved_at, self._period_ns) * 1e-9)
        if lost:
            self._fail(lost)
            return False
        self._scaling.to_valve_volts(gate.applied, sample.valve_volts)
        sample.safe_out = False
        self._backend.write(sample.valve_volts)
        return not gate.stale

    def _read(self) -> None:
        sample, begun = self._sample, self.now()
        self._readable = False
        try:
            self._backend.read(sample.volts)
        except Exception as error:
            self._fail(f'read: {_words(error)}')
            self._pause()
            return
        sample.tick += 1
        now = sample.time = self.now()
        self._readable = True
        took = (now - begun) * 1e-9
        # A valve that stays at the tank does not mind a late sample.
        moving = self._clock is not None and self.state is State.ACTIVE
        if moving and took > self._limits.read_timeout:
            self._fail(f'read took {took:.3g} s: must be <= {self._limits.read_timeout:g} s')
        elapsed = max(now - self._read_at, self._period_ns) * 1e-9
        self._read_at = now
        self._scaling.to_values(sample.volts, sample.values)
        reason = self._sensors.look(sample.volts, sample.values, elapsed)
        reason = reason or self._safety.watch_pressure(sample.values)
        if reason:
            self._fail(reason)
        if self.zeroing is not None and not self.zeroing.done():
            self._zero()

    def _pause(self) -> None:
        if self._clock is not None:
            time.sleep(self._setup.period)  # a card that is not read does not pace the loop

    def _zero(self) -> None:
        zeroing = self.zeroing
        assert zeroing is not None
        if self.state is not State.INACTIVE or not self._sensors.measuring:
            zeroing.refuse(self.fault or 'not every sensor measures')
        zeroing.take(self._sample.volts)
        if zeroing.result is not None:
            self.calibration = zeroing.result
            self._scaling = Scaling(self.calibration)
            self._scaling.to_values(self._sample.volts, self._sample.values)
            np.copyto(self._sensors.good, self._sample.values)

    def _reload(self) -> None:
        if not self._backend.reload_watchdog():
            self._safe_is_out()  # the card itself has done it, and refuses everything
            self._fail("the card's watchdog has expired; configure clears it")

    # ---- The way to safe ----

    def _fail(self, reason: str) -> None:
        if self.fault:
            self._sample.trouble = reason
        self._safety.latch(reason)
        self._make_safe()

    def _make_safe(self) -> None:
        """Put the safe volts out; what goes wrong is a fault, and the next tick tries again."""
        self._gate.reset()
        if self._sample.safe_out:
            return
        try:
            self._backend.make_safe()
        except Exception as error:
            reason = f'make_safe: {_words(error)}'
            if self.fault:
                self._sample.trouble = reason
            self._safety.latch(reason)
            return
        self._safe_is_out()

    def _safe_is_out(self) -> None:
        np.copyto(self._sample.valve_volts, self._setup.safe_volts)
        self._sample.safe_out = True

    def _report(self) -> Sample:
        sample, gate = self._sample, self._gate
        sample.state, sample.fault = self.state, self.fault
        sample.valid = self._readable and self._sensors.has_values
        sample.stale, sample.limited, sample.rejected = gate.stale, gate.limited, gate.rejected
        return sample


def _words(error: BaseException) -> str:
    """Return an error in one line: a card's with its code, any other with its type."""
    if isinstance(error, OSError) and error.strerror:
        code = f' (code {error.errno})' if error.errno else ''
        return ' '.join(error.strerror.split()) + code
    return f'{type(error).__name__}: ' + ' '.join(str(error).split())
