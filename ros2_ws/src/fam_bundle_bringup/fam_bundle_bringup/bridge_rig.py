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
The graph around the hardware bridge and a simulated card that outlives it, under observation.

What is out, and since when, is taken from the log of the card, a process of its own.
"""

from collections.abc import Callable, Mapping
import contextlib
import dataclasses
import os
from pathlib import Path
import sys
import tempfile
import time
from types import TracebackType
from typing import Any

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.graph import BRIDGE, LOOP_LISTENERS, NODES
from fam_bundle_bringup.processes import executable
from fam_bundle_bringup.rig import Rig, Seen
from fam_bundle_io.hardware.calibration import load_hardware, Scaling, write_hardware
from fam_bundle_model.parameters import Configuration
from fam_bundle_sim.volts_card import read_log
import numpy as np
import numpy.typing as npt

CARD = ('fam_bundle_sim', 'volts_card')
PACKAGES = {name: p for p, name in (*NODES, BRIDGE) if name != 'plant_simulator'}
# Standard deviations: a channel that repeats itself to the last bit is a frozen one.
NOISE = {'strain_noise': 5e-5, 'force_noise': 0.5, 'pressure_noise': 500.0, 'flow_noise': 1e-7}
FROZEN_SAMPLES = 500  # the default; the simulated rig's own file has no noise and turns it off
QUIET = 0.3  # s without a disturbance before a fault
DISTURBED = 0.5  # of the time in which a command is stale: no sample, the machine was elsewhere
PATIENCE = 40.0  # s for the loop to be quiet
SOFTER = 0.1  # gains: with the paper's a loop on a late machine is unstable
MATCHED = 0.2  # s after which a service has found its client too; an earlier call waits for that
ANSWER_SHARE = 0.5  # calls of the card take a tenth of a period here, through a socket
PRIORITY = 10  # of all processes, as on a rig; without the right rows are repeated more often
STEP = 4e-4  # V; a converter of 16 bits over 20 V has steps of 0.3 mV
GENTLE = 0.45  # of the nominal pressure, that the stand-in keeps in the first motor unit
FILL = 0.5  # s until then; faster, the second unit sucks its oil in and reads like an open wire

Log = npt.NDArray[np.void]
Command = Callable[[Any], list[float]]  # what a controller makes of a bundle_state


def softer(loop: Any) -> Any:
    """Return a loop with smaller gains."""

    def smaller(gain: Any) -> Any:  # one, or one per motor unit
        return tuple(map(smaller, gain)) if isinstance(gain, tuple) else SOFTER * gain

    return dataclasses.replace(
        loop,
        proportional_gain=smaller(loop.proportional_gain),
        integral_gain=smaller(loop.integral_gain),
    )


class NotQuietError(RuntimeError):
    """The loop never ran undisturbed for long enough to be hurt."""


class BridgeRig(Rig):
    """Four controllers or a stand-in for them, a bridge and its card, each a process."""

    packages: Mapping[str, str] = PACKAGES
    listeners = LOOP_LISTENERS
    topics = ()

    def __init__(self, configuration: Configuration, folder: Path, **limits: float) -> None:
        """
        Write the files of the rig to ``folder``; start nothing yet.

        ``limits`` are laid over those of ``limits.py``.
        """
        folder.mkdir(parents=True, exist_ok=True)
        hardware = load_hardware(default_configuration().with_name('volts_calibration.yaml'))
        changes: dict[str, Any] = {'frozen_samples': FROZEN_SAMPLES, **limits}
        self.limits = dataclasses.replace(hardware.limits, **changes)
        self.safe_volts = Scaling(hardware.calibration).safe_volts
        # A path of a Unix socket must be short.
        self._private = tempfile.TemporaryDirectory(prefix='fam_bundle_')
        self._socket = Path(self._private.name) / 'card'
        options = {'volts_card': {'socket': str(self._socket)}}
        hardware = dataclasses.replace(hardware, limits=self.limits, options=options)
        self.calibration = hardware.calibration
        write_hardware(hardware, folder / 'hardware.yaml')
        path = str((folder / 'hardware.yaml').resolve())
        bridge = dataclasses.replace(
            configuration.bridge,
            backend='volts_card',
            hardware=path,
            start='inactive',
            answer_share=ANSWER_SHARE,
        )
        sensors = dataclasses.replace(configuration.sensors, **NOISE)
        used = dataclasses.replace(
            configuration,
            bridge=bridge,
            sensors=sensors,
            strain_loop=softer(configuration.strain_loop),
            pressure_loop=softer(configuration.pressure_loop),
            process=dataclasses.replace(configuration.process, priority=PRIORITY),
        )
        super().__init__(used, folder)
        self.card_log = folder / 'card.log'
        self._clients: dict[str, Any] = {}
        self.may_end: set[str] = set()  # nodes whose end is no surprise
        # Of the stand-in: its law, whether it answers, and what it says first, each once.
        self.command: Command = self.gentle
        self.answers = True
        self.orders: list[list[float]] = []
        self.vent = False
        self.answered_at = 0  # ns, steady
        self.called_at = 0  # when the newest call of a service went out
        self.hurt = 0, 0  # from when to when (ns) it went safe, or had to go on

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        trace: TracebackType | None,
    ) -> None:
        """End all processes."""
        self._hurry(os.SCHED_OTHER, 0)
        super().__exit__(kind, error, trace)
        self._private.cleanup()

    # ---- Starting ----

    def _hurry(self, policy: int, priority: int) -> None:
        """Put this process, which stands in for controllers, under a scheduling policy."""
        from fam_bundle_node.tuning import set_policy

        with contextlib.suppress(OSError):
            set_policy(policy, priority)

    def _subscribe(self, node: Any) -> None:
        from fam_bundle_msgs.msg import BridgeState
        from fam_bundle_node.qos import RECORDER_SUBSCRIPTION

        super()._subscribe(node)
        keep = self._keeper('bridge_state')
        node.create_subscription(BridgeState, 'bridge_state', keep, RECORDER_SUBSCRIPTION)

    def start_card(self) -> None:
        """Start the card, which knows no rig before a bridge configures it."""
        command = [executable(*CARD), '--socket', str(self._socket), '--log', str(self.card_log)]
        command += ['--priority', str(PRIORITY)]
        self.nodes[CARD[1]] = self.group.start(CARD[1], command)
        self.wait_for(self._socket.exists, 'the card')

    def start_bridge(self, *faulty: str) -> None:
        """Start the bridge; ``faulty`` as ``faulty_bridge`` takes it."""
        for name in list(self._clients):  # of the bridge before
            self.node.destroy_client(self._clients.pop(name))
        module = (sys.executable, '-m', 'fam_bundle_bringup.faulty_bridge', *faulty)
        self.start(BRIDGE[1], prefix=module if faulty else ())
        self.wait_for(lambda: self.state() in ('inactive', 'fault'), 'a configured bridge')
        self.change('activate')

    def start_all(self, *faulty: Any) -> None:
        """Start controllers, card and bridge, and return when the loop runs undisturbed."""
        self.start_card()
        for name in self.packages:
            if name != BRIDGE[1]:
                self.start(name)
        self.start_bridge(*faulty)
        self.arm()

    def start_alone(self, *faulty: str) -> None:
        """Start card and bridge only: this process stands in for the controllers."""
        from fam_bundle_msgs.msg import BundleState, ValveCommand
        from fam_bundle_node.qos import REALTIME_PUBLISHER, REALTIME_SUBSCRIPTION

        self.listeners = 1
        publisher = self.node.create_publisher(ValveCommand, 'valve_command', REALTIME_PUBLISHER)

        def answer(sample: Any) -> None:
            if not self.answers:
                return
            spool = self.orders.pop(0) if self.orders else self.command(sample)
            command = ValveCommand(tick=sample.tick, spool=spool, vent=self.vent)
            command.header = sample.header
            publisher.publish(command)
            self.answered_at = time.monotonic_ns()

        self.node.create_subscription(BundleState, 'bundle_state', answer, REALTIME_SUBSCRIPTION)
        self.start_card()
        self.start_bridge(*faulty)
        self.arm()

    def gentle(self, sample: Any) -> list[float]:
        """Keep some pressure in the first motor unit, and none in the others."""
        share = min(sample.tick * self.configuration.simulation.period / FILL, 1.0)
        wanted = GENTLE * share * self.configuration.source.nominal_pressure
        gain = self.configuration.pressure_loop.proportional_gain[0]
        spool = gain * (wanted - sample.mu_pressure[0])
        return [min(max(spool, -1.0), 1.0)] + [-1.0] * (len(sample.mu_pressure) - 1)

    def arm(self) -> None:
        """
        Arm, and return when the loop runs undisturbed; what the machine spoils is reset.

        Raises NotQuietError when that never is.
        """
        # What is started from here is not to have it before it runs.
        self._hurry(os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, PRIORITY)
        end, words = time.monotonic() + PATIENCE, ''
        while time.monotonic() < end:
            done, words = self.trigger('arm')
            if done and self.is_quiet(end):
                return
            if self.state() == 'fault':
                words = self.newest().fault
                self.trigger('disarm')
                self.trigger('reset_fault')
            self.listen(0.1)
        raise NotQuietError(f'not quiet within {PATIENCE:g} s: {words}')

    # ---- Asking ----

    def call(self, kind: Any, name: str, request: Any) -> Any:
        """Call a service of the bridge and return its answer."""
        if name not in self._clients:
            self._clients[name] = self.node.create_client(kind, f'{BRIDGE[1]}/{name}')
            self.wait_for(self._clients[name].service_is_ready, name)
            self.listen(MATCHED)
        self.called_at = time.monotonic_ns()
        future = self._clients[name].call_async(request)
        self.wait_for(future.done, f'the answer of {name}')
        return future.result()

    def trigger(self, name: str) -> tuple[bool, str]:
        """Call a service that takes nothing; return success and message."""
        from std_srvs.srv import Trigger

        answer = self.call(Trigger, name, Trigger.Request())
        return answer.success, answer.message

    def change(self, transition: str) -> bool:
        """Ask for a transition of the managed node and return whether it was done."""
        from lifecycle_msgs.srv import ChangeState

        request = ChangeState.Request()
        request.transition.label = transition
        return bool(self.call(ChangeState, 'change_state', request).success)

    def inject(self, fault: str, *channels: int) -> int:
        """
        Break the rig and return when that was (ns, steady); without a fault mend it.

        Raises RuntimeError where the bridge refuses.
        """
        from fam_bundle_msgs.srv import InjectFault

        before = time.monotonic_ns()
        request = InjectFault.Request(fault=fault, channels=channels)
        answer = self.call(InjectFault, 'inject_fault', request)
        if not answer.success:
            raise RuntimeError(answer.message)
        return self.first('inject' if fault else 'heal', before) or before

    # ---- What the bridge says ----

    def newest(self) -> Any:
        """Return the newest bridge_state, or None."""
        seen = self.seen['bridge_state']
        return seen[-1].message if seen else None

    def state(self) -> str:
        """Return the state that the bridge reports."""
        newest = self.newest()
        return str(newest.state) if newest else ''

    def fault(self, since: int) -> str:
        """Return the fault that the bridge has reported since then (ns), or nothing."""
        faults = (s.message.fault for s in self.seen['bridge_state'] if s.at >= since)
        return next((str(fault) for fault in faults if fault), '')

    def reported(self, since: int) -> list[Seen]:
        """Return all reports of the bridge since then (ns)."""
        return [s for s in self.seen['bridge_state'] if s.at >= since]

    def ended(self) -> list[str]:
        """Return the nodes that have ended although they should not."""
        return [name for name in super().ended() if name not in self.may_end]

    # ---- What the card did ----

    def log(self, since: int = 0) -> Log:
        """Return what the card has logged since then (ns, steady)."""
        rows = read_log(self.card_log, len(self.safe_volts))
        return rows[np.searchsorted(rows['time'], since) :]  # noqa: E203

    def first(self, event: str, since: int) -> int | None:
        """Return when the first ``event`` since then was (ns); its details may follow."""
        rows = self.log(since)
        found = np.flatnonzero(np.char.startswith(rows['event'], event.encode()))
        return int(rows['time'][found[0]]) if found.size else None

    def is_safe(self, rows: Log) -> npt.NDArray[np.bool_]:
        """Return for each row whether the safe volts were out."""
        safe: npt.NDArray[np.bool_] = np.all(
            np.abs(rows['outputs'] - self.safe_volts) < STEP, axis=1
        )
        return safe

    def safe_since(self, since: int) -> int | None:
        """
        Return from when on the safe volts have been out without a break (ns), if they are.

        That is ``since`` at the earliest.
        """
        rows = self.log(since)
        moved = np.flatnonzero(~self.is_safe(rows))
        after = moved[-1] + 1 if moved.size else 0
        return int(rows['time'][after]) if after < len(rows) else None

    def is_quiet(self, end: float) -> bool:
        """
        Return whether valves follow commands at last, and nothing holds them up for a while.

        False when the bridge is not armed any more, or at the time ``end`` (s, steady).
        """
        self.listen(FILL)
        while self.state() in ('armed', 'active') and time.monotonic() < end:
            since = time.monotonic_ns()
            self.listen(QUIET)
            rows = self.log(since)
            follows = self.state() == 'active' and not self.is_safe(rows).any()
            if follows and not self.disturbed(since, time.monotonic_ns(), 'sample', 'read'):
                return True
        return False

    def was_disturbed(self) -> bool:
        """Return whether the machine held the card or the bridge up while it was hurt."""
        since, until = self.hurt
        watched = ('sample', 'read') if self.nodes[BRIDGE[1]].poll() is None else ('sample',)
        return self.disturbed(since, until, *watched)

    def disturbed(self, since: int, until: int, *events: str) -> bool:
        """Return whether one of ``events`` stayed away for too long in that time (ns)."""
        rows = self.log(since)
        rows = rows[rows['time'] <= until]
        for event in events:
            times = rows['time'][rows['event'] == event.encode()]
            gaps = np.diff(np.concatenate(([since], times, [until])))
            if gaps.max() > DISTURBED * self.limits.command_stale * 1e9:
                return True
        return False
