# SPDX-License-Identifier: Apache-2.0
"""
No parameter, message or field is idle: a change of each parameter changes a run, and reaches ROS.

Those that shape no result (pace, processes, bridge) are read by name outside their declaration.
"""

import ast
from collections.abc import Iterator
import dataclasses
from pathlib import Path
import re
from typing import Any

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.graph import run_graph
from fam_bundle_bringup.offline import run_offline
from fam_bundle_control.strain_controller_node import GOAL_FIELDS
from fam_bundle_model.parameters import Configuration, GROUPS, load_configuration
from fam_bundle_model.schema import declarations
import numpy as np
import pytest

ROOT = Path(__file__).parents[1]
SOURCE = ROOT / 'ros2_ws/src'
SHAPELESS = ('run', 'process', 'bridge')
# One cycle in which every unit is recruited and released.
BASE = {
    'recruitment': {'scheme': 'lag_pressure'},
    'reference': {'amplitude': 0.06, 'frequency': 0.5, 'cycles': 1},
}
NOISE = {'strain_noise': 1e-5, 'force_noise': 0.1, 'pressure_noise': 100.0, 'flow_noise': 1e-8}
STEPS = {'reference': {'kind': 'steps', 'frequency': 0.2}}
SAMPLES = {'reference': {'kind': 'samples', 'times': [0.0, 1.0], 'strains': [0.0, 0.05]}}
# What a parameter needs around it to count, where BASE is not enough.
AROUND: dict[str, dict[str, dict[str, Any]]] = {
    'recruitment.upshift_threshold': {'recruitment': {'scheme': 'baseline'}},
    'recruitment.downshift_threshold': {'recruitment': {'scheme': 'baseline'}},
    'allocation.feedforward': {'allocation': {'policy': 'force'}},
    'sensors.seed': {'sensors': NOISE},
    'reference.final_frequency': {'reference': {'kind': 'chirp'}},
    'reference.multiples': {'reference': {'kind': 'sum_of_sines'}},
    'reference.weights': {'reference': {'kind': 'sum_of_sines'}},
    'reference.seed': {'reference': {'kind': 'random'}},
    'reference.levels': STEPS,
    'reference.strain_rate': STEPS,
    'reference.strain_acceleration': STEPS,
    'reference.times': SAMPLES,
    'reference.strains': SAMPLES,
}
# Another value, where 1.02 times the present one is not allowed, the same, or without effect.
OTHER: dict[str, Any] = {
    'fam.count': [2, 3],
    'fam.mooney_rivlin_share': 0.3,
    'fam.poisson_ratio': 0.4,
    'pressure_loop.integral_limit': 1e-4,
    'recruitment.scheme': 'lag',
    'recruitment.minimum_strain_rate': 0.1,
    'recruitment.minimum_dwell': 10.0,
    'recruitment.reserve': 2e4,
    'recruitment.predictor': 'preview',
    'allocation.policy': 'orderly',
    'allocation.feedforward': 0.5,
    'sensors.strain_resolution': 1e-4,
    'sensors.force_resolution': 1.0,
    'sensors.pressure_resolution': 1e3,
    'sensors.flow_resolution': 1e-7,
    'sensors.seed': 1,
    'simulation.period': 2e-3,
    'simulation.initial_strain': 0.001,
    'lag_table.minimum_source': 0.6,
    'lag_table.maximum_lag': 0.02,
    'reference.kind': 'trapezoid',
    'reference.cycles': 2,
    'reference.multiples': [1.0, 2.0, 3.0],
    'reference.weights': [0.5, 0.3, 0.2],
    'reference.levels': [0.2, 0.9],
    'reference.seed': 1,
    'reference.times': [0.0, 1.5],
    'reference.strains': [0.0, 0.06],
    **{f'sensors.{name}': value for name, value in NOISE.items()},
}


def names() -> Iterator[str]:
    for group, kind in GROUPS.items():
        if group not in SHAPELESS:
            yield from (f'{group}.{name}' for name in declarations(kind))


def configuration_with(*changes: dict[str, dict[str, Any]]) -> Configuration:
    merged: dict[str, dict[str, Any]] = {}
    for change in (BASE, *changes):
        for group, values in change.items():
            merged[group] = {**merged.get(group, {}), **values}
    return load_configuration(default_configuration(), merged)


def changed(name: str, before: Configuration) -> dict[str, dict[str, Any]]:
    """Return the change of one parameter: its other value, or two per cent more."""
    group, field = name.split('.')
    if name in OTHER:
        return {group: {field: OTHER[name]}}
    value = getattr(getattr(before, group), field)
    if isinstance(value, tuple):
        return {group: {field: [1.02 * v for v in value]}}
    return {group: {field: value + 1 if isinstance(value, int) else 1.02 * value}}


def differs(one: Configuration, other: Configuration) -> bool:
    """Return whether the runs of two configurations differ in any array."""
    before, after = run_offline(one), run_offline(other)
    return any(before[name].tobytes() != after[name].tobytes() for name in before)


@pytest.mark.parametrize('name', list(names()))
def test_a_parameter_changes_the_run(name: str) -> None:
    around = AROUND.get(name, {})
    before = configuration_with(around)
    after = configuration_with(around, changed(name, before))
    assert differs(before, after)


def test_all_parameters_reach_the_nodes(tmp_path: Path) -> None:
    """Every one that counts on a sine is changed at once: graph and one process stay equal."""
    before = configuration_with()
    merged: dict[str, dict[str, Any]] = {}
    for name in names():
        group, field = name.split('.')
        if name in ('recruitment.scheme', 'recruitment.minimum_dwell', 'recruitment.reserve'):
            continue  # with these no unit would be released
        if group != 'reference' or field in ('amplitude', 'frequency'):
            merged.setdefault(group, {}).update(changed(name, before)[group])
    merged['recruitment']['minimum_strain_rate'] = 2e-3
    merged['lag_table']['maximum_lag'] = 0.9
    after = configuration_with(merged)
    for group in merged:
        assert getattr(before, group) != getattr(after, group)
    expected, found = run_offline(after), run_graph(after, tmp_path)
    assert set(np.unique(expected['recruitment_state'])) == {1, 2}
    for name in expected:
        assert expected[name].tobytes() == found[name].tobytes(), name


def trees() -> Iterator[tuple[Path, ast.Module]]:
    for path in sorted(SOURCE.glob('*/fam_bundle_*/**/*.py')):
        yield path, ast.parse(path.read_text())


@pytest.mark.parametrize('group', SHAPELESS)
def test_what_shapes_no_result_is_read_where_it_belongs(group: str) -> None:
    read = {
        match[1]
        for path in SOURCE.glob('*/fam_bundle_*/**/*.py')
        if path.name != 'parameters.py'
        for match in re.finditer(rf'\b{group}\.(\w+)', path.read_text())
    }
    assert {field.name for field in dataclasses.fields(GROUPS[group])} <= read


# ---- Messages ----


def definitions() -> list[Path]:
    folder = SOURCE / 'fam_bundle_msgs'
    return [path for kind in ('msg', 'srv', 'action') for path in sorted(folder.glob(f'{kind}/*'))]


def fields_of(path: Path) -> list[str]:
    lines = (line.split('#')[0].strip() for line in path.read_text().splitlines())
    return [m[1] for line in lines if (m := re.fullmatch(r'[\w/\[\]]+ (\w+)( .+)?', line))]


def words(tree: ast.Module) -> set[str]:
    """Return every attribute, keyword, declared field and imported name of a module."""
    found: set[str] = set()
    for node in ast.walk(tree):
        if isinstance(node, ast.Attribute):
            found.add(node.attr)
        elif isinstance(node, ast.AnnAssign) and isinstance(node.target, ast.Name):
            found.add(node.target.id)
        elif isinstance(node, ast.keyword) and node.arg:
            found.add(node.arg)
        elif isinstance(node, ast.ImportFrom):
            found |= {alias.name for alias in node.names}
    return found


def test_every_message_and_each_of_its_fields_is_used() -> None:
    """In modules that import the message, that is: what stands there may be another's."""
    modules = {path.stem: words(tree) for path, tree in trees()}
    # Some take records of another module as they are, or are read by names of parameters.
    modules['loop_meter'].add('LoopStatistics')
    modules['trajectory'] |= {'TrackStrain', *GOAL_FIELDS}
    assert len(definitions()) > 10
    for path in definitions():
        used = set().union(*(found for found in modules.values() if path.stem in found))
        assert used, f'{path.name}: nobody imports it'
        assert fields_of(path), path.name
        assert set(fields_of(path)) - used == set(), path.name
