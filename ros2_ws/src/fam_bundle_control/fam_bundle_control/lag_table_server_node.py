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

"""ROS node that builds, keeps and serves the lag table: a latched topic and three services."""

import dataclasses
import sys
import time
from typing import Any

from fam_bundle_model.lag_table import (
    build_lag_table,
    cached_lag_table,
    lag_table_hash,
    look_up,
    PHYSICS,
)
from fam_bundle_model.parameters import LagTableParameters
from fam_bundle_model.schema import ConfigurationError, make_group
from fam_bundle_msgs.msg import LagTable as LagTableMessage
from fam_bundle_msgs.srv import GetLagTable, QueryLag, RebuildLagTable
from fam_bundle_node.lag_table_message import to_message
from fam_bundle_node.loop_node import LoopNode
from fam_bundle_node.qos import LATCHED
from fam_bundle_node.run import run_node


class LagTableServer(LoopNode):
    """Publishes the table once; no service stands in the 1 kHz path."""

    def __init__(self) -> None:
        """Build the table, or take it from the disk, and publish it."""
        super().__init__('lag_table_server', (*PHYSICS, 'lag_table'))
        self.publisher = self.create_publisher(LagTableMessage, 'lag_table', LATCHED)
        self.table = cached_lag_table(self.configuration)
        self.publisher.publish(self.message())
        self.create_service(QueryLag, '~/query_lag', self.on_query)
        self.create_service(GetLagTable, '~/get_lag_table', self.on_get)
        self.create_service(RebuildLagTable, '~/rebuild_lag_table', self.on_rebuild)

    def message(self) -> LagTableMessage:
        """Return the table as a message."""
        message = to_message(self.table, lag_table_hash(self.configuration))
        message.header.stamp = self.get_clock().now().to_msg()
        return message

    def on_query(
        self, request: QueryLag.Request, response: QueryLag.Response
    ) -> QueryLag.Response:
        """Look one lag up."""
        units = len(self.configuration.fam.count)
        if request.motor_unit >= units:
            response.message = f'motor_unit = {request.motor_unit}: must be < {units}'
            return response
        found = look_up(
            self.table, request.motor_unit, request.source_pressure, request.deslack_pressure
        )
        response.success = True
        response.recruitment_lag = found.lag
        response.source_pressure_drop = found.drop
        response.outside_table = found.outside
        return response

    def on_get(self, _: Any, response: GetLagTable.Response) -> GetLagTable.Response:
        """Return the whole table."""
        response.table = self.message()
        return response

    def on_rebuild(
        self, request: RebuildLagTable.Request, response: RebuildLagTable.Response
    ) -> RebuildLagTable.Response:
        """Build the table on another grid and publish it; a bad grid changes nothing."""
        start = time.monotonic()
        try:
            grid = make_group(
                LagTableParameters,
                'lag_table',
                {
                    **dataclasses.asdict(self.configuration.lag_table),
                    'source_points': request.source_points,
                    'deslack_points': request.deslack_points,
                },
            )
        except ConfigurationError as error:
            response.message = str(error)
            return response
        self.table = build_lag_table(dataclasses.replace(self.configuration, lag_table=grid))
        self.publisher.publish(self.message())
        response.success = True
        response.seconds = time.monotonic() - start
        return response


def main() -> None:
    """Run the node."""
    sys.exit(run_node(LagTableServer))
