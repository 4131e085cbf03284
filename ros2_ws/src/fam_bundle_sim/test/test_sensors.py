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

"""Sensors: exact when ideal, reproducible by seed, of the stated noise and resolution."""

import itertools

from fam_bundle_model.parameters import SensorParameters
from fam_bundle_sim import sensors as module
from fam_bundle_sim.plant import Truth
from fam_bundle_sim.sensors import CHANNELS, measure, noise_samples, sensors
import numpy as np
import pytest
from scipy import stats

TRUE = Truth(0.0623, 184.4, 655.3e3, 4.2e-5)
PRESSURES = (301.7e3, 12.3)
NOISE = {
    'strain_noise': 2e-5,
    'force_noise': 0.5,
    'pressure_noise': 700.0,
    'flow_noise': 1e-7,
}


def readings(parameters, ticks):
    """Return what the sensors read at constant truth, (ticks, 4 + units)."""
    law = sensors(parameters, len(PRESSURES))
    rows = []
    for sample in itertools.islice(noise_samples(parameters, len(PRESSURES)), ticks):
        pressure = np.array(PRESSURES)
        rows.append([*measure(law, TRUE, sample, pressure), *pressure])
    return np.array(rows)


def test_ideal_sensors_read_the_truth_to_the_bit():
    for row in readings(SensorParameters(), 3):
        assert tuple(row) == (*TRUE, *PRESSURES)


def test_the_same_seed_gives_the_same_readings_and_another_does_not():
    first, again = (readings(SensorParameters(**NOISE, seed=7), 50) for _ in range(2))
    assert np.array_equal(first, again)
    other = readings(SensorParameters(**NOISE, seed=8), 50)
    assert np.all(first != other)


def test_noise_has_the_stated_deviation_no_offset_and_is_white():
    ticks = 4000
    rows = readings(SensorParameters(**NOISE, seed=1), ticks)
    deviation = [NOISE[f'{n}_noise'] for n in ('strain', 'force', 'pressure', 'flow')]
    deviation += [NOISE['pressure_noise']] * len(PRESSURES)
    normal = (rows - np.array([*TRUE, *PRESSURES])) / deviation
    low, high = stats.chi2.ppf([1e-6, 1.0 - 1e-6], ticks)
    squares = np.sum(normal**2, axis=0)
    assert np.all((low < squares) & (squares < high))
    assert np.all(np.abs(normal.mean(axis=0)) < 5.0 / np.sqrt(ticks))
    following = np.mean(normal[1:] * normal[:-1], axis=0)
    assert np.all(np.abs(following) < 5.0 / np.sqrt(ticks))
    # Normal, not merely of the right variance.
    for column in normal.T:
        assert stats.kstest(column, 'norm').pvalue > 1e-6


def test_channels_are_independent():
    normal = readings(SensorParameters(**NOISE, seed=2), 4000)
    correlation = np.corrcoef(normal.T) - np.eye(CHANNELS + len(PRESSURES))
    assert np.max(np.abs(correlation)) < 5.0 / np.sqrt(4000)


@pytest.mark.parametrize('block', [1, 7, 333])
def test_the_noise_does_not_depend_on_the_size_of_its_blocks(monkeypatch, block):
    parameters = SensorParameters(seed=5)
    expected = list(itertools.islice(noise_samples(parameters, 2), 2100))
    monkeypatch.setattr(module, '_BLOCK', block)
    found = list(itertools.islice(noise_samples(parameters, 2), 2100))
    assert np.array_equal(found, expected)


def test_readings_are_the_nearest_multiples_of_the_resolution():
    steps = {
        'strain_resolution': 3e-4,
        'force_resolution': 0.25,
        'pressure_resolution': 128.0,
        'flow_resolution': 1e-5,
    }
    row = readings(SensorParameters(**steps), 1)[0]
    true = np.array([*TRUE, *PRESSURES])
    step = np.array([3e-4, 0.25, 128.0, 1e-5, 128.0, 128.0])
    assert np.allclose(row / step, np.rint(row / step), atol=1e-9)
    assert np.all(np.abs(row - true) <= 0.5 * step * (1.0 + 1e-9))
    assert np.all(row != true)


def test_noise_comes_before_the_quantisation():
    """A resolution finer than the noise lets the mean through; both stay on the steps."""
    parameters = SensorParameters(force_noise=1.0, force_resolution=0.5, seed=4)
    force = readings(parameters, 4000)[:, 1]
    assert np.allclose(force / 0.5, np.rint(force / 0.5))
    assert len(set(force)) > 5
    assert force.mean() == pytest.approx(TRUE.force, abs=5.0 / np.sqrt(4000))
    assert force.var() == pytest.approx(1.0 + 0.5**2 / 12.0, rel=0.12)


def test_every_unit_has_its_pressure_channel():
    law = sensors(SensorParameters(pressure_noise=3.0, pressure_resolution=2.0), 5)
    assert law.noise.tolist() == [0.0, 0.0, 3.0, 0.0] + [3.0] * 5
    assert law.resolution.tolist() == [0.0, 0.0, 2.0, 0.0] + [2.0] * 5
    assert len(next(noise_samples(SensorParameters(), 5))) == CHANNELS + 5
