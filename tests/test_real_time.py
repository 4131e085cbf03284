# SPDX-License-Identifier: Apache-2.0
"""
The graph on a clock and in one process: what holds on any machine, however slow.

No test here depends on how punctual the machine is; ``./fam bench`` and ``./fam faults`` measure.
"""

from collections.abc import Callable, Iterator
import dataclasses
import json
import os
from pathlib import Path
import signal
import subprocess
import sys

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.graph import (
    drain,
    drain_patience,
    LOOP_LISTENERS,
    nodes_in,
    own_domain,
    recording,
    run_graph,
    start_nodes,
)
from fam_bundle_bringup.message_faults import inject, not_finite
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.processes import executable
from fam_bundle_bringup.rig import Rig
from fam_bundle_bringup.system_faults import shares_memory
from fam_bundle_bringup.verdicts import first_bump
from fam_bundle_io.trace import Trace
from fam_bundle_model.parameters import Configuration, write_yaml
import numpy as np
import pytest

pytestmark = pytest.mark.alone

SHORT = {'amplitude': 0.06, 'frequency': 0.5, 'cycles': 1}


def assert_same_bits(one: Trace, other: Trace) -> None:
    for name in other:
        assert one[name].tobytes() == other[name].tobytes(), name


# ---- Lock-step in other arrangements ----


def test_one_process_gives_the_same_bits(
    quick: Callable[..., Configuration], tmp_path: Path
) -> None:
    configuration = quick()
    assert_same_bits(run_graph(configuration, tmp_path, composed=True), run_offline(configuration))


def test_the_default_executor_gives_the_same_bits(
    quick: Callable[..., Configuration], tmp_path: Path
) -> None:
    configuration = quick(process={'executor': 'single_threaded'}, reference=SHORT)
    assert_same_bits(run_graph(configuration, tmp_path), run_offline(configuration))


def test_two_bundles_do_not_disturb_each_other_by_a_bit(
    quick: Callable[..., Configuration], tmp_path: Path
) -> None:
    configurations = {
        'left': quick('lag_pressure', reference=SHORT),
        'right': quick('baseline', reference=SHORT),
    }
    with own_domain(), recording(tuple(configurations)) as (recorders, listen):
        with nodes_in(tmp_path) as group:
            owners = []
            for bundle, configuration in configurations.items():
                parameters = tmp_path / f'{bundle}.yaml'
                write_yaml(configuration, parameters)
                listeners = LOOP_LISTENERS + 1
                owners.append(start_nodes(group, parameters, listeners, bundle=bundle))
            while not group.finished(*owners):
                listen(0.05)
            for recorder in recorders:
                drain(recorder, listen, drain_patience(configuration))
        traces = [recorder.trace(2) for recorder in recorders]
    for trace, configuration in zip(traces, configurations.values(), strict=True):
        assert len(trace['time']) == configuration.ticks()
        assert_same_bits(trace, run_offline(configuration))


# ---- On a clock ----


@pytest.mark.parametrize('composed', [False, True])
def test_every_period_is_a_sample_or_counted_as_skipped(
    composed: bool, quick: Callable[..., Configuration], tmp_path: Path
) -> None:
    configuration = quick(reference=SHORT, run={'pace': 'realtime'})
    trace = run_graph(configuration, tmp_path, composed=composed)
    periods = np.rint(trace['time'] / configuration.simulation.period).astype(int)
    assert (np.diff(periods) >= 1).all()
    reports = json.loads((tmp_path / 'loop_statistics.json').read_text())
    last = [r for r in reports if r['node'].endswith('plant_simulator')][-1]
    log = '\n'.join(path.read_text() for path in (tmp_path / 'log').iterdir())
    samples = int(log.split(': ran ')[1].split()[0])
    # The run ends when the first period after it has come due.
    assert samples + last['skipped_periods'] >= configuration.ticks()
    assert last['ticks'] + last['missing'] <= samples
    assert last['duplicate'] == last['out_of_order'] == last['refused'] == 0
    assert {r['node'].rpartition('/')[2] for r in reports} == {
        'lag_table_server',
        'recruitment_supervisor',
        'strain_controller',
        'pressure_controller',
        'plant_simulator',
    }


# ---- What a user may ask for ----


def test_what_the_system_refuses_is_one_warning(tmp_path: Path) -> None:
    absent = 1 << 40
    command = [executable('fam_bundle_control', 'strain_controller'), '--ros-args']
    command += ['--params-file', str(default_configuration()), '-p', f'process.cpu_mask:={absent}']
    with own_domain(), (tmp_path / 'log').open('w+') as log:
        node = subprocess.Popen(command, stderr=log, stdin=subprocess.DEVNULL)
        try:
            warning = 'process.cpu_mask = 0x10000000000: refused (there is no CPU 40)'
            for _ in range(600):
                if warning in (tmp_path / 'log').read_text():
                    break
                assert node.poll() is None
                with pytest.raises(subprocess.TimeoutExpired):
                    node.wait(0.1)
            assert (tmp_path / 'log').read_text().count('refused') == 1
        finally:
            node.kill()
            node.wait()


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['experiment', '--composed', '--pace', 'offline'], '--composed: --pace offline'),
        (['faults', '--only', 'nothing such'], '--only nothing such: no such fault'),
        (['bench', '--rounds', '0'], "'0': must be an integer from 1 to 100"),
    ],
)
def test_what_cannot_be_is_refused_in_one_line(
    arguments: list[str], words: str, tmp_path: Path
) -> None:
    command = [sys.executable, '-m', 'fam_bundle_bringup.cli', *arguments, '--out', str(tmp_path)]
    found = subprocess.run(command, capture_output=True, text=True, timeout=60.0, check=False)
    assert found.returncode == 2
    assert words in found.stderr
    assert found.stderr.count('\n') == 1
    assert not list(tmp_path.iterdir())


def test_a_time_out_below_two_periods_is_refused(quick: Callable[..., Configuration]) -> None:
    from fam_bundle_model.schema import ConfigurationError

    with pytest.raises(ConfigurationError, match=r'run\.command_timeout = 0\.0015 s: must be >='):
        quick(run={'command_timeout': 0.0015})
    assert dataclasses.replace(quick().run, command_timeout=0.002)


# ---- Hurt on a clock ----


@pytest.fixture(scope='module')
def rig(
    quick: Callable[..., Configuration], tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Rig]:
    """
    Return a running loop in real time that no test's machine is too slow for.

    One for all tests here, each of which leaves it running.
    """
    configuration = quick(
        reference={'amplitude': 0.06, 'frequency': 0.02, 'cycles': 1000},
        run={'pace': 'realtime', 'command_timeout': 0.5},
    )
    with Rig(configuration, tmp_path_factory.mktemp('rig')) as running:
        running.start_all()
        yield running


def test_nothing_leaves_the_machine_or_shares_its_memory(rig: Rig) -> None:
    for name, process in rig.nodes.items():
        links = [os.readlink(f) for f in Path(f'/proc/{process.pid}/fd').iterdir()]
        sockets = {link[8:-1] for link in links if link.startswith('socket:[')}
        rows = Path(f'/proc/{process.pid}/net/udp').read_text().splitlines()[1:]
        addresses = {row.split()[1].partition(':')[0] for row in rows if row.split()[9] in sockets}
        assert addresses == {f'{int.from_bytes(bytes([127, 0, 0, 1]), sys.byteorder):08X}'}, name
        assert not shares_memory(process.pid)


@pytest.mark.parametrize('victim', ['strain_controller', 'recruitment_supervisor'])
def test_a_killed_controller_makes_the_plant_safe_and_rejoins(victim: str, rig: Rig) -> None:
    since = rig.signal(victim, signal.SIGKILL)
    rig.wait_for(lambda: rig.safe_after(since) is not None, 'the safe state')
    rig.wait_for(lambda: bool(rig.reason(since, 'waiting for')), 'the reason')
    rig.start(victim)
    rig.wait_for(rig.runs, 'the run to go on')
    joined = rig.first_tick_of_this_stretch()
    assert first_bump(rig, joined) < 0.02 * rig.configuration.source.nominal_pressure


def test_a_new_plant_runs_with_the_controllers_of_the_last(rig: Rig) -> None:
    rig.signal('plant_simulator', signal.SIGKILL)
    rig.start('plant_simulator')
    rig.wait_for(lambda: rig.seen['bundle_state'][-1].message.tick < 100, 'the new run')
    rig.wait_for(rig.runs, 'the new run to run')


def test_bad_commands_latch_a_fault_until_it_is_reset(rig: Rig) -> None:
    from std_srvs.srv import Trigger

    since = inject(rig, 'valve_command', not_finite, 30)
    rig.wait_for(lambda: rig.safe_after(since) is not None, 'the safe state')
    rig.wait_for(lambda: bool(rig.reason(since, 'fault: valve_command')), 'the reason')
    client = rig.node.create_client(Trigger, 'plant_simulator/reset_fault')
    rig.wait_for(client.service_is_ready, 'the service')
    for expected in (True, False):
        answer = client.call_async(Trigger.Request())
        rig.wait_for(answer.done, 'the answer')
        assert answer.result().success is expected
    rig.wait_for(rig.runs, 'the run to go on')
