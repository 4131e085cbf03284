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

"""Volts become SI values and spools become volts, both ways, to rounding and with the sign."""

import dataclasses
import re

from benches import CONFIG
from fam_bundle_io.hardware.calibration import (
    load_hardware,
    make_calibration,
    MU_PRESSURE,
    Scaling,
    STRAIN,
    write_hardware,
    zeroed,
)
from fam_bundle_io.hardware.limits import Limits, make_limits
from fam_bundle_model.schema import ConfigurationError, declarations
from hypothesis import assume, given, settings
from hypothesis import strategies as st
import numpy as np
import pytest
import yaml

SHIPPED = CONFIG / 'volts_calibration.yaml'
TEMPLATE = CONFIG / 'hardware_calibration_template.yaml'
RIG = load_hardware(SHIPPED)
ROUNDING = 2.0**-53


@pytest.fixture(scope='module')
def shipped():
    return RIG


def content():
    """Return the shipped file as plain groups, to be changed."""
    text = SHIPPED.read_text()
    return yaml.safe_load(yaml.safe_dump(yaml.safe_load(text)))  # without shared groups


def changed(path, value):
    values = content()
    *groups, last = path
    inner = values
    for name in groups:
        inner = inner[name]
    if value is None:
        del inner[last]
    else:
        inner[last] = value
    return values


def complaint(path, value):
    with pytest.raises(ConfigurationError) as caught:
        make_calibration(changed(path, value))
    return str(caught.value)


def scaling_of(gain=1.0, offset=0.0, valve=None):
    """Return the scaling of the shipped rig with another strain sensor and another first valve."""
    calibration = RIG.calibration
    strain = dataclasses.replace(calibration.strain, gain=gain, offset=offset)
    first, second = calibration.valves
    valves = (dataclasses.replace(first, **(valve or {})), second)
    return Scaling(dataclasses.replace(calibration, strain=strain, valves=valves))


def strain_at(scaling, volts):
    values = np.empty(6)
    scaling.to_values(np.full(6, volts), values)
    return values[STRAIN]


def valve_volts(scaling, spool):
    volts = np.empty(2)
    scaling.to_valve_volts(np.full(2, spool), volts)
    return volts[0]


def spool_at(scaling, volts):
    spool = np.empty(2)
    scaling.to_spool(np.full(2, volts), spool)
    return spool[0]


# ---- Sensors ----


def test_the_shipped_sensors_read_what_their_data_sheets_say(shipped):
    values = np.empty(6)
    Scaling(shipped.calibration).to_values(np.array([5.0, -2.0, 4.5, 3.5, 0.5, 2.5]), values)
    strain, force, source, flow, first, second = values
    assert strain == pytest.approx(0.1)
    assert force == pytest.approx(-200.0)
    assert source == pytest.approx(200 * 6895, rel=1e-4)  # 200 psi at the upper end
    assert flow == pytest.approx(0.1e-3)  # 350 Hz of 3500 pulses a litre: 0.1 L/s
    assert first == 0.0
    assert second == pytest.approx(100 * 6895, rel=1e-4)


GAINS = st.floats(1e-9, 1e9).flatmap(lambda gain: st.sampled_from([gain, -gain]))
VOLTS = st.floats(-10.0, 10.0)


@settings(deadline=None, max_examples=400)
@given(GAINS, VOLTS, VOLTS)
def test_volts_to_value_and_back_is_exact_to_rounding(gain, offset, volts):
    """
    Three roundings act on the difference to the offset, one on the result.

    Each is at most u = 2^-53 of what it rounds: |error| <= 3 u |v - o| + u |v|; twice that leaves
    room for the products of roundings. Below 1e-290 a double has fewer digits.
    """
    assume(volts == offset or abs(gain * (volts - offset)) > 1e-290)
    scaling = scaling_of(gain, offset)
    values, back = np.empty(6), np.empty(6)
    scaling.to_values(np.full(6, volts), values)
    scaling.to_volts(values, back)
    bound = 2.0 * ROUNDING * (2.0 * abs(volts - offset) + abs(volts))
    assert abs(back[STRAIN] - volts) <= bound


@settings(deadline=None, max_examples=300)
@given(GAINS, VOLTS, VOLTS, VOLTS)
def test_more_volts_never_read_the_other_way_round(gain, offset, one, other):
    scaling = scaling_of(gain, offset)
    low, high = sorted((one, other))
    step = strain_at(scaling, high) - strain_at(scaling, low)
    assert step * gain >= 0.0
    if high - low > 1e-9:
        assert step * gain > 0.0


@settings(deadline=None, max_examples=100)
@given(GAINS, VOLTS)
def test_at_its_offset_a_sensor_reads_exactly_zero(gain, offset):
    assert strain_at(scaling_of(gain, offset), offset) == 0.0


# ---- Valves ----

SPOOLS = st.floats(-1.0, 1.0)
VALVES = st.fixed_dictionaries(
    {
        'full_scale_volts': st.floats(1.0, 9.0),
        'null_volts': st.floats(-1.0, 1.0),
        'sign': st.sampled_from(['positive', 'negative']),
        'dead_band': st.floats(0.0, 0.9),
    }
)


@settings(deadline=None, max_examples=300)
@given(VALVES, SPOOLS)
def test_spool_to_volts_and_back_is_exact_to_rounding(valve, spool):
    """Roundings are of volts below 10 V; the span of at least 0.1 V divides them in the end."""
    scaling = scaling_of(valve=valve)
    span = valve['full_scale_volts'] - valve['dead_band']
    back = spool_at(scaling, valve_volts(scaling, spool))
    assert abs(back - spool) <= 8.0 * ROUNDING * 10.0 / span


@settings(deadline=None, max_examples=300)
@given(VALVES, SPOOLS, SPOOLS)
def test_a_further_spool_is_further_volts_in_the_direction_of_the_wiring(valve, one, other):
    scaling = scaling_of(valve=valve)
    low, high = sorted((one, other))
    direction = 1.0 if valve['sign'] == 'positive' else -1.0
    step = (valve_volts(scaling, high) - valve_volts(scaling, low)) * direction
    assert step >= 0.0
    if high - low > 1e-12:
        assert step > 0.0


@settings(deadline=None, max_examples=100)
@given(VALVES)
def test_the_middle_and_the_ends_are_where_the_calibration_says(valve):
    scaling = scaling_of(valve=valve)
    direction = 1.0 if valve['sign'] == 'positive' else -1.0
    assert valve_volts(scaling, 0.0) == valve['null_volts']
    for end in (1.0, -1.0):
        wanted = valve['null_volts'] + end * direction * valve['full_scale_volts']
        assert valve_volts(scaling, end) == pytest.approx(wanted, abs=8.0 * ROUNDING * 10.0)


@settings(deadline=None, max_examples=100)
@given(VALVES)
def test_safe_is_the_full_spool_to_the_tank_and_not_the_middle(valve):
    """0 V leaves a closed valve at its middle and the pressure trapped."""
    safe = scaling_of(valve=valve).safe_volts[0]
    direction = 1.0 if valve['sign'] == 'positive' else -1.0
    assert (safe - valve['null_volts']) * direction == pytest.approx(-valve['full_scale_volts'])
    assert spool_at(scaling_of(valve=valve), safe) == pytest.approx(-1.0)


@settings(deadline=None, max_examples=200)
@given(VALVES, SPOOLS)
def test_the_dead_band_is_skipped_on_both_sides(valve, spool):
    assume(spool != 0.0)
    scaling = scaling_of(valve=valve)
    away = abs(valve_volts(scaling, spool) - valve['null_volts'])
    assert away >= valve['dead_band'] - 1e-14
    inside = valve['null_volts'] + spool * valve['dead_band'] * 0.999
    assert spool_at(scaling, inside) == 0.0


def test_scaling_keeps_no_array_of_the_caller_and_makes_none(shipped):
    scaling = Scaling(shipped.calibration)
    volts, values = np.full(6, 1.0), np.empty(6)
    scaling.to_values(volts, values)
    assert volts.tolist() == [1.0] * 6
    spool, out = np.array([0.5, -0.5]), np.empty(2)
    scaling.to_valve_volts(spool, out)
    assert spool.tolist() == [0.5, -0.5]
    assert out.tolist() == [0.5 * 9.375, -0.5 * 9.375]


# ---- Zeroing ----


def test_a_zeroed_sensor_reads_its_zero_value_at_the_measured_mean(shipped):
    strain = dataclasses.replace(shipped.calibration.strain, zero_value=-0.01)
    calibration = dataclasses.replace(shipped.calibration, strain=strain)
    means = {STRAIN: 0.3, MU_PRESSURE + 1: 0.52}
    values = np.empty(6)
    moved = zeroed(calibration, means)
    Scaling(moved).to_values(np.array([0.3, 0.0, 0.5, 0.0, 0.5, 0.52]), values)
    assert values == pytest.approx([-0.01, 0.0, 0.0, 0.0, 0.0, 0.0], abs=1e-9)
    assert moved.hash() != calibration.hash()
    assert moved.force == calibration.force


# ---- Refusals ----


@pytest.mark.parametrize(
    ('path', 'value', 'message'),
    [
        (('id',), '', 'id = : must be text that is not blank'),
        (('sensors',), 3, 'sensors = 3: must be a group of parameters'),
        (('sensors', 'strain'), None, 'sensors.strain = None: must be a group of parameters'),
        (
            ('sensors', 'stain'),
            {},
            'sensors.stain: no such parameter; did you mean sensors.strain?',
        ),
        (
            ('sensors', 'force', 'gain'),
            'ten',
            'sensors.force.gain = ten SI/V: must be a finite number',
        ),
        (('sensors', 'force', 'gain'), 0, 'sensors.force.gain = 0 N/V: must not be 0'),
        (
            ('sensors', 'force', 'unit'),
            'Pa',
            'sensors.force.unit = Pa: must be N',
        ),
        (
            ('sensors', 'strain', 'channel'),
            -1,
            'sensors.strain.channel = -1: must be >= 0 and <= 255',
        ),
        (
            ('sensors', 'force', 'channel'),
            0,
            'sensors.force.channel = 0: is taken by sensors.strain already',
        ),
        (
            ('sensors', 'source_pressure', 'live_minimum'),
            0.0,
            'sensors.source_pressure.live_minimum = 0 V: must be > 0, for an open wire reads 0 V '
            'and ratiometric has a live zero',
        ),
        (
            ('sensors', 'strain', 'live_maximum'),
            11.0,
            'sensors.strain.maximum_volts = 10 V: must be >= sensors.strain.live_maximum = 11 V',
        ),
        (
            ('sensors', 'strain', 'live_minimum'),
            9.9,
            'sensors.strain.live_maximum = 9.9 V: must be > sensors.strain.live_minimum = 9.9 V',
        ),
        (
            ('sensors', 'strain', 'type'),
            'frequency',
            'sensors.strain.type = frequency: only the flow meter gives pulses',
        ),
        (
            ('sensors', 'source_flow', 'pulses_per_litre'),
            None,
            'sensors.source_flow.pulses_per_litre: missing; must be > 0 (unit 1/L)',
        ),
        (('valves',), [], 'valves = []: must hold one group for each motor unit'),
        (
            ('valves', 0, 'null_volts'),
            1.0,
            'valves[0].full_scale_volts = 9.375 V: must be <= 9 V, what its output can give on '
            'both sides of null_volts = 1 V',
        ),
        (
            ('valves', 0, 'dead_band'),
            9.375,
            'valves[0].dead_band = 9.375 V: must be < valves[0].full_scale_volts = 9.375 V',
        ),
        (
            ('valves', 0, 'sign'),
            'up',
            'valves[0].sign = up: must be one of positive, negative',
        ),
        (
            ('valves', 1, 'channel'),
            0,
            'valves[1].channel = 0: is taken by valves[0] already',
        ),
        (
            ('valves', 1, 'slew_limit'),
            -1,
            'valves[1].slew_limit = -1 1/s: must be > 0',
        ),
        (
            ('sensors', 'mu_pressure', 1, 'calibration_id'),
            None,
            'sensors.mu_pressure[1].calibration_id: missing; must be text that is not blank',
        ),
    ],
)
def test_what_cannot_be_is_named_with_value_unit_and_bound(path, value, message):
    assert complaint(path, value) == message


def test_each_motor_unit_needs_a_sensor_and_a_valve():
    values = content()
    del values['valves'][1]
    with pytest.raises(ConfigurationError, match=r'valves: 1 for 2 sensors\.mu_pressure; must'):
        make_calibration(values)


def test_a_file_is_refused_with_its_path(tmp_path):
    with pytest.raises(ConfigurationError, match=r'nowhere\.yaml: cannot be read'):
        load_hardware(tmp_path / 'nowhere.yaml')
    path = tmp_path / 'bad.yaml'
    for text, message in (
        ('a: [', 'not YAML'),
        ('3', 'file = 3: must be a group'),
        ('valvs: 3', 'valvs: no such parameter; did you mean valves?'),
        (yaml.safe_dump(changed(('limits', 'command_stale'), 7)), 'limits.command_stale = 7 s: m'),
    ):
        path.write_text(text)
        with pytest.raises(ConfigurationError, match=re.escape(f'{path}: {message}')):
            load_hardware(path)


def test_the_template_is_refused_until_its_blanks_are_filled_in(tmp_path):
    """Every blank stands for something that must be measured; nothing has a made-up value."""
    with pytest.raises(ConfigurationError, match=r'sensors\.\w+'):
        load_hardware(TEMPLATE)
    filled = TEMPLATE.read_text()
    blanks = re.findall(r'^ *(?:- )?(\w+): +# to be measured', filled, re.MULTILINE)
    assert 'pulses_per_litre' in blanks
    for blank in blanks:
        filled = re.sub(rf'({blank}:) +(# to be measured)', r'\1 2.0  \2', filled, count=1)
    filled = re.sub(r'(calibration_id|id): +#', r"\1: 'filled in'  #", filled)
    path = tmp_path / 'filled.yaml'
    path.write_text(filled)
    assert load_hardware(path).calibration.source_flow.pulses_per_litre == 2.0
    for blank in dict.fromkeys(blanks):
        lacking = re.sub(rf'{blank}: 2\.0', f'{blank}:', filled, count=1)
        path.write_text(lacking)
        with pytest.raises(ConfigurationError, match=blank):
            load_hardware(path)


@pytest.mark.parametrize('path', [SHIPPED, TEMPLATE])
def test_every_value_of_a_shipped_file_says_where_it_comes_from(path):
    """The kinds are listed in its head; a line without a comment repeats one of that name."""
    text = path.read_text()
    kinds = re.findall(r'^#   (\S.*?)  ', text, re.MULTILINE)
    assert len(kinds) >= 3
    said = set()
    for line in text.splitlines():
        match = re.match(r'^ +(?:- )?(\w+): *([^#]*)(?:# (.*))?$', line)
        if not match or line.startswith('#') or match[1] in ('unit', 'calibration_id'):
            continue
        name, value, comment = match.groups()
        if comment is None and not value.strip():
            continue  # the head of a group
        if comment is None:
            assert name in said, line
        else:
            assert comment.startswith((*kinds, 'one', 'name')), line
            said.add(name)


# ---- The file and its hash ----


def test_a_written_file_reads_back_to_the_same_rig(shipped, tmp_path):
    write_hardware(shipped, tmp_path / 'rig.yaml')
    assert load_hardware(tmp_path / 'rig.yaml') == shipped


def test_the_hash_depends_on_every_number_and_on_nothing_else(shipped, tmp_path):
    calibration = shipped.calibration
    assert re.fullmatch('[0-9a-f]{64}', calibration.hash())
    text = SHIPPED.read_text().replace('offset: 0.5', 'offset: 5.0e-1')
    path = tmp_path / 'same.yaml'
    path.write_text(text)
    assert load_hardware(path).calibration.hash() == calibration.hash()
    for name in declarations(type(calibration.strain)):
        value = getattr(calibration.strain, name)
        other = value + 1 if isinstance(value, int | float) else value + 'x'
        strain = dataclasses.replace(calibration.strain, **{name: other})
        assert dataclasses.replace(calibration, strain=strain).hash() != calibration.hash(), name


# ---- Limits ----


def test_limits_have_the_documented_defaults():
    limits = make_limits({})
    assert limits == Limits()
    assert (limits.command_stale, limits.command_lost) == (0.02, 0.1)
    assert (limits.overpressure_ratio, limits.overpressure_margin) == (1.05, 50e3)
    assert (limits.overpressure_samples, limits.rejected_commands) == (5, 3)
    assert (limits.depressurised, limits.watchdog_timeout) == (20e3, 0.1)
    assert 3 <= limits.sensor_samples <= 5


@pytest.mark.parametrize(
    ('values', 'message'),
    [
        ({'sensor_samples': 2}, 'limits.sensor_samples = 2: must be >= 3 and <= 5'),
        (
            {'command_lost': 0.02},
            'limits.command_lost = 0.02 s: must be > limits.command_stale = 0.02 s',
        ),
        (
            {'watchdog_timeout': 0.02},
            'limits.watchdog_timeout = 0.02 s: must be > limits.command_stale = 0.02 s',
        ),
        (
            {'watchdog_timeout': 0.42},
            'limits.watchdog_timeout = 0.42 s: must be >= 0.005 and <= 0.4',
        ),
        (
            {'read_timeout': 0.2},
            'limits.watchdog_timeout = 0.1 s: must be > limits.read_timeout = 0.2 s',
        ),
        ({'wachdog': 1}, 'limits.wachdog: no such parameter'),
    ],
)
def test_limits_that_cannot_be_are_refused(values, message):
    with pytest.raises(ConfigurationError) as caught:
        make_limits(values)
    assert str(caught.value).startswith(message)


def test_every_limit_has_a_text_and_its_default_lies_within_its_bounds():
    for name, declaration in declarations(Limits).items():
        assert declaration.text
        assert declaration.convert(name, getattr(Limits(), name)) == getattr(Limits(), name)
