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

"""Which changes of parameters a running node takes."""

from collections.abc import Iterable, Sequence
from typing import Any

from fam_bundle_model.parameters import Configuration, GROUPS
from fam_bundle_model.schema import ConfigurationError, declarations, unknown
from rclpy.parameter import Parameter

FIXED = 'fixed while its node runs; restart it with the new value in its parameter file'


def changes_of(
    configuration: Configuration, live: Sequence[str], parameters: Iterable[Parameter]
) -> tuple[dict[str, Any], list[Parameter]]:
    """
    Return what ``parameters`` change in ``configuration``, by name, and what ROS is to set.

    Left out there are those of ours that keep their value. Raises ConfigurationError for one that
    is bad, or fixed: not live in the schema, or of a group that is not in ``live``.
    """
    changed: dict[str, Any] = {}
    others = []
    for parameter in parameters:
        group, _, field = parameter.name.partition('.')
        present = getattr(configuration, group, None) if group in GROUPS else None
        if present is None:  # not ours: use_sim_time, say
            others.append(parameter)
            continue
        known = declarations(GROUPS[group])
        if field not in known:
            raise ConfigurationError(unknown(parameter.name, [f'{group}.{k}' for k in known]))
        given = parameter.value
        given = list(given) if hasattr(given, 'tolist') else given
        value = known[field].convert(parameter.name, given)
        if value == getattr(present, field):
            continue
        if group not in live or not known[field].live:
            raise ConfigurationError(f'{parameter.name} = {given}: {FIXED}')
        changed[parameter.name] = value
        others.append(parameter)
    return changed, others
