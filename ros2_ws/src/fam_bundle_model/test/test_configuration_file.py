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

"""Configuration files: shipped ones say where their values come from; broken ones are named."""

import difflib
import re

from fam_bundle_model.doubts import doubts
from fam_bundle_model.parameters import GROUPS, load_configuration, read_yaml
from fam_bundle_model.schema import ConfigurationError, declarations
import pytest

EXAMPLES = ('one_unit.yaml', 'three_units.yaml', 'four_units.yaml')
SHIPPED = ('lhacd.yaml', *EXAMPLES)
ORIGINS = ('published', 'data sheet', 'calibrated', 'assumed', 'chosen')


def lines_with_values(text):
    """Yield number, content and comment of each line that gives a parameter its value."""
    group = False
    for number, line in enumerate(text.splitlines(), 1):
        content, _, comment = line.partition('#')
        opens = re.fullmatch(r'\s*(/\*\*|\w+):\s*', content)
        group = group or bool(opens)
        if content.strip() and not opens and content.strip() != '---':
            yield number, content.rstrip(), comment.strip()
    assert group


@pytest.fixture(params=SHIPPED)
def shipped(request, configuration_path):
    return configuration_path.parent / request.param


def test_every_value_says_where_it_comes_from(shipped):
    silent = [
        f'{number}: {content.strip()}'
        for number, content, comment in lines_with_values(shipped.read_text())
        if not comment.startswith(ORIGINS)
    ]
    assert silent == []


def test_every_parameter_stands_on_a_line_of_its_own(shipped):
    text = shipped.read_text()
    given = sum(len(group) for group in read_yaml(shipped).values())
    assert len(list(lines_with_values(text))) == given


def test_the_published_values_are_those_of_the_paper(configuration):
    """Table 1 and section 4."""
    fam = configuration.fam
    assert sum(fam.count) == 4
    assert len(fam.count) == 2
    assert set(fam.inner_radius) == {0.0063}
    assert set(fam.thickness) == {0.0016}
    assert fam.braid_angle == pytest.approx([0.57596] * len(fam.braid_angle), abs=1e-5)
    assert set(fam.length) == {0.222}
    assert set(fam.youngs_modulus_factor) == {1.3}
    assert set(fam.collapse_moment_factor) == {0.75}
    assert set(fam.end_spring_slope) == {0.9e-6}
    assert set(fam.end_spring_offset) == {1.54}
    assert set(fam.transition_constant) == {100.0}
    assert configuration.source.nominal_pressure == 689.5e3
    assert configuration.hose.viscosity == 0.2856
    assert configuration.load.mass == 18.8
    assert configuration.recruitment.upshift_threshold == 0.8
    assert configuration.recruitment.downshift_threshold == 0.4
    assert configuration.reference.amplitude == 0.06
    assert configuration.reference.frequency == 0.1
    assert configuration.simulation.period == 0.001


def test_a_shipped_file_names_only_known_parameters(shipped):
    for group, values in read_yaml(shipped).items():
        assert set(values) <= set(declarations(GROUPS[group]))


@pytest.mark.parametrize('name', EXAMPLES)
def test_an_example_differs_from_the_rig_of_the_paper_where_it_says_so(name, configuration_path):
    """ROS 2 parameter files cannot include one another: each is whole, and this is their bond."""
    rig, example = (
        (configuration_path.parent / file).read_text().splitlines()
        for file in (configuration_path.name, name)
    )
    differences = list(difflib.ndiff(rig, example))
    own = [line[2:] for line in differences if line.startswith('+ ')]
    replaced = [line[2:] for line in differences if line.startswith('- ')]
    values = [line for line in own if not line.startswith('#')]
    assert all(' here: ' in line for line in values)
    assert [v.split(':')[0] for v in values] == [r.split(':')[0] for r in replaced if r[0] != '#']


def test_the_examples_are_one_three_and_four_units_the_smallest_first(configuration_path):
    for name, units in zip(EXAMPLES, (1, 3, 4), strict=True):
        fam = load_configuration(configuration_path.parent / name).fam
        assert len(fam.count) == units
        assert list(fam.count) == sorted(fam.count)


@pytest.mark.parametrize('name', EXAMPLES)
def test_the_gains_of_an_example_are_those_of_the_paper_s_rig_per_muscle(
    name, configuration, configuration_path
):
    example = load_configuration(configuration_path.parent / name)
    for gain in ('proportional_gain', 'integral_gain'):
        (of_two,) = getattr(configuration.pressure_loop, gain)
        per_muscle = pytest.approx([of_two / 2.0 * fams for fams in example.fam.count])
        assert list(getattr(example.pressure_loop, gain)) == per_muscle
    assert doubts(example) == []


@pytest.mark.parametrize(
    ('content', 'reason'),
    [
        ('a: [1, 2', r'not YAML \(.+line'),
        ('a: b: c', r'not YAML \('),
        ('\tindented', r'not YAML \('),
        ('\x00', r'not YAML \('),
        ('', "must hold '/\\*\\*: ros__parameters:'"),
        ('just words', "must hold '/\\*\\*: ros__parameters:'"),
        ('- 1\n- 2', "must hold '/\\*\\*: ros__parameters:'"),
        ('fam: {count: 2}', "must hold '/\\*\\*: ros__parameters:'"),
        ('/**: 3', "must hold '/\\*\\*: ros__parameters:'"),
        ('/**: {ros__parameters: 3}', "must hold '/\\*\\*: ros__parameters:'"),
        ('/**: {ros__parameters: {fan: {}}}', 'fan: no such parameter; did you mean fam\\?'),
        ('/**: {ros__parameters: {fam: }}', 'fam = None: must be a group of parameters'),
        ('/**: {ros__parameters: {fam: {count: []}}}', r'fam\.'),
        ('/**: {ros__parameters: {}}', r'fam\.count: missing; must be >= 1 and <= 64'),
    ],
)
def test_a_broken_file_is_named_with_the_reason(tmp_path, content, reason):
    path = tmp_path / 'rig.yaml'
    path.write_text(content)
    with pytest.raises(ConfigurationError, match=f'^{re.escape(str(path))}: {reason}') as refused:
        load_configuration(path)
    assert '\n' not in str(refused.value)


def test_a_file_that_is_no_text_is_refused(tmp_path):
    path = tmp_path / 'rig.yaml'
    path.write_bytes(b'\xff\xfe\x00\xd8')
    with pytest.raises(ConfigurationError, match=r'rig\.yaml: not YAML'):
        load_configuration(path)


def test_a_file_that_does_not_exist_is_refused(tmp_path):
    with pytest.raises(ConfigurationError, match=r'none\.yaml: cannot be read \(No such file'):
        load_configuration(tmp_path / 'none.yaml')
    with pytest.raises(ConfigurationError, match=r'cannot be read \(Is a directory'):
        load_configuration(tmp_path)
