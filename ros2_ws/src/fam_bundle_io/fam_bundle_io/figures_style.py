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

"""What all figures share: style, colours, windows of a trace, and the files."""

from collections.abc import Mapping
import io
from pathlib import Path
from typing import Any

from fam_bundle_io.metrics import valleys
from fam_bundle_io.trace import Trace
from fam_bundle_model.files import whole_file
import matplotlib
from matplotlib.axes import Axes
from matplotlib.figure import Figure
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]

# A decorator: the style holds while a figure is built or saved, and is then put back.
styled = matplotlib.rc_context(fname=Path(__file__).with_name('fam_bundle.mplstyle'))

KILOPASCAL = 1e-3  # per Pa
PERCENT = 1e2  # per unit strain
LITRES_PER_MINUTE = 6e4  # per m^3/s

# Okabe and Ito's set, told apart under every common colour blindness.
REFERENCE = {'color': '#000000', 'linestyle': '--', 'linewidth': 1.0}
MEASURED = {'color': '#0072B2'}
SOURCE = {'color': '#7a7a7a'}
UPSHIFT, DOWNSHIFT, LAG = '#0072B2', '#D55E00', '#009E73'
UNIT_COLOURS = ('#D55E00', '#56B4E9', '#009E73', '#CC79A7', '#E69F00')
SCHEME_COLOURS = ('#882255', '#CC8800', '#117733', '#332288', '#44AA99', '#888888')
LINE_STYLES = ('-', '--', '-.', ':')


def unit_style(unit: int) -> dict[str, Any]:
    """Return the line of motor unit ``unit`` (0 is the first recruited) in every figure."""
    # Recruited units share one pressure: the lines below show through the gaps of those above.
    return {
        'color': UNIT_COLOURS[unit % len(UNIT_COLOURS)],
        'linestyle': LINE_STYLES[unit % len(LINE_STYLES)],
    }


def scheme_style(position: int) -> dict[str, Any]:
    """Return the line of the scheme at ``position`` in a comparison."""
    turn, colour = divmod(position, len(SCHEME_COLOURS))
    return {'color': SCHEME_COLOURS[colour], 'linestyle': LINE_STYLES[turn % len(LINE_STYLES)]}


def signal(trace: Trace, name: str) -> Array:
    """Return a signal of ``trace`` in SI units; what is infinite becomes a gap (NaN)."""
    values = trace[name].astype(float)
    return np.where(np.isfinite(values), values, np.nan)


def last_cycle(trace: Trace) -> slice:
    """
    Return the ticks of the last whole cycle of the reference, from valley to valley.

    All ticks where the reference has no valley inside the run.
    """
    marks = valleys(signal(trace, 'strain_reference'))
    lengths = np.diff(marks)
    # A run that was stopped ends in a part of a cycle.
    last = len(lengths) - 1
    if last > 0 and lengths[last] < 0.99 * lengths[last - 1]:
        last -= 1
    return slice(marks[last], marks[last + 1])


def mark(axes: Axes, times: list[float]) -> None:
    """Draw a recruitment shift as a vertical dashed line at each of ``times`` (s)."""
    for time in times:
        axes.axvline(time, color='#555555', linestyle=(0, (4, 3)), linewidth=0.8, zorder=1.5)


def legend_beside(axes: Axes, **options: Any) -> None:
    """Put the legend to the right of ``axes``, where it hides nothing."""
    axes.legend(loc='center left', bbox_to_anchor=(1.01, 0.5), **options)


def legend_above(axes: Axes, columns: int) -> None:
    """Put the legend above ``axes`` in ``columns`` columns, where it hides nothing."""
    axes.legend(loc='lower left', bbox_to_anchor=(0.0, 1.0), ncol=columns, columnspacing=1.0)


@styled
def save_figures(figures: Mapping[str, Figure], folder: Path) -> list[Path]:
    """
    Write each figure as ``folder/<name>.png`` (150 dpi) and ``.pdf``; return the paths.

    Everything is drawn before the first file is written, and each file appears whole. Files of
    the same figures by the same matplotlib are equal to the byte.
    """
    contents: dict[Path, bytes] = {}
    for name, figure in figures.items():
        for suffix, metadata in (('png', {}), ('pdf', {'CreationDate': None})):
            buffer = io.BytesIO()
            figure.savefig(buffer, format=suffix, dpi=150, metadata=metadata)
            contents[folder / f'{name}.{suffix}'] = buffer.getvalue()
    folder.mkdir(parents=True, exist_ok=True)
    for path, content in contents.items():
        with whole_file(path) as file:
            file.write(content)
    return list(contents)
