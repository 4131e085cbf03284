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

"""What a running node lets change, and in which words it refuses the rest."""

from pathlib import Path

from fam_bundle_model.parameters import load_configuration
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.live import changes_of
import pytest
from rclpy.parameter import Parameter

CONFIGURATION = load_configuration(
    Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
)
LIVE = ('strain_loop',)


def changed(**values):
    parameters = [Parameter(name.replace('__', '.'), value=v) for name, v in values.items()]
    return changes_of(CONFIGURATION, LIVE, parameters)


def test_what_is_live_changes_and_an_integer_serves():
    changes, others = changed(strain_loop__integral_gain=3)
    assert changes == {'strain_loop.integral_gain': 3.0}
    assert type(changes['strain_loop.integral_gain']) is float
    assert [p.name for p in others] == ['strain_loop.integral_gain']


def test_what_keeps_its_value_is_no_change_even_if_it_is_fixed():
    assert changed(fam__count=[2, 2], load__mass=18.8, fam__length=[0.222]) == ({}, [])


def test_what_is_not_ours_is_left_to_ros():
    changes, others = changed(use_sim_time=True)
    assert not changes
    assert [p.name for p in others] == ['use_sim_time']


@pytest.mark.parametrize(
    ('values', 'said'),
    [
        ({'fam__length': [0.3]}, 'fam.length = [0.3]: fixed while its node runs; restart it'),
        # live in another node, not in this one
        ({'recruitment__reserve': 1.0}, 'recruitment.reserve = 1.0: fixed while its node runs'),
        ({'strain_loop__tracking_time': 0.0}, 'strain_loop.tracking_time = 0.0 s: must be > 0'),
        ({'strain_loop__gain': 1.0}, 'strain_loop.gain: no such parameter'),
        ({'strain_loop__integral_gain': 1.0, 'load__mass': 1.0}, 'load.mass = 1.0: fixed'),
    ],
)
def test_the_rest_is_refused_in_one_line(values, said):
    with pytest.raises(ConfigurationError) as refused:
        changed(**values)
    assert str(refused.value).startswith(said)
    assert '\n' not in str(refused.value)
