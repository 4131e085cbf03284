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
The protocol of a card: volts in, volts out, a watchdog, a safe state. How to find a backend.

Order of the calls::

    configure ─► (read | make_safe)* ─► arm ─► (read | write | reload_watchdog)* ─► make_safe ─► …
    close from anywhere; configure again after an expired watchdog, or with another setup

Only ``arm`` lets a valve move, and ``make_safe`` takes that back. All calls come from one thread.
"""

from collections.abc import Mapping
import dataclasses
import importlib.metadata
from pathlib import Path
import time
from typing import Any, cast, Protocol

from fam_bundle_io.hardware.calibration import Calibration, HardwareFile, Scaling
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.schema import ConfigurationError
import numpy as np
import numpy.typing as npt

GROUP = 'fam_bundle.backends'
SIMULATED = ('volts', 'mock')  # in this process, paced by who asks
MOVE_NOTHING = (*SIMULATED, 'volts_card')
FLOATS = np.dtype(np.float64)

Volts = npt.NDArray[np.float64]


class BackendError(OSError):
    """
    A card that refuses or fails.

    ``errno`` is the vendor's code (0 without one), ``strerror`` its words. A backend that cannot
    import this class raises a plain OSError with the same two.
    """

    def __init__(self, code: int, words: str) -> None:
        """Say what went wrong in the vendor's ``words``."""
        super().__init__(code, words)

    def __str__(self) -> str:
        """Return the words, and the code where there is one."""
        return f'{self.strerror} (code {self.errno})' if self.errno else str(self.strerror)


@dataclasses.dataclass(frozen=True, eq=False)
class Setup:
    """
    What a card is to do; ``make_setup`` makes it.

    Channels come in the order of ``Calibration.sensors()`` and of its valves; ``safe_volts``
    (outputs,) open every motor unit to the tank. ``period`` and the timeouts are in s.
    ``options`` are the backend's own. ``scaling`` and ``configuration`` are for a simulated rig,
    which must invent the volts; a card has no use for them.
    """

    inputs: npt.NDArray[np.uint32]
    input_minimum: Volts
    input_maximum: Volts
    outputs: npt.NDArray[np.uint32]
    output_minimum: Volts
    output_maximum: Volts
    safe_volts: Volts
    period: float
    watchdog_timeout: float
    read_timeout: float
    calibration: Calibration
    scaling: Scaling
    options: Mapping[str, Any] = dataclasses.field(default_factory=dict)
    configuration: Configuration | None = None


def make_setup(
    hardware: HardwareFile,
    backend: str,
    period: float,
    configuration: Configuration | None = None,
) -> Setup:
    """
    Return what the card of ``backend`` is to do, with a sample every ``period`` s.

    ``configuration`` is what a simulated rig simulates.
    """
    calibration, limits = hardware.calibration, hardware.limits
    sensors, valves = calibration.sensors(), calibration.valves
    scaling = Scaling(calibration)
    return Setup(
        inputs=np.array([s.channel for s in sensors], dtype=np.uint32),
        input_minimum=np.array([s.minimum_volts for s in sensors]),
        input_maximum=np.array([s.maximum_volts for s in sensors]),
        outputs=np.array([v.channel for v in valves], dtype=np.uint32),
        output_minimum=np.array([v.minimum_volts for v in valves]),
        output_maximum=np.array([v.maximum_volts for v in valves]),
        safe_volts=scaling.safe_volts,
        period=period,
        watchdog_timeout=limits.watchdog_timeout,
        read_timeout=limits.read_timeout,
        calibration=calibration,
        scaling=scaling,
        options=hardware.options.get(backend, {}),
        configuration=configuration,
    )


def made_up(calibration: Calibration) -> list[str]:
    """Return what in a calibration is still that of the simulated rig, as NAME = VALUE."""
    parts = dict(zip(calibration.names(), calibration.sensors(), strict=True))
    named = {'id': calibration.id}
    named |= {f'sensors.{name}.calibration_id': p.calibration_id for name, p in parts.items()}
    for i, valve in enumerate(calibration.valves):
        named[f'valves[{i}].calibration_id'] = valve.calibration_id
    prefix = 'simulated rig'
    return [f'{n} = {v}' for n, v in named.items() if v.strip().casefold().startswith(prefix)]


def check_rig(hardware: HardwareFile, path: Path, backend: str, units: int) -> None:
    """
    Raise ConfigurationError unless the rig in ``path`` is one for ``backend``.

    It must have a valve for each of ``units`` motor units, and a card that moves something must
    have a calibration of its own: the numbers of the simulated rig are made up.
    """
    valves = len(hardware.calibration.valves)
    if valves != units:
        raise ConfigurationError(f'{path}: {valves} valves for {units} motor units; must be equal')
    invented = made_up(hardware.calibration)
    if backend not in MOVE_NOTHING and invented:
        raise ConfigurationError(
            f'{path}: {invented[0]}: is that of the simulated rig; {backend} needs the '
            'calibration of its own rig'
        )


class Backend(Protocol):
    """
    A card. Every call may raise BackendError.

    Arrays are float64, C-contiguous and the caller's.

    After its watchdog has expired the card keeps the safe volts and refuses everything, until
    ``configure`` clears it.
    """

    def configure(self, setup: Setup) -> None:
        """
        Open the card, or open it anew, and put the safe volts out.

        Clears an expired watchdog and tells it the safe volts; the watchdog does not run yet. A
        card that cannot hold the safe volts by itself after expiry is refused. Options that
        cannot be raise ConfigurationError.
        """

    def arm(self) -> None:
        """Start the watchdog; from here on ``write`` is allowed."""

    def read(self, volts: Volts) -> None:
        """
        Wait for the next sample of all inputs and fill ``volts`` (inputs,): this is the pace.

        Raises BackendError when no sample comes in time, where the vendor's call can tell.
        """

    def write(self, volts: Volts) -> None:
        """Put ``volts`` (outputs,) out. Refused unless armed."""

    def reload_watchdog(self) -> bool:
        """
        Give the watchdog its full time again; False: it had expired before.

        Refused unless armed.
        """

    def make_safe(self) -> None:
        """
        Put the safe volts out and disarm. May be called in any state and any number of times.

        The watchdog is stopped only when the safe volts are known to be out: where they cannot be
        written it runs on, so that its expiry puts them out. Raises BackendError in that case.
        """

    def close(self) -> None:
        """
        Put the safe volts out and let go of the card. Never refused.

        Where they cannot be written it waits for the watchdog to bring them.
        """


def check_volts(call: str, volts: Volts, size: int) -> None:
    """
    Raise BackendError unless ``volts`` is what vendors' wrappers take without checking it.

    They hand on the address of the buffer: whole numbers, or every second element of a larger
    array, would be read as garbage.
    """
    if volts.dtype != FLOATS or volts.shape != (size,) or not volts.flags.c_contiguous:
        raise BackendError(
            0,
            f'{call}: volts have type {volts.dtype}, shape {volts.shape}, '
            f'{"" if volts.flags.c_contiguous else "not "}contiguous; '
            f'must be float64, ({size},) and contiguous',
        )


class Card:
    """
    What all our cards share: the order of the calls and the buffers are checked here.

    A subclass fills in the calls that begin with an underscore; it may rely on the order.
    """

    setup: Setup  # of the newest configure

    def __init__(self) -> None:
        """Hold no card yet."""
        self.configured = self.armed = self.expired = False

    def configure(self, setup: Setup) -> None:
        """Open the card and put the safe volts out; see Backend."""
        self.close()
        self.setup, self.expired = setup, False
        try:
            self._open()
        except BaseException:
            self._let_go()
            raise
        self.configured = True

    def arm(self) -> None:
        """Start the watchdog; see Backend."""
        self._ready('arm')
        if not self.armed:
            self._start_watchdog()
        self.armed = True

    def read(self, volts: Volts) -> None:
        """Wait for the next sample; see Backend."""
        self._ready('read')
        check_volts('read', volts, self.setup.inputs.size)
        self._read(volts)

    def write(self, volts: Volts) -> None:
        """Put ``volts`` out; see Backend."""
        self._ready('write', armed=True)
        check_volts('write', volts, self.setup.outputs.size)
        self._write(volts)

    def reload_watchdog(self) -> bool:
        """Give the watchdog its full time again; see Backend."""
        self._ready('reload_watchdog', armed=True)
        self.expired = not self._reload()
        return not self.expired

    def make_safe(self) -> None:
        """Put the safe volts out, then stop the watchdog; see Backend."""
        self._ready('make_safe')
        self._write(self.setup.safe_volts)
        if self.armed:
            self._stop_watchdog()
            self.armed = False

    def close(self) -> None:
        """Put the safe volts out and let go of the card; see Backend."""
        if not self.configured:
            return
        try:
            self.make_safe()
        except OSError:
            if self.armed and not self.expired:
                # Only the watchdog can bring the safe volts now; who goes may take it along.
                time.sleep(1.5 * self.setup.watchdog_timeout)
        finally:
            self.configured = self.armed = False
            self._let_go()

    def _ready(self, call: str, *, armed: bool = False) -> None:
        """Raise BackendError where ``call`` is out of order."""
        if not self.configured:
            raise BackendError(0, f'{call}: the card is not configured')
        if self.expired:
            raise BackendError(0, f'{call}: the watchdog has expired; configure clears it')
        if armed and not self.armed:
            raise BackendError(0, f'{call}: the card is not armed')

    def _open(self) -> None:
        raise NotImplementedError

    def _start_watchdog(self) -> None:
        raise NotImplementedError

    def _read(self, volts: Volts) -> None:
        raise NotImplementedError

    def _write(self, volts: Volts) -> None:
        raise NotImplementedError

    def _reload(self) -> bool:
        raise NotImplementedError

    def _stop_watchdog(self) -> None:
        raise NotImplementedError

    def _let_go(self) -> None:
        """Close what is open, each step in its own try; raise only what ends the process."""
        raise NotImplementedError


def backend_names() -> list[str]:
    """Return the names of all backends that are registered, in order."""
    return sorted({point.name for point in importlib.metadata.entry_points(group=GROUP)})


def load_backend(name: str) -> Backend:
    """
    Return a new backend, found by its entry point in the group ``fam_bundle.backends``.

    Raises BackendError for a name that nobody registered, with those that exist, and where its
    module cannot be imported. A vendor's package is imported by ``configure``, not here.
    """
    points = {point.name: point for point in importlib.metadata.entry_points(group=GROUP)}
    if name not in points:
        known = ', '.join(sorted(points)) or 'none'
        raise BackendError(0, f'backend {name}: not registered; there are: {known}')
    try:
        return cast(Backend, points[name].load()())
    except (ImportError, OSError, AttributeError) as error:
        raise BackendError(0, f'backend {name}: {points[name].value} ({error})') from error
