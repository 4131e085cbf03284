# SPDX-License-Identifier: Apache-2.0
"""Controllers that believe in another rig than the one that is there."""

from collections.abc import Callable
import dataclasses

from fam_bundle_bringup.experiment import measure_tracking
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.metrics import needless_shifts, shift_times, Tracking
from fam_bundle_model.bundle import motor_units
from fam_bundle_model.fam import deslack_pressure
from fam_bundle_model.parameters import Configuration, GRAVITY
import pytest


def test_a_rig_as_believed_changes_no_bit(quick: Callable[..., Configuration]) -> None:
    configuration = quick(allocation={'policy': 'force'})
    here, there = run_offline(configuration), run_offline(configuration, actual=configuration)
    assert all(here[name].tobytes() == there[name].tobytes() for name in here)


def test_the_plant_is_the_actual_one_and_the_laws_are_not(
    quick: Callable[..., Configuration],
) -> None:
    """The load cell reads the true weight; de-slack pressures are those believed in."""
    believed = quick('all')
    load = dataclasses.replace(believed.load, mass=20.0)
    stiff = dataclasses.replace(believed.fam, youngs_modulus=(4e6,))
    trace = run_offline(believed, actual=dataclasses.replace(believed, load=load, fam=stiff))
    assert trace['force'][0] == pytest.approx(20.0 * GRAVITY, rel=1e-3)
    strain, told = trace['strain'][2000], trace['deslack_pressure'][2000]
    units, actual = motor_units(believed), motor_units(dataclasses.replace(believed, fam=stiff))
    assert told == deslack_pressure(units[1].fam, strain)
    assert told < deslack_pressure(actual[1].fam, strain)


def test_a_wrong_model_costs_tracking_but_not_stability(
    quick: Callable[..., Configuration],
) -> None:
    """
    What is fed forward is then wrong, and the PI has the rest to do.

    It is nearer than nothing still, and than batch, which feeds nothing forward and shares
    nothing out by a model. Shifts come as the reference asks for them, by force and by batch.
    """
    believed = quick('lag_pressure', allocation={'policy': 'force'})
    stiff = dataclasses.replace(
        believed.fam, youngs_modulus=tuple(1.2 * e for e in believed.fam.youngs_modulus)
    )
    actual = dataclasses.replace(believed, fam=stiff)

    def tracked(rig: Configuration, **allocation: str | float) -> Tracking:
        changed = dataclasses.replace(believed.allocation, **allocation)
        trace = run_offline(dataclasses.replace(believed, allocation=changed), actual=rig)
        assert needless_shifts(trace) == 0
        assert [len(shifts) for shifts in shift_times(trace)] == [1, 1]
        return measure_tracking(believed, trace)

    right, wrong = tracked(believed), tracked(actual)
    blind, batch = tracked(actual, feedforward=0.0), tracked(actual, policy='batch')
    assert right.iae < wrong.iae < blind.iae
    assert wrong.max_error < min(blind.max_error, batch.max_error)
