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

"""What the system refuses is a warning, and what nobody asks for is left alone."""

import ctypes
import dataclasses
import errno
import gc
import json
import os
import subprocess
import sys
from types import SimpleNamespace

from fam_bundle_model.parameters import ProcessParameters
from fam_bundle_node import tuning
import pytest

NOTHING = ProcessParameters(timer_slack=0.0, freeze_garbage=False)
EVERYTHING = {
    'priority': 50,
    'cpu_mask': 0b1,
    'lock_memory': True,
    'timer_slack': 3e-6,
    'freeze_garbage': True,
}
# What is asked for, under which pace, how a warning names it, and the system's call for it.
WISHES = [
    ([], 'lockstep', 'SCHED_BATCH', 'sched_setscheduler'),
    (['priority'], 'lockstep', 'process.priority = 50', 'sched_setscheduler'),
    (['priority'], 'realtime', 'process.priority = 50', 'sched_setscheduler'),
    (['cpu_mask'], 'realtime', 'process.cpu_mask = 0x1', 'sched_setaffinity'),
    (['lock_memory'], 'realtime', 'process.lock_memory = true', 'mlockall'),
    (['timer_slack'], 'realtime', 'process.timer_slack = 3e-06 s', 'prctl'),
    (['freeze_garbage'], 'realtime', 'process.freeze_garbage = true', 'freeze'),
]
wishes = pytest.mark.parametrize(('names', 'pace', 'told', 'call'), WISHES)
NOT_PERMITTED = PermissionError(errno.EPERM, 'Operation not permitted')


def tune(names, pace):
    """Tune as ``names`` of everything ask for."""
    wanted = {name: EVERYTHING[name] for name in names}
    return tuning.tune(dataclasses.replace(NOTHING, **wanted), pace)


@pytest.fixture
def system(monkeypatch):
    """Return a system that agrees and does nothing; ``asked`` is what it was called for."""
    system = SimpleNamespace(asked=[], refuses=False)

    def call(name, *arguments):
        system.asked.append((name, *(getattr(a, 'value', a) for a in arguments)))
        if system.refuses and name in ('mlockall', 'prctl'):
            ctypes.set_errno(errno.EPERM)
            return -1
        if system.refuses:
            raise NOT_PERMITTED
        return 0

    def stand_in(name):
        return lambda *arguments: call(name, *arguments)

    for module, name in ((os, 'sched_setscheduler'), (os, 'sched_setaffinity'), (gc, 'freeze')):
        monkeypatch.setattr(module, name, stand_in(name))
    monkeypatch.setattr(gc, 'collect', lambda: 0)
    system.library = SimpleNamespace(mlockall=stand_in('mlockall'), prctl=stand_in('prctl'))
    monkeypatch.setattr(ctypes, 'CDLL', lambda *_, **__: system.library)
    return system


@wishes
def test_one_refusal_is_one_warning_that_says_what_to_read(system, names, pace, told, call):
    system.refuses = True
    (warning,) = tune(names, pace)
    assert warning.startswith(f'{told}: refused (Operation not permitted)')
    assert 'docs/performance.md' in warning


def test_every_refusal_has_its_own_warning(system):
    system.refuses = True
    warnings = tune(EVERYTHING, 'realtime')
    assert len(warnings) == len(EVERYTHING)
    for name in EVERYTHING:
        assert sum(f'process.{name} = ' in warning for warning in warnings) == 1


@wishes
def test_a_call_that_the_system_does_not_have_is_a_warning(
    system, monkeypatch, names, pace, told, call
):
    monkeypatch.delattr(next(m for m in (os, gc, system.library) if hasattr(m, call)), call)
    (warning,) = tune(names, pace)
    assert warning.startswith(told)
    assert call in warning


@wishes
def test_what_is_not_asked_for_is_not_called(system, names, pace, told, call):
    assert tune(names, pace) == []
    assert {name for name, *_ in system.asked} == {call}


def test_nothing_is_called_when_nothing_is_asked_for(system):
    assert tune([], 'realtime') == []
    assert system.asked == []


def test_one_refusal_does_not_keep_the_rest_from_being_set(system):
    del system.library.mlockall
    assert len(tune(EVERYTHING, 'realtime')) == 1
    called = {name for name, *_ in system.asked}
    assert called == {'sched_setscheduler', 'sched_setaffinity', 'prctl', 'freeze'}


def test_every_thread_gets_the_values_of_the_parameters(system):
    tune(EVERYTHING, 'realtime')
    fifo = os.SCHED_FIFO, os.sched_param(50)
    for thread in tuning.threads():
        assert ('sched_setscheduler', thread, *fifo) in system.asked
        assert ('sched_setaffinity', thread, {0}) in system.asked
    assert ('mlockall', 1 | 2) in system.asked
    assert ('prctl', 29, 3000) in system.asked


# Tunes a process with two threads and tells what became of it.
TUNED = """
import ctypes, gc, json, os, sys, threading
from fam_bundle_model.parameters import ProcessParameters
from fam_bundle_node.tuning import threads, tune

def slack():
    return ctypes.CDLL(None).prctl(30, 0, 0, 0, 0)

threading.Thread(target=threading.Event().wait, daemon=True).start()
warnings = tune(ProcessParameters(**json.loads(sys.argv[1])), sys.argv[2])
slacks = [slack()]
later = threading.Thread(target=lambda: slacks.append(slack()))
later.start()
later.join()
status = dict(line.split(':', 1) for line in open('/proc/self/status'))
print(json.dumps({
    'warnings': warnings,
    'threads': len(threads()),
    'policies': sorted({os.sched_getscheduler(thread) for thread in threads()}),
    'cpus': sorted(set().union(*(os.sched_getaffinity(thread) for thread in threads()))),
    'slacks': slacks,
    'locked': int(status['VmLck'].split()[0]) > 0,
    'frozen': gc.get_freeze_count() > 0,
}))
"""


def tuned(pace, **wanted):
    """Return what became of a process that was tuned."""
    arguments = [json.dumps({**dataclasses.asdict(NOTHING), **wanted}), pace]
    found = subprocess.run(
        [sys.executable, '-c', TUNED, *arguments], capture_output=True, text=True, check=True
    )
    return SimpleNamespace(**json.loads(found.stdout))


def test_what_needs_no_rights_takes_effect_on_the_process():
    cpu = max(os.sched_getaffinity(0))
    found = tuned('lockstep', cpu_mask=1 << cpu, timer_slack=77e-6, freeze_garbage=True)
    assert found.warnings == []
    assert found.threads >= 2
    assert found.policies == [os.SCHED_BATCH]
    assert found.cpus == [cpu]
    assert found.slacks == [77_000, 77_000]
    assert found.frozen


def test_what_needs_rights_takes_effect_or_is_warned_about():
    found = tuned('realtime', priority=1, lock_memory=True)
    refused = [warning.split(' = ')[0] for warning in found.warnings]
    assert (found.policies == [os.SCHED_FIFO]) != ('process.priority' in refused)
    assert found.locked != ('process.lock_memory' in refused)
    assert not found.frozen
