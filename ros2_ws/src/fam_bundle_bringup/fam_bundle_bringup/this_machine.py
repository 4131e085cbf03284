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

"""Traffic of the graph stays on this machine."""

import os
from pathlib import Path

OVERRULE = ('ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS')  # a profile


def loopback() -> dict[str, str]:
    """
    Return the variables that keep traffic on the loopback, where none of ``OVERRULE`` is set.

    Raises FileNotFoundError without the profile, for the middleware would then use every network.
    """
    from ament_index_python.packages import get_package_share_directory

    share = Path(get_package_share_directory('fam_bundle_bringup'))
    profile = (share / 'config' / 'fastdds_loopback.xml').resolve(strict=True)
    return {
        'RMW_IMPLEMENTATION': 'rmw_fastrtps_cpp',  # which reads it
        'FASTRTPS_DEFAULT_PROFILES_FILE': str(profile),
        # With LOCALHOST the middleware adds transports of its own, shared memory among them.
        'ROS_AUTOMATIC_DISCOVERY_RANGE': 'SYSTEM_DEFAULT',
    }


def stay_on_this_machine() -> None:
    """
    Let this process and all that it starts talk over the loopback only.

    Raises FileNotFoundError without the profile, for the middleware would then use every network.
    """
    os.environ.update(loopback())
    for name in OVERRULE:
        os.environ.pop(name, None)
