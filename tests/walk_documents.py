# SPDX-License-Identifier: Apache-2.0
"""
Run every command that the documents print, as printed, in a clone made for it.

    ./fam shell
    python3 tests/walk_documents.py FOLDER --long

The clone is FOLDER/fam_bundle, made and set up if it is not there; logs and ``walk.json`` stand
beside it. Commands of ``ros2`` need the real command-line tools on the path, and a plain shell has
the network that ROS chooses: walk where none leads out of the machine. What is not run (a vendor's
card, a container engine, Ubuntu's packages) is listed with the reason, never counted as done.
Status 1 if a command did not end as the document lets one expect.
"""

import argparse
import json
import os
from pathlib import Path
import re
import shlex
import shutil
import signal
import subprocess
import sys
import time

from test_printed_commands import Command, printed, ROOT

CONTROLLERS = (
    'lag_table_server',
    'recruitment_supervisor',
    'strain_controller',
    'pressure_controller',
)
CONFIG = 'ros2_ws/src/fam_bundle_bringup/config'
SAMPLES = 'time,strain\n0.0,0.0\n1.0,0.05\n3.0,0.1\n5.0,0.02\n'
# Words that stand for something, and what for here.
STANDS_FOR = {'FILE': f'{CONFIG}/lhacd.yaml', 'NAME': 'volts', 'rig_zeroed.yaml': 'rig.yaml'}
NOT_HERE = {
    r'git clone|cd fam_bundle': 'the walk begins in a clone',
    r'source |(sudo )?rosdep |colcon build|pip3 ': 'needs Ubuntu with ROS 2 Jazzy',
    r'docker ': 'needs a container engine',
    r'pre-commit ': 'needs pre-commit, which the project does not install',
    r'ros2 launch foxglove_bridge': 'needs foxglove_bridge',
    r'\./fam shell': 'is interactive; the walk runs in one',
    r'export FASTRTPS_DEFAULT_PROFILES_FILE=/path': 'a path of the reader',
    r'python3 tests/walk_documents\.py': 'is this walk',
}
# What must be refused here, without a traceback, and the words that say why: no vendor's package
# is installed, and nobody sits at a terminal to agree that valves move.
REFUSED = {
    r'\./fam doctor --backend quanser': "vendor's SDK",
    r'\./fam check-channels --backend quanser': 'the valves were not told to move',
    r'\./fam zero --backend quanser': "vendor's SDK",
}
# Go on until told to end: the next commands are for a second terminal.
BESIDE = (
    r'(\./fam|ros2) run fam_bundle_control ',
    r'(\./fam|ros2) run fam_bundle_io (hardware_bridge|bag_recorder) ',
    r'ros2 launch .*(realtime|controllers)',
    r'ros2 bag record',
    r'\./fam experiment --pace realtime --composed',
    r'\./fam top',
    r'dask (scheduler|worker)',
)
LONG = (r'\./fam (test|faults)( +#|$)', r'colcon test', r'python3 studies/calibration')
# What the text before a command asks for, in further terminals.
FIRST = {
    r'ros2 run fam_bundle_io hardware_bridge': [
        f'ros2 run fam_bundle_control {name} --ros-args --params-file FILE -p run.pace:=realtime'
        for name in CONTROLLERS
    ],
    r'ros2 param describe': ['ros2 launch fam_bundle_bringup controllers.launch.py'],
}
SOURCED = ('colcon', 'dask', 'export', 'python', 'ros2')  # in a shell with the workspace
PROFILE_EXISTS = 'test -e "${FASTRTPS_DEFAULT_PROFILES_FILE:-/}"'
STARTING = 12.0  # s until what goes on in another terminal answers
WATCHED = 5.0  # s that it is watched at least
LIMIT = 3600.0  # s for a command


def reason_not_here(line: str) -> str | None:
    for pattern, reason in NOT_HERE.items():
        if re.match(pattern, line):
            return reason
    if line.startswith('ros2 ') and shutil.which('ros2') is None:
        return 'needs the ROS command line'
    return None


def any_of(patterns: tuple[str, ...], line: str) -> bool:
    return any(re.match(pattern, line) for pattern in patterns)


class Walk:
    """The clone, what runs beside, and what was found so far."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder / 'fam_bundle'
        self.logs = folder / 'logs'
        self.logs.mkdir(parents=True, exist_ok=True)
        self.rows: list[dict[str, object]] = []
        self.beside: list[tuple[Command, subprocess.Popen[bytes], float, Path]] = []
        self.before: list[str] = []  # lines that change the shell in which the next ones run

    def begin(self) -> None:
        """Clone and set up, and put the reader's own files there."""
        if not self.folder.exists():
            subprocess.run(['git', 'clone', '-q', str(ROOT), str(self.folder)], check=True)
        # What the documents belong to, without what an earlier walk left; what is ignored stays.
        for words in (['fetch', '-q', str(ROOT), 'HEAD'], ['reset', '-q', '--hard', 'FETCH_HEAD']):
            subprocess.run(['git', *words], cwd=self.folder, check=True)
        subprocess.run(['git', 'clean', '-fdq'], cwd=self.folder, check=True)
        parameters = (self.folder / CONFIG / 'lhacd.yaml').read_text()
        rig = (self.folder / CONFIG / 'volts_calibration.yaml').read_text()
        rig = rig.replace('simulated rig', 'rig 7')
        rig += '\nbackends: {quanser: {board_type: qpid_e}}\n' if '\nbackends:' not in rig else ''
        # The reader's own files.
        for name, text in {
            'mine.csv': SAMPLES,
            'other.yaml': parameters,
            'rig_config.yaml': parameters,
            'rig.yaml': rig,
        }.items():
            (self.folder / name).write_text(text)
        self.run(Command(ROOT / 'CONTRIBUTING.md', -1, './fam setup'))
        self.start_daemon()

    def start_daemon(self) -> None:
        """Let ROS's daemon run: for who has used `ros2` before, it does."""
        if shutil.which('ros2'):
            self.start(Command(ROOT, 0, 'ros2 daemon start'))[0].wait()

    def script(self, line: str) -> str:
        for word, value in STANDS_FOR.items():
            line = re.sub(rf'(?<!out )\b{word}\b', value, line)
        line = line.replace('/absolute/', f'{self.folder}/')
        needed = any(each.startswith(SOURCED) for each in (line, *self.before))
        sourced = '. ros2_ws/install/setup.sh' if needed else ':'
        path = f'export PATH={shlex.quote(str(self.folder / ".venv/bin"))}:$PATH'
        return '\n'.join([sourced, path, *self.before, f'exec {line}'])

    def start(self, command: Command) -> tuple[subprocess.Popen[bytes], Path]:
        log = self.logs / f'{len(self.rows):03d}.log'
        with log.open('wb') as output:
            process = subprocess.Popen(
                ['bash', '-c', self.script(command.line)],
                cwd=self.folder,
                env=environment(),
                stdin=subprocess.DEVNULL,
                stdout=output,
                stderr=subprocess.STDOUT,
                start_new_session=True,
            )
        return process, log

    def run(self, command: Command) -> None:
        """Run one command as printed, and note how it ended."""
        if re.match(r'cd |export |unset |[A-Z]+=', command.line):
            self.before.append(command.line)
            check = subprocess.run(
                ['bash', '-ec', self.script(PROFILE_EXISTS)],
                cwd=self.folder,
                env=environment(),
                check=False,
            )
            self.note(command, check.returncode == 0, f'status {check.returncode}', 0.0)
            return
        for pattern, lines in FIRST.items():
            if re.match(pattern, command.line):
                for line in lines:
                    self.run(command._replace(line=line))
        process, log = self.start(command)
        began = time.monotonic()
        # A plant without controllers waits for them.
        waits = 'plant_simulator' in command.line and not self.beside
        if waits or any_of(BESIDE, command.line):
            self.beside.append((command, process, began, log))
            self.rows.append({})  # keeps the number of its log
            time.sleep(STARTING)
            return
        try:
            status = process.wait(LIMIT)
        except BaseException as error:
            os.killpg(process.pid, signal.SIGKILL)
            status = process.wait()
            if not isinstance(error, subprocess.TimeoutExpired):
                raise
        text = log.read_text(errors='replace')
        lasted = time.monotonic() - began
        good = status == 0 and 'success=False' not in text
        for pattern, words in REFUSED.items():
            if re.match(pattern, command.line):
                good = status in (1, 2) and words in text
        self.note(command, good and 'Traceback' not in text, f'status {status}', lasted, log)

    def end_beside(self) -> None:
        """End what went on in other terminals, as Ctrl-C does."""
        for command, process, began, log in reversed(self.beside):
            time.sleep(max(0.0, began + STARTING + WATCHED - time.monotonic()))
            early = process.poll()
            if early is None:
                os.killpg(process.pid, signal.SIGINT)
            try:
                status = process.wait(60.0)
            except subprocess.TimeoutExpired:
                os.killpg(process.pid, signal.SIGKILL)
                status = process.wait()
            good = status == 0 if early is not None else status in (0, 130, -signal.SIGINT)
            said = f'status {status}' + (' at Ctrl-C' if early is None else '')
            # Dask has one of its own at Ctrl-C.
            ours = not command.line.startswith('dask')
            traced = ours and 'Traceback' in log.read_text(errors='replace')
            self.note(command, good and not traced, said, time.monotonic() - began, log)
        self.beside.clear()

    def note(
        self, command: Command, good: bool, said: str, lasted: float, log: Path | None = None
    ) -> None:
        document = command.document.relative_to(ROOT)
        row: dict[str, object] = {'document': str(document), 'command': command.line}
        row |= {'good': good, 'said': said, 'seconds': round(lasted, 1)}
        self.rows.append(row | {'log': str(log.name) if log else None})
        mark = 'ok  ' if good else 'FAIL'
        print(f'{mark} {lasted:7.1f} s  {said:18} {document}: {command.line}', flush=True)

    def leave_out(self, command: Command, reason: str) -> None:
        document = command.document.relative_to(ROOT)
        self.rows.append({'document': str(document), 'command': command.line, 'not_run': reason})
        print(f'not run    {reason}: {document}: {command.line}', flush=True)

    def restore(self) -> None:
        """Take back what a document changed in the sources, and put away its results."""
        self.before.clear()
        self.start_daemon()
        runs = self.folder / 'runs'
        if runs.exists():
            runs.rename(self.folder / f'runs_{len(self.rows)}')
        subprocess.run(['git', 'checkout', '-q', '.'], cwd=self.folder, check=True)


def environment() -> dict[str, str]:
    """Return the environment without what this very shell has of a workspace."""
    ours = ('AMENT_', 'CMAKE_PREFIX', 'COLCON_', 'ROS_', 'RMW_', 'FASTRTPS_', 'VIRTUAL_ENV')
    if 'ROS_DISTRO' in os.environ:  # an installation that is sourced, and has no workspace of ours
        return dict(os.environ)
    kept = {k: v for k, v in os.environ.items() if not k.startswith((*ours, '_ROS', 'LD_LIB'))}
    path = [p for p in kept['PATH'].split(':') if str(ROOT) not in p]
    kept.pop('PYTHONPATH', None)
    return kept | {'PATH': ':'.join(path)}


def walk(folder: Path, only: list[str], long: bool) -> int:
    made = Walk(folder)
    try:
        made.begin()
        follow(made, only, long)
    finally:
        made.end_beside()
        if shutil.which('ros2'):  # its daemon lives on by itself
            made.start(Command(ROOT, 0, 'ros2 daemon stop'))[0].wait()
        rows = [row for row in made.rows if row]
        (folder / 'walk.json').write_text(json.dumps(rows, indent=1))
    run = [row for row in rows if 'good' in row]
    failed = [row for row in run if not row['good']]
    print(f'{len(run)} run, {len(failed)} failed, {len(rows) - len(run)} not run here')
    return 1 if failed or not run else 0


def follow(made: Walk, only: list[str], long: bool) -> None:
    last: Command | None = None
    started_in = -1
    for command in printed():
        if not any(text in str(command.document) for text in only):
            continue
        if last and command.document != last.document:
            made.end_beside()
            made.restore()
        elif made.beside and command.block > started_in + 1:
            made.end_beside()
        last = command
        reason = reason_not_here(command.line)
        if reason is None and not long and any_of(LONG, command.line):
            reason = 'takes long'
        if reason:
            made.leave_out(command, reason)
            continue
        if any_of(BESIDE, command.line) and not made.beside:
            started_in = command.block
        made.run(command)


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.split('\n\n')[0])
    parser.add_argument('folder', type=Path, help='for the clone and the logs')
    parser.add_argument(
        '--only',
        nargs='+',
        default=[''],
        metavar='TEXT',
        help='documents whose path has one of these',
    )
    parser.add_argument('--long', action='store_true', help='also tests, faults and calibration')
    given = parser.parse_args()
    if subprocess.check_output(['git', 'status', '--porcelain'], cwd=ROOT):
        parser.error('the checkout has changes: commit them, for a clone of it is walked')
    # In the background of a shell it is ignored, and all that is started here would ignore it.
    signal.signal(signal.SIGINT, signal.default_int_handler)
    return walk(given.folder.resolve(), given.only, given.long)


if __name__ == '__main__':
    sys.exit(main())
