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

"""The trajectory to and from its message, to the bit."""

from fam_bundle_model.reference import ORDER, Reference
from fam_bundle_msgs.msg import Reference as ReferenceMessage
import numpy as np


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
    """
    Return the trajectory in ``message``.

    Raises ValueError when its parts do not fit, or where it has no strain at some time.
    """
    breaks = np.array(message.breaks, np.float64)
    if breaks.size == 0:
        raise ValueError('it has no polynomial')
    law = Reference(
        float(message.start),
        float(message.end),
        float(message.cycle),
        np.array(message.sines, np.float64).reshape(-1, 3),
        breaks,
        np.array(message.coefficients, np.float64).reshape(breaks.size, ORDER),
    )
    if not all(np.isfinite(part).all() for part in law._replace(cycle=0.0)):
        raise ValueError('a number is not finite')
    if not law.cycle > 0.0:
        raise ValueError(f'cycle = {law.cycle:g} s: must be > 0')
    return law
