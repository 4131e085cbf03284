# SPDX-License-Identifier: Apache-2.0
"""The graph in lock-step and the loop in one process give the same trace to the last bit."""

from collections.abc import Callable
from pathlib import Path

from fam_bundle_bringup.graph import run_graph
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.trace import load_trace, PER_UNIT, SCALARS, Trace
from fam_bundle_model.parameters import Configuration, SCHEMES
import numpy as np
import pytest


def assert_same_bits(one: Trace, other: Trace) -> None:
    assert set(one) == set(other) == {*SCALARS, *PER_UNIT}
    for name in one:
        assert one[name].dtype == other[name].dtype, name
        assert one[name].tobytes() == other[name].tobytes(), name


@pytest.mark.parametrize('scheme', SCHEMES)
def test_graph_equals_one_process(
    scheme: str, quick: Callable[..., Configuration], recorded_run: Callable[[str], Path]
) -> None:
    configuration = quick(scheme)
    trace = load_trace(recorded_run(scheme) / 'trace.npz')
    assert len(trace['time']) == configuration.ticks() == 4000
    assert trace['recruitment_state'].max() == 2, 'the run must contain a shift'
    assert_same_bits(trace, run_offline(configuration))


def test_graph_equals_one_process_while_all_cores_are_busy(
    quick: Callable[..., Configuration], both_cores_busy: None, tmp_path: Path
) -> None:
    configuration = quick(
        recruitment={'scheme': 'lag_pressure', 'predictor': 'preview'},
        allocation={'policy': 'force'},
        reference={'amplitude': 0.06, 'frequency': 0.5, 'cycles': 1},
    )
    assert_same_bits(run_graph(configuration, tmp_path), run_offline(configuration))


def test_graph_equals_one_process_with_sensor_noise_and_three_units(
    three_units: tuple[Configuration, Path],
) -> None:
    configuration, folder = three_units
    trace = load_trace(folder / 'trace.npz')
    assert trace['mu_pressure'].shape == (4000, 3)
    assert np.unique(trace['recruitment_state']).size > 1, 'the run must contain a shift'
    assert_same_bits(trace, run_offline(configuration))


def test_graph_equals_one_process_on_a_reference_of_polynomials(
    quick: Callable[..., Configuration], tmp_path: Path
) -> None:
    """A harmonic one is that of the other tests."""
    samples = {'kind': 'samples', 'times': [0.0, 0.4, 0.9, 1.3], 'strains': [0.0, 0.03, 0.11, 0.1]}
    configuration = quick('lag_pressure', reference=samples)
    trace = run_graph(configuration, tmp_path)
    assert len(trace['time']) == 1300
    assert trace['recruitment_state'].max() == 2, 'the run must contain a shift'
    assert_same_bits(trace, run_offline(configuration))
