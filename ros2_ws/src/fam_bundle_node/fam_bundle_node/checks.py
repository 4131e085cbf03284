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

"""What a message of the loop must hold before anything uses it. Pure Python."""

from collections.abc import Callable, Iterable
import math
from typing import Any

from fam_bundle_node.ticks import TickError


def check_finite(topic: str, tick: int, values: Iterable[float]) -> None:
    """Raise TickError when one of ``values`` is not a finite number."""
    for value in values:
        if not math.isfinite(value):
            raise TickError(f'{topic}: tick {tick} holds {value}; every value must be finite')


def check_length(topic: str, tick: int, values: Iterable[float], units: int) -> None:
    """Raise TickError unless there is one of ``values`` for each motor unit."""
    count = len(tuple(values))
    if count != units:
        raise TickError(f'{topic}: tick {tick} holds {count} values for {units} motor units')


def _bundle_state(message: Any, units: int) -> None:
    check_length('bundle_state', message.tick, message.mu_pressure, units)
    measured = (message.strain, message.force, message.source_pressure, *message.mu_pressure)
    check_finite('bundle_state', message.tick, measured)


def _pressure_reference(message: Any, units: int) -> None:
    check_finite('pressure_reference', message.tick, (message.pressure,))


def _recruitment_state(message: Any, units: int) -> None:
    if not 1 <= message.recruited <= units:
        raise TickError(
            f'recruitment_state: tick {message.tick} holds {message.recruited} recruited; '
            f'must be from 1 to {units}'
        )
    check_finite('recruitment_state', message.tick, (message.pressure_compensation,))


def _valve_command(message: Any, units: int) -> None:
    check_length('valve_command', message.tick, message.spool, units)
    check_finite('valve_command', message.tick, message.spool)


# By topic: raises TickError when the message holds what cannot be.
CHECKS: dict[str, Callable[[Any, int], None]] = {
    'bundle_state': _bundle_state,
    'pressure_reference': _pressure_reference,
    'recruitment_state': _recruitment_state,
    'valve_command': _valve_command,
}
