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
Asks the system for what helps a loop to keep time; a refusal is a warning, never a failure.

Linux. Scheduling is set for every thread of the process, for the middleware's exist before the
nodes know their parameters.
"""

from collections.abc import Callable
import contextlib
import ctypes
import errno
import gc
import os
from pathlib import Path

from fam_bundle_model.parameters import ProcessParameters

_LOCK_CURRENT_AND_FUTURE = 1 | 2  # MCL_CURRENT | MCL_FUTURE
_SET_TIMER_SLACK = 29  # PR_SET_TIMERSLACK
RIGHTS = 'see "Real-time rights" in docs/performance.md'


def threads() -> list[int]:
    """Return the ids of this process's threads."""
    return [int(entry.name) for entry in Path('/proc/self/task').iterdir()]


def set_policy(policy: int, priority: int = 0) -> None:
    """Put all threads under a scheduling ``policy``; raises OSError when the system refuses."""
    for thread in threads():
        with contextlib.suppress(ProcessLookupError):  # it has just ended
            os.sched_setscheduler(thread, policy, os.sched_param(priority))


def set_batch_policy() -> None:
    """
    Let nobody whom this process wakes pre-empt it: a fifth more ticks per second in lock-step.

    Else a publisher is put aside by its first reader before it has served the others. It needs
    no rights. Raises OSError when the system refuses.
    """
    set_policy(os.SCHED_BATCH)


def set_cpus(mask: int) -> None:
    """Keep all threads on the CPUs whose bits are set; raises OSError when the system refuses."""
    cpus = {cpu for cpu in range(mask.bit_length()) if mask >> cpu & 1}
    absent = cpus - set(range(os.cpu_count() or 1))
    if absent:
        raise OSError(errno.EINVAL, f'there is no CPU {min(absent)}')
    for thread in threads():
        with contextlib.suppress(ProcessLookupError):
            os.sched_setaffinity(thread, cpus)


def lock_memory() -> None:
    """Keep all memory, present and future, from being paged out; raises OSError when refused."""
    _call('mlockall', _LOCK_CURRENT_AND_FUTURE)


def set_timer_slack(slack: float) -> None:
    """
    Let the kernel wake this thread, and those it starts, at most ``slack`` s late.

    Raises OSError when the system refuses.
    """
    _call('prctl', _SET_TIMER_SLACK, max(round(slack * 1e9), 1))


def freeze_garbage() -> None:
    """Spare the collector what is there now: numba leaves half a million objects."""
    gc.collect()
    gc.freeze()


def _call(name: str, *arguments: int) -> None:
    library = ctypes.CDLL(None, use_errno=True)
    if getattr(library, name)(*(ctypes.c_ulong(argument) for argument in arguments)) != 0:
        number = ctypes.get_errno()
        raise OSError(number, os.strerror(number))


def tune(process: ProcessParameters, pace: str) -> list[str]:
    """Apply ``process`` to this process; return one warning for each thing that was refused."""
    p = process
    wanted: list[tuple[str, bool, Callable[[], None]]] = [
        ('SCHED_BATCH', p.priority == 0 and pace == 'lockstep', set_batch_policy),
        (
            f'process.priority = {p.priority}',
            p.priority > 0,
            lambda: set_policy(os.SCHED_FIFO, p.priority),
        ),
        (f'process.cpu_mask = {p.cpu_mask:#x}', p.cpu_mask > 0, lambda: set_cpus(p.cpu_mask)),
        ('process.lock_memory = true', p.lock_memory, lock_memory),
        (
            f'process.timer_slack = {p.timer_slack:g} s',
            p.timer_slack > 0.0,
            lambda: set_timer_slack(p.timer_slack),
        ),
        ('process.freeze_garbage = true', p.freeze_garbage, freeze_garbage),
    ]
    warnings = []
    for name, asked, apply in wanted:
        try:
            if asked:
                apply()
        except (OSError, AttributeError) as error:
            reason = getattr(error, 'strerror', None) or str(error)
            warnings.append(f'{name}: refused ({reason}); {RIGHTS}')
    return warnings
