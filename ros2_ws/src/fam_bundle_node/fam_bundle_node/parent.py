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

"""A node that is launched ends with what launched it, however that ends."""

import contextlib
import ctypes
import os
import signal

VARIABLE = 'FAM_BUNDLE_PARENT'  # process id of the launch
_SET_PARENT_DEATH_SIGNAL = 1  # of Linux


def end_with_parent() -> None:
    """
    Ask the kernel for SIGINT at the end of the launch that ``VARIABLE`` names, if any.

    ``ros2 launch`` leaves its nodes behind when it is ended by SIGTERM or killed: with valves
    that follow commands nobody should have to find that out.
    """
    if VARIABLE not in os.environ:
        return
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGINT)
    parent = os.environ.pop(VARIABLE)  # not that of what this process starts
    with contextlib.suppress(ValueError, OSError):
        os.kill(int(parent), 0)
        return
    os.kill(os.getpid(), signal.SIGINT)  # it has ended already
