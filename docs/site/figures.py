# SPDX-License-Identifier: Apache-2.0
"""The figures of the site: those of ``./fam demo``, of runs in one process."""

from pathlib import Path
from tempfile import TemporaryDirectory

from fam_bundle_bringup.demo import draw_figures, with_scheme
from fam_bundle_bringup.offline import run_offline
from fam_bundle_model.parameters import load_configuration, PAPER_SCHEMES

ROOT = Path(__file__).resolve().parents[2]
RIG = ROOT / 'ros2_ws' / 'src' / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'


def drawn() -> dict[str, bytes]:
    """Return every figure as PNG by its path in the site."""
    configuration = load_configuration(RIG)
    runs = {scheme: with_scheme(configuration, scheme) for scheme in PAPER_SCHEMES}
    runs['force'] = with_scheme(configuration, 'lag_pressure', allocation='force')
    traces = {name: run_offline(run) for name, run in runs.items()}
    with TemporaryDirectory() as folder:
        paths = draw_figures(configuration, traces, Path(folder))
        return {f'figures/{p.name}': p.read_bytes() for p in paths if p.suffix == '.png'}
