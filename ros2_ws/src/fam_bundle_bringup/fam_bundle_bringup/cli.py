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

"""The command line: what ``./fam`` passes on."""

import argparse
from collections.abc import Callable, Mapping, Sequence
import importlib.util
import math
from pathlib import Path
import signal
import sys
from types import FrameType
from typing import Any

from fam_bundle_bringup.bag_commands import add_bag_commands, run_bag_command
from fam_bundle_bringup.bag_commands import NAMES as BAG_COMMANDS
from fam_bundle_bringup.bridge_options import add_bridge_options, check_backend, hardware_of
from fam_bundle_bringup.domain_marker import domain_number
from fam_bundle_bringup.experiment import (
    checked_configuration,
    default_configuration,
    PACES,
    prepare_folder,
    RESULTS,
)
from fam_bundle_bringup.one_line_parser import Parser
from fam_bundle_bringup.rig_commands import add_rig_commands, run_rig_command
from fam_bundle_bringup.rig_commands import NAMES as RIG_COMMANDS
from fam_bundle_bringup.study_command import add_study, run_study
from fam_bundle_model.doubts import doubts
from fam_bundle_model.parameters import (
    ALLOCATIONS,
    Configuration,
    KINDS,
    PREDICTORS,
    SCHEMES,
)
from fam_bundle_model.reference_file import read_samples
from fam_bundle_model.schema import ConfigurationError

NAMED = 3  # of what a bag misses


def parser() -> Parser:
    """Return the parser of all commands."""
    top = Parser(prog='fam', description='Variable-recruitment FAM bundles under ROS 2.')
    commands = top.add_subparsers(dest='command', required=True, metavar='COMMAND')
    _add_experiment(commands)
    demo = commands.add_parser(
        'demo', help="the paper's experiment under every scheme, its table and its figures"
    )
    _add_common(demo, Path('runs/demo'))
    bench = commands.add_parser('bench', help='how fast the loop runs on this machine')
    _add_common(bench, Path('runs/bench'))
    bench.add_argument(
        '--rounds',
        type=_rounds,
        default=3,
        metavar='N',
        help='how often each candidate runs, some seven minutes a round (%(default)s)',
    )
    faults = commands.add_parser(
        'faults', help='what goes wrong in real time, done on purpose: one verdict each'
    )
    _add_common(faults, Path('runs/faults'))
    faults.add_argument('--only', default='', metavar='TEXT', help='faults that contain TEXT')
    faults.add_argument(
        '--backend',
        choices=('volts',),
        help='those of the hardware bridge, on the simulated rig in volts',
    )
    add_study(commands)
    _add_top(commands)
    add_bag_commands(commands)
    add_rig_commands(commands)
    return top


def _rounds(text: str) -> int:
    number = int(text) if text.isdecimal() else 0
    if not 1 <= number <= 100:
        raise argparse.ArgumentTypeError(f'{text!r}: must be an integer from 1 to 100')
    return number


def _add_common(command: argparse.ArgumentParser, out: Path) -> None:
    command.add_argument(
        '--config', type=Path, help='parameter file (default: the rig of the paper, lhacd.yaml)'
    )
    command.add_argument(
        '--out', type=Path, default=out, metavar='DIR', help='folder for results (%(default)s)'
    )


def _add_experiment(commands: Any) -> None:
    experiment = commands.add_parser('experiment', help='one run, its trace and its metrics')
    experiment.add_argument(
        '--scheme',
        metavar='|'.join(SCHEMES),
        help='what decides a shift, and what is compensated (default: as configured)',
    )
    experiment.add_argument(
        '--allocation',
        metavar='|'.join(ALLOCATIONS),
        help='what each recruited motor unit is asked for (default: as configured, else batch)',
    )
    experiment.add_argument(
        '--predictor',
        metavar='|'.join(PREDICTORS),
        help='how the strain is expected to go on (default: as configured)',
    )
    experiment.add_argument(
        '--threshold',
        metavar='SHARE',
        help='upshift threshold of the threshold schemes over the nominal pressure',
    )
    experiment.add_argument(
        '--pace',
        choices=PACES,
        help='through the node graph, paced by each other or by a clock, or the same loop in one '
        'process without ROS (default: as configured, else lockstep)',
    )
    experiment.add_argument(
        '--composed', action='store_true', help='all nodes of the graph in one process'
    )
    experiment.add_argument(
        '--record', action='store_true', help='record all topics to DIR/bag (rosbag2, MCAP)'
    )
    add_bridge_options(experiment)
    experiment.add_argument(
        '--reference',
        metavar='KIND|FILE.csv',
        help=f'strain reference: {", ".join(KINDS)}; or a file with the header time,strain, at '
        'whose first strain the run begins',
    )
    experiment.add_argument('--amplitude', metavar='STRAIN', help='half of its peak strain')
    experiment.add_argument('--frequency', metavar='HZ', help='its frequency')
    experiment.add_argument('--cycles', metavar='N', help='how many cycles to run')
    _add_common(experiment, Path('runs/experiment'))


def _add_top(commands: Any) -> None:
    top = commands.add_parser('top', help='live view of how every node keeps up')
    top.add_argument(
        '--domain',
        type=_argument(domain_number),
        metavar='N',
        help='DDS domain (default: ROS_DOMAIN_ID, else that of the running experiment)',
    )
    top.add_argument(
        '--seconds',
        type=_argument(_seconds),
        default=math.inf,
        metavar='S',
        help='end after so many seconds (default: at Ctrl-C)',
    )


def _seconds(text: str) -> float:
    try:
        seconds = float(text)
    except ValueError:
        seconds = math.nan
    if not seconds > 0.0:
        raise ConfigurationError(f'{text!r}: must be a number > 0')
    return seconds


def _argument(convert: Callable[[str], Any]) -> Callable[[str], Any]:
    """Let the parser refuse in the words of ``convert``."""

    def converted(text: str) -> Any:
        try:
            return convert(text)
        except ConfigurationError as error:
            raise argparse.ArgumentTypeError(str(error)) from None

    return converted


def reference_of(text: str | None) -> dict[str, dict[str, Any]]:
    """
    Return the changes that ``--reference`` asks for: a kind, or the samples in a file.

    Raises ConfigurationError when the file holds none.
    """
    if text is None:
        return {}
    if not text.lower().endswith('.csv'):
        return {'reference': {'kind': text}}
    times, strains = read_samples(Path(text))
    samples = {'kind': 'samples', 'times': times, 'strains': strains}
    return {'reference': samples, 'simulation': {'initial_strain': strains[0]}}


def changes_of(options: argparse.Namespace) -> Mapping[str, Mapping[str, Any]]:
    """Return the configuration changes that the options ask for."""
    wanted = {
        ('recruitment', 'scheme'): options.scheme,
        ('recruitment', 'predictor'): options.predictor,
        ('allocation', 'policy'): options.allocation,
        ('recruitment', 'upshift_threshold'): options.threshold,
        ('reference', 'amplitude'): options.amplitude,
        ('reference', 'frequency'): options.frequency,
        ('reference', 'cycles'): options.cycles,
        ('bridge', 'backend'): options.backend,
    }
    changes = reference_of(options.reference)
    for (group, name), value in wanted.items():
        if value is not None:
            changes.setdefault(group, {})[name] = value
    return changes


def run_experiment_command(options: argparse.Namespace, configuration: Configuration) -> None:
    """Run one experiment and print its metrics."""
    from fam_bundle_bringup.experiment import run_experiment
    from fam_bundle_bringup.progress import progress_bar

    scheme = configuration.recruitment.scheme
    pace = options.pace or configuration.run.pace
    hardware = hardware_of(options.backend, options.hardware, configuration)
    with progress_bar(f'{scheme}, {pace}', configuration.ticks()) as progress:
        result = run_experiment(
            configuration,
            pace,
            options.out,
            progress,
            composed=options.composed,
            hardware=hardware,
            record=options.record,
        )
    metrics = result.metrics
    window = f'{metrics["metrics_from"]:g} to {metrics["metrics_to"]:g} s'
    print(f'{scheme}: {metrics["ticks"]} ticks; over {window}:')
    print(f'  IAE           {metrics["iae"]:.4f} s')
    print(f'  maximum error {metrics["max_error"]:.4f}')
    print(f'  upshifts      {_times(metrics["upshift_times"])}')
    print(f'  downshifts    {_times(metrics["downshift_times"])}')
    if pace == 'realtime':
        loop = metrics['loop']
        print(f'  in real time  {loop["answered"]} samples answered, {loop["late"]} of them late;')
        print(f'                {loop["skipped_periods"]} periods skipped, {loop["missing"]} lost')
        for state in loop['states']:
            print(f'                {state}')
    if options.record:
        for line in recorded_lines(metrics['bag']):
            print(line)
    print(f'written to {options.out}')


def recorded_lines(bag: Mapping[str, Any]) -> list[str]:
    """Return what is said of the bag of a run: is it whole, and what did recording take."""
    missing = bag['missing'][:NAMED] or ['whole']
    if len(bag['missing']) > NAMED:
        missing.append(f'and {len(bag["missing"]) - NAMED} more, see metadata.yaml')
    lines = [f'{bag["messages"]} messages, {"; ".join(missing)};']
    unanswered = [f'{n} of {name.lstrip("/")}' for name, n in bag['unanswered'].items() if n]
    if unanswered:
        lines.append(f'samples not answered: {", ".join(unanswered)};')
    memory = f'{bag["peak_memory"] / 1e6:.0f} MB'
    lines.append(f'recorder: {bag["cpu_share"]:.2f} of a core, {memory}')
    return [f'  {"" if number else "recorded":14}{line}' for number, line in enumerate(lines)]


def _times(times: Sequence[float]) -> str:
    return ', '.join(f'{t:.3f} s' for t in times) or 'none'


def _terminate(number: int, frame: FrameType | None) -> None:
    raise KeyboardInterrupt


def run_command(options: argparse.Namespace, configuration: Configuration) -> int:
    """Run a command that takes a configuration and return its exit status."""
    if options.command == 'experiment':
        run_experiment_command(options, configuration)
    elif options.command == 'demo':
        from fam_bundle_bringup.demo import run_demo

        run_demo(configuration, options.out)
    elif options.command == 'bench':
        from fam_bundle_bringup.bench import run_bench

        run_bench(configuration, options.out, options.rounds)
    else:
        from fam_bundle_bringup.faults import run_faults

        bridge = options.backend is not None
        passed = run_faults(configuration, options.out, options.only, bridge=bridge)
        return 0 if passed else 1
    return 0


def main(arguments: Sequence[str] | None = None) -> int:
    """Run one command and return its exit status."""
    options = parser().parse_args(arguments)
    # Every exit unwinds, so that no process is left behind.
    signal.signal(signal.SIGTERM, _terminate)
    try:
        if options.command == 'top':
            from fam_bundle_bringup.top import run_top

            run_top(options.domain, options.seconds)
            return 0
        if options.command in BAG_COMMANDS:
            return run_bag_command(options)
        if options.command == 'study':
            return run_study(options)
        if options.command in RIG_COMMANDS:
            return run_rig_command(options)
        results = RESULTS if options.command == 'experiment' else ()
        changes = changes_of(options) if options.command == 'experiment' else {}
        if options.command == 'experiment' and options.composed and options.pace == 'offline':
            raise ConfigurationError('--composed: --pace offline has no nodes to compose')
        if options.command == 'experiment':
            check_backend(options.backend, options)
        if options.command == 'experiment' and options.record:
            if options.pace == 'offline':
                raise ConfigurationError('--record: --pace offline has no topics to record')
            if importlib.util.find_spec('mcap') is None:
                raise ConfigurationError(
                    '--record: needs the Python package mcap: docs/get_started.md, On Ubuntu'
                )
            if (options.out / 'bag').exists():
                raise ConfigurationError(f'--record: {options.out}/bag exists: name another --out')
        config = options.config or default_configuration()
        offline = options.command == 'demo' or getattr(options, 'pace', None) == 'offline'
        configuration = checked_configuration(config, changes, offline=offline)
        for doubt in doubts(configuration):
            print(f'warning: {doubt}', file=sys.stderr)
        if config.resolve() == (options.out / 'parameters.yaml').resolve():
            raise ConfigurationError(f'--out {options.out}: would overwrite {config}')
        prepare_folder(options.out, results)
        return run_command(options, configuration)
    except ConfigurationError as error:
        print(f'fam {options.command}: {error}', file=sys.stderr)
        return 2
    except KeyboardInterrupt:
        print(f'fam {options.command}: interrupted', file=sys.stderr)
        return 130
    except (RuntimeError, OSError) as error:
        print(f'fam {options.command}: {error}', file=sys.stderr)
        return 1


if __name__ == '__main__':
    sys.exit(main())
