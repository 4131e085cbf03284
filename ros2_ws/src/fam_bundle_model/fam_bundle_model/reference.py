# SPDX-License-Identifier: Apache-2.0
"""The strain to be tracked, as a function of time."""

import math
from typing import NamedTuple

from fam_bundle_model.compile import compiled
from fam_bundle_model.parameters import ReferenceParameters


class Reference(NamedTuple):
    """The trajectory: half of the peak strain, and its frequency in Hz."""

    amplitude: float
    frequency: float


def reference_law(parameters: ReferenceParameters) -> Reference:
    """Return the trajectory of ``parameters``."""
    return Reference(parameters.amplitude, parameters.frequency)


@compiled
def strain_reference(law: Reference, time: float) -> float:
    """Return the reference strain at ``time`` s: amplitude x (1 - cos(2 pi frequency t))."""
    phase = 2.0 * math.pi * law.frequency * time
    return law.amplitude * (1.0 - math.cos(phase))
