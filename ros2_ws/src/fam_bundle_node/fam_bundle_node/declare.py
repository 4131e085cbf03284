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

"""ROS parameters from the one schema of ``fam_bundle_model.parameters``."""

from collections.abc import Iterable, Mapping
import math
import sys
from typing import Any

from fam_bundle_model.parameters import Configuration, GROUPS, make_configuration
from fam_bundle_model.schema import ConfigurationError, Declaration, declarations, unknown
from rcl_interfaces.msg import FloatingPointRange, IntegerRange, ParameterDescriptor
from rclpy.node import Node
from rclpy.parameter import Parameter

LARGEST = sys.float_info.max


def declare_configuration(
    node: Node, groups: Iterable[str], live: Iterable[str] = ()
) -> Configuration:
    """
    Declare the parameters of ``groups`` as ``group.name`` and return their configuration.

    Those that the schema calls live can be set while the node runs if it makes use of that, which
    is told by naming their group in ``live``.
    Raises ConfigurationError naming the parameter, its value and the bound.
    """
    names = tuple(groups)
    values: dict[str, dict[str, Any]] = {}
    for group in names:
        given = values.setdefault(group, {})
        for name in declarations(GROUPS[group]):
            value = _declare(node, f'{group}.{name}')
            if value is not None:
                given[name] = value
    for name in node._parameter_overrides:
        group, _, field = name.partition('.')
        if group in names and field not in declarations(GROUPS[group]):
            known = [f'{group}.{k}' for k in declarations(GROUPS[group])]
            raise ConfigurationError(unknown(name, known))
    configuration = make_configuration(values, names)
    for group in names:
        _describe(node, group, configuration, values[group], live=group in live)
    return configuration


def _declare(node: Node, name: str) -> Any:
    value = node.declare_parameter(name, descriptor=dynamic()).value
    if value is None and name in node._parameter_overrides:  # what rcl makes of an empty list
        raise ConfigurationError(f'{name} = []: must hold at least one value')
    return list(value) if hasattr(value, 'tolist') else value


def _describe(
    node: Node, group: str, configuration: Configuration, given: Mapping[str, Any], *, live: bool
) -> None:
    """
    Give the parameters of a group the defaults in force and their descriptors.

    Only once they are known to be good: ROS would refuse a bad value in words of its own.
    """
    values = vars(getattr(configuration, group))
    defaults = [
        Parameter(f'{group}.{name}', value=list(value) if isinstance(value, tuple) else value)
        for name, value in values.items()
        if name not in given
    ]
    Node.set_parameters_atomically(node, defaults)
    for name, declaration in declarations(GROUPS[group]).items():
        fixed = not (live and declaration.live)
        node.set_descriptor(f'{group}.{name}', descriptor_of(declaration, read_only=fixed))


def dynamic(**fields: Any) -> ParameterDescriptor:
    """Return a descriptor by which 525 serves where a float is wanted, and one value for all."""
    return ParameterDescriptor(dynamic_typing=True, **fields)


def descriptor_of(declaration: Declaration, *, read_only: bool) -> ParameterDescriptor:
    """Return how ROS describes a parameter; lists have no range there."""
    unit = f' [{declaration.unit}]' if declaration.unit else ''
    descriptor = dynamic(
        description=declaration.text + unit,
        additional_constraints=declaration.bound(),
        read_only=read_only,
    )
    low, high = declaration.minimum, declaration.maximum
    if declaration.array or (low, high) == (-math.inf, math.inf):
        return descriptor
    if declaration.kind is int:
        descriptor.integer_range = [IntegerRange(from_value=int(low), to_value=int(high))]
    elif declaration.kind is float:
        ends = (max(low, -LARGEST), min(high, LARGEST))
        limits = FloatingPointRange(from_value=ends[0], to_value=ends[1])
        descriptor.floating_point_range = [limits]
    return descriptor
