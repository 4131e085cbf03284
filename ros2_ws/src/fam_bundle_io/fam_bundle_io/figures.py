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

"""
The figures of the project, each a function that returns a matplotlib ``Figure``.

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
