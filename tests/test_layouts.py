# SPDX-License-Identifier: Apache-2.0
"""The layouts for PlotJuggler and Foxglove show signals that exist, and all of the paper's."""

from collections.abc import Iterator
from functools import cache
from itertools import product
import json
from pathlib import Path
import re
from typing import Any, NamedTuple
import xml.etree.ElementTree as ElementTree

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_io.bag import Bag, COLUMNS, LOOP, read_bag
from fam_bundle_io.message_definitions import complete_definition
from fam_bundle_model.parameters import load_configuration
import numpy as np
import pytest

LAYOUTS = Path(__file__).resolve().parents[1] / 'ros2_ws/src/fam_bundle_bringup/layouts'
PLOTJUGGLER, FOXGLOVE = LAYOUTS / 'plotjuggler.xml', LAYOUTS / 'foxglove.json'
TYPES = {f'/{topic}': name for name, topic in LOOP.items()} | {
    '/loop_statistics': 'fam_bundle_msgs/msg/LoopStatistics',
    '/diagnostics': 'diagnostic_msgs/msg/DiagnosticArray',
}
PAPER = (  # what the figures of runs show, Figures 11 to 14
    'strain_reference',
    'strain',
    'time_to_saturation',
    'time_to_desaturation',
    'recruitment_lag',
    'recruitment_state',
    'source_pressure',
    'mu_pressure',
    'spool',
)
UNITS = 2  # motor units of the paper
BASE, NAME, ARRAY, SEQUENCE = 1, 2, 3, 4  # kinds of fields in rosbags' type system


class Signal(NamedTuple):
    """What a layout shows: a field of a topic, or a value that a node reports there."""

    topic: str
    field: str
    node: str = ''


# ---- What the layouts hold ----


def plotjuggler_signals() -> list[Signal]:
    return [signal_of(curve.attrib['name']) for curve in tree().iter('curve')]


def tree() -> ElementTree.Element:
    return ElementTree.parse(PLOTJUGGLER).getroot()


def signal_of(curve: str) -> Signal:
    """PlotJuggler joins topic and field by '/', a diagnostic's by its hardware id and name."""
    if curve.startswith('/diagnostics/'):
        found = re.fullmatch(r'/diagnostics/(?P<id>.+)/(?P<node>\w+): loop/(?P<key>\w+)', curve)
        assert found is not None, curve
        assert found['id'] == '/', 'the namespace of the nodes'
        return Signal('/diagnostics', found['key'], found['node'])
    _, topic, field = curve.split('/', 2)
    return Signal(f'/{topic}', field.replace('/', '.'))


def foxglove() -> Any:
    return json.loads(FOXGLOVE.read_text())


def foxglove_signals() -> list[Signal]:
    return [
        message_path(path['value'])
        for panel in foxglove()['configById'].values()
        for path in panel.get('paths', ())
    ]


def message_path(path: str) -> Signal:
    """Foxglove: topic, a filter on the node where there is one, and the field."""
    found = re.fullmatch(
        r'(?P<topic>/\w+)(\{node=="/(?P<node>\w+)"\})?\.(?P<field>[\w.]+(\[\d+\])?)', path
    )
    assert found is not None, path
    return Signal(found['topic'], found['field'], found['node'] or '')


SIGNALS = {'plotjuggler': plotjuggler_signals, 'foxglove': foxglove_signals}
each_layout = pytest.mark.parametrize('layout', SIGNALS)


# ---- What there is to be shown ----


@cache
def fields_of(name: str) -> dict[str, dict[str, Any]]:
    """Fields of a message type and of those within it, by type."""
    from rosbags.typesys import get_types_from_msg

    types = get_types_from_msg(complete_definition(name), name)
    return {name: dict(fields) for name, (_, fields) in types.items()}


def is_number(signal: Signal) -> bool:
    """Whether the field of a message definition is a number, or one of an array of numbers."""
    name, kind = TYPES[signal.topic], None
    for part in signal.field.split('.'):
        field, _, index = part.rstrip(']').partition('[')
        assert name in fields_of(TYPES[signal.topic]), signal
        assert field in fields_of(TYPES[signal.topic])[name], signal
        kind = fields_of(TYPES[signal.topic])[name][field]
        assert (kind[0] in (ARRAY, SEQUENCE)) == bool(index), signal
        if index:
            assert int(index) < UNITS, signal
            kind = kind[1][0]
        name = kind[1] if kind[0] == NAME else ''
    return kind is not None and kind[0] == BASE and kind[1][0] not in ('string', 'wstring')


@pytest.fixture(scope='module')
def bag(recorded_runs: Path) -> Bag:
    """Return what a run through the graph recorded."""
    return read_bag(recorded_runs / 'lag_pressure' / 'bag')


def nodes_in(bag: Bag) -> set[str]:
    """Names of the nodes that handle ticks."""
    reports = bag.tables['/loop_statistics']
    return {str(name).lstrip('/') for name in reports['node'][reports['ticks'] > 0]}


def diagnostics_in(bag: Bag) -> set[tuple[str, str, str]]:
    """Hardware id, name and key of every diagnostic value."""
    return {
        (status.hardware_id, status.name, value.key)
        for statuses in bag.tables['/diagnostics']['status']
        for status in statuses
        for value in status.values
    }


@each_layout
def test_every_signal_is_a_number_in_a_message(layout: str) -> None:
    shown = SIGNALS[layout]()
    assert len(shown) > len(PAPER)
    for signal in shown:
        if signal.topic == '/diagnostics':  # has the fields of the statistics, as texts
            signal = signal._replace(topic='/loop_statistics')
        assert is_number(signal), signal


@each_layout
def test_a_recorded_run_has_numbers_for_every_signal(layout: str, bag: Bag) -> None:
    diagnostics = diagnostics_in(bag)
    for signal in SIGNALS[layout]():
        assert bag.types[signal.topic] == TYPES[signal.topic]
        table = bag.tables[signal.topic]
        if signal.topic == '/diagnostics':
            assert ('/', f'{signal.node}: loop', signal.field) in diagnostics
            continue
        if signal.node:
            table = table[table['node'] == f'/{signal.node}']
        assert np.isfinite(table[signal.field].astype(float)).any(), signal


@each_layout
def test_every_signal_of_the_papers_figures_is_shown(layout: str) -> None:
    shown = set(SIGNALS[layout]())
    wanted = [Signal('/pressure_reference', 'strain_error')]
    for name, columns in COLUMNS.items():
        topic = f'/{LOOP[name]}'
        for trace_name in set(PAPER) & set(columns):
            field = columns[trace_name]
            kind = fields_of(name)[name][field]
            indices = range(UNITS) if kind[0] == SEQUENCE else ()
            wanted += [Signal(topic, f'{field}[{unit}]') for unit in indices] or [
                Signal(topic, field)
            ]
    assert len(wanted) == len(PAPER) + 1 + 2  # two signals have one value for each unit
    assert set(wanted) <= shown


def test_the_papers_rig_has_as_many_motor_units_as_are_shown() -> None:
    assert len(load_configuration(default_configuration()).fam.count) == UNITS


@each_layout
def test_every_node_that_handles_ticks_shows_its_timing(layout: str, bag: Bag) -> None:
    shown = {(signal.field, signal.node) for signal in SIGNALS[layout]() if signal.node}
    fields = {field for field, _ in shown}
    assert len(nodes_in(bag)) == 4
    assert 'latency_p99' in fields
    assert shown == set(product(fields, nodes_in(bag)))


# ---- The formats ----


def children(element: ElementTree.Element, *names: str) -> list[ElementTree.Element]:
    found = list(element)
    assert {child.tag for child in found} <= set(names), element.tag
    return found


def areas(splitter: ElementTree.Element) -> Iterator[ElementTree.Element]:
    """Return the plots below a splitter, which must say how it divides its place."""
    parts = children(splitter, 'DockSplitter', 'DockArea')
    sizes = [float(size) for size in splitter.attrib['sizes'].split(';')]
    assert splitter.attrib['orientation'] in '|-'
    assert len(parts) == len(sizes) == int(splitter.attrib['count'])
    assert sum(sizes) == pytest.approx(1.0)
    for part in parts:
        if part.tag == 'DockSplitter':
            yield from areas(part)
        else:
            yield part


def test_plotjuggler_finds_tabs_splitters_and_plots_where_it_looks_for_them() -> None:
    """As plot_docker.cpp and plotwidget.cpp of PlotJuggler 3 read them."""
    (window,) = tree().findall('tabbed_widget')
    assert window.attrib == {'name': 'Main Window', 'parent': 'main_window'}
    *tabs, current = children(window, 'Tab', 'currentTabIndex')
    assert 0 <= int(current.attrib['index']) < len(tabs)
    shown = 0
    for tab in tabs:
        (container,) = children(tab, 'Container')
        (splitter,) = children(container, 'DockSplitter')
        for area in areas(splitter):
            (plot,) = children(area, 'plot')
            assert plot.attrib['mode'] == 'TimeSeries'
            assert plot.attrib['style'] in ('Lines', 'Steps')
            limits, *curves = children(plot, 'limitY', 'curve')
            assert (limits.tag, area.attrib['name'] != '') == ('limitY', True)
            assert all(re.fullmatch('#[0-9a-f]{6}', curve.attrib['color']) for curve in curves)
            shown += len(curves)
    assert shown == len(plotjuggler_signals())


def panels(node: Any) -> list[str]:
    """Panels of a mosaic of Foxglove, each once."""
    if isinstance(node, str):
        return [node]
    assert set(node) == {'direction', 'first', 'second', 'splitPercentage'}
    assert node['direction'] in ('row', 'column')
    assert 0 < node['splitPercentage'] < 100
    return panels(node['first']) + panels(node['second'])


def test_foxglove_finds_a_configuration_for_every_panel() -> None:
    layout = foxglove()
    assert set(layout) == {
        'configById',
        'globalVariables',
        'userNodes',
        'playbackConfig',
        'layout',
    }
    placed = panels(layout['layout'])
    for panel in placed:
        for tab in layout['configById'][panel].get('tabs', ()):
            placed = placed + panels(tab['layout'])
    assert sorted(placed) == sorted(layout['configById'])
    for name, panel in layout['configById'].items():
        kind = name.partition('!')[0]
        assert kind in ('Plot', 'StateTransitions', 'Tab')
        for path in panel.get('paths', ()):
            assert path['timestampMethod'] == 'receiveTime'  # the stamps count from 0
        assert kind != 'Plot' or panel['xAxisVal'] == 'timestamp'


def test_both_layouts_show_the_same() -> None:
    def named(signals: list[Signal]) -> set[Signal]:
        return {
            signal._replace(topic='/loop_statistics') if signal.node else signal
            for signal in signals
        }

    only_states = {Signal('/bundle_state', 'safe')}  # PlotJuggler has no panel of states
    assert named(foxglove_signals()) == named(plotjuggler_signals()) | only_states


def test_the_layouts_are_installed() -> None:
    from ament_index_python.packages import get_package_share_directory

    share = Path(get_package_share_directory('fam_bundle_bringup')) / 'layouts'
    for layout in (PLOTJUGGLER, FOXGLOVE):
        assert (share / layout.name).read_bytes() == layout.read_bytes()
