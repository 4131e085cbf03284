# SPDX-License-Identifier: Apache-2.0
"""Traffic of the graph stays on this machine."""

import os
from pathlib import Path


def stay_on_this_machine() -> None:
    """Let this process and all that it starts talk over the loopback only.

    Raises FileNotFoundError without the profile, for the middleware would then use every network.
    """
    from ament_index_python.packages import get_package_share_directory

    share = Path(get_package_share_directory('fam_bundle_bringup'))
    profile = (share / 'config' / 'fastdds_loopback.xml').resolve(strict=True)
    os.environ['RMW_IMPLEMENTATION'] = 'rmw_fastrtps_cpp'  # which reads it
    os.environ['FASTRTPS_DEFAULT_PROFILES_FILE'] = str(profile)
    for name in ('ROS_DISCOVERY_SERVER', 'ROS_LOCALHOST_ONLY', 'ROS_STATIC_PEERS'):
        os.environ.pop(name, None)  # each would overrule the profile
    # With LOCALHOST the middleware adds transports of its own, shared memory among them.
    os.environ['ROS_AUTOMATIC_DISCOVERY_RANGE'] = 'SYSTEM_DEFAULT'
