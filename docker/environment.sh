# SPDX-License-Identifier: Apache-2.0
# To be sourced: ROS 2, the workspace where it is built, and a network that stays on this machine.
source /opt/ros/jazzy/setup.bash
workspace=/fam_bundle/ros2_ws/install
if [ -f "$workspace/setup.bash" ]; then
  source "$workspace/setup.bash"
  # Who sets a profile of their own chooses another network.
  share="$workspace/fam_bundle_bringup/share/fam_bundle_bringup"
  export RMW_IMPLEMENTATION="${RMW_IMPLEMENTATION:-rmw_fastrtps_cpp}"
  if [[ $RMW_IMPLEMENTATION == rmw_fastrtps* ]]; then
    export FASTRTPS_DEFAULT_PROFILES_FILE="${FASTRTPS_DEFAULT_PROFILES_FILE:-$share/config/fastdds_loopback.xml}"
    export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-SYSTEM_DEFAULT}"
  else # it reads no profile of Fast DDS
    export ROS_AUTOMATIC_DISCOVERY_RANGE="${ROS_AUTOMATIC_DISCOVERY_RANGE:-LOCALHOST}"
  fi
fi
export PYTHONPATH="${PYTHONPATH:+$PYTHONPATH:}/opt/extras"
