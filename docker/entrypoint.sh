#!/bin/bash
# SPDX-License-Identifier: Apache-2.0
# Sources ROS 2 and the workspace, keeps traffic on this machine, then becomes the command.
set -e
source /opt/ros/jazzy/setup.bash
workspace=/fam_bundle/ros2_ws/install
if [ -f "$workspace/setup.bash" ]; then
  source "$workspace/setup.bash"
  # Who sets a profile of their own chooses another network.
  share="$workspace/fam_bundle_bringup/share/fam_bundle_bringup"
  export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$share/config/fastdds_loopback.xml}"
  export RMW_IMPLEMENTATION="${RMW_IMPLEMENTATION:-rmw_fastrtps_cpp}"
  export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-SYSTEM_DEFAULT}"
fi
export PYTHONPATH="${PYTHONPATH:+$PYTHONPATH:}/opt/extras"
exec "$@"
