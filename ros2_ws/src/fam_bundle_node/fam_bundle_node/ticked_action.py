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

"""An action whose goals are executed from tick to tick."""

from collections.abc import Callable
from typing import Any

from rclpy.action import ActionServer
from rclpy.action.server import ServerGoalHandle
from rclpy.node import Node


class TickedAction(ActionServer):
    """
    An action server whose node itself executes a goal, in the callbacks of the loop.

    As a task that waits for its end a goal would be polled between all callbacks: rclpy has no
    other way to wait, and it would hold the loop up.
    """

    def __init__(self, node: Node, action_type: type, name: str, **callbacks: Any) -> None:
        """Serve ``name``; ``callbacks`` are those of an action server but the one to execute."""
        # That one is never called: end() brings its own.
        super().__init__(node, action_type, name, self.notify_execute, **callbacks)

    def notify_execute(self, goal_handle: ServerGoalHandle, execute_callback: Any) -> None:
        """Leave a goal that is to be executed to the node."""

    def end(
        self, goal_handle: ServerGoalHandle, conclude: Callable[[ServerGoalHandle], Any]
    ) -> None:
        """Have a goal's end state set by ``conclude``, which returns the result."""
        super().notify_execute(goal_handle, conclude)
