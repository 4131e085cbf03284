# SPDX-License-Identifier: Apache-2.0
"""What a bag is read as, part by part, whatever its storage."""

from typing import NamedTuple

import numpy as np

Records = dict[str, dict[str, str]]  # of metadata, by name


class Messages(NamedTuple):
    """Messages of one topic and one size.

    ``numbers`` (n) is their order in the bag, ``received`` and ``published`` (n) are times of the
    system clock (ns), ``sequences`` (n) their publisher's numbers of them, 0 where unknown, and
    ``data`` (n, size) their bytes. ``qos`` are the offered profiles as text in YAML.
    """

    topic: str
    type: str
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
