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

"""The nodes of a run as processes: started together, watched, and always ended."""

from collections.abc import Iterator, Mapping, Sequence
import contextlib
import ctypes
import os
from pathlib import Path
import signal
import subprocess
import threading
import time
from typing import NamedTuple

STOP_TIMEOUT = 3.0  # s that a node gets to end by itself


class NodeDied(RuntimeError):
    """A node ended before its time; the message names it and says how and why."""


class NodeProcess(NamedTuple):
    """One running node and the file that holds what it printed."""

    name: str
    process: 'subprocess.Popen[bytes]'
    log: Path


# Found here, for between fork and exec nothing may be loaded.
_PRCTL = ctypes.CDLL(None).prctl
_SET_PARENT_DEATH_SIGNAL = 1


def _end_with_parent() -> None:
    # Linux: a node must not outlive a runner that was killed itself.
    _PRCTL(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)


class NodeGroup:
    """Processes of one run; leaving the context ends every one of them."""

    def __init__(self, environment: Mapping[str, str], logs: Path) -> None:
        """Start nothing yet; what nodes print goes to files in ``logs``."""
        self._environment = dict(environment)
        self._logs = logs
        self._nodes: list[NodeProcess] = []

    def start(
        self,
        name: str,
        command: Sequence[str],
        environment: Mapping[str, str] | None = None,
    ) -> 'subprocess.Popen[bytes]':
        """Start one node, with ``environment`` on top of the group's, and return its process."""
        self._logs.mkdir(parents=True, exist_ok=True)
        log = self._logs / f'{name}.log'
        again = any(node.name == name for node in self._nodes)
        with log.open('ab' if again else 'wb') as output:
            process = subprocess.Popen(
                command,
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                env={**self._environment, **(environment or {})},
                # Ctrl-C reaches the runner alone, which ends the nodes in its own order.
                start_new_session=True,
                preexec_fn=_end_with_parent,
            )
        self._nodes.append(NodeProcess(name, process, log))
        return process

    def finished(self, *names: str) -> bool:
        """
        Return whether all the nodes ``names`` have ended well.

        Raises NodeDied when any node has ended otherwise.
        """
        done = {node.name for node in self._nodes if node.process.poll() == 0}
        for node in self._nodes:
            status = node.process.poll()
            if status is not None and not (status == 0 and node.name in names):
                raise NodeDied(f'{node.name} {_ending(status)}{_last_words(node.log)}')
        return done.issuperset(names)

    def __enter__(self) -> 'NodeGroup':
        """Return the group."""
        return self

    def __exit__(self, *_: object) -> None:
        """End every node: first asked, then killed; another Ctrl-C waits until that is done."""
        with signals_held():
            self._end()

    def _end(self) -> None:
        for node in self._nodes:
            with contextlib.suppress(ProcessLookupError):
                node.process.send_signal(signal.SIGCONT)  # one that was stopped hears nothing
                node.process.send_signal(signal.SIGINT)
        deadline = time.monotonic() + STOP_TIMEOUT
        for node in self._nodes:
            try:
                node.process.wait(max(deadline - time.monotonic(), 0.01))
            except subprocess.TimeoutExpired:
                node.process.kill()
                node.process.wait()


@contextlib.contextmanager
def signals_held() -> Iterator[list[int]]:
    """
    Let SIGINT and SIGTERM wait until the end of the context, and give those that have come.

    In another thread than the main one, which has no signals, there are none to hold.
    """
    came: list[int] = []
    if threading.current_thread() is not threading.main_thread():
        yield came
        return
    before = {
        number: signal.signal(number, lambda number, _: came.append(number))
        for number in (signal.SIGINT, signal.SIGTERM)
    }
    try:
        yield came
    finally:
        for number, handler in before.items():
            signal.signal(number, handler)
        for number in came[:1]:
            signal.raise_signal(number)


def _ending(status: int) -> str:
    if status < 0:
        return f'was ended by signal {signal.Signals(-status).name}'
    return f'ended with exit status {status}'


def _last_words(log: Path) -> str:
    """Return the last line that a node printed, after a colon, or nothing."""
    lines = [x for x in log.read_text(errors='replace').splitlines() if x.strip()]
    return f': {lines[-1].strip()}' if lines else ''


def executable(package: str, name: str) -> str:
    """Return the path of a node's executable, as ``ros2 run`` finds it."""
    from ament_index_python.packages import get_package_prefix

    return os.path.join(get_package_prefix(package), 'lib', package, name)
