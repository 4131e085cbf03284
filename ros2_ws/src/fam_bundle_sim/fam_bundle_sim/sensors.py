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
Simulated sensors: seeded noise and finite resolution on top of the true values.

Ours: the paper gives no noise and no resolution.
"""

from collections.abc import Iterator
from typing import NamedTuple

from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import SensorParameters
from fam_bundle_sim.plant import Truth
import numpy as np
import numpy.typing as npt

CHANNELS = 4  # strain, force, source pressure, source flow; then one pressure per unit
_BLOCK = 1000


class Sensors(NamedTuple):
    """Standard deviation and resolution per channel, shape (4 + units,)."""

    noise: npt.NDArray[np.float64]
    resolution: npt.NDArray[np.float64]


def sensors(parameters: SensorParameters, units: int) -> Sensors:
    """Return the sensors of ``parameters`` for a bundle of ``units`` motor units."""
    p = parameters
    return Sensors(
        np.array(
            [p.strain_noise, p.force_noise, p.pressure_noise, p.flow_noise]
            + [p.pressure_noise] * units
        ),
        np.array(
            [p.strain_resolution, p.force_resolution, p.pressure_resolution, p.flow_resolution]
            + [p.pressure_resolution] * units
        ),
    )


def noise_samples(parameters: SensorParameters, units: int) -> Iterator[npt.NDArray[np.float64]]:
    """Yield one standard normal sample per channel and tick, the same for the same seed."""
    generator = np.random.default_rng(parameters.seed)
    while True:
        yield from generator.standard_normal((_BLOCK, CHANNELS + units))


@compiled
def _reading(law: Sensors, channel: int, value: float, sample: npt.NDArray[np.float64]) -> float:
    value += law.noise[channel] * sample[channel]
    step = law.resolution[channel]
    return np.rint(value / step) * step if step > 0.0 else value


@compiled
def measure(
    law: Sensors,
    true: Truth,
    sample: npt.NDArray[np.float64],
    mu_pressure: npt.NDArray[np.float64],
) -> Truth:
    """
    Return what the sensors read for ``true``, and turn ``mu_pressure`` (units,) Pa into readings.

    ``sample`` is one standard normal value per channel.
    """
    for i in range(mu_pressure.shape[0]):
        mu_pressure[i] = _reading(law, CHANNELS + i, mu_pressure[i], sample)
    return Truth(
        _reading(law, 0, true.strain, sample),
        _reading(law, 1, true.force, sample),
        _reading(law, 2, true.source_pressure, sample),
        _reading(law, 3, true.source_flow, sample),
    )
