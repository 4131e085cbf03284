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

"""
Compilation of plain functions of floats by numba, with a cache that cannot go stale.

Every law of the project is written once, as a plain function. ``compiled`` hands it to numba;
where numba is missing the function is interpreted, which is slower and gives the same bits.
"""

from collections.abc import Callable
import hashlib
import importlib.util
import os
from pathlib import Path
from typing import Any, cast, TypeVar

Function = TypeVar('Function', bound=Callable[..., Any])

# Packages whose functions inline each other when compiled.
COMPILED_PACKAGES = (
    'fam_bundle_model',
    'fam_bundle_control',
    'fam_bundle_sim',
    'fam_bundle_bringup',
)


def source_digest(packages: tuple[str, ...] = COMPILED_PACKAGES) -> str:
    """Return a digest of the sources of ``packages``, of all that hold compiled functions."""
    digest = hashlib.sha256()
    for package in packages:
        spec = importlib.util.find_spec(package)
        for folder in (spec.submodule_search_locations or ()) if spec else ():
            for path in sorted(Path(folder).glob('*.py')):
                digest.update(path.name.encode() + b'\0' + path.read_bytes())
    return digest.hexdigest()[:16]


def cache_directory() -> Path:
    """
    Return the folder for compiled code and lag tables of this user.

    ``$XDG_CACHE_HOME/fam_bundle``, or ``~/.cache/fam_bundle``.
    """
    return Path(os.environ.get('XDG_CACHE_HOME') or Path.home() / '.cache') / 'fam_bundle'


def _numba_decorator() -> Callable[[Any], Any] | None:
    try:
        import numba
    except ImportError:
        return None
    # numba checks only the file that defines a function, not those of the functions it inlines:
    # a cache folder of its own for each state of the sources keeps old code from being loaded.
    if 'NUMBA_CACHE_DIR' not in os.environ:
        folder = cache_directory() / f'compiled-{source_digest()}'
        setattr(numba.config, 'CACHE_DIR', str(folder))  # noqa: B010  numba declares it late
    decorator: Callable[[Any], Any] = numba.njit(cache=True, error_model='numpy')
    return decorator


_DECORATOR = None if os.environ.get('FAM_BUNDLE_INTERPRET') else _numba_decorator()


def compiled(function: Function) -> Function:
    """
    Compile ``function`` with numba (IEEE arithmetic, no fast math), or return it as it is.

    ``FAM_BUNDLE_INTERPRET=1`` in the environment leaves every function interpreted.
    """
    return function if _DECORATOR is None else _DECORATOR(function)


def direct(function: Function, *arguments: Any) -> Function:
    """
    Return what runs ``function`` without numba's look at the types of each call.

    That look takes longer than a law itself, 5 us for the supervisor's. The result is for
    arguments of the same types as ``arguments`` only, with which ``function`` is called once
    here: give copies of what it changes. An interpreted function is returned as it is.
    """
    function(*arguments)
    if _DECORATOR is None:
        return function
    import numba

    type_of = cast(Callable[[Any], Any], numba.typeof)
    types = tuple(type_of(argument) for argument in arguments)
    entry: Function = cast(Any, function).overloads[types].entry_point
    return entry
