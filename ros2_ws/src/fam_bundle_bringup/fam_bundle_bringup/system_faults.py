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

"""What can go wrong around the nodes: the system's clock, the middleware's shared memory."""

from collections.abc import Mapping
import os
from pathlib import Path
import shutil
import subprocess
import sys
import time

from fam_bundle_bringup.rig import PACKAGES, Rig
from fam_bundle_bringup.verdicts import AFTER, both, Fault, HARMLESS, harmless_or_safe

COMPILERS = ('cc', 'gcc', 'clang')
LEASE = 25.0  # s; after 20 the middleware forgets who was not heard of

# Preloaded, it adds the seconds in a mapped file to the system clock of a process, and to that of
# waits until a date. libfaketime 0.9.10 will not do: with it sleeps on the steady
# clock fail, waits for the interpreter's lock are late, and its own lock holds the loop up.
OWN_CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
#include <errno.h>
#include <fcntl.h>
#include <pthread.h>
#include <semaphore.h>
#include <stdlib.h>
#include <sys/mman.h>
#include <sys/time.h>
#include <time.h>

typedef const struct timespec *instant;
static const volatile long *offset;
static int (*get)(clockid_t, struct timespec *);
static int (*cond_wait)(pthread_cond_t *, pthread_mutex_t *, instant);
static int (*sem_wait_until)(sem_t *, instant);
static int (*mutex_lock_until)(pthread_mutex_t *, instant);

__attribute__((constructor)) static void find(void)
{
    int file = open(getenv("CLOCK_OFFSET"), O_RDONLY);
    offset = mmap(NULL, sizeof *offset, PROT_READ, MAP_SHARED, file, 0);
    get = dlsym(RTLD_NEXT, "clock_gettime");
    cond_wait = dlvsym(RTLD_NEXT, "pthread_cond_timedwait", "GLIBC_2.3.2"); /* x86-64 has two */
    if (!cond_wait) cond_wait = dlsym(RTLD_NEXT, "pthread_cond_timedwait");
    sem_wait_until = dlsym(RTLD_NEXT, "sem_timedwait");
    mutex_lock_until = dlsym(RTLD_NEXT, "pthread_mutex_timedlock");
}

int clock_gettime(clockid_t clock, struct timespec *now)
{
    if (!get) find(); /* another library's constructor may be first */
    int failed = get(clock, now);
    if (clock == CLOCK_REALTIME || clock == CLOCK_REALTIME_COARSE) now->tv_sec += *offset;
    return failed;
}

int gettimeofday(struct timeval *restrict now, void *restrict zone)
{
    struct timespec precise;
    clock_gettime(CLOCK_REALTIME, &precise);
    now->tv_sec = precise.tv_sec;
    now->tv_usec = precise.tv_nsec / 1000;
    return 0;
}

time_t time(time_t *seconds)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    return seconds ? (*seconds = now.tv_sec) : now.tv_sec;
}

/* A wait until a date ends when this clock gets there, also if it is stepped meanwhile: so it
   looks again every ten milliseconds. A wait on the steady clock is as it was. */
static int again(int result, instant t, struct timespec *slice)
{
    struct timespec now;
    clock_gettime(CLOCK_REALTIME, &now);
    if (result != ETIMEDOUT || t->tv_sec < 1000000000) return 0;
    if (now.tv_sec > t->tv_sec || (now.tv_sec == t->tv_sec && now.tv_nsec >= t->tv_nsec)) return 0;
    get(CLOCK_REALTIME, slice);
    slice->tv_nsec += 10000000;
    if (slice->tv_nsec >= 1000000000) { slice->tv_sec++; slice->tv_nsec -= 1000000000; }
    return 1;
}

static struct timespec first(instant t)
{
    struct timespec slice = *t;
    again(ETIMEDOUT, t, &slice);
    return slice;
}

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, instant t)
{
    struct timespec slice = first(t);
    int result;
    do result = cond_wait(condition, mutex, &slice);
    while (again(result, t, &slice));
    return result;
}

int sem_timedwait(sem_t *semaphore, instant t)
{
    struct timespec slice = first(t);
    int result;
    do result = sem_wait_until(semaphore, &slice);
    while (result && again(errno, t, &slice));
    return result;
}

int pthread_mutex_timedlock(pthread_mutex_t *mutex, instant t)
{
    struct timespec slice = first(t);
    int result;
    do result = mutex_lock_until(mutex, &slice);
    while (again(result, t, &slice));
    return result;
}
"""


def stepped_clock(folder: Path, seconds: int) -> Fault:
    """Return the fault that the system clock of all nodes jumps by ``seconds``."""
    offset = folder / 'clock_offset'

    def start(rig: Rig) -> None:
        rig.start_all(with_own_clock(offset, folder))

    def hurt(rig: Rig) -> tuple[str, bool]:
        since = time.monotonic_ns()
        set_offset(offset, seconds)
        found = harmless_or_safe(rig, since, LEASE)
        jumps = {report.node: report.stamp - report.at_system for report in rig.reports}
        jumped = set(jumps) == set(PACKAGES) and all(
            abs(jump - seconds) < 1.0 for jump in jumps.values()
        )
        least = min(jumps, key=lambda node: abs(jumps[node]))
        silent = ', '.join(sorted(set(PACKAGES) - set(jumps)))
        words = f'clocks: the least jump by {jumps[least]:.0f} s; silent: {silent or "none"}'
        return both(found, (words, jumped))

    return Fault(f'system clock steps by {seconds:+d} s', HARMLESS, hurt, start)


def set_offset(offset: Path, seconds: int) -> None:
    """Step the clock of all processes that map the file ``offset``, at once."""
    with offset.open('r+b' if offset.exists() else 'w+b') as file:
        file.write(seconds.to_bytes(8, sys.byteorder, signed=True))


def with_own_clock(offset: Path, folder: Path) -> Mapping[str, str]:
    """
    Return the environment in which a process adds what is in ``offset`` to its clock.

    Raises RuntimeError without a C compiler.
    """
    set_offset(offset, 0)
    library = (folder / 'own_clock.so').resolve()
    named = os.environ.get('CC', '').split()[:1]
    compiler = next(filter(shutil.which, (*named, *COMPILERS)), 'cc')
    command = [compiler, '-shared', '-fPIC', '-x', 'c', '-o', str(library), '-', '-ldl']
    try:
        subprocess.run(command, input=OWN_CLOCK, text=True, check=True, capture_output=True)
    except OSError as error:
        raise RuntimeError(f'not tried: the C compiler {compiler}: {error.strerror}') from None
    except subprocess.CalledProcessError as error:
        last = error.stderr.strip().splitlines()[-1:]
        raise RuntimeError(f'not tried: {compiler}: {"".join(last)}') from None
    return {'LD_PRELOAD': str(library), 'CLOCK_OFFSET': str(offset.resolve())}


def without_shared_memory(name: str) -> Fault:
    """
    Return the fault that one node has shared memory of its own, in a mount namespace.

    Nothing uses any: that is asked of all nodes, for a process that is killed while it holds a
    lock there holds the others up.
    """
    user = () if os.geteuid() == 0 else ('--user', '--map-root-user')
    namespace = ('unshare', *user, '--mount', '--propagation', 'private')
    prefix = (*namespace, 'sh', '-c', 'mount -t tmpfs tmpfs /dev/shm && exec "$@"', 'sh')

    def start(rig: Rig) -> None:
        for other in PACKAGES:
            rig.start(other, prefix=prefix if other == name else ())
        rig.wait_for(rig.runs, 'the loop to run')

    def hurt(rig: Rig) -> tuple[str, bool]:
        sharing = [n for n, process in rig.nodes.items() if shares_memory(process.pid)]
        words = f'shared memory of the middleware in: {", ".join(sharing) or "no node"}'
        found = harmless_or_safe(rig, time.monotonic_ns(), 2.0 * AFTER)
        return both(found, (words, not sharing))

    return Fault(f'shared memory of its own: {name}', f'none is used; {HARMLESS}', hurt, start)


def shares_memory(process: int) -> bool:
    """Return whether Fast DDS has mapped shared memory in a process."""
    return '/dev/shm/fastrtps' in Path(f'/proc/{process}/maps').read_text()
