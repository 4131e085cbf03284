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

"""Every threshold of the bridge: what it tolerates, for how long, and how it goes safe."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from fam_bundle_model.schema import ConfigurationError, integer, make_group, number, positive


@dataclass(frozen=True)
class Limits:
    """What ends the active state, and what may begin it."""

    command_stale: float = number(
        's', 'an older command ramps to safe', default=0.02, minimum=1e-3, maximum=1.0
    )
    command_lost: float = number(
        's', 'an older command is a fault', default=0.1, minimum=2e-3, maximum=5.0
    )
    ramp_time: float = number(
        's',
        'a stale command goes from one end of the spool to the other in this time',
        default=0.02,
        minimum=0.0,
        maximum=1.0,
        exclusive=True,
    )
    rejected_commands: int = integer(
        'commands in a row that cannot be used and are a fault', 1, 100, default=3
    )
    activation_commands: int = integer(
        'fresh commands in a row that make an armed bridge active', 1, 1000, default=5
    )
    overpressure_ratio: float = number(
        '',
        'highest pressure of a motor unit over the nominal one',
        default=1.05,
        minimum=1.0,
        maximum=2.0,
    )
    overpressure_margin: float = number(
        'Pa', 'highest pressure of a motor unit above the source', default=50e3, minimum=0.0
    )
    overpressure_samples: int = integer(
        'samples in a row beyond one of these that are a fault', 1, 100, default=5
    )
    depressurised: float = number(
        'Pa',
        'every motor unit below it: a fault may be reset',
        default=20e3,
        minimum=0.0,
        maximum=100e3,
        exclusive=True,
    )
    sensor_samples: int = integer(
        'samples that are no measurement, less those that are, and are a fault', 3, 5, default=4
    )
    frozen_samples: int = integer(
        'samples in a row that are equal to the last bit and are a fault; 0 never is',
        0,
        100_000,
        default=500,
    )
    strain_rate: float = positive('1/s', 'faster is a jump, no measurement', default=5.0)
    force_rate: float = positive('N/s', 'faster is a jump, no measurement', default=1e5)
    pressure_rate: float = positive('Pa/s', 'faster is a jump, no measurement', default=1.5e8)
    flow_rate: float = positive('m^3/s^2', 'faster is a jump, no measurement', default=0.15)
    zero_time: float = number(
        's', 'over which zeroing takes the mean', default=1.0, minimum=0.01, maximum=60.0
    )
    zero_strain_deviation: float = positive(
        '', 'largest standard deviation of the strain while zeroing', default=1e-3
    )
    zero_pressure_deviation: float = positive(
        'Pa', 'largest standard deviation of a pressure while zeroing', default=2e3
    )
    zero_strain_shift: float = positive('', 'farthest that zeroing moves strain', default=0.05)
    zero_pressure_shift: float = positive('Pa', 'farthest that it moves a pressure', default=20e3)
    read_timeout: float = number(
        's', 'a sample that takes longer is a fault', default=0.02, minimum=1e-3, maximum=1.0
    )
    watchdog_timeout: float = number(
        's', "time of the card's watchdog", default=0.1, minimum=5e-3, maximum=0.4
    )


def make_limits(values: Mapping[str, Any]) -> Limits:
    """
    Return the limits with ``values`` in place of their defaults.

    Raises ConfigurationError naming the parameter, its value and the bound.
    """
    limits = make_group(Limits, 'limits', values)
    for short, long in (
        ('command_stale', 'command_lost'),
        ('command_stale', 'watchdog_timeout'),
        ('read_timeout', 'watchdog_timeout'),
    ):
        below, above = getattr(limits, short), getattr(limits, long)
        if above <= below:
            raise ConfigurationError(
                f'limits.{long} = {above:g} s: must be > limits.{short} = {below:g} s'
            )
    return limits
