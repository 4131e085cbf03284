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
``./fam replay``: a bag through the laws and through the simulated plant.

Recorded samples into the controllers: do they still command what was recorded, to the last bit?
And recorded commands into the plant: how good is the model?
"""

from collections.abc import Iterator, Mapping
import dataclasses
import json
import math
from pathlib import Path
from types import SimpleNamespace
from typing import Any, NamedTuple, TYPE_CHECKING

from fam_bundle_bringup.experiment import prepare_folder, versions
from fam_bundle_bringup.json_file import write_json
from fam_bundle_bringup.progress import progress_bar
from fam_bundle_bringup.replay_changes import changes_of
from fam_bundle_bringup.replay_changes import TOPIC as CHANGES
from fam_bundle_bringup.replay_controllers import (
    ANSWERS,
    COMMAND,
    compare_tables,
    Comparison,
    REFERENCE,
    replay_controllers,
    Run,
    samples_of,
    Stamp,
    STATE,
)
from fam_bundle_bringup.replay_plant import (
    Deviation,
    deviations,
    measured,
    replay_plant,
    RESTART_PERIOD,
    SIGNAL_UNITS,
    Simulated,
)
from fam_bundle_control.announced import Announcement, BEGINNING
from fam_bundle_control.trajectory import FROM_OUTSIDE, LIVE
from fam_bundle_io.bag import (
    Bag,
    LOOP,
    loop_topics,
    read_bag,
    recorded_configuration,
    run_tables,
    runs_of,
)
from fam_bundle_io.bag_writer import BagError
from fam_bundle_model.lag_table import cached_lag_table, lag_table_hash, LagTable
from fam_bundle_model.parameters import Configuration, load_configuration
from fam_bundle_model.reference import reference_law
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.stamps import nanoseconds
import numpy as np

if TYPE_CHECKING:
    import pandas as pd

FILES = ('replay.json', 'replay.png', 'replay.pdf')
SAMPLES, LAG_TABLE, LAW = 'bundle_state', 'lag_table', 'reference'
STAMP = ('header.stamp.sec', 'header.stamp.nanosec')
# Fields without which nothing can be replayed; what else is recorded is only compared.
NEEDED = {
    SAMPLES: (*STAMP, 'safe', 'strain', 'force', 'source_pressure', 'mu_pressure[0]'),
    REFERENCE: ('pressure',),
    STATE: ('recruited', 'pressure_compensation'),
    COMMAND: (*STAMP, 'vent', 'spool[0]'),
}


class Chosen(NamedTuple):
    """The parameters that a bag is replayed with, and where they come from, in words."""

    configuration: Configuration
    source: str


class Replay(NamedTuple):
    """What a replay has found; ``notes`` in words, the plant's part None where it has none."""

    chosen: Chosen
    run: Run
    comparisons: list[Comparison]
    simulated: Simulated | None
    notes: list[str]


def run_replay(bag: Path, config: Path | None, out: Path | None, namespace: str = '') -> bool:
    """
    Replay the last run of a bundle in ``bag``; return whether its controllers do the same.

    To the last bit, wherever the record determines it. The parameters are those in the bag unless
    ``config`` is given; ``namespace`` is that of the bundle, '' the root. Results go to the folder
    ``out`` if there is one. Raises BagError for a bag without a run, ConfigurationError for bad
    parameters or none, or an ``out`` that cannot be written.
    """
    space = f'/{namespace.strip("/")}'.rstrip('/')
    found = read_bag(
        bag, lambda name: name.rpartition('/')[2] in (SAMPLES, LAG_TABLE, LAW, CHANGES, *ANSWERS)
    )
    chosen = choose(found, bag, config)
    tables, notes = tables_of(found, space)
    check_units(chosen, tables[SAMPLES])
    if out is not None:
        prepare_folder(out, FILES)
    replay = replay_of(found, chosen, tables, space)
    replay.notes[:0] = notes
    print_replay(replay)
    if out is not None:
        write_replay(replay, bag, space, out)
        print(f'written to {out}')
    return is_equal(replay.comparisons)


# ---- What is replayed ----


def choose(bag: Bag, path: Path, config: Path | None) -> Chosen:
    """
    Return the parameters to replay with; the pace is always the recorded one, if there is one.

    Raises ConfigurationError when there are none.
    """
    try:
        recorded = recorded_configuration(bag)
    except ConfigurationError as error:
        if config is None:
            raise ConfigurationError(f'{path}: {error}: give --config FILE') from None
        recorded = None
    if config is None:
        if recorded is None:
            raise ConfigurationError(f'{path}: holds no parameters: give --config FILE')
        return Chosen(recorded, 'those in the bag')
    given = load_configuration(config)
    if recorded is None:
        return Chosen(given, f'{config}')
    run = dataclasses.replace(given.run, pace=recorded.run.pace)
    return Chosen(dataclasses.replace(given, run=run), f'{config}, not those in the bag')


def tables_of(bag: Bag, space: str) -> 'tuple[dict[str, pd.DataFrame], list[str]]':
    """
    Return what the last run of a bundle has on each topic, by tick, and what it lacks.

    Raises BagError where it has no samples.
    """
    others = sorted(name.lstrip('/') or '(root)' for name in loop_topics(bag))
    if f'{space}/{SAMPLES}' not in bag.types:
        hint = f'; its bundles are {", ".join(others)}' if others else ''
        raise BagError(f'{space}/{SAMPLES}: not in the bag{hint}')
    notes = [*bag.warnings, *said_by_recorder(bag)]
    tables, warnings = run_tables(bag, space)
    runs = int(runs_of(bag.tables[f'{space}/{SAMPLES}'])[-1]) + 1
    if runs > 1:
        notes.append(f'{runs} runs in the bag: the last is replayed')
    found = {LOOP[name]: table for name, table in tables.items()}
    for topic, table in found.items():
        for name in NEEDED[topic]:
            if name not in table:
                raise BagError(f'{space}/{topic}: has no {name}')
            if table[name].dtype.kind not in 'biuf':
                raise BagError(f'{space}/{topic}: {name} is no number')
        possible = table.index <= np.iinfo(np.int64).max
        if not possible.all():
            notes.append(f'{topic}: {int((~possible).sum())} messages of no possible tick')
            found[topic] = table[possible]
    units, spools = (
        sum(name.startswith(f'{field}[') for name in found.get(topic, ()))
        for topic, field in ((SAMPLES, 'mu_pressure'), (COMMAND, 'spool'))
    )
    if COMMAND in found and spools != units:
        raise BagError(f'{space}/{COMMAND}: {spools} spools of {units} motor units')
    found[SAMPLES] = found[SAMPLES].sort_index()
    return found, notes + warnings


def said_by_recorder(bag: Bag) -> list[str]:
    """Return what the recorder noted as missing."""
    text = bag.records.get('fam_bundle.completeness', {}).get('missing', '[]')
    try:
        missing = json.loads(text)
    except ValueError:
        missing = None
    if not isinstance(missing, list):
        return ['recorder: what it noted as missing cannot be read']
    return [f'recorder: {line}' for line in missing]


def check_units(chosen: Chosen, table: 'pd.DataFrame') -> None:
    """Raise ConfigurationError where bag and parameters are of different bundles."""
    recorded = sum(name.startswith('mu_pressure[') for name in table)
    units = len(chosen.configuration.fam.count)
    if recorded != units:
        raise ConfigurationError(
            f'fam.count ({chosen.source}): {units} motor units; the bag holds {recorded}'
        )


def replay_of(
    bag: Bag, chosen: Chosen, tables: 'Mapping[str, pd.DataFrame]', space: str
) -> Replay:
    """Return what controllers and plant do with the recorded run."""
    configuration, table = chosen.configuration, tables[SAMPLES]
    answers = {topic: tables[topic] for topic in ANSWERS if topic in tables}
    begun = int(table['published'].iloc[0])
    laws, notes = tracked_laws(bag.tables.get(f'{space}/{LAW}'), begun, configuration)
    changed = bag.tables.get(f'{space}/{CHANGES}')
    changes, more = changes_of(changed, begun, configuration)
    notes += more
    if f'{space}/{CHANGES}' not in bag.types:
        notes.append(f'{CHANGES}: not in the bag; parameters set while it ran would not be known')
    realtime = configuration.run.pace == 'realtime'
    lossy = frozenset(topic for topic in answers if realtime and not is_whole(bag, space, topic))
    run = Run(samples_of(table), answers, realtime, laws, changes, lossy)
    if lossy:
        notes.append(
            f'{", ".join(sorted(lossy))}: the recorder does not vouch that none was lost; where '
            'an answer is missing, nothing is judged until the controller starts again'
        )
    for topic, found in answers.items():
        lacking = len(table.index.difference(found.index))
        if lacking and not run.realtime:
            notes.append(f'{topic}: the answers to {lacking} samples are not in the bag')
    if COMMAND in answers and len(answers) < len(ANSWERS):
        notes.append(f'{COMMAND}: not compared without {REFERENCE} and {STATE}')
    lags, comparisons, said = choose_lag_table(bag, configuration, space)
    notes += said
    with progress_bar('controllers', len(answers) * len(table)) as progress:
        comparisons += replay_controllers(configuration, run, lags, progress)
    notes += undetermined(comparisons)
    simulated = None
    try:
        with progress_bar('plant', 2 * len(table)) as progress:
            simulated = replay_plant(configuration, run, progress)
            notes += simulated.notes
    except BagError as error:
        notes.append(str(error))
    return Replay(chosen, run, comparisons, simulated, notes)


def is_whole(bag: Bag, space: str, topic: str) -> bool:
    """Return whether the recorder knows of a topic that no message was lost: ours counts them."""
    record = bag.records.get('fam_bundle.completeness', {})
    try:
        lost = json.loads(record.get(f'{space}/{topic}', '{}')).get('lost')
    except (ValueError, AttributeError):
        return False
    return lost == 0 and record.get('dropped') == '0'


def tracked_laws(
    table: 'pd.DataFrame | None', begun: int, configuration: Configuration
) -> tuple[list[Announcement], list[str]]:
    """
    Return the trajectories of a run, that of its beginning first, and notes.

    The configured one is made of the parameters; live values, goals and the way back from them
    are taken from ``table``, the messages of the topic ``reference``. ``begun`` is when the run's
    first sample was published.
    """
    from fam_bundle_node.reference_message import from_message

    reference = configuration.reference
    configured = Announcement(BEGINNING, reference_law(reference), reference.kind == LIVE)
    if table is None or not {'kind', 'published', 'start'} <= set(table):
        return [configured], []
    laws = [configured]
    first = max(int((table['published'] < begun).sum()) - 1, 0)
    try:
        for message in messages_in(table.iloc[first:]):
            since = nanoseconds(message.header.stamp) or BEGINNING
            law = from_message(message) if message.kind in FROM_OUTSIDE else configured.law
            laws.append(Announcement(since, law, message.kind == LIVE))
    except (ValueError, TypeError, AttributeError, KeyError, OverflowError) as error:
        return [configured], [f'{LAW}: damaged ({error}); only the configured one is tracked']
    return laws, []


def messages_in(table: 'pd.DataFrame') -> Iterator[Any]:
    """
    Give the messages in a table, whether or not their arrays are columns of their own.

    A column for an element that a message does not have holds NaN there.
    """
    for row in table.to_dict('records'):
        message: dict[str, Any] = {}
        arrays: dict[str, dict[int, float]] = {'sines': {}, 'breaks': {}, 'coefficients': {}}
        for name, value in row.items():
            field, _, index = str(name).rstrip(']').partition('[')
            if not index:
                message[field] = value
            elif not math.isnan(value):
                arrays[field][int(index)] = value
        for field, elements in arrays.items():
            message.setdefault(field, [elements[k] for k in sorted(elements)])
        if 'header' not in message:
            stamp = Stamp(message['header.stamp.sec'], message['header.stamp.nanosec'])
            message['header'] = SimpleNamespace(stamp=stamp)
        yield SimpleNamespace(**message)


def choose_lag_table(
    bag: Bag, configuration: Configuration, space: str
) -> tuple[LagTable, list[Comparison], list[str]]:
    """
    Return the lag table for the supervisor, how it compares, and what there is to say of it.

    The recorded one, if it is of these parameters; and it is compared with the one that the lag
    table server would build of them.
    """
    from fam_bundle_node.lag_table_message import from_message

    built = cached_lag_table(configuration)
    messages = bag.tables.get(f'{space}/{LAG_TABLE}')
    if messages is None or 'units' not in messages:
        return built, [], ['lag_table: not in the bag; it is built anew']
    expected = lag_table_hash(configuration)
    fitting = [m for m in messages.itertuples() if m.parameters_hash == expected]
    if not fitting:
        return built, [], ['lag_table: recorded with other parameters; it is built anew']
    try:
        recorded = [from_message(message) for message in fitting]
    except ValueError as error:
        return built, [], [f'lag_table: damaged ({error}); it is built anew']
    notes = []
    if any(not _same(recorded[0], other) for other in recorded[1:]):
        notes.append('lag_table: rebuilt during the recording; the supervisor gets the first one')
    if recorded[0].lag.shape != built.lag.shape:
        return recorded[0], [], [*notes, 'lag_table: recorded on another grid, not compared']
    return recorded[0], compare_tables(built, recorded[0]), notes


def _same(one: LagTable, other: LagTable) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(one, other, strict=True))


def undetermined(comparisons: list[Comparison]) -> list[str]:
    """Return in words how many ticks the record does not determine, by topic."""
    counts = {c.topic: c.unknown for c in comparisons if c.unknown}
    notes = []
    for topic, count in counts.items():
        equal = min(c.unknown_equal for c in comparisons if c.topic == topic)
        notes.append(
            f'{topic}: at {count} ticks the law rests on samples that are not in the bag; '
            f'{equal} of them are equal all the same, none is judged'
        )
    return notes


def is_equal(comparisons: list[Comparison]) -> bool:
    """Return whether every signal has been compared and is equal to the last bit."""
    judged = [c for c in comparisons if c.topic in ANSWERS]
    whole = all(c.compared > 0 and c.equal == c.compared for c in comparisons)
    return bool(judged) and whole


def first_difference(comparisons: list[Comparison]) -> Comparison | None:
    """Return the signal that differs first, None where none does."""
    different = [c for c in comparisons if c.equal < c.compared]
    return min(different, key=lambda c: -1 if c.tick is None else c.tick, default=None)


# ---- What is said of it ----


def verdict(comparisons: list[Comparison]) -> str:
    """Return the outcome in one line."""
    first = first_difference(comparisons)
    if first is not None:
        where = 'in the table' if first.tick is None else f'at tick {first.tick}'
        unit = f' {first.unit}' if first.unit else ''
        return (
            f'not equal: {first.topic} {first.signal} differs first {where}: '
            f'{first.replayed!r}{unit}, recorded {first.recorded!r}{unit}'
        )
    if is_equal(comparisons):
        judged = ', at all ticks that can be judged' if any(c.unknown for c in comparisons) else ''
        return f'every controller commands what was recorded, to the last bit{judged}'
    empty = [c.topic for c in comparisons if not c.compared]
    what = ', '.join(dict.fromkeys(empty)) or 'the controllers'
    return f'nothing of {what} could be judged'


def print_replay(replay: Replay) -> None:
    """Print both tables, what there is to say, and the verdict."""
    from rich.console import Console

    console = Console()
    console.print(controllers_table(replay.comparisons))
    if replay.simulated is not None:
        console.print(plant_table(replay))
    pace = replay.chosen.configuration.run.pace
    print(f'{len(replay.run.samples.tick)} samples, {pace}; parameters: {replay.chosen.source}')
    for note in replay.notes:
        print(note)
    print(verdict(replay.comparisons))


def controllers_table(comparisons: list[Comparison]) -> Any:
    """Return the table of what the controllers command against what was recorded."""
    from rich.table import Table

    table = Table(title='Controllers on recorded samples, against what they answered')
    table.add_column('signal', no_wrap=True)
    for heading in ('compared', 'equal', 'largest off', 'first tick'):
        table.add_column(heading, justify='right')
    topics = dict.fromkeys(c.topic for c in comparisons)
    for topic in topics:
        table.add_section()
        table.add_row(topic, style='bold')
        for c in comparisons:
            if c.topic == topic:
                tick = '' if c.tick is None else f'{c.tick}'
                largest = f'{c.largest:.3g} {c.unit}'.strip()
                table.add_row(f'  {c.signal}', f'{c.compared}', f'{c.equal}', largest, tick)
    return table


def plant_table(replay: Replay) -> Any:
    """Return the table of how far the simulated plant is from what was measured."""
    from rich.table import Table

    table = Table(
        title='Plant on recorded commands: simulated minus measured, from the start of the run '
        f'and set to what was measured each {RESTART_PERIOD:g} s'
    )
    table.add_column('signal', no_wrap=True)
    table.add_column('unit')
    for heading in ('RMS', 'largest', 'RMS, set anew', 'largest'):
        table.add_column(heading, justify='right')
    for signal, (once, anew) in plant_deviations(replay).items():
        values = (f'{value:.3g}' for value in (*once, *anew))
        table.add_row(signal, unit_of(signal), *values)
    return table


def unit_of(signal: str) -> str:
    """Return the unit of a measured signal."""
    return SIGNAL_UNITS[signal.partition('[')[0]]


def plant_deviations(replay: Replay) -> dict[str, tuple[Deviation, Deviation]]:
    """Return by signal how far the plant is off, from the start and set anew each second."""
    if replay.simulated is None:
        return {}
    seen = measured(replay.run.samples)
    once = deviations(seen, replay.simulated.open_loop)
    anew = deviations(seen, replay.simulated.restarted)
    return {signal: (once[signal], anew[signal]) for signal in seen}


def write_replay(replay: Replay, bag: Path, space: str, out: Path) -> None:
    """Write ``replay.json`` and, where the plant has been compared, the figure, to ``out``."""
    write_json(as_json(replay, bag, space), out / 'replay.json')
    if replay.simulated is not None:
        from fam_bundle_bringup.replay_figure import replay_figure
        from fam_bundle_io.figures_style import save_figures

        save_figures({'replay': replay_figure(replay.run, replay.simulated)}, out)


def as_json(replay: Replay, bag: Path, space: str) -> dict[str, Any]:
    """Return all numbers of a replay; None where one is not finite."""
    configuration = replay.chosen.configuration
    plant = {
        signal: {
            'unit': unit_of(signal),
            'from_the_start': _finite(once._asdict()),
            'set_anew': _finite(anew._asdict()),
        }
        for signal, (once, anew) in plant_deviations(replay).items()
    }
    return {
        'bag': f'{bag}',
        'namespace': space or '/',
        'pace': configuration.run.pace,
        'samples': len(replay.run.samples.tick),
        'parameters': replay.chosen.source,
        'parameters_hash': configuration.hash(),
        'equal': is_equal(replay.comparisons),
        'verdict': verdict(replay.comparisons),
        'notes': replay.notes,
        'controllers': [_finite(dataclasses.asdict(c)) for c in replay.comparisons],
        'plant': plant,
        'set_anew_every': RESTART_PERIOD,
        'versions': versions(),
    }


def _finite(values: Mapping[str, Any]) -> dict[str, Any]:
    return {
        name: None if isinstance(value, float) and not math.isfinite(value) else value
        for name, value in values.items()
    }
