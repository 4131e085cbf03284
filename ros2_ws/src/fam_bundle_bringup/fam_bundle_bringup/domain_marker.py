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

"""Which DDS domains runs of this user are in: one file each, locked by the run. No ROS."""

from collections.abc import Iterator, Mapping
import contextlib
import fcntl
import os
from pathlib import Path
import stat
import sys
import tempfile
from typing import NamedTuple

from fam_bundle_model.schema import ConfigurationError

VARIABLE = 'ROS_DOMAIN_ID'
LARGEST_DOMAIN = 232  # its ports are the last below 65536
PREFIX = 'domain-'


class Run(NamedTuple):
    """A run on this machine: its domain and the process that holds it."""

    domain: int
    process: int


def marker_folder() -> Path:
    """Return the folder of this user's markers."""
    return Path(tempfile.gettempdir()) / f'fam_bundle-{os.getuid()}'


@contextlib.contextmanager
def marked(domain: int, folder: Path | None = None) -> Iterator[None]:
    """
    Mark ``domain`` as that of this process.

    A marker only helps to find a run: where there can be none, a line on stderr says why.
    """
    with contextlib.ExitStack() as stack:
        try:
            _hold(domain, folder or marker_folder(), stack)
        except OSError as error:
            print(f'fam top will not find domain {domain} by itself: {error}', file=sys.stderr)
        yield


def running(folder: Path | None = None) -> list[Run]:
    """Return the runs whose process lives; raises OSError when the folder is not to be trusted."""
    folder = folder or marker_folder()
    try:
        _refuse_foreign(folder)
    except FileNotFoundError:
        return []
    found = (_live(path) for path in folder.glob(f'{PREFIX}*'))
    return sorted(run for run in found if run is not None)


def domain_number(text: str) -> int:
    """Return ``text`` as a domain; raises ConfigurationError when it is none."""
    if not text.isdecimal() or int(text) > LARGEST_DOMAIN:
        raise ConfigurationError(f'{text!r}: must be an integer from 0 to {LARGEST_DOMAIN}')
    return int(text)


def chosen_domain(environment: Mapping[str, str], folder: Path | None = None) -> int | None:
    """
    Return the domain that ``environment`` names, else that of the only run, else None.

    Raises ConfigurationError when it names none or when there are several runs.
    """
    if named := environment.get(VARIABLE):
        try:
            return domain_number(named)
        except ConfigurationError as error:
            raise ConfigurationError(f'{VARIABLE} = {error}') from None
    runs = running(folder)
    if len(runs) > 1:
        found = ', '.join(f'{run.domain} (process {run.process})' for run in runs)
        raise ConfigurationError(f'runs in the domains {found}: choose one with --domain')
    return runs[0].domain if runs else None


def _refuse_foreign(folder: Path) -> None:
    """Raise PermissionError unless ``folder`` is one of this user; a link is none."""
    found = folder.lstat()
    if not stat.S_ISDIR(found.st_mode) or found.st_uid != os.getuid():
        raise PermissionError(f'{folder}: is no folder of this user')


def _hold(domain: int, folder: Path, stack: contextlib.ExitStack) -> None:
    """Put a locked marker into ``folder`` until ``stack`` is left."""
    with contextlib.suppress(FileExistsError):
        folder.mkdir(mode=0o700)
    _refuse_foreign(folder)
    folder.chmod(0o700)
    path = folder / f'{PREFIX}{domain}'
    # Locked before it gets the name under which it is looked for; a stale one is replaced.
    new = folder / f'.{domain}-{os.getpid()}'
    marker = stack.enter_context(new.open('w'))
    fcntl.flock(marker, fcntl.LOCK_EX | fcntl.LOCK_NB)
    print(os.getpid(), file=marker, flush=True)
    new.replace(path)
    stack.callback(_remove, path, os.fstat(marker.fileno()))


def _remove(path: Path, ours: os.stat_result) -> None:
    with contextlib.suppress(OSError):
        if os.path.samestat(path.stat(), ours):
            path.unlink()


def _live(path: Path) -> Run | None:
    """Return the run whose marker ``path`` is, or None if its process has ended."""
    try:
        with path.open() as marker:
            try:
                fcntl.flock(marker, fcntl.LOCK_SH | fcntl.LOCK_NB)
            except BlockingIOError:
                return Run(int(path.name.removeprefix(PREFIX)), int(marker.read()))
    except (FileNotFoundError, ValueError):  # removed just now, or no marker
        pass
    return None
