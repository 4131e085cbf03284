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

"""Two simulated bundles beside each other, in the namespaces left and right."""

from fam_bundle_bringup import launch_parts

ARGUMENTS = (
    'params_file',
    'scheme',
    'cycles',
    'pace',
    'composed',
    'record',
    'bag',
    'log_level',
)


def generate_launch_description():
    """Return what `ros2 launch` is to start."""
    return launch_parts.describe(ARGUMENTS, launch_parts.two_bundles)
