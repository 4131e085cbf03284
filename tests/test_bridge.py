# SPDX-License-Identifier: Apache-2.0
"""The hardware bridge in place of the plant simulator lets valves move only if told."""

from collections.abc import Callable, Iterator
import contextlib
import dataclasses
import os
from pathlib import Path
import signal
import subprocess
import time
from typing import Any

from fam_bundle_bringup.experiment import (
    default_configuration,
    measure_tracking,
    run_experiment,
    with_bridge,
)
from fam_bundle_bringup.graph import own_domain
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.processes import executable
from fam_bundle_io.bag import read_bag, trace_of
from fam_bundle_io.hardware.calibration import HardwareFile, load_hardware
from fam_bundle_model.parameters import Configuration, write_yaml
import numpy as np
import pytest

pytestmark = pytest.mark.alone

Make = Callable[..., Configuration]
SHORT = {'amplitude': 0.06, 'frequency': 0.5, 'cycles': 1}


VOLTS = default_configuration().with_name('volts_calibration.yaml')


@pytest.fixture(scope='module')
def hardware() -> HardwareFile:
    return load_hardware(VOLTS)


def with_bits(hardware: HardwareFile, bits: int) -> HardwareFile:
    return dataclasses.replace(hardware, options={'volts': {'bits': bits}})


def test_through_the_bridge_the_experiment_is_the_same(
    quick: Make, hardware: HardwareFile, tmp_path: Path
) -> None:
    """Without converters' steps it differs only by the first commands, which arm the bridge."""
    configuration = quick('lag_pressure', reference=SHORT)
    direct = measure_tracking(configuration, run_offline(configuration))
    found = run_experiment(
        configuration, 'lockstep', tmp_path, hardware=with_bits(hardware, 0), record=True
    )
    assert found.metrics['ticks'] == configuration.ticks()
    assert found.metrics['iae'] == pytest.approx(direct.iae, rel=0.05)
    assert found.metrics['max_error'] == pytest.approx(direct.max_error, rel=0.05)
    assert found.metrics['bag']['missing'] == []
    bag = read_bag(tmp_path / 'bag')
    run = trace_of(bag)
    assert run.trace['strain'].tobytes() == found.trace['strain'].tobytes()
    applied, told = bag.tables['/bridge_state'], bag.tables['/valve_command'].set_index('tick')
    of_run = applied[applied['state'] == 'active'].drop_duplicates('tick').set_index('tick')
    # What stands in the report of a tick was put out before its sample.
    for unit in range(2):
        before = told.loc[of_run.index - 1, f'spool[{unit}]'].to_numpy()
        assert np.array_equal(of_run[f'spool[{unit}]'], before)
    info = bag.tables['/backend_info'].iloc[0]
    assert info['backend'] == 'volts'
    assert info['calibration_hash'] == hardware.calibration.hash()


def test_sixteen_bits_change_little(quick: Make, hardware: HardwareFile, tmp_path: Path) -> None:
    configuration = quick('baseline', reference=SHORT)
    direct = measure_tracking(configuration, run_offline(configuration))
    found = run_experiment(configuration, 'lockstep', tmp_path, hardware=with_bits(hardware, 16))
    assert found.metrics['iae'] == pytest.approx(direct.iae, rel=0.05)
    assert found.metrics['upshift_times']


# ---- By hand ----


class Bridge:
    """A running bridge without controllers, and calls of its services."""

    def __init__(self, process: 'subprocess.Popen[str]', node: Any) -> None:
        self.process, self.node, self.states = process, node, list[Any]()
        from fam_bundle_msgs.msg import BridgeState

        node.create_subscription(BridgeState, 'bridge_state', self.states.append, 10)

    def call(self, name: str, request: Any, kind: type) -> Any:
        import rclpy

        client = self.node.create_client(kind, f'/hardware_bridge/{name}')
        assert client.wait_for_service(20.0), name
        future = client.call_async(request)
        rclpy.spin_until_future_complete(self.node, future, timeout_sec=60.0)
        assert future.done(), name
        self.node.destroy_client(client)
        return future.result()

    def trigger(self, name: str) -> Any:
        from std_srvs.srv import Trigger

        return self.call(name, Trigger.Request(), Trigger)

    def change(self, transition: int) -> bool:
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request()
        request.transition.id = transition
        return bool(self.call('change_state', request, ChangeState).success)

    def state(self) -> Any:
        """Return the next report."""
        import rclpy

        count, end = len(self.states), time.monotonic() + 20.0
        while len(self.states) == count and time.monotonic() < end:
            rclpy.spin_once(self.node, timeout_sec=0.1)
        return self.states[-1]


@contextlib.contextmanager
def bridge(configuration: Configuration, folder: Path) -> Iterator[Bridge]:
    import rclpy
    from rclpy.signals import SignalHandlerOptions

    parameters = folder / 'parameters.yaml'
    write_yaml(configuration, parameters)
    with own_domain():
        command = [executable('fam_bundle_io', 'hardware_bridge')]
        command += ['--ros-args', '--params-file', str(parameters)]
        process = subprocess.Popen(command, stderr=subprocess.PIPE, text=True, env=os.environ)
        rclpy.init(signal_handler_options=SignalHandlerOptions.NO)
        node = rclpy.create_node('operator')
        try:
            yield Bridge(process, node)
        finally:
            node.destroy_node()
            rclpy.try_shutdown()
            process.send_signal(signal.SIGTERM)
            _, err = process.communicate(timeout=30)
        assert 'Traceback' not in err, err


def prepared(
    quick: Make, hardware: HardwareFile, folder: Path, start: str = 'unconfigured'
) -> Configuration:
    configuration = with_bridge(quick(), 'realtime', hardware, folder / 'hardware.yaml')
    run = dataclasses.replace(configuration.run, pace='realtime')
    held = dataclasses.replace(configuration.bridge, start=start)
    return dataclasses.replace(configuration, run=run, bridge=held)


def test_an_operator_leads_it_by_hand(quick: Make, hardware: HardwareFile, tmp_path: Path) -> None:
    from lifecycle_msgs.msg import Transition

    with bridge(prepared(quick, hardware, tmp_path), tmp_path) as one:
        assert 'is unconfigured' in one.trigger('zero').message
        assert one.change(Transition.TRANSITION_CONFIGURE)
        assert (one.state().state, one.state().safe_out) == ('inactive', True)
        assert 'not active; configure and activate' in one.trigger('arm').message
        assert one.change(Transition.TRANSITION_ACTIVATE)
        refused = one.trigger('arm')
        assert not refused.success
        assert 'bundle_state has 0 of 3 listeners' in refused.message
        stopped = one.trigger('emergency_stop')
        assert stopped.success
        end = time.monotonic() + 10.0
        while one.state().state != 'fault' and time.monotonic() < end:
            pass
        assert one.state().fault == 'emergency stop'
        assert one.state().safe_out
        assert one.trigger('disarm').success
        assert one.state().state == 'fault'
        # At rest the first unit holds the load: a fault ends only where no unit has pressure.
        assert 'must be < 20000 Pa' in one.trigger('reset_fault').message
        assert one.change(Transition.TRANSITION_DEACTIVATE)
        assert one.change(Transition.TRANSITION_CLEANUP)


def test_a_card_that_is_not_there_is_said(quick: Make, tmp_path: Path) -> None:
    file = tmp_path / 'rig.yaml'
    file.write_text(VOLTS.read_text().replace('simulated rig', 'rig 7'))
    configuration = prepared(quick, load_hardware(file), tmp_path, 'inactive')
    quanser = dataclasses.replace(configuration.bridge, backend='quanser')
    write_yaml(dataclasses.replace(configuration, bridge=quanser), tmp_path / 'p.yaml')
    with own_domain():
        command = [executable('fam_bundle_io', 'hardware_bridge')]
        command += ['--ros-args', '--params-file', str(tmp_path / 'p.yaml')]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 1
    assert 'quanser' in done.stderr
    assert 'Traceback' not in done.stderr


@pytest.mark.parametrize(
    ('change', 'words'),
    [
        ({'hardware': 'no.yaml'}, 'no.yaml: cannot be read'),
        ({'backend': 'none'}, 'backend none: not registered'),
        ({'backend': 'quanser'}, 'is that of the simulated rig; quanser needs'),
        ({'start': 'now'}, 'bridge.start = now: must be one of'),
    ],
)
def test_the_bridge_refuses_in_one_line(
    quick: Make, hardware: HardwareFile, tmp_path: Path, change: dict[str, str], words: str
) -> None:
    configuration = prepared(quick, hardware, tmp_path)
    bad = dataclasses.replace(configuration.bridge, **change)
    write_yaml(dataclasses.replace(configuration, bridge=bad), tmp_path / 'p.yaml')
    with own_domain():
        command = [executable('fam_bundle_io', 'hardware_bridge')]
        command += ['--ros-args', '--params-file', str(tmp_path / 'p.yaml')]
        done = subprocess.run(command, capture_output=True, text=True, timeout=60, check=False)
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count('\n') == 1


# ---- The command ----


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (('--hardware', 'x.yaml'), 'name it with --backend'),
        (('--backend', 'nothing'), '--backend nothing: not known; there are: '),
        (('--backend', 'volts', '--composed'), 'not with --composed'),
        (('--backend', 'volts', '--pace', 'offline'), '--pace offline has no bridge'),
        (('--backend', 'volts', '--hardware', 'no.yaml'), 'no.yaml: cannot be read'),
        (('--backend', 'quanser'), 'needs --hardware FILE'),
        (
            ('--backend', 'quanser', '--pace', 'realtime', '--hardware', VOLTS),
            'is that of the simulated rig; quanser needs',
        ),
    ],
)
def test_options_that_do_not_fit_are_refused_in_one_line(
    fam: Any, tmp_path: Path, arguments: tuple[str, ...], words: str
) -> None:
    done = fam('experiment', *arguments, '--out', tmp_path / 'out')
    assert done.returncode == 2
    assert words in done.stderr
    assert done.stderr.count('\n') == 1
    assert done.stdout == ''
