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

"""Whether anybody has chosen the network that a node talks over."""

from collections.abc import Mapping

# Each of these is a choice.
CHOICES = (
    'CYCLONEDDS_URI',
    'FASTDDS_DEFAULT_PROFILES_FILE',
    'FASTRTPS_DEFAULT_PROFILES_FILE',
    'ROS_AUTOMATIC_DISCOVERY_RANGE',
    'ROS_DISCOVERY_SERVER',
    'ROS_LOCALHOST_ONLY',
    'ROS_STATIC_PEERS',
)
NOT_CHOSEN = (
    'no network was chosen, so every machine of the subnet can take part: set '
    'ROS_AUTOMATIC_DISCOVERY_RANGE=LOCALHOST, or another as docs/networks.md tells'
)


def chosen_network(environ: Mapping[str, str]) -> list[str]:
    """Return what ``environ`` says of the network, as NAME=VALUE; nothing where ROS 2 decides."""
    given = {name: environ.get(name, '') for name in CHOICES}
    if given['ROS_LOCALHOST_ONLY'] == '0':  # the default, and it opens the subnet
        del given['ROS_LOCALHOST_ONLY']
    return [f'{name}={value}' for name, value in given.items() if value]
