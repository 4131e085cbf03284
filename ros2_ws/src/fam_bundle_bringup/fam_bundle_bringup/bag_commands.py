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

"""The commands that work on bags: ``./fam report``, ``./fam replay`` and ``./fam recover``."""

import argparse
import os
from pathlib import Path
import sys
from typing import Any

from fam_bundle_bringup.progress import progress_bar
from fam_bundle_io.bag_writer import BagError
from fam_bundle_model.parameters import Configuration, load_configuration
from fam_bundle_model.schema import ConfigurationError

NAMES = ('report', 'replay', 'recover')


def add_bag_commands(commands: Any) -> None:
    """Add the parsers of the commands."""
    report = commands.add_parser(
        'report', help='metrics, figures and an interactive page out of recorded bags'
    )
    report.add_argument('bags', nargs='+', type=Path, metavar='BAG', help='folder or file')
    _add_configuration(report)
    report.add_argument(
        '--out',
        type=Path,
        default=Path('runs/report'),
        metavar='DIR',
        help='folder for the report (%(default)s)',
    )
    replay = commands.add_parser(
        'replay', help='feed a bag to controllers and plant, and compare with what it holds'
    )
    replay.add_argument('bag', type=Path, metavar='BAG', help='folder or file')
    _add_configuration(replay)
    replay.add_argument(
        '--namespace', default='', metavar='NAME', help='of one bundle of several in the bag'
    )
    replay.add_argument('--out', type=Path, metavar='DIR', help='folder for numbers and figure')
    recover = commands.add_parser('recover', help='make a whole bag out of a damaged one')
    recover.add_argument('bag', type=Path, metavar='BAG', help='folder or file')
    recover.add_argument(
        '--out', type=Path, metavar='DIR', help='folder of the new bag (BAG_recovered)'
    )


def _add_configuration(command: argparse.ArgumentParser) -> None:
    command.add_argument(
        '--config', type=Path, metavar='FILE', help='parameter file (default: that in the bag)'
    )


def run_bag_command(options: argparse.Namespace) -> int:
    """
    Run one of the commands and return its exit status.

    Raises ConfigurationError for a bad parameter file, OSError where nothing can be written.
    """
    try:
        if options.command == 'report':
            return run_report(options)
        if options.command == 'replay':
            from fam_bundle_bringup.replay import run_replay

            same = run_replay(options.bag, options.config, options.out, options.namespace)
            return 0 if same else 1
        from fam_bundle_bringup.recover_command import run_recover

        return run_recover(options.bag, options.out)
    except BagError as error:
        print(f'fam {options.command}: {error}', file=sys.stderr)
        return 2
    except ModuleNotFoundError as error:
        package = str(error.name).partition('.')[0]
        words = f'Python package {package} is missing: docs/get_started.md, On Ubuntu'
        print(f'fam {options.command}: {words}', file=sys.stderr)
        return 2


def check_folder(folder: Path) -> None:
    """Raise ConfigurationError unless ``folder`` can be written to; make nothing yet."""
    there = folder
    while not there.exists() and there != there.parent:
        there = there.parent
    if not there.is_dir() or not os.access(there, os.W_OK):
        raise ConfigurationError(f'--out {folder}: cannot be written')


def run_report(options: argparse.Namespace) -> int:
    """Write a report and say where; status 1 when a bag could not be used."""
    from fam_bundle_io.report_files import steps_of, write_report

    check_folder(options.out)
    given: Configuration | None = None
    if options.config is not None:
        given = load_configuration(options.config)
    with progress_bar('report', steps_of(options.bags)) as progress:
        runs, troubles = write_report(options.bags, options.out, given, progress)
    for run in runs:
        print(f'{run.name}: {run.numbers["ticks"]} ticks')
        if run.numbers['iae'] is not None:
            start, stop = run.numbers['metrics_from'], run.numbers['metrics_to']
            tracked = f'IAE {run.numbers["iae"]:.4f} s, maximum {run.numbers["max_error"]:.4f}'
            print(f'  {tracked}, over {start:g} to {stop:g} s')
        for line in run.numbers['warnings']:
            print(f'  {line}')
    for line in troubles:
        print(line, file=sys.stderr)
    print(f'open {options.out / "report.html"}; figures and tables beside it')
    return 1 if troubles else 0
