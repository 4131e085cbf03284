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

"""What the figures of a study show, against pandas and SciPy."""

import itertools
from typing import Any

from fam_bundle_io.figures_study import (
    axis_words,
    heat_map_figure,
    quantities,
    rank_correlations,
    sensitivity_figure,
    tradeoff_figure,
)
import numpy as np
import pandas as pd
import pytest
from scipy.stats import spearmanr

SCHEMES = ['baseline', 'lag', 'preview']
FREQUENCIES, AMPLITUDES, MASSES = [0.1, 0.2, 0.3, 0.5], [0.04, 0.05], [10.0, 15.0, 18.8]


@pytest.fixture
def columns() -> dict[str, list[Any]]:
    """Return a study of three axes with a gap, a case that chatters, and ratios."""
    random = np.random.default_rng(3)
    rows = itertools.product(FREQUENCIES, AMPLITUDES, MASSES, SCHEMES)
    names = ('reference.frequency', 'reference.amplitude', 'load.mass', 'scheme')
    found = {n: list(c) for n, c in zip(names, zip(*rows, strict=True), strict=True)}
    number = len(found['scheme'])
    for name in ('iae', 'max_error', 'efficiency', 'best_threshold.iae_ratio'):
        found[name] = random.uniform(0.1, 2.0, number).tolist()
    found['upshifts'] = found['needless_shifts'] = [0] * (number - 1) + [4]
    for k in range(0, 9, 3):
        found['iae'][k] = None  # all cases of the first cell of the first scheme
    return found


def panels(figure: Any) -> dict[str, Any]:
    return {axes.get_title(loc='left'): axes for axes in figure.axes if axes.images}


def test_cells_are_the_medians_of_their_cases(columns: dict[str, list[Any]]) -> None:
    axes = ('reference.frequency', 'reference.amplitude')
    figure = heat_map_figure(columns, SCHEMES, *axes, quantities([])[0])
    table = pd.DataFrame(columns)
    table['iae'] = table['iae'].astype(float)
    shown = panels(figure)
    assert list(shown) == SCHEMES
    for scheme, panel in shown.items():
        pivot = table[table.scheme == scheme].pivot_table(
            index=axes[1], columns=axes[0], values='iae', aggfunc='median', dropna=False
        )
        cells = np.ma.filled(panel.images[0].get_array(), np.nan)
        np.testing.assert_allclose(cells, pivot.to_numpy())
    assert np.isnan(np.ma.filled(shown['baseline'].images[0].get_array(), np.nan)[0, 0])
    assert len(shown['baseline'].patches) == 1
    assert any(text.get_text().endswith('×') for text in shown['preview'].texts)
    assert 'median of up to 3 cases' in figure.get_suptitle()


def test_ratios_have_one_scale_around_1(columns: dict[str, list[Any]]) -> None:
    (ratio,) = (q for q in quantities(['best_threshold']) if q.column.endswith('iae_ratio'))
    figure = heat_map_figure(columns, SCHEMES, 'load.mass', 'scheme', ratio)
    ((_, panel),) = panels(figure).items()
    norm = panel.images[0].norm
    assert norm(1.0) == pytest.approx(0.5)
    values = np.ma.filled(panel.images[0].get_array(), np.nan)
    assert values.shape == (3, 3)
    assert norm.vmin <= values.min() and values.max() <= norm.vmax


def test_correlations_are_those_of_scipy(columns: dict[str, list[Any]]) -> None:
    table = pd.DataFrame(columns)
    for scheme in SCHEMES:
        known = table[(table.scheme == scheme) & table.iae.notna()]
        expected = spearmanr(known['load.mass'], known['iae'].astype(float)).statistic
        found = rank_correlations(columns, scheme, ['load.mass'], 'iae')
        assert found == [pytest.approx(expected)]


def test_what_does_not_differ_has_no_correlation(columns: dict[str, list[Any]]) -> None:
    columns['load.mass'] = [10.0] * len(columns['scheme'])
    assert np.isnan(rank_correlations(columns, 'lag', ['load.mass'], 'iae')).all()
    assert sensitivity_figure(columns, SCHEMES, ['load.mass', 'reference.amplitude']).axes


def test_medians_are_drawn_for_every_scheme_with_numbers(columns: dict[str, list[Any]]) -> None:
    columns['iae'] = [
        v if s != 'lag' else None for v, s in zip(columns['iae'], columns['scheme'], strict=True)
    ]
    figure = tradeoff_figure(columns, SCHEMES, [])
    (legend,) = figure.legends
    assert [text.get_text() for text in legend.get_texts()] == ['baseline', 'preview']


def test_axes_have_units() -> None:
    assert axis_words('reference.frequency') == 'reference.frequency (Hz)'
    assert axis_words('reference.amplitude') == 'reference.amplitude'
    assert axis_words('way') == 'way'
