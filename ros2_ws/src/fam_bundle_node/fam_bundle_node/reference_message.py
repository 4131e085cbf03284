# SPDX-License-Identifier: Apache-2.0
"""The trajectory to and from its message, to the bit."""

import numpy as np

from fam_bundle_model.reference import ORDER, Reference
from fam_bundle_msgs.msg import Reference as ReferenceMessage


def to_message(law: Reference, kind: str) -> ReferenceMessage:
    """Return the message of ``law``; the header's stamp is left to the caller."""
    return ReferenceMessage(
        kind=kind,
        start=law.start,
        end=law.end,
        cycle=law.cycle,
        sines=law.sines.ravel().tolist(),
        breaks=law.breaks.tolist(),
        coefficients=law.coefficients.ravel().tolist(),
    )


def from_message(message: ReferenceMessage) -> Reference:
    """Return the trajectory in ``message``; raises ValueError when its parts do not fit."""
    breaks = np.array(message.breaks, np.float64)
    if breaks.size == 0:
        raise ValueError('it has no polynomial')
    return Reference(
        float(message.start),
        float(message.end),
        float(message.cycle),
        np.array(message.sines, np.float64).reshape(-1, 3),
        breaks,
        np.array(message.coefficients, np.float64).reshape(breaks.size, ORDER),
    )
