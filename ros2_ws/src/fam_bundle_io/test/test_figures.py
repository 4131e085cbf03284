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

"""The figures hold the data they are given, mark what they say, and are written whole."""

import dataclasses
import itertools
from pathlib import Path
import subprocess
import sys

from fam_bundle_bringup.expectation import expectation
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.figures import (
    comparison_figure,
    lag_table_figure,
    prediction_figure,
    response_figure,
    run_figure,
    save_figures,
    source_figure,
    surface_figure,
)
from fam_bundle_io.figures_runs import prediction_before
from fam_bundle_io.figures_style import last_cycle
from fam_bundle_io.metrics import shift_times
from fam_bundle_io.trace import empty_trace
from fam_bundle_model import fam
from fam_bundle_model.bundle import modelled_strain, motor_units
from fam_bundle_model.lag_table import build_lag_table, LagTable, look_up
from fam_bundle_model.parameters import load_configuration, PREDICTORS
import matplotlib
from matplotlib.figure import Figure
from matplotlib.image import imread
import numpy as np
import pytest

CONFIGURATION = Path(__file__).parents[2] / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
QUICK = {
    'reference': {'amplitude': 0.06, 'frequency': 0.25, 'cycles': 2},
    'lag_table': {'source_points': 8, 'deslack_points': 11},
}


@pytest.fixture(scope='module')
def configuration():
    return load_configuration(CONFIGURATION, QUICK)


@pytest.fixture(scope='module')
def table(configuration):
    return build_lag_table(configuration)


@pytest.fixture(scope='module')
def runs(configuration, table):
    """Return two real cycles of a threshold scheme and of an anticipatory one."""

    def run(scheme):
        recruitment = dataclasses.replace(configuration.recruitment, scheme=scheme)
        one = dataclasses.replace(configuration, recruitment=recruitment)
        return run_offline(one, table=table)

    return {scheme: run(scheme) for scheme in ('baseline', 'lag')}


@pytest.fixture
def synthetic():
    """Return a maker of two cycles of 1 s: states 1, 2 and back in each, nothing predicted."""

    def make(units=2, shifts=True):
        trace = empty_trace(200, units)
        for values in trace.values():
            values[:] = 0
        time = 0.01 * np.arange(200)
        trace['time'] = time
        trace['strain_reference'] = 0.06 * (1.0 - np.cos(2.0 * np.pi * time))
        trace['strain'] = 0.9 * trace['strain_reference']
        trace['source_pressure'][:] = 600e3
        trace['mu_pressure'][:] = 1e5 * np.arange(1, units + 1)
        trace['time_to_saturation'][:] = np.inf
        trace['time_to_desaturation'][:] = np.inf
        trace['recruitment_lag'][:] = np.inf
        phase = np.arange(200) % 100
        trace['recruitment_state'][:] = np.where(shifts & (phase >= 30) & (phase < 80), 2, 1)
        return trace

    return make


def lines(axes, label):
    found = [line for line in axes.get_lines() if line.get_label() == label]
    assert len(found) == 1, f'{len(found)} lines labelled {label}'
    return found[0]


def vertical_lines(axes):
    """Return the times of the lines across the whole height of ``axes``."""
    spans = [(np.array(line.get_xdata()), np.array(line.get_ydata())) for line in axes.get_lines()]
    return sorted(float(x[0]) for x, y in spans if y.tolist() == [0, 1] and x[0] == x[1])


def texts(axes):
    return [text.get_text() for text in axes.texts]


def test_a_run_shows_its_last_cycle_in_kilopascal_and_percent(synthetic):
    trace = synthetic()
    figure = run_figure(trace, 'a title')
    tracking, _, pressures, error = figure.axes
    for label, name in (('measured', 'strain'), ('reference', 'strain_reference')):
        line = lines(tracking, label)
        np.testing.assert_array_equal(line.get_xdata(), trace['time'][100:])
        np.testing.assert_allclose(line.get_ydata(), 100.0 * trace[name][100:])
    assert set(lines(pressures, 'source').get_ydata()) == {600.0}
    difference = trace['strain_reference'] - trace['strain']
    np.testing.assert_allclose(error.get_lines()[1].get_ydata(), 100.0 * difference[100:])
    # matplotlib 3.6 has no public getter.
    assert figure._suptitle.get_text() == 'a title'


def test_a_run_has_one_pressure_curve_for_each_of_seven_motor_units(synthetic):
    pressures = run_figure(synthetic(units=7), '').axes[-2]
    curves = [lines(pressures, f'MU{k}') for k in range(1, 8)]
    assert [set(c.get_ydata()) for c in curves] == [{100.0 * k} for k in range(1, 8)]
    looks = {(c.get_color(), c.get_linestyle(), str(c._dash_pattern)) for c in curves}
    assert len(looks) == 7


def test_every_panel_of_a_real_run_marks_its_shifts(runs):
    for trace in runs.values():
        start = trace['time'][last_cycle(trace)][0]
        expected = [t for times in shift_times(trace) for t in times if t >= start]
        assert len(expected) == 2
        for axes in run_figure(trace, '').axes:
            assert vertical_lines(axes) == pytest.approx(sorted(expected))


def test_infinite_times_are_gaps_and_the_panel_goes_when_there_is_nothing_else(runs, synthetic):
    trace = runs['lag']
    panel = run_figure(trace, '').axes[1]
    drawn = np.asarray(lines(panel, 'to saturation').get_ydata())
    given = trace['time_to_saturation'][last_cycle(trace)]
    assert np.isnan(drawn).any() and np.isfinite(drawn).any()
    np.testing.assert_array_equal(drawn, np.where(np.isfinite(given), given, np.nan))
    assert np.isfinite(panel.get_ylim()).all()
    assert len(run_figure(synthetic(), '').axes) == 4


def test_a_lag_of_never_all_along_leaves_finite_axes(synthetic):
    trace = synthetic()
    trace['time_to_saturation'][120:130] = 0.1
    panel = run_figure(trace, '').axes[1]
    assert np.isfinite(panel.get_ylim()).all()


def test_the_last_cycle_is_the_last_whole_one(synthetic):
    trace = synthetic()
    stopped = {name: values[:170] for name, values in trace.items()}
    flat = {**trace, 'strain_reference': np.full(200, 0.05)}
    assert last_cycle(trace) == slice(100, 200)
    assert last_cycle(stopped) == slice(0, 100)
    assert last_cycle(flat) == slice(0, 200)


def test_the_comparison_zooms_to_the_upshifts_of_all_schemes(runs):
    near, whole = comparison_figure(runs).axes
    low, high = near.get_xlim()
    for name, trace in runs.items():
        window = last_cycle(trace)
        start = trace['time'][window][0]
        np.testing.assert_allclose(
            lines(near, name).get_ydata(), 100.0 * trace['strain'][window], atol=1e-12
        )
        upshift = next(t for t in shift_times(trace)[0] if t >= start) - start
        assert low < upshift < high
    error = runs['lag']['strain_reference'] - runs['lag']['strain']
    np.testing.assert_allclose(
        whole.get_lines()[1].get_ydata(), 100.0 * error[last_cycle(runs['lag'])], atol=1e-12
    )


def test_a_comparison_without_upshift_says_so_and_shows_the_whole_cycle(synthetic):
    near, whole = comparison_figure({'still': synthetic(shifts=False)}).axes
    assert near.get_title(loc='left') == 'no upshift in this cycle'
    assert near.get_xlim() == whole.get_xlim()


def predictions_of(trace, configuration):
    return prediction_figure(trace, configuration, expectation(configuration, trace))


def filtered_force(trace, configuration):
    """Return the force as the recruitment law filters it (backward Euler)."""
    period, constant = trace['time'][1], configuration.recruitment.force_time_constant
    out = [trace['force'][0]]
    for value in trace['force'][1:]:
        out.append((constant * out[-1] + period * value) / (constant + period))
    return np.array(out)


@pytest.mark.parametrize('predictor', PREDICTORS)
def test_the_expected_strain_drawn_meets_the_limit_of_the_model(configuration, table, predictor):
    recruitment = dataclasses.replace(configuration.recruitment, scheme='lag', predictor=predictor)
    configuration = dataclasses.replace(configuration, recruitment=recruitment)
    trace, units = run_offline(configuration, table=table), motor_units(configuration)
    load = filtered_force(trace, configuration)
    ups, downs = shift_times(trace)
    panels = predictions_of(trace, configuration).axes
    for axes, name, shift in (
        (panels[0], 'time_to_saturation', ups[-1]),
        (panels[1], 'time_to_desaturation', downs[-1]),
    ):
        found = prediction_before(trace, configuration, name, shift)
        at = int(np.argmin(np.abs(trace['time'] - found.time)))
        strain, source = trace['strain'][at], trace['source_pressure'][at]
        lag = look_up(table, 1, source, fam.deslack_pressure(units[1].fam, strain))
        limit = modelled_strain(units, 1, source - lag.drop, load[at])
        assert lines(axes, 'strain limit').get_ydata()[0] == pytest.approx(100.0 * limit, rel=1e-6)
        time, drawn = lines(axes, '$E(t)$').get_data()
        there = np.interp(found.time + found.time_to_limit, time, drawn)
        assert there == pytest.approx(100.0 * limit, rel=1e-3)
        assert vertical_lines(axes) == pytest.approx([shift])
        assert any(f'{found.lag:.3f} s' in text for text in texts(axes))
        assert lag.lag == pytest.approx(found.lag)


def test_a_prediction_figure_without_shifts_says_so(synthetic, configuration):
    panels = predictions_of(synthetic(shifts=False), configuration).axes
    assert [texts(a) for a in panels] == [['no upshift in this run'], ['no downshift in this run']]


def test_a_shift_that_nothing_predicted_is_told_from_no_shift(synthetic, configuration):
    panels = predictions_of(synthetic(), configuration).axes
    assert texts(panels[0]) == ['no prediction before the upshift']


def test_a_lag_that_never_ends_is_named_and_not_drawn(synthetic, configuration):
    trace = synthetic()
    trace['time_to_saturation'][120:131] = 0.1
    axes = predictions_of(trace, configuration).axes[0]
    assert any(text.endswith(': never') for text in texts(axes))
    assert np.isfinite([*axes.get_xlim(), *axes.get_ylim()]).all()


def test_the_annotated_lag_and_drop_equal_those_of_the_table(configuration, table):
    nominal = configuration.source.nominal_pressure
    # 0.8 of the nominal pressure is a node of this table: nothing is interpolated.
    entry = look_up(table, 1, nominal, 0.8 * nominal)
    axes = response_figure(configuration).axes[0]
    assert any(text.endswith(f'= {entry.lag:.3f} s') for text in texts(axes))
    assert any(text.endswith(f'= {1e-3 * entry.drop:.1f} kPa') for text in texts(axes))
    assert vertical_lines(axes) == pytest.approx([entry.lag])
    time, pressure = lines(axes, 'MU2').get_data()
    threshold = 0.95 * 0.8e-3 * nominal
    assert lines(axes, '95 % of it').get_ydata()[0] == pytest.approx(threshold)
    reached = np.interp(entry.lag, time, pressure)
    assert reached >= threshold
    assert np.all(pressure[time < entry.lag] < threshold)


def test_a_response_that_does_not_arrive_says_so(configuration):
    patience = dataclasses.replace(configuration.lag_table, maximum_lag=0.05)
    axes = response_figure(dataclasses.replace(configuration, lag_table=patience)).axes[0]
    assert axes.get_title(loc='right') == 'not reached within 0.05 s'
    assert axes.get_xlim() == (0.0, 0.05)


def test_the_source_line_has_the_configured_droop_and_spans_the_runs(configuration, runs):
    axes = source_figure(configuration, runs).axes[0]
    flow, pressure = lines(axes, 'source, settled').get_data()
    slope = 1e3 * (pressure[1] - pressure[0]) / ((flow[1] - flow[0]) / 6e4)
    assert slope == pytest.approx(-configuration.source.droop)
    assert pressure[0] == pytest.approx(1e-3 * configuration.source.nominal_pressure)
    assert flow[1] >= 6e4 * max(trace['source_flow'].max() for trace in runs.values())
    assert source_figure(configuration, {}).axes[0].get_lines()


def test_the_force_curves_are_those_of_the_fam_and_join(configuration):
    law = motor_units(configuration)[0].fam
    whole = surface_figure(configuration).axes[0]
    curves = {}
    for line in whole.get_lines():
        if len(line.get_xdata()) > 2:
            curves.setdefault(tuple(line.get_color()), []).append(line)
    nominal = configuration.source.nominal_pressure
    assert len(curves) == 6
    for pressure, parts in zip(np.linspace(0.0, nominal, 6), curves.values(), strict=True):
        assert [p.get_linestyle() for p in parts] == ['-', '--', ':'][: len(parts)]
        for part in parts:
            strain, force = np.asarray(part.get_xdata()) / 100.0, np.asarray(part.get_ydata())
            for k in (0, 77, 199):
                expected = fam.force(law, float(pressure), float(strain[k]))
                assert force[k] == pytest.approx(expected, rel=1e-9, abs=1e-6)
        for one, following in itertools.pairwise(parts):
            assert one.get_ydata()[-1] == pytest.approx(following.get_ydata()[0], abs=1e-6)


def test_units_with_equal_tables_share_a_row_and_never_is_masked():
    lag = np.array([[[0.1, 0.2, np.inf], [0.1, 0.2, 0.3]]] * 3)
    lag[2] *= 2.0
    axis = np.array([1e5, 2e5]), np.array([0.0, 1e5, 2e5])
    figure = lag_table_figure(LagTable(*axis, lag, np.full(lag.shape, 5e4)))
    maps = [a for a in figure.axes if a.get_xlabel() == 'de-slack pressure (kPa)']
    assert len(maps) == 4
    assert [maps[0].get_ylabel(), maps[2].get_ylabel()] == [
        'MU1, MU2: source pressure (kPa)',
        'MU3: source pressure (kPa)',
    ]
    for axes in maps:
        values = axes.collections[0].get_array().reshape(2, 3)
        assert np.ma.getmaskarray(values).tolist() == [[False, False, True], [False] * 3]


def figure_of(values):
    figure = Figure(figsize=(2.0, 1.0))
    figure.subplots().plot(values)
    return figure


def test_figures_are_written_as_png_and_pdf_and_nothing_else(tmp_path):
    folder = tmp_path / 'new' / 'folder'
    paths = save_figures({'one': figure_of([1, 2]), 'two': figure_of([2, 1])}, folder)
    assert sorted(paths) == sorted(folder.iterdir())
    assert {p.name for p in paths} == {'one.png', 'one.pdf', 'two.png', 'two.pdf'}
    assert imread(folder / 'one.png').shape == (150, 300, 4)
    pdf = (folder / 'one.pdf').read_bytes()
    assert pdf.startswith(b'%PDF-') and pdf.rstrip().endswith(b'%%EOF')
    assert b'CreationDate' not in pdf


def test_the_same_figures_give_the_same_bytes(tmp_path, synthetic):
    first = save_figures({'run': run_figure(synthetic(), 'same')}, tmp_path / 'a')
    again = save_figures({'run': run_figure(synthetic(), 'same')}, tmp_path / 'b')
    assert [p.read_bytes() for p in first] == [p.read_bytes() for p in again]


def test_a_figure_that_cannot_be_drawn_leaves_the_folder_as_it_was(tmp_path):
    (tmp_path / 'one.png').write_bytes(b'old')
    broken = figure_of([1, 2])
    broken.axes[0].set_title('$\\nosuchmacro$')
    with pytest.raises(ValueError, match='nosuchmacro'):
        save_figures({'one': figure_of([1, 2]), 'two': broken}, tmp_path)
    assert [p.name for p in tmp_path.iterdir()] == ['one.png']
    assert (tmp_path / 'one.png').read_bytes() == b'old'


def test_figures_leave_the_style_of_the_caller_alone(synthetic, tmp_path):
    before = dict(matplotlib.rcParams)
    save_figures({'run': run_figure(synthetic(), '')}, tmp_path)
    assert dict(matplotlib.rcParams) == before


def test_figures_need_neither_pyplot_nor_a_display():
    code = 'import sys, fam_bundle_io.figures; print("matplotlib.pyplot" in sys.modules)'
    done = subprocess.run(
        [sys.executable, '-c', code], capture_output=True, text=True, check=True, timeout=60.0
    )
    assert done.stdout.strip() == 'False'
