# SPDX-License-Identifier: Apache-2.0
"""A replay of a damaged or foreign bag: an error in one line, or a result; never a traceback."""

from collections.abc import Callable, Iterator
import functools
import json
from pathlib import Path
import random
from typing import Any
import warnings

import damage
from fam_bundle_bringup import replay_controllers
from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.replay import run_replay
from fam_bundle_io.bag import read_bag, trace_of
from fam_bundle_io.bag_writer import BagError, BagFolder, Item, Topic
from fam_bundle_model import bundle
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_sim import plant
import numpy as np
import pytest
from rosbags.typesys import get_types_from_msg, get_typestore, Stores

CONFIG = default_configuration()
STATE, COMMAND, RECRUITMENT = '/bundle_state', '/valve_command', '/recruitment_state'


@pytest.fixture(scope='module', autouse=True)
def same_units() -> Iterator[None]:
    """Build the FAMs' tables once, for the parameters are always the same."""
    with pytest.MonkeyPatch.context() as patch:
        once = functools.cache(bundle.motor_units)
        for module in (replay_controllers, plant):
            patch.setattr(module, 'motor_units', once)
        yield


@pytest.fixture(autouse=True)
def loud() -> Iterator[None]:
    """Make warnings errors: one would print source line and path."""
    with warnings.catch_warnings():
        warnings.simplefilter('error')
        yield


@pytest.fixture(scope='module')
def whole(tmp_path_factory: pytest.TempPathFactory) -> Callable[[str], Path]:
    return damage.whole_bags(tmp_path_factory.mktemp('whole'))


# A third of them: a replay takes longer than reading, which is tried with all.
@pytest.mark.parametrize('name', list(damage.CASES)[::3])
def test_every_damaged_bag(
    name: str,
    whole: Callable[[str], Path],
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
) -> None:
    case = damage.CASES[name]
    path = case.make(whole(case.of), tmp_path / 'bag', random.Random(name))
    try:
        same = run_replay(path, CONFIG, None)
    except (BagError, ConfigurationError) as error:
        assert '\n' not in f'{error}'
        return
    assert not same, 'these answers are made of sines'
    assert 'samples, ' in capsys.readouterr().out


def bag_of(
    folder: Path,
    change: Callable[[str, Any], None] = lambda topic, message: None,
    topics: dict[str, Topic] | None = None,
    records: dict[str, str] | None = None,
    ticks: int = 50,
) -> Path:
    """Write a short bag whose messages were changed, or whose topics are others."""
    bag = BagFolder(folder)
    for topic in (topics or damage.TOPICS).values():
        bag.add_topic(topic)
    for item in damage.loop(range(ticks)):
        kind = damage.TYPES[item.topic]
        message = damage.STORE.deserialize_cdr(item.data, kind)
        change(item.topic, message)
        bag.write(item._replace(data=bytes(damage.STORE.serialize_cdr(message, kind))))
    bag.close({'fam_bundle.completeness': records} if records else {})
    return folder


@pytest.mark.parametrize('text', ['Z]', '7', '"words"', '{"a": 1}', 'null', ''])
def test_a_damaged_note_of_the_recorder_is_a_note(
    text: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_replay(bag_of(tmp_path / 'bag', records={'missing': text}), CONFIG, None)
    assert 'recorder: what it noted as missing cannot be read\n' in capsys.readouterr().out


def test_a_note_of_the_recorder_is_passed_on(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run_replay(bag_of(tmp_path / 'bag', records={'missing': '["words", 3]'}), CONFIG, None)
    assert 'recorder: words\nrecorder: 3\n' in capsys.readouterr().out


@pytest.mark.parametrize(
    ('topic', 'old', 'new', 'words'),
    [
        (STATE, 'Header header', 'Header other', 'has no header.stamp.sec'),
        (COMMAND, 'Header header', 'Header other', 'has no header.stamp.sec'),
        (COMMAND, 'bool vent', 'bool went', 'has no vent'),
        (COMMAND, 'float64[] spool', 'float64[] spools', r'has no spool\[0\]'),
    ],
)
def test_what_a_foreign_bag_lacks_is_named(
    topic: str, old: str, new: str, words: str, tmp_path: Path
) -> None:
    known = damage.TOPICS[topic]
    assert old in known.definition
    other = known._replace(definition=known.definition.replace(old, new))
    bag = bag_of(tmp_path / 'bag', topics=damage.TOPICS | {topic: other})
    with pytest.raises(BagError, match=f'^{topic}: {words}$'):
        run_replay(bag, CONFIG, None)


def test_a_bag_from_before_a_field_came_is_read_and_replayed(tmp_path: Path) -> None:
    known = damage.TOPICS[RECRUITMENT]
    before, _, after = known.definition.partition('# Error of the predictor')
    rest = after.partition('float64 prediction_error\n')[2]
    assert rest
    topic = known._replace(definition=before + rest)
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(topic.definition, topic.type))
    bag = BagFolder(tmp_path / 'bag')
    for one in (damage.TOPICS | {RECRUITMENT: topic}).values():
        bag.add_topic(one)
    for item in damage.loop(range(50)):
        data = item.data
        if item.topic == RECRUITMENT:
            message = damage.STORE.deserialize_cdr(data, topic.type)
            data = bytes(store.serialize_cdr(message, topic.type))
        bag.write(item._replace(data=data))
    bag.close({})
    run = trace_of(read_bag(tmp_path / 'bag'))
    assert run.missing == {'prediction_error'}
    assert 'recruitment_state: has no prediction_error' in run.warnings
    assert np.isnan(run.trace['prediction_error']).all()
    assert np.isfinite(run.trace['deslack_pressure']).all()
    run_replay(tmp_path / 'bag', CONFIG, tmp_path / 'replay')
    replayed = json.loads((tmp_path / 'replay' / 'replay.json').read_text())
    signals = {one['signal'] for one in replayed['controllers']}
    assert 'strain_rate' in signals
    assert 'prediction_error' not in signals


def test_text_for_a_number_is_refused(tmp_path: Path) -> None:
    known = damage.TOPICS[STATE]
    text = known.definition.replace('float64 strain\n', 'string strain\n')
    store = get_typestore(Stores.EMPTY)
    store.register(get_types_from_msg(text, known.type))
    make = store.types
    bag = BagFolder(tmp_path / 'bag')
    bag.add_topic(known._replace(definition=text))
    for tick in range(3):
        stamp = make['builtin_interfaces/msg/Time'](sec=0, nanosec=tick)
        values = {name: 0 for name, _ in store.fielddefs[known.type][1]} | {
            'header': make['std_msgs/msg/Header'](stamp=stamp, frame_id=''),
            'tick': tick,
            'safe': False,
            'strain': 'much',
            'mu_pressure': np.zeros(2),
        }
        data = bytes(store.serialize_cdr(make[known.type](**values), known.type))
        bag.write(Item(STATE, tick, tick, tick + 1, data))
    bag.close({})
    with pytest.raises(BagError, match=r'^/bundle_state: strain is no number$'):
        run_replay(tmp_path / 'bag', CONFIG, None)


def put(topic: str, field: str, value: Any, first: int = 20) -> Callable[[str, Any], None]:
    """Return a change of a field from a tick on."""

    def change(name: str, message: Any) -> None:
        if name == topic and message.tick >= first:
            object.__setattr__(message, field, value)

    return change


@pytest.mark.parametrize('value', [1e300, -np.inf, np.nan])
@pytest.mark.parametrize('field', ['mu_pressure', 'strain', 'force', 'source_pressure'])
def test_impossible_measurements_end_in_no_warning_of_numpy(
    field: str, value: float, tmp_path: Path
) -> None:
    values = np.full(2, value) if field == 'mu_pressure' else value
    bag = bag_of(tmp_path / 'bag', put(STATE, field, values))
    assert not run_replay(bag, CONFIG, tmp_path / 'out')
    json.loads((tmp_path / 'out' / 'replay.json').read_text(), parse_constant=pytest.fail)


def test_stamps_that_stand_still_are_named(tmp_path: Path) -> None:
    def stop(topic: str, message: Any) -> None:
        object.__setattr__(message.header.stamp, 'nanosec', 0)

    with pytest.raises(BagError, match=r'^stamps of bundle_state: stamp \d+ ns does not follow'):
        run_replay(bag_of(tmp_path / 'bag', stop), CONFIG, None)


def test_commands_for_other_valves_than_there_are_units_are_refused(tmp_path: Path) -> None:
    bag = bag_of(tmp_path / 'bag', put(COMMAND, 'spool', np.zeros(1), first=0))
    with pytest.raises(BagError, match=r'^/valve_command: 1 spools of 2 motor units$'):
        run_replay(bag, CONFIG, None)


def test_a_tick_beyond_all_numbers_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def change(item: Item) -> Item:
        return damage.with_tick(item, 2**64 - 1) if item.sequence == 30 else item

    items = [change(item) for item in damage.loop(range(50))]
    assert not run_replay(damage.write_bag(tmp_path / 'bag', items), CONFIG, None)
    out = capsys.readouterr().out
    assert '49 samples, ' in out
    assert 'bundle_state: 1 messages of no possible tick\n' in out
