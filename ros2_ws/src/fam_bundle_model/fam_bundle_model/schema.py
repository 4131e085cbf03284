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
How a parameter is declared: type, unit, range and one sentence, stated once.

A group is a frozen dataclass whose fields are made by ``number``, ``integer``, ``choice``,
``flag``, ``word``, ``per_unit`` or ``series``. Validation, the YAML loader, ROS parameter
descriptors and the reference page all read the same declaration.
"""

from collections.abc import Mapping
import dataclasses
import difflib
import math
from typing import Any, TypeVar

Group = TypeVar('Group')


class ConfigurationError(ValueError):
    """A configuration that cannot be used; the message names parameter, value and bound."""


@dataclasses.dataclass(frozen=True)
class Declaration:
    """
    What is known of one parameter besides its value.

    ``unit`` is an SI unit or empty; ``minimum`` and ``maximum`` bound the value, and
    ``exclusive`` says that the minimum itself is not allowed. ``kind`` is ``float``, ``int``,
    ``bool`` or ``str``; ``array`` marks one value per motor unit (a single value serves all), or
    with ``series`` a row of its own length. ``live`` says that it may
    change while its loop runs.
    """

    kind: type
    unit: str
    text: str
    minimum: float = -math.inf
    maximum: float = math.inf
    exclusive: bool = False
    choices: tuple[str, ...] = ()
    array: bool = False
    series: bool = False
    live: bool = False

    def is_free_text(self) -> bool:
        """Return whether any text will do that is not blank."""
        return self.kind is str and not self.choices

    def bound(self) -> str:
        """Return the allowed range in words."""
        if self.choices:
            return 'must be one of ' + ', '.join(self.choices)
        if self.kind is bool:
            return 'must be true or false'
        if self.kind is str:
            return 'must be text that is not blank'
        bounds = []
        if self.minimum > -math.inf:
            bounds.append(f'{">" if self.exclusive else ">="} {self._plain(self.minimum)}')
        if self.maximum < math.inf:
            bounds.append(f'<= {self._plain(self.maximum)}')
        return 'must be ' + (' and '.join(bounds) if bounds else 'a finite number')

    def _plain(self, bound: float) -> str:
        return str(int(bound)) if self.kind is int else f'{bound:g}'

    def convert(self, name: str, value: Any) -> Any:
        """Return ``value`` as the declared type, or raise ConfigurationError."""
        if not self.array:
            return self._convert_one(name, value)
        values = value if isinstance(value, list | tuple) else [value]
        if len(values) == 0:
            wanted = 'at least one value' if self.series else 'a value for each motor unit'
            raise ConfigurationError(f'{name} = []: must hold {wanted}')
        names = [name] if len(values) == 1 else [f'{name}[{i}]' for i in range(len(values))]
        return tuple(self._convert_one(n, v) for n, v in zip(names, values, strict=True))

    def _convert_one(self, name: str, value: Any) -> Any:
        unit = f' {self.unit}' if self.unit else ''
        refused = ConfigurationError(f'{name} = {value}{unit}: {self.bound()}')
        if self.choices:
            if value not in self.choices:
                raise refused
            return value
        if self.kind is bool:
            if not isinstance(value, bool):
                raise refused
            return value
        if self.kind is str:
            if not isinstance(value, str) or not value.strip():
                raise refused
            return value
        try:
            # YAML 1.1 reads 4.9e7 as text, so text that is a number counts as one. To float()
            # 1_0 is ten; in a file it is rather a mistake.
            number = math.nan if isinstance(value, bool) or '_' in str(value) else float(value)
        except (TypeError, ValueError, OverflowError):
            raise refused from None
        below = number <= self.minimum if self.exclusive else number < self.minimum
        if not math.isfinite(number) or below or number > self.maximum:
            raise refused
        if self.kind is int and not number.is_integer():
            raise ConfigurationError(f'{name} = {value}: must be a whole number')
        return self.kind(number)


def _field(declaration: Declaration, default: Any) -> Any:
    metadata = {'declaration': declaration}
    if default is None:
        return dataclasses.field(metadata=metadata)
    return dataclasses.field(default=default, metadata=metadata)


def number(unit: str, text: str, *, default: float | None = None, **bounds: Any) -> Any:
    """Declare a float in ``unit``; ``bounds`` are as in Declaration, ``live`` too."""
    return _field(Declaration(float, unit, text, **bounds), default)


def positive(unit: str, text: str, *, default: float | None = None, live: bool = False) -> Any:
    """Declare a float that must be greater than zero."""
    return number(unit, text, default=default, minimum=0.0, exclusive=True, live=live)


def integer(text: str, minimum: int, maximum: int, *, default: int | None = None) -> Any:
    """Declare a whole number from ``minimum`` to ``maximum``."""
    return _field(Declaration(int, '', text, minimum, maximum), default)


def choice(text: str, choices: tuple[str, ...], *, default: str | None = None) -> Any:
    """Declare one word out of ``choices``."""
    return _field(Declaration(str, '', text, choices=choices), default)


def word(text: str, *, default: str | None = None) -> Any:
    """Declare free text that is not blank."""
    return _field(Declaration(str, '', text), default)


def flag(text: str, *, default: bool) -> Any:
    """Declare true or false."""
    return _field(Declaration(bool, '', text), default)


def per_unit(kind: type, unit: str, text: str, **bounds: Any) -> Any:
    """Declare one value for each motor unit, or a single one for all."""
    return _field(Declaration(kind, unit, text, array=True, **bounds), None)


def series(unit: str, text: str, *, default: tuple[float, ...], **bounds: Any) -> Any:
    """Declare a row of one or more floats in ``unit``."""
    declaration = Declaration(float, unit, text, array=True, series=True, **bounds)
    return _field(declaration, default)


def declarations(group: type) -> dict[str, Declaration]:
    """Return the declaration of each parameter of a group, by field name."""
    return {f.name: f.metadata['declaration'] for f in dataclasses.fields(group)}


def required(group: type) -> set[str]:
    """Return the names of the parameters of a group that have no default."""
    fields = dataclasses.fields(group)
    return {f.name for f in fields if f.default is dataclasses.MISSING}


def make_group(group: type[Group], name: str, values: Mapping[str, Any]) -> Group:
    """
    Return ``group`` filled with validated ``values``.

    Raises ConfigurationError for an unknown or missing parameter, or a value out of its range.
    """
    known = declarations(group)
    for key in values:
        if key not in known:
            raise ConfigurationError(unknown(f'{name}.{key}', [f'{name}.{k}' for k in known]))
    for key in known:
        if key in required(group) and key not in values:
            unit = f' (unit {known[key].unit})' if known[key].unit else ''
            raise ConfigurationError(f'{name}.{key}: missing; {known[key].bound()}{unit}')
    converted = {k: known[k].convert(f'{name}.{k}', v) for k, v in values.items()}
    return group(**converted)


def unknown(name: str, known: list[str]) -> str:
    """Return the message for a name that does not exist, with the nearest that does."""
    near = difflib.get_close_matches(name, known, n=1)
    return f'{name}: no such parameter' + (f'; did you mean {near[0]}?' if near else '')
