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

"""A timer that no step of the system clock can hold up."""

from collections.abc import Callable
import threading

from rclpy.node import Node

ENOUGH = 1.0  # s for waking an executor


class SteadyTimer:
    """
    Calls back in the executor of a node, woken by a thread of its own.

    The executor's own timers wait on the system clock where it was built with an old C library,
    whatever clock they are of: one that is set back by an hour silences them for that hour.
    """

    def __init__(
        self,
        node: Node,
        period: float,
        callback: Callable[[], None],
        failed: Callable[[Exception], None],
    ) -> None:
        """
        Call ``callback`` every ``period`` s while the node has an executor.

        ``failed`` gets what it raises, which the executor would keep to itself.
        """
        self._node, self._period = node, period
        self._callback, self._failed = callback, failed
        self._ended = threading.Event()
        self._thread = threading.Thread(target=self._run, name='timer', daemon=True)
        self._thread.start()

    def _run(self) -> None:
        while not self._ended.wait(self._period):
            executor = self._node.executor
            if executor is not None:
                executor.create_task(self._call)

    def _call(self) -> None:
        if self._ended.is_set():  # after it was woken
            return
        try:
            self._callback()
        except Exception as error:
            self.cancel()
            self._failed(error)

    def cancel(self) -> None:
        """Call no more; nothing of it runs on, in rclpy least of all, while Python ends."""
        self._ended.set()
        if threading.current_thread() is not self._thread:
            self._thread.join(ENOUGH)
