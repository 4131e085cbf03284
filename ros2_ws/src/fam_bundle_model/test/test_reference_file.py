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

"""A reference from a CSV file: what is read, and that everything else is refused in one line."""

from fam_bundle_model.parameters import make_configuration, MOST_SAMPLES, read_yaml
from fam_bundle_model.reference_file import read_samples
from fam_bundle_model.schema import ConfigurationError
from hypothesis import given, HealthCheck, settings
from hypothesis import strategies as st
import pytest

HEAD = 'time,strain\n'
shared_folder = settings(suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture
def complaint(tmp_path):
    """Return a function that gives what is said of a file with some content, without its name."""

    def refused(content):
        path = tmp_path / 'bad.csv'
        path.write_bytes(content if isinstance(content, bytes) else content.encode())
        with pytest.raises(ConfigurationError) as error:
            read_samples(path)
        message = str(error.value)
        assert '\n' not in message
        assert message.startswith(f'{path}: ')
        return message.removeprefix(f'{path}: ')

    return refused


@shared_folder
@given(
    st.lists(st.floats(0.0, 1e6, allow_subnormal=False), min_size=2, max_size=30, unique=True),
    st.data(),
)
def test_numbers_are_read_to_the_bit(tmp_path, times, data):
    times.sort()
    strains = data.draw(st.lists(st.floats(-0.1, 0.3), min_size=len(times), max_size=len(times)))
    path = tmp_path / 'good.csv'
    rows = [f'{t!r},{e!r}\n' for t, e in zip(times, strains, strict=True)]
    path.write_text(HEAD + ''.join(rows))
    assert read_samples(path) == (times, strains)


def test_what_spreadsheets_write_is_read(tmp_path):
    path = tmp_path / 'sheet.csv'
    path.write_bytes('\ufefftime, strain\r\n0, 0.01\r\n\r\n"1.5",1e-2\r\n ,\r\n'.encode())
    assert read_samples(path) == ([0.0, 1.5], [0.01, 0.01])


@pytest.mark.parametrize(
    ('content', 'message'),
    [
        ('', "row 1 = '': must be time,strain"),
        ('t,e\n0,0\n', "row 1 = 't,e': must be time,strain"),
        ('0,0\n1,0\n', "row 1 = '0,0': must be time,strain"),
        (HEAD, '0 samples; must be >= 2'),
        (HEAD + '0,0\n', '1 samples; must be >= 2'),
        (HEAD + '0,0\n1\n', 'row 3: 1 values; must be 2, time and strain'),
        (HEAD + '0,0\n1,0,0\n', 'row 3: 3 values; must be 2, time and strain'),
        (HEAD + '0,0\n\n1,much\n', 'row 4: strain = much: must be >= -0.1 and <= 0.3'),
        (HEAD + '0,0\n1,\n', 'row 3: strain = : must be >= -0.1 and <= 0.3'),
        (HEAD + '0,0\n1_0,0\n', 'row 3: time = 1_0 s: must be >= 0 and <= 1e+06'),
        (HEAD + '0,0\n1,nan\n', 'row 3: strain = nan: must be >= -0.1 and <= 0.3'),
        (HEAD + '0,0\n1,5\n', 'row 3: strain = 5: must be >= -0.1 and <= 0.3'),
        (HEAD + '0,0\n-1,0\n', 'row 3: time = -1 s: must be >= 0 and <= 1e+06'),
        (HEAD + '0,0\ninf,0\n', 'row 3: time = inf s: must be >= 0 and <= 1e+06'),
        (HEAD + '0,0\n2,0\n2,0\n', 'row 4: time = 2 s: must be > 2 s, the one before'),
        (HEAD + '0,0\n2,0\n1,0\n', 'row 4: time = 1 s: must be > 2 s, the one before'),
        (HEAD + '0;0\n1;0\n', 'row 2: 1 values; must be 2, time and strain'),
    ],
)
def test_a_bad_row_is_named_with_its_value_and_its_bound(complaint, content, message):
    assert complaint(content) == message


def test_a_file_that_is_not_there_is_named(tmp_path):
    with pytest.raises(ConfigurationError) as refused:
        read_samples(tmp_path / 'none.csv')
    expected = f'{tmp_path}/none.csv: cannot be read (No such file or directory)'
    assert str(refused.value) == expected


def test_too_many_rows_are_refused_where_they_become_too_many(complaint):
    rows = ''.join(f'{k},0\n' for k in range(MOST_SAMPLES + 1))
    expected = f'row {MOST_SAMPLES + 2}: must be the last; <= {MOST_SAMPLES} samples'
    assert complaint(HEAD + rows) == expected


@shared_folder
@given(st.binary(max_size=60), st.booleans())
def test_any_bytes_are_read_or_refused_in_one_line(tmp_path, content, head):
    path = tmp_path / 'any.csv'
    path.write_bytes((HEAD.encode() if head else b'') + content)
    try:
        times, strains = read_samples(path)
    except ConfigurationError as error:
        assert str(error).startswith(f'{path}: ')
        assert len(str(error).splitlines()) == 1
    else:
        assert len(times) == len(strains) >= 2


@shared_folder
@given(
    st.lists(
        st.sampled_from(['0', '1', '2.5', '', ' ', '"', ',', '\n', '1e400', 'x']), max_size=30
    )
)
def test_any_rows_are_samples_of_a_configuration_or_refused(tmp_path, configuration_path, parts):
    path = tmp_path / 'rows.csv'
    path.write_text(HEAD + ''.join(parts))
    try:
        times, strains = read_samples(path)
    except ConfigurationError as error:
        assert len(str(error).splitlines()) == 1
        return
    values = read_yaml(configuration_path)
    values['reference'].update(kind='samples', times=times, strains=strains)
    assert make_configuration(values).duration() == times[-1]
