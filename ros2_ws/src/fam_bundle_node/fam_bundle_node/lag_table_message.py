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

"""The lag table to and from its message; both are plain rows of doubles."""

from fam_bundle_model.lag_table import LagTable
from fam_bundle_msgs.msg import LagTable as LagTableMessage
from fam_bundle_msgs.msg import MotorUnitLag
import numpy as np


def to_message(table: LagTable, parameters_hash: str) -> LagTableMessage:
    """Return the message of ``table``; the header's stamp is left to the caller."""
    return LagTableMessage(
        parameters_hash=parameters_hash,
        source_pressure=table.source_pressure.tolist(),
        deslack_pressure=table.deslack_pressure.tolist(),
        units=[
            MotorUnitLag(
                recruitment_lag=lag.ravel().tolist(), source_pressure_drop=drop.ravel().tolist()
            )
            for lag, drop in zip(table.lag, table.drop, strict=True)
        ],
    )


def from_message(message: LagTableMessage) -> LagTable:
    """Return the table in ``message``; raises ValueError when its parts do not fit together."""
    shape = (len(message.units), len(message.source_pressure), len(message.deslack_pressure))
    return LagTable(
        np.array(message.source_pressure),
        np.array(message.deslack_pressure),
        np.array([unit.recruitment_lag for unit in message.units]).reshape(shape),
        np.array([unit.source_pressure_drop for unit in message.units]).reshape(shape),
    )
