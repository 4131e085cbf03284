# SPDX-License-Identifier: Apache-2.0
"""Oil does not pull: a unit shut in by its valve cannot hold more than a vacuum."""

import numpy as np

from fam_bundle_sim.plant import plant_step, resting_state, truth

ATMOSPHERE = 101325.0  # Pa


def test_no_unit_is_drawn_below_absolute_vacuum(rig, configuration):
    """The second unit's valve stays shut while the first contracts the bundle."""
    state, pressure = resting_state(configuration, rig), np.empty(2)
    lowest = 0.0
    for _ in range(700):
        plant_step(rig, state, np.array([0.15, 0.0]), 0.001, 4)
        truth(rig, state, pressure)
        lowest = min(lowest, pressure[1])
    assert lowest >= -ATMOSPHERE
