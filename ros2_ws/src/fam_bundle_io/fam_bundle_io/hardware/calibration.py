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
What volts mean: the calibration of every sensor and valve, its file, and the scaling.

A sensor reads ``gain (volts - offset)``. A valve's spool s is put out as ``null +- span |s|``
beyond its dead band, with the sign that the wiring asks for. SI units and volts throughout.
"""

from collections.abc import Mapping
import dataclasses
from dataclasses import dataclass
import hashlib
import json
from pathlib import Path
from typing import Any, TypeVar

from fam_bundle_io.hardware.limits import Limits, make_limits
from fam_bundle_model.files import whole_file
from fam_bundle_model.hydraulics import TO_TANK
from fam_bundle_model.schema import (
    choice,
    ConfigurationError,
    integer,
    make_group,
    number,
    positive,
    unknown,
    word,
)
import numpy as np
import numpy.typing as npt

Volts = npt.NDArray[np.float64]
Values = npt.NDArray[np.float64]
Group = TypeVar('Group')

# Order of the inputs; then the pressure of each motor unit.
STRAIN, FORCE, SOURCE_PRESSURE, SOURCE_FLOW, MU_PRESSURE = range(5)
# Unit of each quantity that is measured once, in that order.
QUANTITIES = {'strain': '', 'force': 'N', 'source_pressure': 'Pa', 'source_flow': 'm^3/s'}
# An open wire reads 0 V, which a sensor of these types never does.
LIVE_ZERO = ('ratiometric', 'current_loop')
TYPES = (*LIVE_ZERO, 'bipolar', 'frequency')


@dataclass(frozen=True, kw_only=True)
class _Sensor:
    """What every sensor has."""

    type: str = choice('kind of signal; the first two have a live zero', TYPES)  # noqa: A003
    channel: int = integer('number of the analogue input on the card', 0, 255)
    minimum_volts: float = number('V', 'range of the input', minimum=-100.0, maximum=100.0)
    maximum_volts: float = number('V', 'range of the input', minimum=-100.0, maximum=100.0)
    live_minimum: float = number('V', 'lower is no measurement', minimum=-100.0, maximum=100.0)
    live_maximum: float = number('V', 'higher is no measurement', minimum=-100.0, maximum=100.0)
    offset: float = number('V', 'what it gives at zero', minimum=-100.0, maximum=100.0)
    unit: str = choice('unit of what is measured; none for strain', ('', 'N', 'Pa', 'm^3/s'))
    calibration_id: str = word('certificate or record of the calibration')


@dataclass(frozen=True, kw_only=True)
class SensorCalibration(_Sensor):
    """One sensor: value = gain x (volts - offset)."""

    gain: float = number('SI/V', 'value per volt; negative where the signal falls')
    zero_value: float = number(
        'unit',
        'true value while every motor unit is vented: what zeroing makes of it',
        default=0.0,
    )

    def slope(self) -> float:
        """Return the value per volt."""
        return self.gain


@dataclass(frozen=True, kw_only=True)
class FlowCalibration(_Sensor):
    """
    A flow meter that gives pulses, behind a frequency-to-voltage converter.

    Its frequency in Hz is ``pulses_per_litre`` times the flow in L/s.
    """

    pulses_per_litre: float = positive('1/L', "K of this very meter's certificate")
    hertz_per_volt: float = positive('Hz/V', 'of the frequency-to-voltage converter')

    def slope(self) -> float:
        """Return the flow in m^3/s per volt."""
        return self.hertz_per_volt / (1000.0 * self.pulses_per_litre)


@dataclass(frozen=True, kw_only=True)
class ValveCalibration:
    """One servo valve, behind an amplifier that drives its coil by the voltage of an output."""

    channel: int = integer('number of the analogue output on the card', 0, 255)
    minimum_volts: float = number('V', 'range of the output', minimum=-100.0, maximum=100.0)
    maximum_volts: float = number('V', 'range of the output', minimum=-100.0, maximum=100.0)
    full_scale_volts: float = positive('V', 'full spool, counted from null_volts')
    null_volts: float = number('V', 'spool in the middle', minimum=-10.0, maximum=10.0)
    sign: str = choice('which volts open the unit to the source', ('positive', 'negative'))
    dead_band: float = number(
        'V', 'skipped on each side of null_volts', default=0.0, minimum=0.0, maximum=10.0
    )
    slew_limit: float = positive('1/s', 'fastest change of the commanded spool')
    calibration_id: str = word('certificate or record of the calibration')

    def direction(self) -> float:
        """Return 1 or -1."""
        return 1.0 if self.sign == 'positive' else -1.0


Sensor = SensorCalibration | FlowCalibration


@dataclass(frozen=True, kw_only=True)
class Calibration:
    """All channels of a rig; one pressure and one valve for each motor unit."""

    id: str  # noqa: A003
    strain: SensorCalibration
    force: SensorCalibration
    source_pressure: SensorCalibration
    source_flow: Sensor
    mu_pressure: tuple[SensorCalibration, ...]
    valves: tuple[ValveCalibration, ...]

    def sensors(self) -> tuple[Sensor, ...]:
        """Return all sensors in the order of the inputs: see STRAIN to MU_PRESSURE."""
        single = (self.strain, self.force, self.source_pressure, self.source_flow)
        return (*single, *self.mu_pressure)

    def names(self) -> tuple[str, ...]:
        """Return the names of all sensors in the order of the inputs."""
        return (*QUANTITIES, *(f'mu_pressure[{i}]' for i in range(len(self.mu_pressure))))

    def hash(self) -> str:  # noqa: A003
        """Return a SHA-256 over all values: the same for the same numbers, however written."""
        values = dataclasses.asdict(self)
        return hashlib.sha256(json.dumps(values, sort_keys=True).encode()).hexdigest()


class Scaling:
    """
    Turns volts into SI values and spools into volts, and back, without new arrays.

    Volts to a value and back differ by at most ``2 u (2 |volts - offset| + |volts|)``, u = 2^-53:
    three roundings on the difference, and one on the result. ``safe_volts`` (valves,) command
    every spool fully to the tank.
    """

    def __init__(self, calibration: Calibration) -> None:
        """Take the numbers of ``calibration``."""
        sensors, valves = calibration.sensors(), calibration.valves
        self.offset = np.array([s.offset for s in sensors])
        self.gain = np.array([s.slope() for s in sensors])
        self.null = np.array([v.null_volts for v in valves])
        self.dead = np.array([v.direction() * v.dead_band for v in valves])
        self.span = np.array([v.direction() * (v.full_scale_volts - v.dead_band) for v in valves])
        self._dead_width = np.abs(self.dead)
        self._side = np.empty(len(valves))
        self._inside = np.empty(len(valves), dtype=np.bool_)
        self.safe_volts = np.empty(len(valves))
        self.to_valve_volts(np.full(len(valves), TO_TANK), self.safe_volts)

    def to_values(self, volts: Volts, values: Values) -> None:
        """Fill ``values`` with what sensors at ``volts`` measure; both (4 + units,)."""
        np.subtract(volts, self.offset, out=values)
        np.multiply(values, self.gain, out=values)

    def to_volts(self, values: Values, volts: Volts) -> None:
        """Fill ``volts`` with what the sensors give at ``values``; both (4 + units,)."""
        np.divide(values, self.gain, out=volts)
        np.add(volts, self.offset, out=volts)

    def to_valve_volts(self, spool: Values, volts: Volts) -> None:
        """Fill ``volts`` with the commands of ``spool`` within -1 to 1; both (units,)."""
        np.sign(spool, out=self._side)
        np.multiply(spool, self.span, out=volts)
        np.multiply(self._side, self.dead, out=self._side)
        np.add(volts, self._side, out=volts)
        np.add(volts, self.null, out=volts)

    def to_spool(self, volts: Volts, spool: Values) -> None:
        """Fill ``spool`` with what ``volts`` command, 0 within the dead band; both (units,)."""
        np.subtract(volts, self.null, out=spool)
        np.abs(spool, out=self._side)
        np.less_equal(self._side, self._dead_width, out=self._inside)
        np.copysign(self.dead, spool, out=self._side)
        np.subtract(spool, self._side, out=spool)
        np.copyto(spool, 0.0, where=self._inside)
        np.divide(spool, self.span, out=spool)


def zeroed(calibration: Calibration, volts: Mapping[int, float]) -> Calibration:
    """
    Return ``calibration`` with offsets by which the inputs in ``volts`` read their zero value.

    ``volts`` holds the mean in V of each input that was measured while every unit was vented.
    """

    def moved(index: int, sensor: SensorCalibration) -> SensorCalibration:
        if index not in volts:
            return sensor
        offset = volts[index] - sensor.zero_value / sensor.gain
        return dataclasses.replace(sensor, offset=offset)

    return dataclasses.replace(
        calibration,
        strain=moved(STRAIN, calibration.strain),
        source_pressure=moved(SOURCE_PRESSURE, calibration.source_pressure),
        mu_pressure=tuple(
            moved(MU_PRESSURE + i, sensor) for i, sensor in enumerate(calibration.mu_pressure)
        ),
    )


# ---- The file ----


@dataclass(frozen=True)
class HardwareFile:
    """A rig: its calibration, its limits, and by backend the options of its card."""

    calibration: Calibration
    limits: Limits
    options: dict[str, dict[str, Any]]


def make_calibration(values: Mapping[str, Any]) -> Calibration:
    """
    Return the calibration of ``values``: ``id``, ``sensors`` and ``valves``.

    Raises ConfigurationError naming the parameter, its value and the bound.
    """
    sensors = _mapping('sensors', values.get('sensors'))
    for key in sensors:
        if key not in (*QUANTITIES, 'mu_pressure'):
            known = [f'sensors.{name}' for name in (*QUANTITIES, 'mu_pressure')]
            raise ConfigurationError(unknown(f'sensors.{key}', known))
    flow = _mapping('sensors.source_flow', sensors.get('source_flow'))
    flow_kind: type[Sensor] = (
        FlowCalibration if flow.get('type') == 'frequency' else SensorCalibration
    )
    single = {
        name: _sensor(SensorCalibration, f'sensors.{name}', sensors.get(name), QUANTITIES[name])
        for name in ('strain', 'force', 'source_pressure')
    }
    pressures = _list('sensors.mu_pressure', sensors.get('mu_pressure'))
    valves = _list('valves', values.get('valves'))
    calibration = Calibration(
        id=_id(values),
        **single,
        source_flow=_sensor(flow_kind, 'sensors.source_flow', flow, QUANTITIES['source_flow']),
        mu_pressure=tuple(
            _sensor(SensorCalibration, f'sensors.mu_pressure[{i}]', given, 'Pa')
            for i, given in enumerate(pressures)
        ),
        valves=tuple(_valve(f'valves[{i}]', given) for i, given in enumerate(valves)),
    )
    _check_channels(calibration)
    return calibration


def _id(values: Mapping[str, Any]) -> str:
    name = values.get('id')
    if not isinstance(name, str) or not name.strip():
        raise ConfigurationError(f'id = {name}: must be text that is not blank')
    return name


def _mapping(name: str, given: Any) -> Mapping[str, Any]:
    if not isinstance(given, Mapping):
        raise ConfigurationError(f'{name} = {given}: must be a group of parameters')
    return given


def _list(name: str, given: Any) -> list[Any]:
    if not isinstance(given, list) or not given:
        raise ConfigurationError(f'{name} = {given}: must hold one group for each motor unit')
    return given


def _sensor(kind: type[Group], name: str, given: Any, unit: str) -> Group:
    sensor: Any = make_group(kind, name, _mapping(name, given))
    if sensor.unit != unit:
        raise ConfigurationError(f'{name}.unit = {sensor.unit}: must be {unit or "empty"}')
    if sensor.type == 'frequency' and kind is not FlowCalibration:
        raise ConfigurationError(f'{name}.type = frequency: only the flow meter gives pulses')
    if sensor.slope() == 0.0:
        raise ConfigurationError(f'{name}.gain = 0 {unit}/V: must not be 0')
    _ordered(name, sensor, 'minimum_volts', 'live_minimum', strictly=False)
    _ordered(name, sensor, 'live_minimum', 'live_maximum', strictly=True)
    _ordered(name, sensor, 'live_maximum', 'maximum_volts', strictly=False)
    if sensor.type in LIVE_ZERO and sensor.live_minimum <= 0.0:
        raise ConfigurationError(
            f'{name}.live_minimum = {sensor.live_minimum:g} V: must be > 0, for an open wire '
            f'reads 0 V and {sensor.type} has a live zero'
        )
    checked: Group = sensor
    return checked


def _ordered(name: str, group: Any, low: str, high: str, *, strictly: bool) -> None:
    below, above = getattr(group, low), getattr(group, high)
    if above < below or (strictly and above == below):
        sign = '>' if strictly else '>='
        raise ConfigurationError(
            f'{name}.{high} = {above:g} V: must be {sign} {name}.{low} = {below:g} V'
        )


def _valve(name: str, given: Any) -> ValveCalibration:
    valve = make_group(ValveCalibration, name, _mapping(name, given))
    if valve.dead_band >= valve.full_scale_volts:
        raise ConfigurationError(
            f'{name}.dead_band = {valve.dead_band:g} V: must be < {name}.full_scale_volts = '
            f'{valve.full_scale_volts:g} V'
        )
    room = min(valve.maximum_volts - valve.null_volts, valve.null_volts - valve.minimum_volts)
    if valve.full_scale_volts > room:
        raise ConfigurationError(
            f'{name}.full_scale_volts = {valve.full_scale_volts:g} V: must be <= {room:g} V, what '
            f'its output can give on both sides of null_volts = {valve.null_volts:g} V'
        )
    return valve


def _check_channels(calibration: Calibration) -> None:
    """Raise ConfigurationError where two share a channel or a unit lacks its sensor or valve."""
    units, valves = len(calibration.mu_pressure), len(calibration.valves)
    if units != valves:
        raise ConfigurationError(
            f'valves: {valves} for {units} sensors.mu_pressure; must be equal'
        )
    inputs = {
        f'sensors.{name}': sensor.channel
        for name, sensor in zip(calibration.names(), calibration.sensors(), strict=True)
    }
    outputs = {f'valves[{i}]': valve.channel for i, valve in enumerate(calibration.valves)}
    for channels in (inputs, outputs):
        owner: dict[int, str] = {}
        for name, channel in channels.items():
            if channel in owner:
                raise ConfigurationError(
                    f'{name}.channel = {channel}: is taken by {owner[channel]} already'
                )
            owner[channel] = name


def load_hardware(path: Path) -> HardwareFile:
    """
    Return the rig in the YAML file ``path``.

    Its groups are ``id``, ``sensors``, ``valves``, ``limits`` (may be left out) and ``backends``
    (options by backend, may be left out). Raises ConfigurationError with a message that starts
    with the path.
    """
    import yaml

    try:
        content = yaml.safe_load(Path(path).read_text(encoding='utf-8'))
    except OSError as error:
        raise ConfigurationError(f'{path}: cannot be read ({error.strerror})') from None
    except (yaml.YAMLError, UnicodeDecodeError) as error:
        raise ConfigurationError(f'{path}: not YAML ({" ".join(str(error).split())})') from None
    try:
        return _make_hardware(_mapping('file', content))
    except ConfigurationError as error:
        raise ConfigurationError(f'{path}: {error}') from None


def _make_hardware(content: Mapping[str, Any]) -> HardwareFile:
    known = ['id', 'sensors', 'valves', 'limits', 'backends']
    for key in content:
        if key not in known:
            raise ConfigurationError(unknown(str(key), known))
    backends = _mapping('backends', content.get('backends', {}))
    return HardwareFile(
        make_calibration(content),
        make_limits(_mapping('limits', content.get('limits', {}))),
        {str(k): dict(_mapping(f'backends.{k}', v)) for k, v in backends.items()},
    )


def write_hardware(hardware: HardwareFile, path: Path) -> None:
    """
    Write a rig so that ``load_hardware`` gives the same one; whole or not at all.

    Comments of the file that it came from are lost.
    """
    with whole_file(path) as file:
        file.write(hardware_text(hardware).encode())


def hardware_text(hardware: HardwareFile) -> str:
    """Return a rig as YAML."""
    import yaml

    calibration = hardware.calibration
    single = {name: dataclasses.asdict(getattr(calibration, name)) for name in QUANTITIES}
    pressures = [dataclasses.asdict(sensor) for sensor in calibration.mu_pressure]
    content = {
        'id': calibration.id,
        'sensors': {**single, 'mu_pressure': pressures},
        'valves': [dataclasses.asdict(valve) for valve in calibration.valves],
        'limits': dataclasses.asdict(hardware.limits),
        'backends': hardware.options,
    }
    return str(yaml.safe_dump(content, sort_keys=False))
