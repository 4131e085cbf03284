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

"""The configuration: every parameter declared, validated, hashed and written without loss."""

import dataclasses
import math
import re

from fam_bundle_model.parameters import (
    GROUPS,
    load_configuration,
    make_configuration,
    read_yaml,
    write_yaml,
)
from fam_bundle_model.schema import ConfigurationError, declarations
import pytest

EVERY = [(group, name) for group, kind in GROUPS.items() for name in declarations(kind)]
# Ratios, counts and words; everything else has a unit.
DIMENSIONLESS = {
    'fam': 'count youngs_modulus_factor mooney_rivlin_share poisson_ratio collapse_moment_factor '
    'end_spring_span end_spring_offset transition_constant',
    'pressure_loop': 'integral_limit',
    'recruitment': 'scheme predictor upshift_threshold downshift_threshold',
    'allocation': 'policy feedforward',
    'sensors': 'strain_noise strain_resolution seed',
    'simulation': 'substeps initial_strain',
    'lag_table': 'source_points deslack_points minimum_source',
    'reference': 'kind amplitude cycles multiples weights levels seed strains',
    'run': 'pace listeners',
    'process': 'executor priority cpu_mask lock_memory freeze_garbage',
    'bridge': 'backend hardware start answer_share',
}
UNIT = r'(1|m|s|kg|N|Pa|Hz|rad)(\^\d)?'


@pytest.fixture
def values(configuration_path):
    """Return the shipped parameters by group, free to be changed."""
    return read_yaml(configuration_path)


def complaint(values):
    with pytest.raises(ConfigurationError) as refused:
        make_configuration(values)
    return str(refused.value)


@pytest.mark.parametrize(('group', 'name'), EVERY)
def test_every_parameter_has_a_text_and_a_unit_or_none_on_purpose(group, name):
    declaration = declarations(GROUPS[group])[name]
    assert declaration.text.strip()
    assert not declaration.text.endswith('.')
    if name in DIMENSIONLESS.get(group, '').split():
        assert declaration.unit == ''
    else:
        factors = re.split(r'[ /()]+', declaration.unit.strip('()'))
        assert all(re.fullmatch(UNIT, f) for f in factors), declaration.unit


@pytest.mark.parametrize('value', [math.nan, math.inf, -math.inf, True, 'much', None, []])
@pytest.mark.parametrize(('group', 'name'), EVERY)
def test_no_parameter_takes_what_is_no_number(values, group, name, value):
    if declarations(GROUPS[group])[name].kind is bool and value is True:
        value = 1
    if declarations(GROUPS[group])[name].is_free_text() and value == 'much':
        value = ' '
    values.setdefault(group, {})[name] = value
    message = complaint(values)
    assert message.startswith(f'{group}.{name} = ')
    assert str(value) in message
    assert re.search(r': must (be|hold) .+', message)


@pytest.mark.parametrize(('group', 'name'), EVERY)
def test_both_bounds_of_every_number_hold(values, group, name):
    declaration = declarations(GROUPS[group])[name]
    if declaration.kind in (str, bool):
        return
    assert declaration.minimum > -math.inf  # nothing here has a sign of its own without a bound
    for bound, step in ((declaration.minimum, -1.0), (declaration.maximum, 1.0)):
        if math.isfinite(bound):
            values.setdefault(group, {})[name] = bound + step
            message = complaint(values)
            assert message.startswith(f'{group}.{name} = {bound + step}')
            text = str(int(bound)) if declaration.kind is int else f'{bound:g}'
            assert text in message.split(': ', 1)[1]


@pytest.mark.parametrize(
    ('group', 'name'),
    [(g, n) for g, n in EVERY if GROUPS[g].__dataclass_fields__[n].default is dataclasses.MISSING],
)
def test_a_missing_parameter_is_named(values, group, name):
    del values[group][name]
    assert complaint(values).startswith(f'{group}.{name}: missing; must be ')


def test_a_missing_group_is_named_by_its_first_parameter(values):
    del values['strain_loop']
    assert complaint(values) == 'strain_loop.proportional_gain: missing; must be >= 0 (unit Pa)'


def test_no_motor_units_are_refused(values):
    values['fam']['count'] = []
    assert complaint(values) == 'fam.count = []: must hold a value for each motor unit'
    values['fam']['count'] = [2, 0]
    assert complaint(values) == 'fam.count[1] = 0: must be >= 1 and <= 64'


@pytest.mark.parametrize('given', [2, 4])
def test_a_wrong_number_of_values_is_refused(values, given):
    values['fam'].update(count=[2, 2, 2], thickness=[0.0016] * given)
    expected = f'fam.thickness: {given} values for 3 motor units; must be 1 or 3'
    assert complaint(values) == expected
    values['fam']['thickness'] = 0.0016
    values['pressure_loop']['integral_gain'] = [1e-6] * given
    expected = f'pressure_loop.integral_gain: {given} values for 3 motor units; must be 1 or 3'
    assert complaint(values) == expected


def test_fams_of_different_lengths_are_refused(values):
    """They would share the displacement, not the strain."""
    values['fam']['length'] = [0.222, 0.2]
    expected = 'fam.length = [0.222, 0.2] m: must be equal, for all FAMs share one strain'
    assert complaint(values) == expected


def test_unknown_names_are_refused_with_the_nearest_known(values):
    misspelt = {**values, 'valves': values['valve']}
    assert complaint(misspelt) == 'valves: no such parameter; did you mean valve?'
    values['hose']['lenght'] = 1.0
    expected = 'hose.lenght: no such parameter; did you mean hose.length?'
    assert complaint(values) == expected


def test_a_group_that_is_none_is_refused(values):
    assert complaint({**values, 'oil': None}) == 'oil = None: must be a group of parameters'
    assert complaint({**values, 'oil': 7e7}) == 'oil = 70000000.0: must be a group of parameters'


@pytest.mark.parametrize('name', [5, None, True, 1.5])
def test_a_group_whose_name_is_no_text_is_refused(values, name):
    assert complaint({**values, name: {}}).startswith(f'{name}: no such parameter')


@pytest.mark.parametrize(('group', 'name'), EVERY)
def test_hash_changes_with_every_parameter(configuration, group, name):
    part = getattr(configuration, group)
    value = getattr(part, name)

    def other(v):
        if isinstance(v, str):
            return v + '_'
        if isinstance(v, bool):
            return not v
        return v + 1 if isinstance(v, int) else math.nextafter(v, math.inf)

    changed = tuple(map(other, value)) if isinstance(value, tuple) else other(value)
    part = dataclasses.replace(part, **{name: changed})
    second = dataclasses.replace(configuration, **{group: part})
    # How the graph is run changes no result.
    assert (second.hash() == configuration.hash()) == (group in ('run', 'process', 'bridge'))
    assert second.hash(group) != configuration.hash(group)
    rest = [g for g in GROUPS if g != group]
    assert second.hash(*rest) == configuration.hash(*rest)


def test_written_yaml_reads_back_to_the_same_bits(configuration, tmp_path):
    awkward = dataclasses.replace(
        configuration,
        load=dataclasses.replace(configuration.load, mass=0.1 + 0.2, damping=1e-300),
        oil=dataclasses.replace(configuration.oil, bulk_modulus=1e22),
        fam=dataclasses.replace(configuration.fam, thickness=(1 / 300, 2 / 300), count=(1, 64)),
        sensors=dataclasses.replace(configuration.sensors, seed=2**31 - 1),
    )
    for number, original in enumerate((configuration, awkward)):
        path = tmp_path / f'{number}.yaml'
        write_yaml(original, path)
        again = load_configuration(path)
        assert again == original
        assert again.hash() == original.hash()


def test_duration_and_ticks(configuration):
    reference = dataclasses.replace(configuration.reference, frequency=0.3, cycles=3)
    simulation = dataclasses.replace(configuration.simulation, period=0.003)
    short = dataclasses.replace(configuration, reference=reference, simulation=simulation)
    assert short.duration() == pytest.approx(10.0)
    assert short.ticks() == 3333


def test_changes_are_laid_over_the_file(configuration_path, configuration):
    changes = {'load': {'mass': 3.0}, 'sensors': {'seed': 5}}
    changed = load_configuration(configuration_path, changes)
    assert (changed.load.mass, changed.sensors.seed) == (3.0, 5)
    assert changed.load.damping == configuration.load.damping


def test_a_bad_change_is_refused_without_blaming_the_file(configuration_path):
    with pytest.raises(ConfigurationError) as refused:
        load_configuration(configuration_path, {'load': {'mass': -3}})
    assert str(refused.value) == 'load.mass = -3 kg: must be > 0'
