# SPDX-License-Identifier: Apache-2.0
"""The live view of the nodes: what it shows, which domain it finds, and what it hears."""

from collections.abc import Iterator
import itertools
import os
from pathlib import Path
import signal
import subprocess
import sys
import threading
import time

from fam_bundle_bringup.cli import main
from fam_bundle_bringup.domain_marker import chosen_domain, marked, marker_folder, Run, running
from fam_bundle_bringup.graph import own_domain
from fam_bundle_bringup.statistics_listener import Report, report_of
from fam_bundle_bringup.top import plain_line, view
from fam_bundle_model.schema import ConfigurationError
from fam_bundle_msgs.msg import LoopStatistics
from fam_bundle_node.qos import REPORTS
import pytest
import rclpy
from rclpy.node import Node
from rich.console import Console

NOW = 1000.0
REASON = 'safe: valve_command: no answer since tick 81234'
HOLD = """
import sys, time
from pathlib import Path
from fam_bundle_bringup.domain_marker import marked
with marked(int(sys.argv[1]), Path(sys.argv[2])):
    print('held', flush=True)
    time.sleep(60)
"""

Capture = pytest.CaptureFixture[str]


def report(node: str, state: str = 'running', age: float = 0.5, **changes: float) -> Report:
    message = LoopStatistics(
        node=node,
        state=state,
        rate=999.96,
        latency_p50=0.000151,
        latency_p99=0.000412,
        latency_max=0.00734,
        cpu_time_per_tick=0.000205,
        cpu_share=0.205,
        ticks=81234,
        **changes,
    )
    return report_of(message, NOW - age)


REPORTS_OF_FOUR = (
    report('/right/plant_simulator', REASON, overruns=3, skipped_periods=17),
    report('/right/pressure_controller', 'waiting for recruitment_state', late=5),
    report('/left/strain_controller', missing=4),
    report('/left/plant_simulator', age=12.4),
)


def shown(width: int, *reports: Report, height: int | None = None, color: bool = False) -> str:
    system = 'standard' if color else None
    console = Console(width=width, force_terminal=color, color_system=system)
    with console.capture() as capture:
        console.print(view(reports, NOW, 42, height))
    return capture.get()


# ---- What it shows ----


@pytest.mark.parametrize('width', [80, 160])
def test_nothing_is_cut(width: int) -> None:
    text = shown(width, *REPORTS_OF_FOUR)
    assert max(map(len, text.splitlines())) <= width
    assert '…' not in text
    for words in ('domain 42', 'running', 'waiting', 'safe', 'silent 12 s', '1000.0', '151'):
        assert words in text
    for words in ('412', '7340', '205', '20.5', '81234', '3 (17)'):
        assert words in text
    assert REASON in ' '.join(text.replace('/right/plant_simulator:', '').split())
    assert 'waiting for recruitment_state' in text


def first_words(text: str) -> list[str]:
    """Return the first word of each line of the first table."""
    table = text.split('\n\n')[1].splitlines()
    return [line.split()[0] for line in table[2:]]


def test_one_line_per_node_by_namespace() -> None:
    assert first_words(shown(160, *REPORTS_OF_FOUR)) == [
        '/left/plant_simulator',
        '/left/strain_controller',
        '/right/plant_simulator',
        '/right/pressure_controller',
    ]
    assert first_words(shown(80, *REPORTS_OF_FOUR)) == [
        *('/left', 'plant_simulator', 'strain_controller'),
        *('/right', 'plant_simulator', 'pressure_controller'),
    ]


def test_a_narrow_screen_counts_faults_where_there_are_any() -> None:
    table = shown(80, *REPORTS_OF_FOUR).split('\n\n')[-1].splitlines()
    assert [' '.join(line.split()) for line in table[2:]] == [
        '/left/strain_controller 0 (0) 4 0 0 0 0',
        '/right/plant_simulator 3 (17) 0 0 0 0 0',
        '/right/pressure_controller 0 (0) 0 0 0 5 0',
    ]
    assert shown(80, report('/plant')).splitlines()[-1].startswith('no overrun')


@pytest.mark.parametrize('width', [80, 160])
def test_counts_stand_below_their_titles(width: int) -> None:
    counts = {'missing': 11, 'duplicate': 22, 'order': 33, 'late': 44, 'refused': 55}
    changes = {'out_of_order' if name == 'order' else name: n for name, n in counts.items()}
    titles, line = shown(width, report('/plant', **changes)).splitlines()[-2:]
    for title, count in counts.items():
        assert line[: titles.index(title) + len(title)].endswith(f' {count}')


def test_states_have_their_colours() -> None:
    text = shown(160, *REPORTS_OF_FOUR, color=True)
    assert '\x1b[32mrunning' in text
    assert '\x1b[33mwaiting' in text
    assert '\x1b[1;31msafe' in text
    assert '\x1b[1;31mtrouble' in shown(160, report('/plant', 'tick 7 came twice'), color=True)
    assert '31msilent 12 s' in text


def test_a_node_that_fell_silent_still_tells_what_it_said_last() -> None:
    text = shown(160, report('/plant', REASON, age=3.5))
    assert 'silent 4 s' in text
    assert f'last said: {REASON}' in text
    assert 'silent' not in shown(160, report('/plant', age=2.9))


def test_what_was_not_measured_is_a_dash() -> None:
    nan = float('nan')
    idle = report('/lag_table_server')._replace(
        rate=0.0, latency_p50=nan, latency_p99=nan, latency_max=nan, cpu_time_per_tick=0.0
    )
    assert shown(160, idle).splitlines()[-1].split()[:7] == [
        *('/lag_table_server', 'running', '0.0'),
        *('-', '-', '-', '-'),
    ]


def test_a_low_screen_says_what_it_hides() -> None:
    whole = shown(80, *REPORTS_OF_FOUR).splitlines()
    low = shown(80, *REPORTS_OF_FOUR, height=8).splitlines()
    assert low[:7] == whole[:7]
    assert low[7:] == [f'{len(whole) - 7} more lines: the terminal is too low']
    assert shown(80, *REPORTS_OF_FOUR, height=len(whole)).splitlines() == whole


def test_a_text_cannot_steer_the_terminal() -> None:
    nasty = report('/plant', 'bad\x1b[2J [red]value[/red]\nof tick 5')
    for text in (plain_line(nasty), shown(160, nasty)):
        assert '\x1b' not in text
        assert 'bad [2J [red]value[/red] of tick 5' in text


def test_a_plain_line_holds_everything() -> None:
    line = plain_line(REPORTS_OF_FOUR[0])
    for words in ('/right/plant_simulator', 'p99_us=412', 'overruns=3/17', 'cpu_percent=20.5'):
        assert f' {words} ' in line
    assert line.endswith(f' state={REASON}')


def test_a_reader_that_leaves_is_no_error() -> None:
    script = (
        'import math, test_top\n'
        'from fam_bundle_bringup.top import print_lines\n'
        'print_lines(lambda _: [test_top.report("/plant")] * 1000, math.inf)'
    )
    environment = {**os.environ, 'PYTHONPATH': f'{Path(__file__).parent}:{_python_path()}'}
    process = subprocess.Popen(
        [sys.executable, '-c', script],
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        env=environment,
    )
    assert process.stdout is not None and process.stderr is not None
    assert b'/plant' in process.stdout.readline()
    process.stdout.close()
    assert process.stderr.read() == b''
    assert process.wait(30.0) == 0


def _python_path() -> str:
    return os.environ.get('PYTHONPATH', '')


# ---- Which domain ----


def test_a_marker_is_there_while_its_run_is(tmp_path: Path) -> None:
    folder = tmp_path / 'markers'
    assert running(folder) == []
    with marked(7, folder):
        assert folder.stat().st_mode & 0o777 == 0o700
        assert running(folder) == [Run(7, os.getpid())]
        assert chosen_domain({}, folder) == 7
    assert list(folder.iterdir()) == []
    assert chosen_domain({}, folder) is None


def test_own_domain_is_marked() -> None:
    with own_domain() as domain:
        assert Run(domain, os.getpid()) in running()
    assert Run(domain, os.getpid()) not in running()


def test_a_marker_whose_process_was_killed_counts_no_longer(tmp_path: Path) -> None:
    process = subprocess.Popen(
        [sys.executable, '-c', HOLD, '7', str(tmp_path)], stdout=subprocess.PIPE
    )
    assert process.stdout is not None
    assert process.stdout.readline() == b'held\n'
    assert running(tmp_path) == [Run(7, process.pid)]
    with marked(8, tmp_path), pytest.raises(ConfigurationError) as refusal:
        chosen_domain({}, tmp_path)
    for words in (f'7 (process {process.pid})', f'8 (process {os.getpid()})', '--domain'):
        assert words in str(refusal.value)
    process.kill()
    process.communicate()
    assert (tmp_path / 'domain-7').exists()
    assert running(tmp_path) == []
    with marked(7, tmp_path):
        assert running(tmp_path) == [Run(7, os.getpid())]


def test_a_folder_of_somebody_else_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    somebody = os.getuid() + 1
    with monkeypatch.context() as patch:
        patch.setattr('fam_bundle_bringup.domain_marker.os.getuid', lambda: somebody)
        with pytest.raises(PermissionError, match=str(tmp_path)):
            running(tmp_path)
        with marked(7, tmp_path):  # the run itself goes on
            assert list(tmp_path.iterdir()) == []
    assert capsys.readouterr().err.count('\n') == 1
    link = tmp_path / 'link'
    link.symlink_to(tmp_path)
    with pytest.raises(PermissionError):
        running(link)
    assert str(os.getuid()) in marker_folder().name


def test_the_environment_comes_first(tmp_path: Path) -> None:
    with marked(7, tmp_path):
        assert chosen_domain({'ROS_DOMAIN_ID': '9'}, tmp_path) == 9
        assert chosen_domain({'ROS_DOMAIN_ID': ''}, tmp_path) == 7
        with pytest.raises(ConfigurationError, match=r'ROS_DOMAIN_ID = .x.: .* 232'):
            chosen_domain({'ROS_DOMAIN_ID': 'x'}, tmp_path)


@pytest.mark.parametrize(
    ('option', 'value'),
    [
        *(('--domain', value) for value in ('-1', '233', 'x', '1.5', '')),
        *(('--seconds', value) for value in ('0', '-1', 'nan', 'x')),
    ],
)
def test_a_bad_option_is_refused_in_one_line(option: str, value: str, capsys: Capture) -> None:
    with pytest.raises(SystemExit) as end:
        main(['top', f'{option}={value}'])
    message = capsys.readouterr().err
    assert end.value.code == 2
    assert message.count('\n') == 1
    assert option in message and f"'{value}'" in message


# ---- What it hears ----


@pytest.fixture
def domain() -> Iterator[int]:
    """Return a domain in which a node of this process may be."""
    with own_domain() as number:
        rclpy.init(args=[])
        try:
            yield number
        finally:
            rclpy.try_shutdown()


def top(*arguments: str) -> 'subprocess.Popen[str]':
    return subprocess.Popen(
        [sys.executable, '-m', 'fam_bundle_bringup.cli', 'top', *arguments],
        stdin=subprocess.DEVNULL,
        stdout=subprocess.PIPE,
        stderr=subprocess.PIPE,
        text=True,
    )


class Publishing:
    """Publishes a report of one node in each namespace, the second a second later."""

    def __init__(self) -> None:
        self.node = Node('test')
        self.over = threading.Event()
        self.thread = threading.Thread(target=self.publish)

    def publish(self) -> None:
        publishers = {}
        for step in itertools.count():
            if step in (0, 10):
                name = '/right' if step else '/left'
                topic = f'{name}/loop_statistics'
                publishers[name] = self.node.create_publisher(LoopStatistics, topic, REPORTS)
            for name, publisher in publishers.items():
                publisher.publish(LoopStatistics(node=f'{name}/plant', state='running'))
            if self.over.wait(0.1):
                return

    def __enter__(self) -> None:
        self.thread.start()

    def __exit__(self, *_: object) -> None:
        self.over.set()
        self.thread.join()
        self.node.destroy_node()


@pytest.mark.parametrize('number', [signal.SIGINT, signal.SIGTERM])
def test_lines_of_every_namespace_until_a_signal_ends_it(domain: int, number: int) -> None:
    missing = {'/left/plant', '/right/plant'}
    with Publishing():
        process = top('--domain', str(domain), '--seconds', '60')
        assert process.stdout is not None
        for line in process.stdout:
            missing -= set(line.split())
            assert line.endswith(' state=running\n')
            if not missing:
                process.send_signal(number)
                break
        _, err = process.communicate(timeout=30.0)
    assert not missing
    assert (process.returncode, err) == (0, '')


def test_it_ends_by_itself(domain: int) -> None:
    begin = time.monotonic()
    process = top('--domain', str(domain), '--seconds', '0.5')
    assert process.communicate(timeout=60.0) == ('', '')
    assert process.returncode == 0
    assert time.monotonic() > begin + 0.5
