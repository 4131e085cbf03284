# SPDX-License-Identifier: Apache-2.0
"""
Faults of a rig behind the hardware bridge, on any machine, however slow: counts, no times.

``./fam faults --backend volts`` has all of them, and times.
"""

from collections.abc import Iterator
import signal
import time

from fam_bundle_bringup.bridge_rig import BridgeRig
from fam_bundle_bringup.bridge_verdicts import (
    ended,
    latched,
    reads_between,
    reset_and_armed,
    said,
)
from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_io.hardware.calibration import MU_PRESSURE
from fam_bundle_model.parameters import load_configuration
import pytest

pytestmark = pytest.mark.alone

BAD_SAMPLES = 4  # limits.sensor_samples


@pytest.fixture(scope='module')
def rig(tmp_path_factory: pytest.TempPathFactory) -> Iterator[BridgeRig]:
    """Return a bridge whose valves follow commands, and that no machine is too slow for."""
    changes = {'reference': {'cycles': 1000}, 'run': {'pace': 'realtime'}}
    configuration = load_configuration(default_configuration(), changes)
    patient = {
        'command_stale': 0.3,
        'command_lost': 2.0,
        'watchdog_timeout': 0.4,
        'read_timeout': 0.35,
    }
    with BridgeRig(configuration, tmp_path_factory.mktemp('rig'), **patient) as running:
        running.start_alone()
        yield running


def went_safe(rig: BridgeRig, since: int, word: str) -> int:
    """Wait for the fault; check it by the card's own log; return how many samples it took."""
    found, shown = said(rig, since, word)
    assert shown, found
    rig.wait_for(lambda: rig.safe_since(since) is not None, 'the safe volts')
    at = rig.safe_since(since)
    assert at is not None
    assert latched(rig)[1]
    assert rig.safe_since(since) == at
    return reads_between(rig, since, at)


def runs_again(rig: BridgeRig) -> None:
    found, runs = reset_and_armed(rig)
    assert runs, found


def test_while_it_runs_the_valves_are_not_at_the_tank(rig: BridgeRig) -> None:
    since = time.monotonic_ns()
    rig.listen(0.5)
    assert not rig.is_safe(rig.log(since)).any()
    assert (rig.safe_volts < -1.0).all()  # 0 V would close them


def test_bad_commands_in_a_row_put_the_safe_volts_out(rig: BridgeRig) -> None:
    since = time.monotonic_ns()
    rig.orders += [[float('nan'), 0.0]] * 30
    went_safe(rig, since, 'valve_command')
    rig.orders.clear()
    runs_again(rig)


def test_an_open_wire_does_so_after_four_samples(rig: BridgeRig) -> None:
    since = rig.inject('input_open', MU_PRESSURE)
    assert went_safe(rig, since, 'mu_pressure[0] = 0 V') == BAD_SAMPLES
    assert not rig.trigger('reset_fault')[0]
    rig.inject('')
    runs_again(rig)


@pytest.mark.parametrize(('fault', 'word'), [('read_error', 'read: '), ('watchdog', 'watchdog')])
def test_a_card_that_fails_is_safe_and_comes_back_by_reset_and_arm(
    fault: str, word: str, rig: BridgeRig
) -> None:
    since = rig.inject(fault)
    assert went_safe(rig, since, word) <= 1
    rig.inject('')
    runs_again(rig)


def test_where_nothing_can_be_written_the_watchdog_does_it(rig: BridgeRig) -> None:
    since = rig.inject('write_error')
    went_safe_at = went_safe(rig, since, 'does not answer')
    assert rig.first('expire', since) == rig.safe_since(since)
    assert went_safe_at > 1
    rig.inject('')
    runs_again(rig)


def test_a_killed_bridge_leaves_it_to_the_watchdog(rig: BridgeRig) -> None:
    since = rig.signal('hardware_bridge', signal.SIGKILL)
    rig.wait_for(lambda: rig.safe_since(since) is not None, 'the safe volts')
    assert rig.first('expire', since) == rig.safe_since(since)
    rig.seen['bridge_state'].clear()
    rig.start_bridge()
    assert rig.safe_since(since) is not None
    rig.arm()


@pytest.mark.parametrize('number', [signal.SIGTERM])
def test_a_bridge_that_is_told_to_end_puts_the_safe_volts_out_itself(
    number: signal.Signals, rig: BridgeRig
) -> None:
    rig.may_end.add('hardware_bridge')
    since = rig.signal('hardware_bridge', number)
    found, good = ended(rig, 130)
    assert good, found
    assert rig.safe_since(since) is not None
    assert rig.first('make_safe', since) is not None
    assert rig.first('expire', since) is None
