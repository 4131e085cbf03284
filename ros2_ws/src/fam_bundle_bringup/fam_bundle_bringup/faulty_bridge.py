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

"""The hardware bridge, with an error in one of its methods once a file exists. For faults only."""

from collections.abc import Callable
from pathlib import Path
import sys
from typing import Any

from fam_bundle_io.hardware.monitor import Monitor
from fam_bundle_io.hardware_bridge_node import HardwareBridge
from fam_bundle_node.run import run_node
import rclpy

SHUTDOWN = 'shutdown'  # no error: ROS's context is shut down in the command's callback


def break_method(owner: type, name: str, trigger: Path, hurt: Callable[[], None]) -> None:
    """Let the method ``name`` call ``hurt`` first as soon as ``trigger`` exists."""
    whole = getattr(owner, name)

    def broken(*arguments: Any) -> Any:
        if trigger.exists():
            hurt()
        return whole(*arguments)

    broken.__name__ = name
    setattr(owner, name, broken)


def fail() -> None:
    """Raise what nobody expects: an ArithmeticError."""
    raise ArithmeticError('raised on purpose')


def main() -> None:
    """Run the bridge with an error in the method that is named first; the second is the file."""
    name, trigger = sys.argv[1], Path(sys.argv[2])
    if name == SHUTDOWN:
        break_method(HardwareBridge, 'on_valve_command', trigger, lambda: rclpy.shutdown())
    else:
        owner, _, method = name.rpartition('.')
        break_method(Monitor if owner == 'Monitor' else HardwareBridge, method, trigger, fail)
    sys.exit(run_node(HardwareBridge))


if __name__ == '__main__':
    main()
