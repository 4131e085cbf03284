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

"""Declarations of parameters: what they accept, and what they say when they do not."""

from dataclasses import dataclass
import math

from fam_bundle_model.schema import (
    choice,
    ConfigurationError,
    declarations,
    integer,
    make_group,
    number,
    per_unit,
    positive,
    required,
    word,
)
from hypothesis import given, settings
from hypothesis import strategies as st
import pytest


@dataclass(frozen=True)
class Rig:
    """An example group with every kind of parameter."""

    length: float = positive('m', 'length')
    share: float = number('', 'share', minimum=0.0, maximum=0.5)
    width: tuple[float, ...] = per_unit(float, 'm', 'width', minimum=0.0, exclusive=True)
    count: tuple[int, ...] = per_unit(int, '', 'count', minimum=1, maximum=4)
    anything: float = number('Pa', 'any pressure', default=1.0)
    steps: int = integer('steps', 1, 9, default=3)
    mode: str = choice('mode', ('slow', 'fast'), default='slow')
    label: str = word('label', default='none')


GOOD = {'length': 2.0, 'share': 0.25, 'width': [0.1, 0.2], 'count': 2}


def complaint(**changes):
    with pytest.raises(ConfigurationError) as refused:
        make_group(Rig, 'rig', {**GOOD, **changes})
    return str(refused.value)


def test_good_values_become_their_declared_types():
    rig = make_group(Rig, 'rig', {**GOOD, 'length': 2, 'steps': 4.0})
    assert rig == Rig(2.0, 0.25, (0.1, 0.2), (2,), 1.0, 4, 'slow')
    assert type(rig.length) is float
    assert type(rig.steps) is int
    assert type(rig.count[0]) is int


def test_text_that_is_a_number_counts_as_one():
    """YAML 1.1 reads 4.9e7 as text."""
    assert make_group(Rig, 'rig', {**GOOD, 'length': '4.9e7'}).length == 4.9e7


@pytest.mark.parametrize(
    ('changes', 'message'),
    [
        ({'length': 0.0}, 'rig.length = 0.0 m: must be > 0'),
        ({'length': -3}, 'rig.length = -3 m: must be > 0'),
        ({'length': math.nan}, 'rig.length = nan m: must be > 0'),
        ({'length': math.inf}, 'rig.length = inf m: must be > 0'),
        ({'length': '1e400'}, 'rig.length = 1e400 m: must be > 0'),
        ({'length': True}, 'rig.length = True m: must be > 0'),
        ({'length': 'long'}, 'rig.length = long m: must be > 0'),
        ({'length': None}, 'rig.length = None m: must be > 0'),
        ({'length': [1.0]}, 'rig.length = [1.0] m: must be > 0'),
        ({'length': {}}, 'rig.length = {} m: must be > 0'),
        ({'share': 0.51}, 'rig.share = 0.51: must be >= 0 and <= 0.5'),
        ({'share': -1e-9}, 'rig.share = -1e-09: must be >= 0 and <= 0.5'),
        ({'anything': -math.inf}, 'rig.anything = -inf Pa: must be a finite number'),
        ({'steps': 0}, 'rig.steps = 0: must be >= 1 and <= 9'),
        ({'steps': 10}, 'rig.steps = 10: must be >= 1 and <= 9'),
        ({'steps': 2.5}, 'rig.steps = 2.5: must be a whole number'),
        ({'steps': False}, 'rig.steps = False: must be >= 1 and <= 9'),
        ({'mode': 'faster'}, 'rig.mode = faster: must be one of slow, fast'),
        ({'mode': True}, 'rig.mode = True: must be one of slow, fast'),
        ({'mode': ['slow']}, "rig.mode = ['slow']: must be one of slow, fast"),
        ({'width': []}, 'rig.width = []: must hold a value for each motor unit'),
        ({'width': [0.1, 0.0]}, 'rig.width[1] = 0.0 m: must be > 0'),
        ({'width': [math.nan, 0.1]}, 'rig.width[0] = nan m: must be > 0'),
        ({'width': -0.1}, 'rig.width = -0.1 m: must be > 0'),
        ({'count': [1, 5]}, 'rig.count[1] = 5: must be >= 1 and <= 4'),
        ({'count': [1, 1.5]}, 'rig.count[1] = 1.5: must be a whole number'),
        ({'count': [True]}, 'rig.count = True: must be >= 1 and <= 4'),
        ({'label': ' '}, 'rig.label =  : must be text that is not blank'),
        ({'label': 3}, 'rig.label = 3: must be text that is not blank'),
        ({'lenght': 1.0}, 'rig.lenght: no such parameter; did you mean rig.length?'),
        ({'zzz': 1.0}, 'rig.zzz: no such parameter'),
    ],
)
def test_a_refused_value_is_named_with_its_unit_and_bound(changes, message):
    assert complaint(**changes) == message


def test_an_integer_beyond_any_double_is_refused_like_an_infinite_number():
    assert complaint(length=10**400).endswith('must be > 0')


@pytest.mark.parametrize(
    ('name', 'message'),
    [
        ('length', 'rig.length: missing; must be > 0 (unit m)'),
        ('share', 'rig.share: missing; must be >= 0 and <= 0.5'),
        ('width', 'rig.width: missing; must be > 0 (unit m)'),
    ],
)
def test_a_missing_value_is_named_with_its_bound(name, message):
    with pytest.raises(ConfigurationError) as refused:
        make_group(Rig, 'rig', {k: v for k, v in GOOD.items() if k != name})
    assert str(refused.value) == message


def test_only_parameters_without_default_are_required():
    assert required(Rig) == {'length', 'share', 'width', 'count'}
    assert list(declarations(Rig)) == [
        'length',
        'share',
        'width',
        'count',
        'anything',
        'steps',
        'mode',
        'label',
    ]


@settings(deadline=None, max_examples=100)
@given(st.floats())
def test_bounds_are_what_the_message_says(value):
    accepted = 0.0 <= value <= 0.5
    if accepted:
        assert make_group(Rig, 'rig', {**GOOD, 'share': value}).share == value
    else:
        assert complaint(share=value).endswith(': must be >= 0 and <= 0.5')
