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

"""The gain at which a pressure loop rings against scipy's sampling of it; what is said of it."""

import dataclasses

from fam_bundle_model import fam
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.doubts import doubts, highest_loop_gain, ringing
from fam_bundle_model.hydraulics import hydraulic_law, unit_flow
from hypothesis import given
from hypothesis import strategies as st
import numpy as np
import pytest
from scipy.signal import cont2discrete


def change(configuration, **groups):
    parts = {g: dataclasses.replace(getattr(configuration, g), **v) for g, v in groups.items()}
    return dataclasses.replace(configuration, **parts)


def largest_root(gain, lag, period):
    """Return the largest closed-loop root (z) of an integrator behind a lag, sampled and held."""
    spool = np.array([[0.0, 1.0], [0.0, -1.0 / lag]]), np.array([[0.0], [1.0 / lag]])
    a, b, c, *_ = cont2discrete((*spool, np.array([[1.0, 0.0]]), np.zeros((1, 1))), period)
    roots = np.linalg.eigvals(a - gain * b @ c)
    return roots[np.argmax(np.abs(roots))]


def loop_gain(configuration, unit, proportional):
    """Return 1/s of a taut unit at half the nominal pressure, from the plant's own functions."""
    law, pressure = hydraulic_law(configuration), 0.5 * configuration.source.nominal_pressure
    small, step = 1e-6, 10.0
    source = configuration.source.nominal_pressure
    flow = unit_flow(law, small, source, pressure) - unit_flow(law, -small, source, pressure)
    oil = [fam.oil_of(unit.fam, pressure + d, 0.0, law.bulk_modulus) for d in (-step, step)]
    compliance = unit.fams * (oil[1] - oil[0]) / (2.0 * step)
    return proportional * flow / (2.0 * small) / compliance


def test_the_ringing_gain_puts_a_root_on_the_unit_circle_at_its_frequency(configuration):
    bundle = change(configuration, fam={'count': (1, 2, 5)})
    lag, period = configuration.valve.spool_time_constant, configuration.simulation.period
    for unit, found in zip(motor_units(bundle), ringing(bundle), strict=True):
        # Compressed by the pressure, the column is the hundredth stiffer that is left out.
        root = largest_root(loop_gain(bundle, unit, found.gain), lag, period)
        assert abs(root) == pytest.approx(1.0, abs=2e-3)
        assert abs(np.angle(root)) / (2.0 * np.pi * period) == pytest.approx(
            found.frequency, rel=5e-3
        )


@given(lag=st.floats(1e-5, 1.0), period=st.floats(1e-4, 0.1))
def test_below_the_highest_loop_gain_the_loop_is_stable_and_above_it_is_not(lag, period):
    gain, frequency = highest_loop_gain(lag, period)
    assert abs(largest_root(0.98 * gain, lag, period)) < 1.0
    root = largest_root(1.02 * gain, lag, period)
    assert abs(root) > 1.0
    assert abs(np.angle(root)) / (2.0 * np.pi * period) == pytest.approx(frequency, rel=0.1)


def test_a_spool_of_any_slowness_has_a_ringing_gain(configuration):
    slow = change(configuration, valve={'spool_time_constant': 1e30})
    slower = change(configuration, valve={'spool_time_constant': 1e300})
    assert ringing(slow) == ringing(slower)
    assert np.isfinite(ringing(slow)).all()


def test_half_the_muscles_take_half_the_gain(configuration):
    found = ringing(change(configuration, fam={'count': (1, 2, 4)}))
    assert [f.gain / found[0].gain for f in found] == pytest.approx([1.0, 2.0, 4.0])
    assert len({f.frequency for f in found}) == 1


def test_the_rig_of_the_paper_is_not_doubted(configuration):
    assert doubts(configuration) == []


def test_a_gain_too_high_for_the_small_units_is_said_once(configuration):
    (line,) = doubts(change(configuration, fam={'count': (1, 1, 2)}))
    assert line == (
        'pressure_loop.proportional_gain = 6.746e-06 1/Pa: motor unit 1, 2 will ring at 110 Hz '
        'when taut; should be well below 5.46e-06 1/Pa'
    )
    gains = {'proportional_gain': (3.4e-6, 3.4e-6, 6.7e-6)}
    assert doubts(change(configuration, fam={'count': (1, 1, 2)}, pressure_loop=gains)) == []


def test_a_unit_weaker_than_the_one_before_it_is_named(configuration):
    gains = {'proportional_gain': (1e-6,)}
    (line,) = doubts(change(configuration, fam={'count': (2, 3, 1)}, pressure_loop=gains))
    assert line.startswith('fam.count = [2, 3, 1]: motor unit 3 is weaker than the one before it')
    # Size is force, not number: two wide muscles are more than three narrow ones.
    wide = {'count': (3, 2), 'inner_radius': (0.004, 0.008)}
    assert doubts(change(configuration, fam=wide, pressure_loop=gains)) == []
