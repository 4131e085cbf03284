# SPDX-License-Identifier: Apache-2.0
"""The reference pages of the site: parameters, messages, command line, Python."""

import argparse
from collections.abc import Iterator
from pathlib import Path
import subprocess
import sys

from fam_bundle_bringup.cli import parser
from fam_bundle_model.parameters import GROUPS, read_yaml
from fam_bundle_model.schema import declarations

ROOT = Path(__file__).resolve().parents[2]
SOURCE = ROOT / 'ros2_ws' / 'src'
RIG = SOURCE / 'fam_bundle_bringup' / 'config' / 'lhacd.yaml'
MESSAGES = SOURCE / 'fam_bundle_msgs'
KINDS = {'msg': 'Messages', 'srv': 'Services', 'action': 'Actions'}


def pages() -> dict[str, str]:
    """Return each page's text by its path in the site."""
    made = {
        'parameters': ''.join(parameters()),
        'messages': ''.join(messages()),
        'command_line': ''.join(command_line()),
        **{package: ''.join(python(package)) for package in packages()},
    }
    return {f'reference/{name}.md': text for name, text in made.items()}


def packages() -> list[str]:
    """Return the names of our Python packages."""
    return sorted(path.parent.name for path in SOURCE.glob('*/setup.py'))


def parameters() -> Iterator[str]:
    """Yield the tables of all parameters, with the values of the paper's rig."""
    rig = read_yaml(RIG)
    yield (
        '# Parameters\n\nOf the schema in `fam_bundle_model/parameters.py`, which also checks, '
        'loads and declares them. "Rig" is the value in [lhacd.yaml]'
        f'(../{RIG.relative_to(ROOT)}.md), whose comments say where it comes from, or the '
        'default. A *live* parameter may change while its loop runs.\n'
    )
    for name, group in GROUPS.items():
        yield f'\n## {name}\n\n{" ".join((group.__doc__ or "").split())}\n\n'
        yield '| Name | Unit | Rig | Range | Live | Meaning |\n|---|---|---|---|---|---|\n'
        values = rig.get(name, {})
        for parameter, found in declarations(group).items():
            allowed = found.bound().removeprefix('must be ')
            value = values.get(parameter, getattr(group, parameter, ''))
            live = 'yes' if found.live else ''
            yield (
                f'| `{parameter}` | {found.unit or "-"} | `{value}` | {allowed} | {live} '
                f'| {found.text} |\n'
            )


def messages() -> Iterator[str]:
    """Yield every message, service and action with its comments."""
    yield '# Messages, services and actions\n\n'
    yield f'What they are for: [fam_bundle_msgs](../{MESSAGES.relative_to(ROOT)}/README.md).\n'
    for kind, title in KINDS.items():
        yield f'\n## {title}\n'
        for path in sorted((MESSAGES / kind).glob(f'*.{kind}')):
            lines = path.read_text(encoding='utf-8').splitlines()
            text = '\n'.join(line for line in lines if 'SPDX-License' not in line).strip()
            yield f'\n### {path.stem}\n\n```text\n{text}\n```\n'


def command_line() -> Iterator[str]:
    """Yield the help texts of ``./fam`` and its commands."""
    shown = [sys.executable, str(ROOT / 'fam'), 'help']
    text = subprocess.check_output(shown, text=True)
    yield f'# Command line\n\n```text\n{text.rstrip()}\n```\n'
    commands = next(a for a in parser()._actions if isinstance(a, argparse._SubParsersAction))
    for name, command in commands.choices.items():
        command.formatter_class = wide(command.formatter_class)
        yield f'\n## ./fam {name}\n\n```text\n{command.format_help().rstrip()}\n```\n'


def wide(formatter: type[argparse.HelpFormatter]) -> type[argparse.HelpFormatter]:
    """Return a formatter that asks no terminal for its width."""

    class Wide(formatter):  # type: ignore[misc,valid-type]
        def __init__(self, prog: str) -> None:
            super().__init__(prog, width=96)

    return Wide


def python(package: str) -> Iterator[str]:
    """Yield the page of a package's modules, which mkdocstrings fills in."""
    folder = SOURCE / package / package
    yield f'---\ntitle: {package}\n---\n# The Python of {package}\n\n'
    readme = f'../{folder.parent.relative_to(ROOT)}/README.md'
    yield f'What each module is for: [{package}]({readme}).\n'
    for path in sorted(folder.rglob('*.py')):
        if path.name != '__init__.py':
            module = '.'.join(path.relative_to(folder.parent).with_suffix('').parts)
            yield f'\n::: {module}\n'
