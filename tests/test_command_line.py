# SPDX-License-Identifier: Apache-2.0
"""What the command line writes, and how it refuses."""

from collections.abc import Callable
import json
from pathlib import Path
import subprocess

from fam_bundle_bringup.cli import main
from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_io.trace import load_trace, PER_UNIT, SCALARS
import numpy as np
import pytest
from scipy.integrate import trapezoid
import yaml

Fam = Callable[..., 'subprocess.CompletedProcess[str]']

Capture = pytest.CaptureFixture[str]

QUICK = ('--frequency', '0.25', '--cycles', '1')


def assert_refused(arguments: list[str], words: tuple[str, ...], capsys: Capture) -> None:
    try:
        status = main(arguments)
    except SystemExit as end:  # by the parser
        status = end.code
    message = capsys.readouterr().err
    assert status == 2
    assert message.count('\n') == 1, message
    assert all(word in message for word in words), message


def test_offline_experiment_writes_its_folder(fam: Fam, tmp_path: Path) -> None:
    out = tmp_path / 'deep' / 'out'
    done = fam('experiment', '--scheme', 'lag', '--pace', 'offline', *QUICK, '--out', out)
    assert done.returncode == 0, done.stderr
    metrics = json.loads((out / 'metrics.json').read_text())
    trace = load_trace(out / 'trace.npz')
    assert set(trace) == {*SCALARS, *PER_UNIT}
    assert metrics['scheme'] == 'lag'
    assert metrics['ticks'] == len(trace['time']) == 4000
    error = np.abs(trace['strain_reference'] - trace['strain'])
    assert metrics['max_error'] == pytest.approx(error.max(), rel=1e-12)
    assert metrics['iae'] == pytest.approx(trapezoid(error, trace['time']), rel=1e-3)
    state = trace['recruitment_state']
    assert metrics['upshift_times'] == trace['time'][1:][np.diff(state) > 0].tolist()
    assert metrics['downshift_times'] == trace['time'][1:][np.diff(state) < 0].tolist()
    assert set(metrics) >= {'parameters_hash', 'versions'}


def test_written_parameters_give_the_same_run_again(fam: Fam, tmp_path: Path) -> None:
    first, again = tmp_path / 'first', tmp_path / 'again'
    fam('experiment', '--pace', 'offline', *QUICK, '--out', first)
    parameters = first / 'parameters.yaml'
    fam('experiment', '--pace', 'offline', '--config', parameters, '--out', again)
    assert json.loads((first / 'metrics.json').read_text()) == json.loads(
        (again / 'metrics.json').read_text()
    )


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('--scheme', 'lagg'), ('recruitment.scheme', 'lagg', 'baseline, lag, pressure')),
        (('--threshold', '1.5'), ('recruitment.upshift_threshold', '1.5', '<= 1')),
        (('--threshold', 'nan'), ('recruitment.upshift_threshold', 'nan')),
        (('--amplitude', '0.1'), ('reference.amplitude', '0.1', '<=')),
        (('--frequency', '-1'), ('reference.frequency', '-1', '>=')),
        (('--cycles', '0'), ('reference.cycles', '0', '>= 1')),
        (('--pace', 'warp'), ('--pace', 'warp')),
        (('--reference', 'square'), ('reference.kind', 'square', 'sine')),
        (('--config', '/does/not/exist.yaml'), ('/does/not/exist.yaml', 'No such file')),
        (('--bogus',), ('--bogus',)),
        (
            ('--scheme', 'baseline', '--allocation', 'orderly'),
            ('allocation.policy', 'orderly', 'recruitment.scheme = baseline', 'lag'),
        ),
        (('--cycles', '100000'), ('reference.cycles', '100000', '<= 2000')),
    ],
)
def test_bad_argument_is_refused_in_one_line(
    arguments: tuple[str, ...], words: tuple[str, ...], capsys: Capture, tmp_path: Path
) -> None:
    out = tmp_path / 'out'
    assert_refused(['experiment', *arguments, '--out', str(out)], words, capsys)
    assert not out.exists()


@pytest.mark.parametrize(
    ('group', 'name', 'value', 'words'),
    [
        ('load', 'mass', 140.0, ('load.mass', '140', 'never be lifted', 'at most')),
        ('load', 'mass', float('nan'), ('load.mass', 'nan', '> 0')),
        ('hose', 'radius', -0.003, ('hose.radius', '-0.003 m', '> 0')),
        ('fam', 'count', [], ('fam.count', '[]')),
        ('fam', 'count', 0, ('fam.count', '0', '>= 1')),
        ('strain_loop', 'integral_gain', None, ('strain_loop.integral_gain', 'missing')),
        ('hose', 'radus', 0.1, ('hose.radus', 'hose.radius')),
        ('simulation', 'substeps', 2.5, ('simulation.substeps', '2.5')),
    ],
)
def test_bad_configuration_is_refused_in_one_line(
    group: str, name: str, value: object, words: tuple[str, ...], capsys: Capture, tmp_path: Path
) -> None:
    content = yaml.safe_load(default_configuration().read_text())
    values = content['/**']['ros__parameters'][group]
    if value is None:
        del values[name]
    else:
        values[name] = value
    config, out = tmp_path / 'bad.yaml', tmp_path / 'out'
    config.write_text(yaml.safe_dump(content))
    arguments = ['experiment', '--pace', 'offline', '--config', str(config), '--out', str(out)]
    assert_refused(arguments, words, capsys)
    assert not out.exists()


def test_diverging_plant_is_an_error_and_keeps_what_was_good(
    capsys: Capture, tmp_path: Path
) -> None:
    content = yaml.safe_load(default_configuration().read_text())
    content['/**']['ros__parameters']['valve']['spool_time_constant'] = 1e-5
    config, out = tmp_path / 'stiff.yaml', tmp_path / 'out'
    config.write_text(yaml.safe_dump(content))
    arguments = ['experiment', '--pace', 'offline', *QUICK, '--config', str(config)]
    assert main([*arguments, '--out', str(out)]) == 1
    message = capsys.readouterr().err
    assert 'is not finite' in message
    assert 'simulation.substeps' in message
    assert not (out / 'metrics.json').exists()
    for values in load_trace(out / 'trace.npz').values():
        assert not np.isnan(values).any()


def test_own_parameters_are_not_overwritten(capsys: Capture, tmp_path: Path) -> None:
    config = tmp_path / 'parameters.yaml'
    config.write_text(default_configuration().read_text())
    before = config.read_bytes()
    arguments = ['experiment', '--pace', 'offline', '--config', str(config), '--out']
    assert_refused([*arguments, str(tmp_path)], ('would overwrite',), capsys)
    assert config.read_bytes() == before


def test_out_that_is_a_file_is_refused(capsys: Capture, tmp_path: Path) -> None:
    out = tmp_path / 'out'
    out.write_text('precious')
    arguments = ['experiment', '--pace', 'offline', *QUICK, '--out', str(out)]
    assert_refused(arguments, (str(out),), capsys)
    assert out.read_text() == 'precious'
