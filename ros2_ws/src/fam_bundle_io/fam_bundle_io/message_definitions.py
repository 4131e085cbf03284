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

"""Complete message definitions, as a bag holds them so that it needs no workspace to be read."""

from collections.abc import Callable
from pathlib import Path
import re

FIELD = re.compile(r'^\s*(?P<type>[A-Za-z][\w/]*)(?:<=\d+)?(?:\[[^\]]*\])?\s+\w')
BUILT_IN = {
    'bool',
    'byte',
    'char',
    'float32',
    'float64',
    'int8',
    'uint8',
    'int16',
    'uint16',
    'int32',
    'uint32',
    'int64',
    'uint64',
    'string',
    'wstring',
}
SEPARATOR = '=' * 80


def installed_definition(name: str) -> str:
    """
    Return the text of ``package/msg/Name`` of the sourced workspaces.

    Raises FileNotFoundError where it is not installed.
    """
    from ament_index_python.packages import get_package_share_directory, PackageNotFoundError

    package, _, message = name.split('/')
    try:
        share = Path(get_package_share_directory(package))
    except PackageNotFoundError:
        raise FileNotFoundError(f'{name}: package {package} is not installed') from None
    return (share / 'msg' / f'{message}.msg').read_text()


def complete_definition(name: str, text_of: Callable[[str], str] = installed_definition) -> str:
    """Return the definition of ``package/msg/Name`` and after it those that it is made of."""
    found = {name: text_of(name)}
    waiting = [name]
    while waiting:
        known = waiting.pop(0)
        for needed in types_in(found[known], known.split('/')[0]):
            if needed not in found:
                found[needed] = text_of(needed)
                waiting.append(needed)
    main, *others = found
    parts = [found[main]]
    for other in others:
        package, _, message = other.split('/')
        parts.append(f'{SEPARATOR}\nMSG: {package}/{message}\n{found[other]}')
    return '\n'.join(parts)


def types_in(text: str, package: str) -> list[str]:
    """Return the message types that fields of the definition ``text`` in ``package`` have."""
    types = []
    for line in text.splitlines():
        field = FIELD.match(line.partition('#')[0])
        if field is None or field['type'] in BUILT_IN:
            continue
        owner, _, message = field['type'].rpartition('/')
        types.append(f'{owner.removesuffix("/msg") or package}/msg/{message}')
    return types
