# SPDX-License-Identifier: Apache-2.0
"""Pressure loops of units of any size: where they ring, as predicted, and that examples do not."""

from pathlib import Path
from typing import Any

from fam_bundle_bringup.cli import main
from fam_bundle_bringup.doctor import check_configuration, OK, WARNING
from fam_bundle_bringup.experiment import checked_configuration, default_configuration
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.trace import Trace
from fam_bundle_model.bundle import motor_units, state_force
from fam_bundle_model.doubts import doubts, ringing
from fam_bundle_model.parameters import Configuration, GRAVITY, load_configuration
import numpy as np
import pytest

CONFIG = Path(__file__).parents[1] / 'ros2_ws' / 'src' / 'fam_bundle_bringup' / 'config'


def bundle(counts: list[int], share: float, **groups: Any) -> Configuration:
    """Return a bundle whose inner loops have ``share`` of the gain at which each rings."""
    path, changes = default_configuration(), {'fam': {'count': counts}, **groups}
    limits = ringing(load_configuration(path, changes))
    gains = {'proportional_gain': [share * limit.gain for limit in limits]}
    return checked_configuration(path, {**changes, 'pressure_loop': gains})


def ringing_share(trace: Trace, frequency: float) -> float:
    """
    Return the share of tenths of a second in which some spool swings as a ring would.

    A ring at ``frequency`` (Hz) turns the spool round twice a period. Two thirds of that count,
    by steps of more than a thousandth of the stroke.
    """
    step = np.diff(trace['spool'], axis=0)
    turned = (step[1:] * step[:-1] < 0.0) & (np.abs(step[1:]) > 1e-3)
    tenths = turned[: len(turned) // 100 * 100].reshape(-1, 100, turned.shape[1]).sum(axis=1)
    return float(np.mean(tenths.max(axis=1) > 2.0 / 3.0 * 2.0 * frequency * 0.1))


def swing(configuration: Configuration) -> tuple[float, float]:
    """Return the standard deviation (Pa) of the first unit's pressure at rest, and its Hz."""
    pressure = run_offline(configuration)['mu_pressure'][1000:, 0]
    moved = pressure - pressure.mean()
    spectrum = np.abs(np.fft.rfft(moved * np.hanning(len(moved))))
    frequencies = np.fft.rfftfreq(len(moved), configuration.simulation.period)
    return float(moved.std()), float(frequencies[spectrum.argmax()])


@pytest.mark.parametrize('fams', [1, 2])
def test_a_unit_at_rest_rings_above_the_predicted_gain_and_not_below(fams: int) -> None:
    """One taut unit at half the nominal pressure; a sensor noise of 1 Pa is the only start."""
    nothing = {'amplitude': 0.0, 'frequency': 0.5, 'cycles': 1}
    path = default_configuration()
    one = load_configuration(path, {'fam': {'count': [fams]}})
    mass = state_force(motor_units(one), 1, 0.5 * one.source.nominal_pressure, 0.0) / GRAVITY
    groups = {'load': {'mass': mass}, 'reference': nothing, 'sensors': {'pressure_noise': 1.0}}
    below, above = (bundle([fams], share, **groups) for share in (0.9, 1.1))
    quiet, _ = swing(below)
    loud, frequency = swing(above)
    assert quiet < 10.0
    assert loud > 1000.0
    assert frequency == pytest.approx(ringing(above)[0].frequency, rel=0.05)


@pytest.mark.parametrize(('counts', 'mass'), [([1, 1, 2], 18.8), ([1] * 16, 30.0)])
def test_a_bundle_of_unequal_or_many_units_rings_above_that_gain_and_not_well_below(
    counts: list[int], mass: float
) -> None:
    groups = {'load': {'mass': mass}, 'reference': {'cycles': 1}}
    calm, ringing_one = (bundle(counts, share, **groups) for share in (0.4, 1.25))
    frequency = ringing(calm)[0].frequency
    assert ringing_share(run_offline(calm), frequency) == 0.0
    assert ringing_share(run_offline(ringing_one), frequency) > 0.5


@pytest.mark.parametrize('scheme', ['baseline', 'lag_pressure'])
@pytest.mark.parametrize(
    ('name', 'units'), [('one_unit.yaml', 1), ('three_units.yaml', 3), ('four_units.yaml', 4)]
)
def test_an_example_climbs_its_whole_ladder_and_comes_down_without_ringing(
    name: str, units: int, scheme: str
) -> None:
    configuration = checked_configuration(CONFIG / name, {'recruitment': {'scheme': scheme}})
    trace = run_offline(configuration)
    settled = trace['recruitment_state'][configuration.ticks() // 2 :]
    visited = [int(settled[0]), *(int(s) for s in settled[1:][np.diff(settled) != 0])]
    assert visited == [*range(1, units), *range(units, 0, -1)]
    assert ringing_share(trace, ringing(configuration)[0].frequency) == 0.0


def test_a_bundle_that_will_ring_or_is_in_no_order_of_size_is_run_with_a_warning(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    text = (CONFIG / 'lhacd.yaml').read_text().replace('count: [2, 2]', 'count: [3, 1]')
    (tmp_path / 'rig.yaml').write_text(text)
    quick = ['--pace', 'offline', '--frequency', '1', '--cycles', '1', '--amplitude', '0.01']
    config, out = str(tmp_path / 'rig.yaml'), str(tmp_path / 'out')
    assert main(['experiment', '--config', config, '--out', out, *quick]) == 0
    found = [line for line in capsys.readouterr().err.splitlines() if line.startswith('warning')]
    assert found == [
        f'warning: {doubt}' for doubt in doubts(load_configuration(tmp_path / 'rig.yaml'))
    ]
    assert [line.split(' = ')[0] for line in found] == [
        'warning: pressure_loop.proportional_gain',
        'warning: fam.count',
    ]
    checked = check_configuration(Path(config), None, 'none')
    assert checked.state == WARNING
    assert check_configuration(CONFIG / 'lhacd.yaml', None, 'none').state == OK
