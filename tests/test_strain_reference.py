# SPDX-License-Identifier: Apache-2.0
"""
The strain controller's own reference: goals, live values, and the latched law.

The node runs in this process beside a bundle that is perfect: its strain is the reference of the
tick before. Where trajectories are foreseen the supervisor is there too. Times are those of the
run.
"""

from collections.abc import Callable, Iterator
import contextlib
import math
from pathlib import Path
from typing import Any

from action_msgs.msg import GoalStatus
from action_msgs.srv import CancelGoal
from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.graph import own_domain
from fam_bundle_bringup.replay import tracked_laws
from fam_bundle_bringup.replay_controllers import (
    Run,
    Samples,
    Stamp,
    steps_of,
    strain_answers,
    supervisor_answers,
)
from fam_bundle_control import strain_controller_node
from fam_bundle_control.announced import NOTICE
from fam_bundle_control.recruitment import RecruitmentOutput
from fam_bundle_control.recruitment_supervisor_node import RecruitmentSupervisor
from fam_bundle_control.strain_controller_node import StrainController
from fam_bundle_model.bundle import modelled_strain, motor_units
from fam_bundle_model.lag_table import cached_lag_table, lag_table_hash
from fam_bundle_model.parameters import Configuration, load_configuration, write_yaml
from fam_bundle_model.reference import reference_law, strain_reference
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_msgs.action import TrackStrain
from fam_bundle_msgs.msg import (
    BundleState,
    LagTable,
    PressureReference,
    RecruitmentState,
    Reference,
    StrainReference,
)
from fam_bundle_node import lag_table_message
from fam_bundle_node.qos import CHANGES, LATCHED, LOOP_PUBLISHER, LOOP_SUBSCRIPTION, NEWEST
from fam_bundle_node.reference_message import from_message, to_message
from fam_bundle_node.run import make_executor
import numpy as np
import pandas as pd
import pytest
import rclpy
from rclpy.action import ActionClient
from rclpy.executors import Executor
from rclpy.node import Node

PERIOD = 1e-3
PATIENCE = 30.0  # s
WEIGHT = 180.0  # N, of the load that hangs on the bundle
SLOW = {'strain_rate': 0.2, 'strain_acceleration': 4.0}


class Bundle(Node):
    """Publishes the next tick when the one before is answered, up to ``until``."""

    def __init__(self) -> None:
        super().__init__('bundle')
        self.references: list[float] = []
        self.pressures: list[float] = []
        self.strains: list[float] = []
        self.laws: list[Reference] = []
        self.states: list[tuple[Any, ...]] = []
        self.supervised = self.safe = False
        self.until = 0
        self.out = self.create_publisher(BundleState, 'bundle_state', LOOP_PUBLISHER)
        self.live = self.create_publisher(StrainReference, 'strain_reference', NEWEST)
        self.create_subscription(
            PressureReference, 'pressure_reference', self.answered, LOOP_SUBSCRIPTION
        )
        self.create_subscription(Reference, 'reference', self.laws.append, CHANGES)
        self.create_subscription(
            RecruitmentState, 'recruitment_state', self.decided, LOOP_SUBSCRIPTION
        )
        self.table = self.create_publisher(LagTable, 'lag_table', LATCHED)
        self.news = self.create_publisher(Reference, 'reference', CHANGES)
        self.client = ActionClient(self, TrackStrain, 'track_strain')

    def begin(self) -> None:
        """Begin a new run."""
        for values in (self.references, self.pressures, self.strains, self.states):
            values.clear()
        self.publish(0)

    def publish(self, tick: int) -> None:
        strain = self.references[-1] if self.references else 0.0
        self.strains.append(strain)
        message = BundleState(tick=tick, strain=strain, source_pressure=6.8e5, force=WEIGHT)
        nanoseconds = tick * 1_000_000
        message.header.stamp.sec, message.header.stamp.nanosec = divmod(nanoseconds, 10**9)
        message.mu_pressure, message.safe = [1e5, 0.0], self.safe
        self.out.publish(message)

    def answered(self, answer: PressureReference) -> None:
        assert answer.tick == len(self.references)
        self.references.append(answer.strain_reference)
        self.pressures.append(answer.pressure)
        self.go_on()

    def decided(self, answer: RecruitmentState) -> None:
        self.states.append(tuple(getattr(answer, name) for name in RecruitmentOutput._fields))
        self.go_on()

    def go_on(self) -> None:
        """Publish the next tick when all have answered the last one."""
        done = len(self.references)
        if done < self.until and done == (len(self.states) if self.supervised else done):
            self.publish(done)

    @property
    def answered_all(self) -> bool:
        """Whether all of the wanted ticks are answered."""
        waits = self.states if self.supervised else self.references
        return min(len(self.references), len(waits)) >= self.until


class Rig:
    """The two nodes on one executor."""

    def __init__(self, executor: Executor, nodes: list[Any], bundle: Bundle) -> None:
        self.executor, self.nodes, self.bundle = executor, nodes, bundle

    def spin(self, done: Callable[[], bool]) -> None:
        waits = rclpy.task.Future()
        for _ in range(int(PATIENCE / 0.02)):
            if done():
                return
            self.executor.spin_until_future_complete(waits, timeout_sec=0.02)
        raise AssertionError('nothing came')

    def run(self, seconds: float) -> None:
        """Let so much time of the run pass."""
        bundle = self.bundle
        bundle.until = len(bundle.references) + round(seconds / PERIOD)
        if bundle.references:
            bundle.publish(len(bundle.references))
        else:
            bundle.begin()
        self.spin(lambda: bundle.answered_all)

    def send(self, feedback: Callable[[Any], None] | None = None, **goal: Any) -> Any:
        """Send a goal and return its handle."""
        self.spin(self.bundle.client.server_is_ready)
        sent = self.bundle.client.send_goal_async(TrackStrain.Goal(**goal), feedback)
        self.spin(sent.done)
        return sent.result()

    def connect_live(self) -> None:
        """Send a value that changes nothing until one has come through."""
        laws = self.bundle.laws

        def heard() -> bool:
            self.bundle.live.publish(StrainReference(strain=0.0))
            return len(laws) > 1

        self.spin(heard)
        self.run(0.05)  # for those under way
        del laws[1:]

    def end_of(self, handle: Any) -> tuple[int, Any]:
        """Return status and result of a goal that has come to its end."""
        wrapped = handle.get_result_async()
        self.spin(wrapped.done)
        return wrapped.result().status, wrapped.result().result


def time_of(tick: int) -> float:
    """Return the time in s of a tick as nodes have it, from whole nanoseconds."""
    return tick * 1_000_000 / 1e9


def configured(predictor: str = 'preview', **reference: Any) -> Configuration:
    values = {'kind': 'sine', 'frequency': 0.5, 'cycles': 4, **reference}
    changes = {'reference': values, 'recruitment': {'predictor': predictor}}
    return load_configuration(default_configuration(), changes)


@pytest.fixture
def rig(tmp_path: Path, request: pytest.FixtureRequest) -> Iterator[Rig]:
    """Return the rig with a configured reference, and an executor, of the test's choice."""
    reference, kind = getattr(request, 'param', ({}, 'events'))
    with rig_of(configured(**reference), kind, tmp_path) as made:
        yield made


@contextlib.contextmanager
def rig_of(
    configuration: Configuration, kind: str, folder: Path, *, supervised: bool = False
) -> Iterator[Rig]:
    """Give the nodes of a run, and take them down."""
    write_yaml(configuration, folder / 'parameters.yaml')
    with own_domain():
        rclpy.init(args=['--ros-args', '--params-file', str(folder / 'parameters.yaml')])
        executor = make_executor(kind)
        bundle = Bundle()
        nodes = [StrainController(), *([RecruitmentSupervisor()] if supervised else [])]
        try:
            for node in (*nodes, bundle):
                executor.add_node(node)
            made = Rig(executor, nodes, bundle)
            made.spin(lambda: len(bundle.laws) == 1)
            if supervised:
                bundle.supervised = True
                table = cached_lag_table(configuration)
                message = lag_table_message.to_message(table, lag_table_hash(configuration))
                bundle.table.publish(message)
                made.spin(lambda: bundle.out.get_subscription_count() == len(nodes))
            yield made
        finally:
            for node in nodes:
                node.close()
            executor.shutdown()
            for node in (*nodes, bundle):
                node.destroy_node()
            rclpy.try_shutdown()


def both_executors(**reference: Any) -> pytest.MarkDecorator:
    kinds = ('events', 'single_threaded')
    return pytest.mark.parametrize('rig', [(reference, kind) for kind in kinds], indirect=True)


def live() -> pytest.MarkDecorator:
    reference = {'kind': 'topic', 'strain_rate': 0.1}
    return pytest.mark.parametrize('rig', [(reference, 'events')], indirect=True)


def assert_no_jump(references: list[float], rate: float = 0.2) -> None:
    assert np.abs(np.diff(references)).max() <= rate * PERIOD * (1 + 1e-6)


# ---- The action ----


@both_executors()
def test_a_goal_begins_without_a_jump_and_ends_with_its_score(rig: Rig) -> None:
    rig.run(0.7)
    told: list[Any] = []
    goal = {'kind': 'minimum_jerk', 'amplitude': 0.03, 'frequency': 2.0, 'cycles': 1, **SLOW}
    handle = rig.send(lambda message: told.append(message.feedback), **goal)
    assert handle.accepted
    start = from_message(rig.bundle.laws[-1]).start
    assert start > 0.7
    rig.run(start + 0.6 - 0.7)
    status, result = rig.end_of(handle)
    assert (status, result.message) == (GoalStatus.STATUS_SUCCEEDED, '')

    references = np.array(rig.bundle.references)
    assert_no_jump(references.tolist(), 1.875 * 0.03 / 0.125)  # of least jerk, to the next level
    law = reference_law(configured(**goal).reference)
    wanted = [strain_reference(law, k * PERIOD - start) for k in range(len(references))]
    after = np.arange(len(references)) * PERIOD >= start
    assert references[after] == pytest.approx(np.array(wanted)[after], abs=1e-12)
    # The bundle is one tick behind: the error is the step of the reference.
    inside = after & (np.arange(len(references)) * PERIOD < start + 0.5)
    error = np.abs(np.diff(references, prepend=0.0))[inside]
    assert result.samples == error.size
    assert result.iae == pytest.approx(error.sum() * PERIOD)
    assert result.max_error == pytest.approx(error.max())
    rig.spin(lambda: len(told) >= 5)
    assert told[0].time < 0.0 < told[-1].time, 'first the way to it, then the waveform'
    assert np.diff([f.time for f in told]) == pytest.approx(0.05, abs=1.01 * PERIOD)
    assert all(abs(f.error) <= 0.45 * PERIOD for f in told)


def test_a_cancelled_goal_goes_back_smoothly_before_it_is_cancelled(rig: Rig) -> None:
    rig.run(0.1)
    handle = rig.send(kind='sine', amplitude=0.05, frequency=0.2, cycles=2, **SLOW)
    rig.run(1.5)
    before = rig.bundle.references[-1]
    assert before > 0.02
    cancelled = handle.cancel_goal_async()
    rig.spin(cancelled.done)
    assert cancelled.result().return_code == CancelGoal.Response.ERROR_NONE
    rig.run(0.05)
    assert rig.bundle.references[-1] > before, 'it goes on where it was going, and slows down'
    assert rig.bundle.laws[-1].kind == 'return'
    assert not rig.send(kind='ramp').accepted, 'while another is on its way back'
    rig.run(1.5)
    status, result = rig.end_of(handle)
    assert status == GoalStatus.STATUS_CANCELED
    assert 1000 < result.samples < 1600, 'the way back is not scored'
    assert rig.bundle.references[-1] == pytest.approx(0.0, abs=1e-12)
    assert_no_jump(rig.bundle.references)
    assert np.abs(np.diff(rig.bundle.references, 2))[200:].max() <= 4.0 * PERIOD**2 * 1.01


@pytest.mark.parametrize('since', [0.6, 1.2])
def test_a_cancel_drives_the_strain_no_higher_than_braking_takes(rig: Rig, since: float) -> None:
    """The sine peaks at 0.14; all that the bundle can hold is 0.1505."""
    rig.run(0.1)
    handle = rig.send(kind='sine', amplitude=0.07, frequency=0.3, cycles=3)
    rig.run(from_message(rig.bundle.laws[-1]).start + since - 0.1)
    before = rig.bundle.references[-1]
    speed = (before - rig.bundle.references[-2]) / PERIOD
    assert speed > 0.08
    rig.spin(handle.cancel_goal_async().done)
    rig.run(4.0)
    assert rig.end_of(handle)[0] == GoalStatus.STATUS_CANCELED
    assert max(rig.bundle.references) == pytest.approx(before + 0.5 * speed**2, abs=1e-4)
    assert rig.bundle.references[-1] == pytest.approx(0.0, abs=1e-12)


def test_no_goal_is_tracked_while_the_plant_is_safe(
    rig: Rig, capfd: pytest.CaptureFixture[str]
) -> None:
    rig.run(0.1)
    handle = rig.send(kind='sine', amplitude=0.05, frequency=0.2, cycles=2, **SLOW)
    rig.run(1.5)
    rig.bundle.safe = True
    rig.run(0.5)
    status, result = rig.end_of(handle)
    assert status == GoalStatus.STATUS_ABORTED
    assert result.message == 'the plant is safe and follows nothing'
    assert result.samples < 1600
    references = np.array(rig.bundle.references)
    speed = (references[1599] - references[1598]) / PERIOD
    held = references[1600] + 0.5 * speed**2 / SLOW['strain_acceleration']
    assert references[-1] == pytest.approx(held, abs=1e-4)
    assert set(references[-400:]) == {references[-1]}
    rig.spin(lambda: [law.kind for law in rig.bundle.laws] == ['sine', 'goal', 'hold'])
    assert strain_reference(from_message(rig.bundle.laws[-1]), 99.0) == references[-1]

    assert not rig.send(kind='ramp', amplitude=0.02).accepted
    said = capfd.readouterr().err
    assert 'track_strain: the plant is safe and follows nothing; rejected' in said
    rig.bundle.safe = False
    rig.run(0.1)
    assert set(rig.bundle.references[-400:]) == {references[-1]}
    assert rig.send(kind='ramp', amplitude=0.02).accepted


def test_a_goal_that_nobody_drives_is_given_up_and_its_reference_held(
    rig: Rig, monkeypatch: pytest.MonkeyPatch
) -> None:
    rig.run(0.1)
    handle = rig.send(kind='sine', amplitude=0.05, frequency=0.2, cycles=2, **SLOW)
    rig.run(1.5)
    monkeypatch.setattr(strain_controller_node, 'PATIENCE', 0.1)
    status, result = rig.end_of(handle)
    assert (status, result.message) == (GoalStatus.STATUS_ABORTED, 'bundle_state stayed away')
    rig.run(1.0)
    assert rig.bundle.laws[-1].kind == 'hold'
    assert len(set(rig.bundle.references[-900:])) == 1


def test_what_cannot_be_tracked_is_rejected_and_disturbs_nothing(
    rig: Rig, capfd: pytest.CaptureFixture[str]
) -> None:
    assert not rig.send(kind='sine').accepted
    rig.run(0.1)
    for goal, reason in (
        ({'kind': 'square'}, 'reference.kind = square: must be one of sine'),
        ({'kind': 'topic'}, 'reference.kind = topic: must be another in a goal'),
        ({'amplitude': 0.1}, 'goal: its peak strain 0.2 must be <= 0.1505'),
        ({'amplitude': math.nan}, 'reference.amplitude = nan: must be >= 0 and <= 0.15'),
        ({'kind': 'samples'}, 'reference.times: 1 samples; must be >= 2'),
        (
            {'kind': 'samples', 'times': [0.0, 1.0], 'strains': [0.0, -0.09]},
            'goal: its lowest strain -0.09 must be >= -0.0',
        ),
        (
            {'kind': 'samples', 'times': [0.1 * k for k in range(1001)]},
            'reference.times: 1001 values; must be <= 1000 in a goal',
        ),
        ({'kind': 'random', 'cycles': 501}, 'reference.cycles = 501: must be <= 500'),
        ({'kind': 'sum_of_sines', 'multiples': [1000.0], 'frequency': 9.0}, 'must be 1 or 1'),
        ({'kind': 'steps', 'strain_rate': 1e-3}, 'reference.levels: a step of '),
        ({'strain_acceleration': 1e-300}, 'reference.strain_acceleration = 1e-300 1/s^2: must be'),
        ({'strain_acceleration': 1e-310}, 'must be >= 0.001 and <= 1000'),
        ({'strain_rate': 1e-310}, '1/s: must be >= 0.0001 and <= 10'),
        (
            {'kind': 'samples', 'times': [0.0, 1e-70, 1.0], 'strains': [0.0, 0.01, 0.0]},
            'reference.times[1] = 1e-70 s: must be >= 1e-06 s after 0 s, the one before',
        ),
    ):
        assert not rig.send(**goal).accepted, goal
        said = capfd.readouterr().err
        assert 'track_strain: ' in said
        assert reason in said
    rig.run(0.2)
    law = reference_law(configured().reference)
    expected = [strain_reference(law, time_of(k)) for k in range(300)]
    assert rig.bundle.references == expected
    assert len(rig.bundle.laws) == 1


def test_a_second_goal_waits_for_the_first_and_then_sets_in_where_that_ended(rig: Rig) -> None:
    rig.run(0.05)
    quick = {'frequency': 2.0, 'cycles': 1, **SLOW}
    first = rig.send(kind='ramp', amplitude=0.02, **quick)
    assert not rig.send(kind='ramp', amplitude=0.03, **quick).accepted
    rig.run(1.0)
    assert rig.end_of(first)[0] == GoalStatus.STATUS_SUCCEEDED
    assert rig.bundle.references[-1] == pytest.approx(0.04)
    held = {'kind': 'samples', 'times': [0.0, 0.2], 'strains': [0.05, 0.06], **SLOW}
    second = rig.send(**held)
    rig.run(1.0)
    assert rig.end_of(second)[0] == GoalStatus.STATUS_SUCCEEDED
    assert rig.bundle.references[-1] == pytest.approx(0.06)
    assert_no_jump(rig.bundle.references)


def test_a_new_run_ends_a_goal_and_begins_with_the_configured_reference(rig: Rig) -> None:
    rig.run(0.3)
    handle = rig.send(kind='sine', amplitude=0.05, **SLOW)
    rig.run(0.2)
    rig.bundle.until = 100
    rig.bundle.begin()
    rig.spin(lambda: len(rig.bundle.references) == 100)
    status, result = rig.end_of(handle)
    assert (status, result.message) == (GoalStatus.STATUS_ABORTED, 'a new run began')
    law = reference_law(configured().reference)
    assert rig.bundle.references == [strain_reference(law, time_of(k)) for k in range(100)]
    rig.spin(lambda: [law.kind for law in rig.bundle.laws] == ['sine', 'goal', 'sine'])


def test_a_parameter_without_a_value_is_refused() -> None:
    """To rcl an empty list has no type, and rclpy would declare the parameter as not set."""
    given = ['--params-file', str(default_configuration()), '-p', 'reference.levels:=[]']
    with own_domain():
        rclpy.init(args=['--ros-args', *given])
        try:
            with pytest.raises(ConfigurationError, match=r'^reference\.levels = \[\]: must hold'):
                StrainController()
        finally:
            rclpy.try_shutdown()


# ---- Live values ----


@live()
def test_live_values_are_held_and_approached_at_the_limited_rate(rig: Rig) -> None:
    rig.run(0.1)
    rig.connect_live()
    assert set(rig.bundle.references) == {0.0}, 'no message: hold'
    start = len(rig.bundle.references) - 1
    rig.bundle.live.publish(StrainReference(strain=0.03))
    rig.spin(lambda: len(rig.bundle.laws) == 2)
    rig.run(0.5)
    moved = np.diff(rig.bundle.references)
    assert moved.max() == pytest.approx(0.1 * PERIOD)
    assert rig.bundle.references[start + 150] == pytest.approx(0.015)
    assert set(rig.bundle.references[-150:]) == {0.03}, 'it is held'


@live()
def test_live_values_that_cannot_be_are_not_taken(
    rig: Rig, capfd: pytest.CaptureFixture[str]
) -> None:
    rig.run(0.05)
    rig.connect_live()
    for strain in (math.nan, math.inf, -math.inf, 0.2, -0.1, 1e300):
        rig.bundle.live.publish(StrainReference(strain=strain))
        rig.run(0.05)
    assert set(rig.bundle.references) == {0.0}
    assert len(rig.bundle.laws) == 1
    said = capfd.readouterr().err
    assert 'strain_reference: strain = nan: must be >= -0.0' in said
    assert said.count('not taken') == 1, 'once a second'
    rig.bundle.live.publish(StrainReference(strain=0.001))
    rig.spin(lambda: len(rig.bundle.laws) == 2)


# ---- The latched law ----


@pytest.mark.parametrize('kind', ['sine', 'steps', 'random', 'chirp'])
def test_a_law_survives_its_message_to_the_bit(kind: str) -> None:
    law = reference_law(configured(kind=kind, strain_rate=0.5).reference)
    again = from_message(to_message(law, kind))
    assert again[:3] == law[:3]
    for one, other in zip(again[3:], law[3:], strict=True):
        assert one.tobytes() == other.tobytes()
        assert (one.shape, one.dtype) == (other.shape, other.dtype)


@pytest.mark.parametrize('field', ['sines', 'breaks', 'coefficients'])
def test_a_law_whose_parts_do_not_fit_is_refused(field: str) -> None:
    message = to_message(reference_law(configured().reference), 'sine')
    setattr(message, field, [*getattr(message, field), 1.0])
    with pytest.raises(ValueError, match='cannot reshape'):
        from_message(message)
    with pytest.raises(ValueError, match='no polynomial'):
        from_message(Reference())


def test_every_reference_of_a_run_follows_from_the_latched_laws(rig: Rig) -> None:
    """Each holds for the ticks after its stamp, the first from the start."""
    rig.run(0.2)
    first = rig.send(kind='sine', amplitude=0.03, frequency=1.0, **SLOW)
    rig.run(0.8)
    rig.spin(first.cancel_goal_async().done)
    rig.run(1.0)
    rig.spin(lambda: len(rig.bundle.laws) == 3)
    laws = [(m.header.stamp.nanosec * 1e-9 + m.header.stamp.sec, m) for m in rig.bundle.laws]
    for tick, reference in enumerate(rig.bundle.references):
        time = time_of(tick)
        message = [m for stamp, m in laws if stamp < time or m is laws[0][1]][-1]
        assert strain_reference(from_message(message), time) == reference


@pytest.mark.parametrize('flat', [True, False], ids=['columns', 'objects'])
def test_a_replay_tracks_what_was_tracked(rig: Rig, flat: bool) -> None:
    """The table of a bag may have a column for each element of an array."""
    rig.run(0.3)
    goal = rig.send(kind='sine', amplitude=0.03, frequency=1.0, **SLOW)
    rig.run(0.4)
    rig.spin(goal.cancel_goal_async().done)
    rig.run(0.4)
    rig.spin(lambda: len(rig.bundle.laws) == 3)
    bundle = rig.bundle
    table = pd.DataFrame([as_columns(m) if flat else as_object(m) for m in bundle.laws])
    assert ('coefficients[11]' in table) == flat
    laws, notes = tracked_laws(table, 2, configured())
    assert notes == []
    run = run_of(bundle)._replace(laws=laws)
    steps = steps_of(run.samples, run.samples.tick, set(run.samples.tick), configured())
    found = strain_answers(configured(), run, steps, lambda done: None)
    assert found['strain_reference'].tolist() == bundle.references
    assert found['pressure'].tolist() == bundle.pressures


def run_of(bundle: Bundle) -> Run:
    """Return what a recorder would have of a run, but for its laws."""
    ticks = len(bundle.references)
    stamps = [Stamp(*divmod(tick * 1_000_000, 10**9)) for tick in range(ticks)]
    force, source = [WEIGHT] * ticks, [6.8e5] * ticks
    pressures = np.tile([1e5, 0.0], (ticks, 1))
    samples = Samples(
        list(range(ticks)), [], stamps, [False] * ticks, bundle.strains, force, source, pressures
    )
    return Run(samples, {}, False, [])


def as_object(message: Reference) -> dict[str, Any]:
    names = message.get_fields_and_field_types()
    published = 1 if message.kind == 'sine' else 3
    return {'published': published, **{name: getattr(message, name) for name in names}}


def as_columns(message: Reference) -> dict[str, Any]:
    row = as_object(message)
    stamp = row.pop('header').stamp
    row |= {'header.stamp.sec': stamp.sec, 'header.stamp.nanosec': stamp.nanosec}
    for name in ('sines', 'breaks', 'coefficients'):
        row |= {f'{name}[{k}]': value for k, value in enumerate(row.pop(name))}
    return row


# ---- The supervisor foresees them ----


def column(bundle: Bundle, name: str) -> np.ndarray:
    return np.array([state[RecruitmentOutput._fields.index(name)] for state in bundle.states])


def assert_replay_gives(bundle: Bundle, configuration: Configuration, ticks: int) -> None:
    """Hold the first ``ticks`` of the supervisor's answers against its law on the record."""
    table = pd.DataFrame([as_object(message) for message in bundle.laws])
    laws, notes = tracked_laws(table, 2, configuration)
    assert notes == []
    run = run_of(bundle)._replace(laws=laws)
    steps = steps_of(run.samples, run.samples.tick, set(run.samples.tick), configuration)
    lags = cached_lag_table(configuration)
    found = supervisor_answers(configuration, lags, run, steps, lambda done: None)
    for name, values in found.items():
        assert values[:ticks].tobytes() == column(bundle, name)[:ticks].tobytes(), name


# Held for half a second, then up beyond what one unit holds.
RISE = {'kind': 'samples', 'times': [0.0, 0.5, 1.2], 'strains': [0.02, 0.02, 0.13], **SLOW}


def test_a_goal_is_foreseen_from_a_fixed_time_after_its_news_on(tmp_path: Path) -> None:
    configuration = configured(amplitude=0.0)
    with rig_of(configuration, 'events', tmp_path, supervised=True) as rig:
        rig.run(0.3)
        assert rig.send(**RISE).accepted
        rig.run(1.6)
        bundle = rig.bundle
    goal, stamp = from_message(bundle.laws[-1]), bundle.laws[-1].header.stamp.nanosec
    told = stamp // 1_000_000 + NOTICE // 1_000_000 + 1
    left = column(bundle, 'time_to_saturation')
    assert np.isinf(left[:told]).all(), 'nothing was to happen'
    assert np.isfinite(left[told]), 'though what one unit can hold is a second away'
    # The course alone tells when the strain will be at what one unit can hold.
    shift = int(np.argmax(column(bundle, 'recruited') == 2))
    margin = column(bundle, 'source_pressure_drop') + column(bundle, 'pressure_compensation')
    attainable, unforeseen = 6.8e5 - margin, bundle.references[told]
    assert 0.0 < unforeseen < 0.003, 'it had begun to move when it was foreseen'
    for tick in range(told, shift, 50):
        limit = modelled_strain(motor_units(configuration), 1, attainable[tick], WEIGHT)
        then = strain_reference(goal, time_of(tick) + left[tick])
        assert then == pytest.approx(limit, abs=unforeseen)
    assert shift > told + 100
    assert left[shift] <= column(bundle, 'recruitment_lag')[shift] + PERIOD
    # What was expected before the news is due a horizon later.
    horizon = round(configuration.recruitment.prediction_horizon / PERIOD)
    error = np.abs(column(bundle, 'prediction_error'))
    assert error[told : told + horizon].max() > 0.01
    assert error[told + horizon :].max() < unforeseen
    assert_replay_gives(bundle, configuration, len(bundle.states))


def test_the_constant_rate_does_not_foresee_a_goal(tmp_path: Path) -> None:
    configuration = configured('constant_rate', amplitude=0.0)
    with rig_of(configuration, 'events', tmp_path, supervised=True) as rig:
        rig.run(0.3)
        rig.send(**RISE)
        rig.run(1.6)
        assert np.abs(column(rig.bundle, 'prediction_error')).max() > 0.02
        assert_replay_gives(rig.bundle, configuration, len(rig.bundle.states))


def test_live_values_are_expected_to_go_on_and_a_goal_after_them_is_foreseen(
    tmp_path: Path,
) -> None:
    live = {'kind': 'topic', 'strain_rate': 0.1}
    configuration = configured(**live)
    with rig_of(configuration, 'events', tmp_path, supervised=True) as rig:
        rig.run(0.1)
        rig.connect_live()
        rig.bundle.live.publish(StrainReference(strain=0.03))
        rig.spin(lambda: len(rig.bundle.laws) == 2)
        rig.run(0.5)
        before = len(rig.bundle.states)
        assert rig.send(**RISE).accepted
        rig.run(0.2)
        assert_replay_gives(rig.bundle, configured('constant_rate', **live), before)
        assert np.isinf(column(rig.bundle, 'time_to_saturation')[before])
        assert np.isfinite(column(rig.bundle, 'time_to_saturation')[-1])
        assert_replay_gives(rig.bundle, configuration, len(rig.bundle.states))


def test_news_that_come_after_their_tick_end_a_run_in_lockstep(
    tmp_path: Path, capfd: pytest.CaptureFixture[str]
) -> None:
    with rig_of(configured(), 'events', tmp_path, supervised=True) as rig:
        rig.run(0.3)
        late = to_message(reference_law(configured(kind='ramp').reference), 'goal')
        late.header.stamp.nanosec = 100_000_000
        rig.bundle.news.publish(late)
        rig.spin(rig.nodes[1].done.done)
        assert rig.nodes[1].done.result() == 1
    assert 'reference: came 149 ms too late to be foreseen in time' in capfd.readouterr().err
