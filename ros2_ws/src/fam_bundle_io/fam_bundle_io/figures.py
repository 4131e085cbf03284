# SPDX-License-Identifier: Apache-2.0
"""The figures of the project, each a function that returns a matplotlib ``Figure``.

No pyplot and no state of matplotlib's: the style is applied while a figure is built and saved.
"""

from fam_bundle_io.figures_model import (
    lag_table_figure,
    response_figure,
    source_figure,
    surface_figure,
)
from fam_bundle_io.figures_report import energy_figure, timing_figure
from fam_bundle_io.figures_runs import comparison_figure, prediction_figure, run_figure
from fam_bundle_io.figures_style import save_figures

__all__ = [
    'comparison_figure',
    'energy_figure',
    'lag_table_figure',
    'prediction_figure',
    'response_figure',
    'run_figure',
    'save_figures',
    'source_figure',
    'surface_figure',
    'timing_figure',
]
