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

"""The lag table on disk: the same bits, never that of other parameters, never a broken one."""

import dataclasses
import math

from fam_bundle_model import lag_table
from fam_bundle_model.lag_table import (
    cached_lag_table,
    lag_table_hash,
    LagTable,
    load_lag_table,
    save_lag_table,
)
import numpy as np
import pytest


@pytest.fixture
def table():
    random = np.random.default_rng(3)
    lag = random.standard_normal((2, 4, 5)) * 10.0 ** random.integers(-300, 300, (2, 4, 5))
    lag[0, 0, 0], lag[1, 2, 3] = math.inf, -0.0
    return LagTable(random.random(4), random.random(5), lag, random.random((2, 4, 5)))


def same_bits(first, second):
    return all(
        a.shape == b.shape and a.dtype == b.dtype and a.tobytes() == b.tobytes()
        for a, b in zip(first, second, strict=True)
    )


def test_a_saved_table_loads_to_the_same_bits(table, tmp_path):
    path = tmp_path / 'new' / 'folder' / 'table.npz'
    save_lag_table(table, 'abc', path)
    assert same_bits(load_lag_table(path, 'abc'), table)
    assert [p.name for p in path.parent.iterdir()] == ['table.npz']  # no temporary file left


def test_a_table_of_other_parameters_is_refused(table, tmp_path):
    path = tmp_path / 'table.npz'
    save_lag_table(table, 'abc', path)
    with pytest.raises(ValueError, match=r'table\.npz: built from parameters abc, not xyz'):
        load_lag_table(path, 'xyz')


def test_a_missing_table_is_an_os_error(tmp_path):
    with pytest.raises(OSError, match=r'none\.npz'):
        load_lag_table(tmp_path / 'none.npz', 'abc')


@pytest.fixture
def cache(configuration, monkeypatch, tmp_path):
    """Return a small configuration whose cache is a folder of this test, and the builds made."""
    monkeypatch.setenv('XDG_CACHE_HOME', str(tmp_path))
    grid = dataclasses.replace(configuration.lag_table, source_points=2, deslack_points=3)
    builds = []
    build = lag_table.build_lag_table

    def counted(configuration):
        builds.append(configuration)
        return build(configuration)

    monkeypatch.setattr(lag_table, 'build_lag_table', counted)
    return dataclasses.replace(configuration, lag_table=grid), builds


def test_the_second_call_reads_what_the_first_has_built(cache):
    configuration, builds = cache
    first, second = cached_lag_table(configuration), cached_lag_table(configuration)
    assert len(builds) == 1
    assert same_bits(first, second)


def test_another_gain_builds_another_table(cache):
    configuration, builds = cache
    cached_lag_table(configuration)
    loop = dataclasses.replace(configuration.pressure_loop, proportional_gain=(1e-5,))
    cached_lag_table(dataclasses.replace(configuration, pressure_loop=loop))
    cached_lag_table(configuration)
    assert len(builds) == 2


def spoilt(content):
    """Return broken files by what befell them, from a good one's ``content``."""
    flipped = bytearray(content)
    flipped[content.index(b'lag.npy') + 200] ^= 0xFF
    return {
        'empty': b'',
        'text': b'not a table\n',
        'truncated': content[: len(content) // 2],
        'flipped bit': bytes(flipped),
        'zip without members': b'PK\x05\x06' + bytes(18),
    }


@pytest.mark.parametrize('accident', list(spoilt(b'lag.npy' + bytes(300))))
def test_a_broken_file_is_built_anew(cache, accident):
    configuration, builds = cache
    good = cached_lag_table(configuration)
    path = next(lag_table.cache_directory().rglob('*.npz'))
    path.write_bytes(spoilt(path.read_bytes())[accident])
    assert same_bits(cached_lag_table(configuration), good)
    assert len(builds) == 2
    assert same_bits(cached_lag_table(configuration), good)
    assert len(builds) == 2


def test_hash_depends_on_what_the_lag_depends_on_and_on_nothing_else(configuration):
    def other(group, **values):
        part = dataclasses.replace(getattr(configuration, group), **values)
        return lag_table_hash(dataclasses.replace(configuration, **{group: part}))

    same = lag_table_hash(configuration)
    assert other('recruitment', minimum_dwell=9.0) == same
    assert other('load', mass=1.0) == same
    assert other('hose', length=9.0) != same
    assert other('simulation', period=0.01) != same
    assert other('pressure_loop', integral_limit=(0.123,)) != same
    assert other('fam', count=(1, 7)) != same
