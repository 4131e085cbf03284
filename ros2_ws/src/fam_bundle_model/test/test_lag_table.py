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

"""The lag table: its shape, and its bilinear look-up."""

import dataclasses
import math

from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.lag_table import build_lag_table, fill_response, LagTable, look_up, REACHED
from fam_bundle_model.pressure_pi import pressure_gains
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

PLANE = LagTable(
    np.linspace(2e5, 7e5, 6),
    np.linspace(0.0, 6e5, 4),
    np.empty((1, 6, 4)),
    np.empty((1, 6, 4)),
)


def bilinear(source, deslack):
    return 0.3 - 2e-7 * source + 1e-6 * deslack + 3e-13 * source * deslack


PLANE.lag[0] = bilinear(PLANE.source_pressure[:, np.newaxis], PLANE.deslack_pressure)
PLANE.drop[0] = 1e5 * PLANE.lag[0] + 7.0


@pytest.fixture(scope='module')
def coarse(configuration, change):
    grid = dataclasses.replace(
        configuration.lag_table, source_points=9, deslack_points=12, minimum_source=0.3
    )
    return change('lag_table', **dataclasses.asdict(grid))


@pytest.fixture(scope='module')
def table(coarse):
    return build_lag_table(coarse)


def test_axes_span_what_the_configuration_says(table, coarse):
    nominal = coarse.source.nominal_pressure
    assert table.source_pressure == pytest.approx(np.linspace(0.3 * nominal, nominal, 9))
    assert table.deslack_pressure == pytest.approx(np.linspace(0.0, nominal, 12))
    assert table.lag.shape == table.drop.shape == (len(coarse.fam.count), 9, 12)


def test_a_higher_deslack_pressure_takes_no_less_time(table, coarse):
    tick = 1.001 * coarse.simulation.period
    for row in table.lag.reshape(-1, table.lag.shape[-1]):
        reached = row[np.isfinite(row)]
        assert np.all(np.diff(reached) >= -tick)
        assert np.all(np.isinf(row[len(reached) :]))  # once never, always never  # noqa: E203


def test_a_higher_source_pressure_takes_no_more_time(table, coarse):
    tick = 1.001 * coarse.simulation.period
    for unit in table.lag:
        for column in unit.T:
            reached = column[np.isfinite(column)]
            assert np.all(np.diff(reached) <= tick)
            assert np.all(np.isinf(column[: len(column) - len(reached)]))


def test_what_the_source_cannot_give_is_never_reached(table):
    source = table.source_pressure[:, np.newaxis]
    beyond = REACHED * table.deslack_pressure >= source
    assert beyond.any()
    assert np.all(np.isinf(table.lag[:, beyond]))
    within = table.deslack_pressure <= 0.5 * source
    assert np.all(np.isfinite(table.lag[:, within]))


def test_no_deslack_pressure_takes_no_time_and_any_other_does(table, coarse):
    assert np.all(table.lag[:, :, 0] == 0.0)
    assert np.all(table.lag[:, :, 1:] >= coarse.simulation.period)


def test_drop_is_a_share_of_the_source(table):
    assert np.all(table.drop >= 0.0)
    assert np.all(table.drop < table.source_pressure[:, np.newaxis])
    reached = np.isfinite(table.lag) & (table.deslack_pressure > 0.0)
    assert np.all(table.drop[reached] > 0.0)


def test_nodes_are_single_fillings(table, coarse, units, hydraulics):
    gains = pressure_gains(coarse)[1]
    for i, j in ((8, 5), (4, 3)):
        supply = hydraulics._replace(nominal_pressure=table.source_pressure[i])
        target = table.deslack_pressure[j]
        expected = fill_response(
            supply,
            gains,
            units[1],
            target,
            coarse.lag_table.maximum_lag,
            coarse.simulation.period,
            coarse.simulation.substeps,
            np.empty((0, 5)),
        )
        assert (table.lag[1, i, j], table.drop[1, i, j]) == expected


def test_equal_units_share_their_lag_and_larger_ones_take_longer(change, coarse):
    grid = dataclasses.replace(coarse.lag_table, source_points=2, deslack_points=4)
    three = dataclasses.replace(
        coarse, fam=dataclasses.replace(coarse.fam, count=(2, 4, 2)), lag_table=grid
    )
    lag = build_lag_table(three).lag
    assert np.array_equal(lag[0], lag[2])
    assert np.all(lag[1, -1, 1:3] > lag[0, -1, 1:3])
    assert len({id(u.fam) for u in motor_units(three)}) == 1


def test_look_up_gives_the_nodes_exactly(table):
    for i, source in enumerate(table.source_pressure):
        for j, deslack in enumerate(table.deslack_pressure):
            found = look_up(table, 0, source, deslack)
            assert found.lag == pytest.approx(table.lag[0, i, j], rel=1e-12)
            assert not found.outside


@settings(deadline=None, max_examples=100)
@given(st.floats(2e5, 7e5), st.floats(0.0, 6e5))
def test_look_up_is_exact_for_bilinear_data(source, deslack):
    found = look_up(PLANE, 0, source, deslack)
    assert found.lag == pytest.approx(bilinear(source, deslack), rel=1e-12)
    assert found.drop == pytest.approx(1e5 * bilinear(source, deslack) + 7.0, rel=1e-12)
    assert not found.outside


@settings(deadline=None, max_examples=60)
@given(st.floats(-1e6, 2e6), st.floats(-1e6, 2e6))
def test_outside_of_the_grid_the_edge_counts_and_is_flagged(source, deslack):
    inside = min(max(source, 2e5), 7e5), min(max(deslack, 0.0), 6e5)
    found = look_up(PLANE, 0, source, deslack)
    assert found.lag == pytest.approx(bilinear(*inside), rel=1e-12)
    assert found.outside == (inside != (source, deslack))


def test_an_infinite_deslack_pressure_is_outside():
    found = look_up(PLANE, 0, 5e5, math.inf)
    assert found.outside
    assert found.lag == pytest.approx(bilinear(5e5, 6e5))


def test_never_spreads_over_the_cells_that_touch_it_and_no_further():
    lag = PLANE.lag.copy()
    lag[0, 2, 2] = math.inf
    table = PLANE._replace(lag=lag)
    s, d = PLANE.source_pressure, PLANE.deslack_pressure
    for source, deslack in ((s[2] + 1.0, d[2] + 1.0), (s[2] - 9e4, d[2] - 1e5), (s[2], d[2])):
        assert look_up(table, 0, source, deslack).lag == math.inf
    for source, deslack in ((s[3], d[2]), (s[2], d[1]), (s[3] + 1.0, d[2]), (s[1], d[2])):
        assert look_up(table, 0, source, deslack).lag < math.inf


def test_each_unit_looks_up_its_own_table():
    table = PLANE._replace(
        lag=np.concatenate([PLANE.lag, 2.0 * PLANE.lag]), drop=np.concatenate([PLANE.drop] * 2)
    )
    first, second = (look_up(table, i, 3.3e5, 1.1e5).lag for i in range(2))
    assert second == pytest.approx(2.0 * first)


def test_lag_is_that_of_the_strain_whose_deslack_pressure_is_asked(table, units):
    """The table's second axis is a strain in disguise."""
    strains = [fam.free_strain(units[1].fam, p) for p in table.deslack_pressure]
    assert np.all(np.diff(strains) > 0.0)
    back = [fam.deslack_pressure(units[1].fam, e) for e in strains]
    assert back == pytest.approx(table.deslack_pressure.tolist(), rel=1e-9, abs=1e-6)
