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

"""A node knows whether anybody has chosen its network."""

from fam_bundle_node.network import CHOICES, chosen_network
import pytest


@pytest.mark.parametrize('name', CHOICES)
def test_each_of_these_is_a_choice(name):
    assert chosen_network({name: '1', 'HOME': '/'}) == [f'{name}=1']


@pytest.mark.parametrize('environ', [{}, {'ROS_LOCALHOST_ONLY': '0'}, {'ROS_STATIC_PEERS': ''}])
def test_these_leave_the_subnet_open(environ):
    assert chosen_network(environ) == []
