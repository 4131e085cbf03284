# SPDX-License-Identifier: Apache-2.0
"""The SROS2 policy and the running graph: what there is is allowed, what is allowed is there."""

from collections.abc import Callable, Iterator
import contextlib
from pathlib import Path
from xml.etree import ElementTree

from ament_index_python.packages import get_package_share_directory
from fam_bundle_bringup.experiment import default_configuration, with_bridge
from fam_bundle_bringup.graph import (
    listening,
    nodes_in,
    own_domain,
    start_bag_recorder,
    start_nodes,
)
from fam_bundle_bringup.statistics_listener import StatisticsListener
from fam_bundle_io.hardware.calibration import load_hardware
from fam_bundle_io.trace_recorder_node import TraceRecorder
from fam_bundle_model.parameters import Configuration, load_configuration, write_yaml
from fam_bundle_msgs.msg import StrainReference
from fam_bundle_node.qos import NEWEST
import pytest
from rclpy.node import Node, NodeNameNonExistentError

POLICY = Path(get_package_share_directory('fam_bundle_bringup'), 'security/fam_bundle.policy.xml')
LOOKS = 600  # at most, of a tenth of a second; a graph that is complete ends it
ACTION_SERVICES = ('send_goal', 'cancel_goal', 'get_result')
ACTION_TOPICS = ('feedback', 'status')
# What a node does to names of a kind, as the policy says it and as rclpy tells it.
DEEDS = ('publish', 'subscribe', 'reply', 'request')
Rights = set[tuple[str, str]]  # deed and whole name

LOOP = (
    'lag_table_server',
    'recruitment_supervisor',
    'strain_controller',
    'pressure_controller',
)
LISTENERS = ('bag_recorder', 'trace_recorder', 'fam_top')
OPERATOR = 'operator'
OF_A_BRIDGE = ('backend_info', 'bridge_state', 'transition_event')


def enclaves() -> dict[str, list[ElementTree.Element]]:
    root = ElementTree.parse(POLICY).getroot()
    assert root.get('version') == '0.2.0'
    return {found.get('path', ''): found.findall('.//profile') for found in root.iter('enclave')}


def whole(name: str, profile: ElementTree.Element) -> str:
    space, node = profile.attrib['ns'].rstrip('/'), profile.attrib['node']
    if name.startswith('~'):
        return f'{space}/{node}{name[1:]}'
    return name if name.startswith('/') else f'{space}/{name}'


def rights(profile: ElementTree.Element) -> Rights:
    """Return what a profile allows; an action is its services and topics."""
    found = []
    for rules in profile:
        ((deed, verdict),) = rules.attrib.items()
        assert verdict == 'ALLOW'
        for name in (whole(str(rule.text), profile) for rule in rules):
            if rules.tag == 'actions':
                served, told = (
                    ('reply', 'publish') if deed == 'execute' else ('request', 'subscribe')
                )
                found += [(served, f'{name}/_action/{part}') for part in ACTION_SERVICES]
                found += [(told, f'{name}/_action/{part}') for part in ACTION_TOPICS]
            else:
                found.append((deed, name))
    assert len(found) == len(set(found)), 'said twice'
    return set(found)


def allowed() -> dict[str, Rights]:
    """Return what each node may do in its own enclave."""
    return {
        profile.attrib['node']: rights(profile)
        for path, profiles in enclaves().items()
        for profile in profiles
        if path == f'/{profile.attrib["node"]}'
    }


def test_each_process_has_one_enclave() -> None:
    nodes = {path: [found.attrib['node'] for found in many] for path, many in enclaves().items()}
    assert nodes.pop('/composed_loop') == [*LOOP, 'plant_simulator']
    alone = [*LOOP, 'plant_simulator', 'hardware_bridge', *LISTENERS, OPERATOR]
    assert nodes == {f'/{name}': [name] for name in alone}


def test_among_the_enclaves_are_no_comments() -> None:
    """`ros2 security generate_artifacts` takes each child for an enclave, and ends at one."""
    keep = ElementTree.XMLParser(target=ElementTree.TreeBuilder(insert_comments=True))
    found = ElementTree.parse(POLICY, keep).getroot().find('enclaves')
    assert found is not None
    assert {child.tag for child in found} == {'enclave'}


def test_composed_nodes_may_do_what_each_may() -> None:
    for profile in enclaves()['/composed_loop']:
        assert rights(profile) == allowed()[profile.attrib['node']]


def test_what_an_operator_may_is_there_to_be_done() -> None:
    others = set().union(*(found for node, found in allowed().items() if node != OPERATOR))
    counterpart = dict(zip(DEEDS, ('subscribe', 'publish', 'request', 'reply'), strict=True))
    # What every node does, and each command of the command line is one.
    own = {('publish', '/parameter_events'), ('publish', '/rosout')}
    own |= {('reply', f'/{node}/get_type_description') for node in (OPERATOR, '_ros2cli_*')}
    assert own <= allowed()[OPERATOR]
    for deed, name in allowed()[OPERATOR] - own:
        assert (counterpart[deed], name) in others, (deed, name)


def seen(observer: Node, node: str) -> Rights:
    """Return what a node of the running graph does."""
    ways = (
        observer.get_publisher_names_and_types_by_node,
        observer.get_subscriber_names_and_types_by_node,
        observer.get_service_names_and_types_by_node,
        observer.get_client_names_and_types_by_node,
    )
    # A node that is not there, or not whole yet, is asked again.
    with contextlib.suppress(NodeNameNonExistentError):
        return {
            (deed, name)
            for deed, ask in zip(DEEDS, ways, strict=True)
            for name, _ in ask(node, '/')
        }
    return set()


def listeners() -> list[Node]:
    """Return the observer and what listens in this process."""
    observer = Node('observer', enable_rosout=False, start_parameter_services=False)
    # The topic of references has a publisher only where somebody gives them.
    observer.create_publisher(StrainReference, 'strain_reference', NEWEST)
    return [observer, TraceRecorder(), StatisticsListener().node]


@contextlib.contextmanager
def whole_graph(
    configuration: Configuration, folder: Path, *, bridge: bool
) -> Iterator[tuple[Node, Callable[[float], None]]]:
    """Start a bundle and all that listens to it; the run itself waits for a listener more."""
    parameters = folder / 'parameters.yaml'
    write_yaml(configuration, parameters)
    with own_domain(), listening(listeners) as (nodes, listen), nodes_in(folder) as group:
        start_bag_recorder(group, parameters, folder / 'bag')
        start_nodes(group, parameters, 99, bridge=bridge)
        yield nodes[0], listen


@pytest.mark.parametrize('owner', ['plant_simulator', 'hardware_bridge'])
def test_policy_equals_the_running_graph(owner: str, tmp_path: Path) -> None:
    bridge = owner == 'hardware_bridge'
    changes: dict[str, dict[str, str]] = {
        'recruitment': {'scheme': 'lag_pressure', 'predictor': 'preview'},
        'reference': {'kind': 'topic'},
    }
    configuration = load_configuration(default_configuration(), changes)
    if bridge:
        hardware = load_hardware(default_configuration().with_name('volts_calibration.yaml'))
        configuration = with_bridge(configuration, 'lockstep', hardware, tmp_path / 'rig.yaml')
    nodes = (*LOOP, owner, *LISTENERS)
    expected = {node: allowed()[node] for node in nodes}
    if not bridge:
        # What only a bridge publishes, nobody records without one.
        expected['bag_recorder'] = {
            (deed, name)
            for deed, name in expected['bag_recorder']
            if not name.endswith(OF_A_BRIDGE)
        }
    with whole_graph(configuration, tmp_path, bridge=bridge) as (observer, listen):
        found: dict[str, Rights] = {}
        for _ in range(LOOKS):
            found = {node: seen(observer, node) for node in nodes}
            if found == expected:
                break
            listen(0.1)
    for node in nodes:
        assert found[node] - expected[node] == set(), f'{node}: done, but not allowed'
        assert expected[node] - found[node] == set(), f'{node}: allowed, but not done'
