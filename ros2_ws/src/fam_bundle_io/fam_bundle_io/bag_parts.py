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

"""What a bag is read as, part by part, whatever its storage."""

from typing import NamedTuple

import numpy as np

Records = dict[str, dict[str, str]]  # of metadata, by name


class Messages(NamedTuple):
    """
    Messages of one topic and one size.

    ``numbers`` (n) is their order in the bag, ``received`` and ``published`` (n) are times of the
    system clock (ns), ``sequences`` (n) their publisher's numbers of them, 0 where unknown, and
    ``data`` (n, size) their bytes. ``qos`` are the offered profiles as text in YAML.
    """

    topic: str
    type: str  # noqa: A003
    definition: str
    numbers: np.ndarray
    received: np.ndarray
    published: np.ndarray
    sequences: np.ndarray
    data: np.ndarray
    qos: str = ''
    type_hash: str = ''


class Damage(NamedTuple):
    """What is lost or has changed, in words."""

    words: str


class Doubt(NamedTuple):
    """What to know of a bag in which nothing need be wrong, in words."""

    words: str


# Messages come in lists of some that lie together, such as in one chunk: the numbers in each list
# are higher than those in the lists before.
Part = list[Messages] | Records | Damage | Doubt


def rows_of(data: list[bytes]) -> np.ndarray:
    """Return messages of one size as the rows of an array."""
    return np.frombuffer(b''.join(data), 'u1').reshape(len(data), len(data[0]))


def short(error: Exception) -> str:
    """Return an error in one short line."""
    return ' '.join(f'{type(error).__name__} {error}'.split())[:120]
