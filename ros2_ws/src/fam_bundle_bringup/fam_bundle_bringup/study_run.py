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

"""Runs the cases of a study on all cores or on a Dask cluster, and goes on where it stopped."""

from collections.abc import Callable, Iterable, Iterator, Mapping
import concurrent.futures
from concurrent.futures import Executor
import contextlib
import ctypes
import fcntl
import functools
import hashlib
import json
import multiprocessing
import os
from pathlib import Path
import signal
import time
from typing import NamedTuple, TextIO

from fam_bundle_bringup.experiment import versions
from fam_bundle_bringup.study import Case
from fam_bundle_bringup.study_case import lag_table_of, not_run, RIVALS, Row, run_case, Setting
from fam_bundle_model.compile import COMPILED_PACKAGES, source_digest
from fam_bundle_model.lag_table import PHYSICS
from fam_bundle_model.schema import ConfigurationError

CASE = 'case'
ANSWER = 10.0  # s of waiting for a Dask cluster
_SET_PARENT_DEATH_SIGNAL = 1


class StudyStopped(RuntimeError):
    """A study that cannot go on; what is done so far is kept."""


class Job(NamedTuple):
    """
    Runs that give one row: a case, or a rival in a situation; ``runs`` is how many.

    ``key`` is that of the row, ``origin`` what the worker's sources must be.
    """

    key: str
    kind: str
    setting: Setting
    runs: int
    origin: str


class Done(NamedTuple):
    """A row, and the CPU time in s that it took."""

    row: Row
    cpu_time: float


# ---- Jobs and their keys ----


@functools.lru_cache
def origin() -> str:
    """Return a digest of all that shapes a row besides the configuration: sources, versions."""
    digest = hashlib.sha256(source_digest((*COMPILED_PACKAGES, 'fam_bundle_io')).encode())
    digest.update(json.dumps(versions(), sort_keys=True).encode())
    return digest.hexdigest()[:16]


def key_of(kind: str, setting: Setting, made_by: str) -> str:
    """Return the key of a row: equal for equal runs by equal sources, and for no others."""
    text = f'{kind} {setting.hash()} {made_by}'
    return hashlib.sha256(text.encode()).hexdigest()[:32]


def jobs_of(cases: Iterable[Case], rivals: Iterable[str], made_by: str) -> dict[str, Job]:
    """Return what has to be run, by key, equal runs once; the longest first."""
    wanted = [
        (rival, case.situation, RIVALS[rival].runs)
        for rival in rivals
        for case in cases
        if case.situation is not None
    ]
    wanted += [(CASE, case.setting, 1) for case in cases if case.setting is not None]
    wanted.sort(key=lambda item: -item[2])
    jobs = [Job(key_of(kind, s, made_by), kind, s, runs, made_by) for kind, s, runs in wanted]
    return {job.key: job for job in jobs}


def runs_of(jobs: Mapping[str, Job]) -> int:
    """Return how many runs ``jobs`` are."""
    return sum(job.runs for job in jobs.values())


def row_of(case: Case, rows: Mapping[str, Row], made_by: str) -> Row:
    """Return the row of ``case``."""
    if case.setting is None:
        return not_run('impossible', case.reason)
    return rows[key_of(CASE, case.setting, made_by)]


def rival_of(case: Case, rival: str, rows: Mapping[str, Row], made_by: str) -> Row:
    """Return the row of ``rival`` in the situation of ``case``."""
    if case.situation is None:
        return not_run('impossible', case.reason)
    return rows[key_of(rival, case.situation, made_by)]


# ---- In a worker ----


def perform(job: Job) -> Done:
    """Run ``job``; raises StudyStopped where the sources are not those that asked for it."""
    check_origin(job.origin)
    begin = time.process_time()
    run = run_case if job.kind == CASE else RIVALS[job.kind].run
    return Done(run(job.setting), time.process_time() - begin)


def prepare(job: Job) -> Done:
    """Leave the lag table of ``job`` on disk."""
    check_origin(job.origin)
    lag_table_of(job.setting.believed)
    return Done({}, 0.0)


def check_origin(made_by: str) -> None:
    """Raise StudyStopped unless the sources here are those of ``made_by``."""
    if origin() != made_by:
        raise StudyStopped('a worker has other sources or versions: the same everywhere, please')


def _start_worker(parent: int) -> None:
    # Linux: no worker outlives a command that was killed.
    ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != parent:
        os._exit(1)


# ---- Where jobs are run ----


@contextlib.contextmanager
def processes(workers: int) -> Iterator[Executor]:
    """Give an executor of ``workers`` processes; none is left, however the context ends."""
    others = set(multiprocessing.active_children())
    executor = concurrent.futures.ProcessPoolExecutor(
        workers, multiprocessing.get_context('spawn'), _start_worker, (os.getpid(),)
    )
    try:
        yield executor
    except BaseException:
        executor.shutdown(wait=False, cancel_futures=True)
        for child in set(multiprocessing.active_children()) - others:
            child.kill()
        raise
    finally:
        executor.shutdown()


@contextlib.contextmanager
def dask_cluster(address: str) -> Iterator[Executor]:
    """
    Give an executor of the Dask cluster whose scheduler is at ``address``.

    Raises ConfigurationError where there is none, or none can be used, and StudyStopped where a
    worker ends in mid-study.
    """
    try:
        from distributed import Client, KilledWorker
    except ModuleNotFoundError:
        raise ConfigurationError(
            '--dask: needs the Python package distributed: pip install distributed'
        ) from None
    try:
        client = Client(address, timeout=ANSWER, set_as_default=False)
    except (OSError, ValueError, TypeError) as error:
        reason = ' '.join(str(error).split())
        raise ConfigurationError(f'--dask {address}: does not answer ({reason})') from None
    with client:
        try:
            client.wait_for_workers(1, timeout=ANSWER)
        except TimeoutError:
            raise ConfigurationError(f'--dask {address}: has no workers') from None
        executor = client.get_executor(pure=False)
        try:
            yield executor
        except KilledWorker as error:
            raise StudyStopped(f'--dask {address}: {" ".join(str(error).split())}') from None
        finally:
            executor.shutdown(wait=False)


@contextlib.contextmanager
def _not_interrupted() -> Iterator[None]:
    # Workers inherit what is blocked: Ctrl-C is for the command, which ends them.
    old = signal.pthread_sigmask(signal.SIG_BLOCK, (signal.SIGINT,))
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, old)


# ---- Rows that stay ----


class Journal:
    """The rows of a folder that are done, one JSON object a line, each kept at once."""

    def __init__(self, path: Path) -> None:
        """
        Read the rows in ``path``, if there are any, and keep others away from it.

        Raises ConfigurationError where another study runs there.
        """
        self.file: TextIO = path.open('a+', encoding='utf-8')
        try:
            fcntl.flock(self.file, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            self.file.close()
            raise ConfigurationError(
                f'--out {path.parent}: another study is running there'
            ) from None
        self.file.seek(0)
        self.rows: dict[str, Row] = {}
        self.cpu_times: dict[str, float] = {}
        text = self.file.read()
        for line in text.splitlines():
            # The last one may have been cut short by a crash.
            with contextlib.suppress(ValueError, KeyError, TypeError):
                entry = json.loads(line)
                self.cpu_times[entry['key']] = float(entry['cpu_time'])
                self.rows[entry['key']] = dict(entry['row'])
        if text and not text.endswith('\n'):
            self.file.write('\n')

    def add(self, key: str, done: Done) -> None:
        """Keep a row."""
        entry = {'key': key, 'row': done.row, 'cpu_time': done.cpu_time}
        self.file.write(json.dumps(entry, allow_nan=False) + '\n')
        self.file.flush()
        self.rows[key] = done.row
        self.cpu_times[key] = done.cpu_time

    def close(self) -> None:
        """Let others at it."""
        self.file.close()


# ---- All of it ----


def run_jobs(
    jobs: Mapping[str, Job],
    journal: Journal,
    executor: Executor,
    progress: Callable[[int], None],
) -> None:
    """
    Run the ``jobs`` whose rows ``journal`` lacks; ``progress`` gets the runs done of all.

    First one for each number of motor units, which compiles the laws, then each lag table once,
    so that no two workers do the same. Raises StudyStopped where a worker dies.
    """
    left = {key: job for key, job in jobs.items() if key not in journal.rows}
    first = {len(job.setting.believed.fam.count): job for job in left.values()}
    tables = {job.setting.believed.hash(*PHYSICS, 'lag_table'): job for job in left.values()}

    runs = runs_of(jobs) - runs_of(left)
    progress(runs)

    def run(some: Iterable[Job]) -> None:
        nonlocal runs
        for job, done in _results(executor, perform, some):
            journal.add(job.key, done)
            runs += job.runs
            progress(runs)

    run(first.values())
    for _ in _results(executor, prepare, tables.values()):
        pass
    run(job for key, job in left.items() if key not in journal.rows)


def _results(
    executor: Executor, function: Callable[[Job], Done], jobs: Iterable[Job]
) -> Iterator[tuple[Job, Done]]:
    """Yield each of ``jobs`` with what ``function`` returned for it, as they come."""
    with _not_interrupted():
        futures = {executor.submit(function, job): job for job in jobs}
    try:
        for future in concurrent.futures.as_completed(futures):
            yield futures.pop(future), future.result()
    except (concurrent.futures.BrokenExecutor, concurrent.futures.CancelledError):
        raise StudyStopped('workers died; the same command goes on from here') from None
    except ModuleNotFoundError as error:
        raise StudyStopped(f'a worker lacks the Python package {error.name}') from None
