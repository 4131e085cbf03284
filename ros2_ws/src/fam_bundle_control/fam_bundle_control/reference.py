# SPDX-License-Identifier: Apache-2.0
"""The strain to be tracked, as a function of time."""

import math

from fam_bundle_model.parameters import ReferenceParameters


def strain_reference(parameters: ReferenceParameters, time: float) -> float:
    """Return the reference strain at ``time`` s: amplitude x (1 - cos(2 pi frequency t))."""
    phase = 2.0 * math.pi * parameters.frequency * time
    return parameters.amplitude * (1.0 - math.cos(phase))
