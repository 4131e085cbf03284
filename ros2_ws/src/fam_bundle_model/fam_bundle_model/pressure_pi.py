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
The PI of one motor unit's pressure (Figure 3b, c): the controller's, and the lag table's.

It stands in the model because the recruitment lag is the lag of valve, hose and this law together
(Figure 6).
"""

from typing import NamedTuple

from fam_bundle_model.compile import compiled
from fam_bundle_model.fam import value_of
from fam_bundle_model.parameters import Configuration


class PressureGains(NamedTuple):
    """One unit's gains in 1/Pa and 1/(Pa s), and the largest integral share of its command."""

    proportional: float
    integral: float
    integral_limit: float


def pressure_gains(configuration: Configuration) -> tuple[PressureGains, ...]:
    """Return the gains of each motor unit of ``configuration``."""
    p = configuration.pressure_loop
    given = (p.proportional_gain, p.integral_gain, p.integral_limit)
    units = range(len(configuration.fam.count))
    return tuple(PressureGains(*(value_of(v, i) for v in given)) for i in units)


@compiled
def clamp(value: float, low: float, high: float) -> float:
    """Return ``value`` limited to the range from ``low`` to ``high``."""
    return min(max(value, low), high)


@compiled
def pressure_pi(
    gains: PressureGains, integral: float, reference: float, pressure: float, dt: float
) -> tuple[float, float]:
    """
    Return the next integral share and the spool command before its limit of +-1.

    ``reference`` and ``pressure`` in Pa, ``dt`` in s. An error that would push a saturated spool
    further out is not integrated.
    """
    error = reference - pressure
    spool = gains.proportional * error + integral
    if abs(spool) < 1.0 or spool * error < 0.0:
        limit = gains.integral_limit
        integral = clamp(integral + gains.integral * error * dt, -limit, limit)
    return integral, spool
