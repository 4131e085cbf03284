# SPDX-License-Identifier: Apache-2.0
"""As much of ``launch`` as the launch files use, for where it is missing: PyPI has it not."""

import sys
from types import ModuleType, SimpleNamespace
from typing import Any


class LaunchContext:
    """Holds the arguments of a launch."""

    def __init__(self) -> None:
        self.launch_configurations: dict[str, str] = {}


class LaunchDescription:
    """A list of actions."""

    def __init__(self, entities: list[Any]) -> None:
        self.entities = entities


class Action:
    """Keeps what it is made of."""

    def __init__(self, *arguments: Any, **options: Any) -> None:
        self.arguments, self.options = arguments, options


class DeclareLaunchArgument(Action):
    """Refuses a value that is not among the choices, as the real one does."""

    def execute(self, context: LaunchContext) -> None:
        (name,) = self.arguments
        given = context.launch_configurations
        if name not in given:
            if 'default_value' not in self.options:
                raise RuntimeError(f'Included launch description missing required argument {name}')
            given[name] = self.options['default_value']
        choices = self.options.get('choices')
        if choices is not None and given[name] not in choices:
            raise RuntimeError(f'{name}: {given[name]} is not in {choices}')


class OpaqueFunction(Action):
    """Calls its function."""

    def execute(self, context: LaunchContext) -> Any:
        return self.options['function'](context)


def install(log_dir: str) -> None:
    """Put the stand-ins where an import finds them."""
    logger = SimpleNamespace(warning=lambda text: None)
    config = SimpleNamespace(log_dir=log_dir)
    names = ('EmitEvent', 'LogInfo', 'RegisterEventHandler', 'SetEnvironmentVariable')
    more = ('TimerAction', 'UnsetEnvironmentVariable')
    actions = {name: type(name, (Action,), {}) for name in (*names, *more)}
    modules: dict[str, dict[str, Any]] = {
        'launch': {'LaunchContext': LaunchContext, 'LaunchDescription': LaunchDescription},
        'launch.actions': {
            'DeclareLaunchArgument': DeclareLaunchArgument,
            'OpaqueFunction': OpaqueFunction,
            **actions,
        },
        'launch.event_handlers': {'OnProcessExit': type('OnProcessExit', (Action,), {})},
        'launch.events': {'Shutdown': type('Shutdown', (Action,), {})},
        'launch.logging': {'launch_config': config, 'get_logger': lambda name: logger},
        'launch_ros': {},
        'launch_ros.actions': {'Node': type('Node', (Action,), {})},
    }
    for name, content in modules.items():
        module = ModuleType(name)
        vars(module).update(content)
        sys.modules[name] = module
    launch: Any = sys.modules['launch']
    for name in ('actions', 'event_handlers', 'events', 'logging'):
        setattr(launch, name, sys.modules[f'launch.{name}'])
