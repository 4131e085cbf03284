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

"""A message that holds what cannot be is refused before anything uses it."""

from array import array
import copy
import math
from types import SimpleNamespace

from fam_bundle_node.checks import check_finite, check_length, CHECKS
from fam_bundle_node.ticks import TickError
import pytest

UNITS = 2
# For each topic a message as it should be, with what a consumer of the loop uses.
GOOD = {
    'bundle_state': {
        'strain': 0.05,
        'force': -3.0,
        'source_pressure': 6.9e5,
        'mu_pressure': array('d', [1e5, 0.0]),
    },
    'pressure_reference': {'pressure': 2e5},
    'recruitment_state': {'recruited': 2, 'pressure_compensation': 0.0},
    'valve_command': {'spool': array('d', [-1.0, 0.3])},
}
FIELDS = [(topic, field) for topic, fields in GOOD.items() for field in fields]
NUMBERS = [(topic, field) for topic, field in FIELDS if field != 'recruited']


def message(topic, **changes):
    return SimpleNamespace(tick=41, **{**copy.deepcopy(GOOD[topic]), **changes})


def refusal(topic, **changes):
    """Return why a message with ``changes`` is refused."""
    with pytest.raises(TickError, match=f'^{topic}: tick 41 holds ') as refused:
        CHECKS[topic](message(topic, **changes), UNITS)
    return str(refused.value)


@pytest.mark.parametrize('topic', list(GOOD))
def test_good_message_passes(topic):
    CHECKS[topic](message(topic), UNITS)


def test_every_topic_of_the_loop_is_checked():
    assert set(CHECKS) == set(GOOD)


@pytest.mark.parametrize('bad', [math.nan, math.inf, -math.inf])
@pytest.mark.parametrize(('topic', 'field'), NUMBERS)
def test_no_value_that_is_used_may_be_other_than_finite(topic, field, bad):
    good = GOOD[topic][field]
    places = [(bad, 0.0), (0.0, bad)] if isinstance(good, array) else [bad]
    for value in places:
        assert str(bad) in refusal(topic, **{field: value})


@pytest.mark.parametrize('count', [0, 1, 3])
@pytest.mark.parametrize(
    ('topic', 'field'), [('bundle_state', 'mu_pressure'), ('valve_command', 'spool')]
)
def test_there_is_one_value_for_each_motor_unit(topic, field, count):
    assert f'{count} values for 2 motor units' in refusal(topic, **{field: [0.0] * count})


@pytest.mark.parametrize('recruited', [0, 3, 2**32 - 1])
def test_no_more_and_no_fewer_units_are_recruited_than_there_are(recruited):
    assert f'{recruited} recruited; must be from 1 to 2' in refusal(
        'recruitment_state', recruited=recruited
    )


@pytest.mark.parametrize('recruited', [1, 2])
def test_any_unit_may_be_the_last_recruited(recruited):
    CHECKS['recruitment_state'](message('recruitment_state', recruited=recruited), UNITS)


def test_the_first_bad_value_is_named():
    with pytest.raises(TickError, match='valve_command: tick 3 holds inf; every value'):
        check_finite('valve_command', 3, (0.0, math.inf, math.nan))
    check_finite('valve_command', 3, (0.0, -1.0))


def test_length_of_anything_iterable_is_checked():
    check_length('bundle_state', 3, iter((1.0, 2.0)), 2)
    with pytest.raises(TickError, match='bundle_state: tick 3 holds 1 values for 2 motor units'):
        check_length('bundle_state', 3, iter((1.0,)), 2)
