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
What the launch files are made of: arguments, the nodes of a bundle, and how a launch ends.

The only module that imports ``launch``: a full ROS 2 installation has it, PyPI does not.
"""

from collections.abc import Callable, Mapping, Sequence
import dataclasses
import os
from pathlib import Path
from typing import Any, NamedTuple

from fam_bundle_bringup.bridge_options import rig_for
from fam_bundle_bringup.experiment import (
    checked_configuration,
    default_configuration,
    with_bridge,
)
from fam_bundle_bringup.graph import LOOP_LISTENERS, nodes_of
from fam_bundle_bringup.this_machine import loopback, OVERRULE
from fam_bundle_io.hardware.backend import backend_names, MOVE_NOTHING, SIMULATED
from fam_bundle_model.doubts import doubts
from fam_bundle_model.parameters import Configuration, PACES, SCHEMES, write_yaml
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_node.network import chosen_network
from fam_bundle_node.parent import VARIABLE
from launch import LaunchContext, LaunchDescription
from launch.actions import (
    DeclareLaunchArgument,
    EmitEvent,
    LogInfo,
    OpaqueFunction,
    RegisterEventHandler,
    SetEnvironmentVariable,
    TimerAction,
    UnsetEnvironmentVariable,
)
from launch.event_handlers import OnProcessExit
from launch.events import Shutdown
import launch.logging
from launch_ros.actions import Node
import yaml

AS_CONFIGURED = 'as_configured'
LEVELS = ('debug', 'info', 'warn', 'error', 'fatal')
BOOLEANS = ('true', 'false')
# After the end of a run the last messages may still be on their way to a recorder; one that was
# lost is sent again with the middleware's next heartbeat, three seconds later.
SETTLE, SETTLE_RECORDED = 0.1, 4.0  # s
CLOSING = 20  # s that a recorder gets to write what it has


class Argument(NamedTuple):
    """A launch argument: what it is for, its default, and what it may be, if that is a list."""

    text: str
    default: str | None
    choices: Sequence[str] = ()


REAL = [name for name in backend_names() if name not in MOVE_NOTHING]
ARGUMENTS = {
    'params_file': Argument('parameter file of the bundle', str(default_configuration())),
    'namespace': Argument('namespace of the bundle; empty: none', ''),
    'log_level': Argument('what the nodes log', 'info', LEVELS),
    'scheme': Argument(
        'what decides a shift, and what is compensated', AS_CONFIGURED, (AS_CONFIGURED, *SCHEMES)
    ),
    'pace': Argument(
        'what paces the graph: each other, or a clock', AS_CONFIGURED, (AS_CONFIGURED, *PACES)
    ),
    'cycles': Argument('cycles of the reference until the run ends', AS_CONFIGURED),
    'composed': Argument('all nodes in one process', 'false', BOOLEANS),
    'record': Argument('record all topics of the bundle to the folder bag', 'false', BOOLEANS),
    'bag': Argument('folder of the bag, which must not exist', 'bag'),
    'simulated_backend': Argument(
        'volts: our plant behind volts; mock: sensors at rest', SIMULATED[0], SIMULATED
    ),
    'backend': Argument('what drives the card', None, REAL),
    'hardware': Argument('calibration, limits and options of this very rig', None),
    'start': Argument(
        'how far the bridge goes by itself; inactive: the card is read, safe volts are put out',
        'unconfigured',
        ('unconfigured', 'inactive'),
    ),
}
Values = Mapping[str, str]


class Bundle(NamedTuple):
    """The processes of one bundle, as node actions, and that with whose end its run ends."""

    name: str
    nodes: list[Node]
    owner: Node | None  # none: it runs until it is told to end
    recorded: bool


def describe(
    names: Sequence[str], make: Callable[[Values, Path], Sequence[Bundle]]
) -> LaunchDescription:
    """
    Return the description of a launch with the arguments ``names``.

    ``make`` gets their values and a folder for files, and returns the bundles to run; it raises
    ConfigurationError to refuse.
    """

    def begin(context: LaunchContext) -> list[Any]:
        values = {name: context.launch_configurations[name] for name in names}
        folder = Path(launch.logging.launch_config.log_dir)
        try:
            bundles = make(values, folder)
        except (ConfigurationError, OSError) as error:
            # Without the frames: the line says all.
            raise RuntimeError(str(error)) from None
        return [*network(), *start(bundles)]

    return LaunchDescription([*(declare(name) for name in names), OpaqueFunction(function=begin)])


def declare(name: str) -> DeclareLaunchArgument:
    """Return the declaration of an argument."""
    argument = ARGUMENTS[name]
    options: dict[str, Any] = {'description': argument.text}
    if argument.default is not None:
        options['default_value'] = argument.default
    if argument.choices:
        options['choices'] = list(argument.choices)
    return DeclareLaunchArgument(name, **options)


def network() -> list[Any]:
    """Return the actions that keep traffic on this machine, unless a network was chosen."""
    chosen = chosen_network(os.environ)
    if chosen:
        return [LogInfo(msg=f'network as chosen: {", ".join(chosen)}')]
    # Not a choice, and set to 0 it would overrule the profile.
    cleared = [UnsetEnvironmentVariable(name) for name in OVERRULE]
    middleware = os.environ.get('RMW_IMPLEMENTATION') or 'rmw_fastrtps_cpp'
    said, kept = 'the loopback of this machine', {**loopback(), 'RMW_IMPLEMENTATION': middleware}
    if not middleware.startswith('rmw_fastrtps'):  # it reads no profile of Fast DDS
        said, kept = (
            f'this machine, as far as {middleware} goes by ROS_AUTOMATIC_DISCOVERY_RANGE',
            {'ROS_AUTOMATIC_DISCOVERY_RANGE': 'LOCALHOST'},
        )
    return [
        LogInfo(msg=f'network: {said} (docs/networks.md)'),
        *cleared,
        *(SetEnvironmentVariable(name, value) for name, value in kept.items()),
    ]


def start(bundles: Sequence[Bundle]) -> list[Any]:
    """Return the actions that start all nodes, and end all when the runs are over or one dies."""
    recorded = any(bundle.recorded for bundle in bundles)
    settle = SETTLE_RECORDED if recorded else SETTLE
    running = {bundle.name for bundle in bundles}
    actions: list[Any] = []
    for bundle in bundles:
        for node in bundle.nodes:

            def ended(event: Any, _: Any, node: Node = node, bundle: Bundle = bundle) -> Any:
                """Say why the launch ends, or let the other bundles go on."""
                if node is not bundle.owner or event.returncode != 0:
                    return shut_down(f'{event.process_name} ended with {event.returncode}')
                running.discard(bundle.name)
                if running:
                    return None
                over = shut_down('the run is over')
                return TimerAction(period=settle, actions=[over])

            actions.append(RegisterEventHandler(OnProcessExit(target_action=node, on_exit=ended)))
        actions += bundle.nodes
    return actions


def shut_down(reason: str) -> EmitEvent:
    """Return the action that ends the launch."""
    return EmitEvent(event=Shutdown(reason=reason))


def node(package: str, executable: str, values: Values, files: Sequence[Path]) -> Node:
    """Return the action of one node, which ends with the launch."""
    arguments = [word for file in files for word in ('--params-file', str(file))]
    # As the security policy names it; without security it says nothing.
    space = values['namespace'].strip('/')
    arguments += ['--enclave', f'/{space}/{executable}' if space else f'/{executable}']
    return Node(
        package=package,
        executable=executable,
        namespace=values['namespace'],
        output='screen',
        ros_arguments=[*arguments, '--log-level', values['log_level']],
        additional_env={VARIABLE: str(os.getpid())},
        sigterm_timeout=str(CLOSING),
    )


def configuration_of(values: Values, changes: dict[str, dict[str, Any]]) -> Configuration:
    """Return what the parameter file and the arguments ask for, or raise ConfigurationError."""
    for name, (group, parameter) in {
        'scheme': ('recruitment', 'scheme'),
        'pace': ('run', 'pace'),
        'cycles': ('reference', 'cycles'),
    }.items():
        if values.get(name, AS_CONFIGURED) != AS_CONFIGURED:
            changes.setdefault(group, {})[parameter] = values[name]
    configuration = checked_configuration(Path(values['params_file']), changes)
    for doubt in doubts(configuration):
        launch.logging.get_logger('fam_bundle').warning(doubt)
    return configuration


def bundle(values: Values, folder: Path, configuration: Configuration, **graph: bool) -> Bundle:
    """
    Return one bundle, whose nodes take one parameter file, written to ``folder``.

    ``graph`` is what ``nodes_of`` takes. Raises ConfigurationError.
    """
    record = values.get('record') == 'true'
    listeners = LOOP_LISTENERS + record
    run = dataclasses.replace(configuration.run, listeners=listeners)
    name = values['namespace'].strip('/')
    file = folder / f'{name or "fam_bundle"}.yaml'.replace('/', '_')
    write_yaml(dataclasses.replace(configuration, run=run), file)
    nodes = [node(package, name, values, [file]) for package, name in nodes_of(**graph)]
    owner = nodes[-1]
    if record:
        nodes.insert(0, recorder(values, file))
    return Bundle(name, nodes, owner, record)


def recorder(values: Values, parameters: Path) -> Node:
    """Return the action of the recorder; raises ConfigurationError where its folder is taken."""
    bag = Path(values['bag']).resolve()
    if bag.exists():
        raise ConfigurationError(f'bag = {bag}: exists; name another folder')
    file = parameters.with_suffix('.bag.yaml')
    content = {'/**': {'ros__parameters': {'bag': {'folder': str(bag)}}}}
    file.write_text(yaml.safe_dump(content))
    return node('fam_bundle_io', 'bag_recorder', values, [parameters, file])


# ---- One for each launch file ----


def sim(values: Values, folder: Path) -> list[Bundle]:
    """Return the bundle with the plant simulator."""
    configuration = configuration_of(values, {})
    return [bundle(values, folder, configuration, composed=values['composed'] == 'true')]


def two_bundles(values: Values, folder: Path) -> list[Bundle]:
    """Return two simulated bundles, in the namespaces left and right."""
    bag = Path(values['bag'])
    return [
        one
        for side in ('left', 'right')
        for one in sim({**values, 'namespace': side, 'bag': str(bag / side)}, folder)
    ]


def mock(values: Values, folder: Path) -> list[Bundle]:
    """Return the bundle with the hardware bridge and a card that moves nothing."""
    backend = values['simulated_backend']
    configuration = configuration_of(values, {'bridge': {'backend': backend}})
    rig, written = rig_for(None, configuration, backend), folder / 'hardware.yaml'
    configuration = with_bridge(configuration, configuration.run.pace, rig, written)
    return [bundle(values, folder, configuration, bridge=True)]


def hardware(values: Values, folder: Path) -> list[Bundle]:
    """Return the bundle with the hardware bridge and a real card; nothing is armed."""
    path = Path(values['hardware']).resolve()
    bridge = {'backend': values['backend'], 'hardware': str(path), 'start': values['start']}
    changes = {'bridge': bridge, 'run': {'pace': 'realtime'}}
    configuration = configuration_of(values, changes)
    rig_for(path, configuration, values['backend'])
    return [bundle(values, folder, configuration, bridge=True)]


def record(values: Values, folder: Path) -> list[Bundle]:
    """Return a recorder of a bundle that runs, or is to run, elsewhere."""
    configuration = configuration_of(values, {})
    file = folder / 'recorded.yaml'
    write_yaml(configuration, file)
    return [Bundle('bag_recorder', [recorder(values, file)], None, True)]


def controllers(values: Values, folder: Path) -> list[Bundle]:
    """Return the controllers of a bundle whose plant or bridge runs elsewhere."""
    file = folder / 'controllers.yaml'
    write_yaml(configuration_of(values, {}), file)
    nodes = [node(package, name, values, [file]) for package, name in nodes_of()[:-1]]
    return [Bundle('controllers', nodes, None, False)]
