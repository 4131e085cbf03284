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

from collections.abc import Iterable
from typing import Any

from fam_bundle_model.parameters import Configuration, GROUPS, make_configuration
from fam_bundle_model.schema import ConfigurationError, Declaration, declarations, unknown
from rcl_interfaces.msg import ParameterDescriptor
from rclpy.node import Node


def declare_configuration(node: Node, groups: Iterable[str]) -> Configuration:
    """
    Declare the parameters of ``groups`` as ``group.name`` and return their configuration.

    Raises ConfigurationError naming the parameter, its value and the bound.
    """
    names = tuple(groups)
    values: dict[str, dict[str, Any]] = {}
    for group in names:
        given = values.setdefault(group, {})
        for name, declaration in declarations(GROUPS[group]).items():
            value = _declare(node, f'{group}.{name}', declaration)
            if value is not None:
                given[name] = value
    for name in node._parameter_overrides:
        group, _, field = name.partition('.')
        if group in names and field not in declarations(GROUPS[group]):
            known = [f'{group}.{k}' for k in declarations(GROUPS[group])]
            raise ConfigurationError(unknown(name, known))
    return make_configuration(values, names)


def _declare(node: Node, name: str, declaration: Declaration) -> Any:
    unit = f' [{declaration.unit}]' if declaration.unit else ''
    descriptor = ParameterDescriptor(
        description=declaration.text + unit,
        additional_constraints=declaration.bound(),
        read_only=True,
        # So that 525 serves where a float is wanted, and one value for all motor units.
        dynamic_typing=True,
    )
    value = node.declare_parameter(name, descriptor=descriptor).value
    if value is None and name in node._parameter_overrides:  # what rcl makes of an empty list
        raise ConfigurationError(f'{name} = []: must hold at least one value')
    return list(value) if hasattr(value, 'tolist') else value
