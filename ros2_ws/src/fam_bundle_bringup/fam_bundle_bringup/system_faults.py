# SPDX-License-Identifier: Apache-2.0
"""What can go wrong around the nodes: the system's clock, the middleware's shared memory."""

import os
import subprocess
import sys
import time
from collections.abc import Mapping
from pathlib import Path

from fam_bundle_bringup.rig import PACKAGES, Rig
from fam_bundle_bringup.verdicts import AFTER, Fault, both, harmless

# Preloaded, it adds the seconds in a mapped file to the system clock of a process, and takes them
# off again where a wait gives a date. libfaketime 0.9.10 will not do: with it sleeps on the steady
# clock fail, waits for the interpreter's lock are late, and its own lock holds the loop up.
OWN_CLOCK = r"""
#define _GNU_SOURCE
#include <dlfcn.h>
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

static struct timespec until(instant t)
{
    struct timespec real = *t;
    if (real.tv_sec > 1000000000) real.tv_sec -= *offset; /* a date, not a time since the start */
    return real;
}

int pthread_cond_timedwait(pthread_cond_t *condition, pthread_mutex_t *mutex, instant t)
{
    struct timespec real = until(t);
    return cond_wait(condition, mutex, &real);
}

int sem_timedwait(sem_t *semaphore, instant t)
{
    struct timespec real = until(t);
    return sem_wait_until(semaphore, &real);
}

int pthread_mutex_timedlock(pthread_mutex_t *mutex, instant t)
{
    struct timespec real = until(t);
    return mutex_lock_until(mutex, &real);
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
        found = harmless(rig, since, 2.0 * AFTER)
        jumps = {report.node: report.stamp - report.at_system for report in rig.reports}
        jumped = set(jumps) == set(PACKAGES) and all(
            abs(jump - seconds) < 1.0 for jump in jumps.values()
        )
        least = min(jumps.values(), key=abs)
        words = f'{len(jumps)} clocks jumped, the least by {least:.0f} s'
        return both(found, (words, jumped))

    return Fault(f'system clock steps by {seconds:+d} s', 'harmless', hurt, start)


def set_offset(offset: Path, seconds: int) -> None:
    """Step the clock of all processes that map the file ``offset``, at once."""
    with offset.open('r+b' if offset.exists() else 'w+b') as file:
        file.write(seconds.to_bytes(8, sys.byteorder, signed=True))


def with_own_clock(offset: Path, folder: Path) -> Mapping[str, str]:
    """Return the environment in which a process adds what is in ``offset`` to its clock.

    Raises RuntimeError without a C compiler.
    """
    set_offset(offset, 0)
    library = (folder / 'own_clock.so').resolve()
    command = ['cc', '-shared', '-fPIC', '-x', 'c', '-o', str(library), '-', '-ldl']
    try:
        subprocess.run(command, input=OWN_CLOCK, text=True, check=True, capture_output=True)
    except (OSError, subprocess.CalledProcessError) as error:
        raise RuntimeError(f'not tried: the C compiler cc is needed: {error}') from None
    return {'LD_PRELOAD': str(library), 'CLOCK_OFFSET': str(offset.resolve())}


# Both take shared memory from one process only, in a mount namespace of its own.
WITHOUT_SHARED_MEMORY = {
    'read-only': 'mount -o remount,bind,ro /dev/shm',
    'of its own': 'mount -t tmpfs tmpfs /dev/shm',
}


def without_shared_memory(name: str, kind: str) -> Fault:
    """Return the fault that one node cannot use the shared memory of the others."""
    mount = f'mount --bind /dev/shm /dev/shm && {WITHOUT_SHARED_MEMORY[kind]} && exec "$@"'
    user = () if os.geteuid() == 0 else ('--user', '--map-root-user')
    namespace = ('unshare', *user, '--mount', '--propagation', 'private')
    prefix = (*namespace, 'sh', '-c', mount, 'sh')

    def start(rig: Rig) -> None:
        for other in PACKAGES:
            rig.start(other, prefix=prefix if other == name else ())
        rig.wait_for(rig.runs, 'the loop to run')

    def hurt(rig: Rig) -> tuple[str, bool]:
        return harmless(rig, time.monotonic_ns(), 2.0 * AFTER)

    return Fault(f'shared memory {kind}: {name}', 'harmless', hurt, start)
