# SPDX-License-Identifier: Apache-2.0
"""The study file: what is read, what is refused, and which cases it makes."""

from collections.abc import Callable
import itertools
from pathlib import Path
import re
import runpy

from fam_bundle_bringup.cli import main, parser
from fam_bundle_bringup.study import Case, cases_of, Range, read_study, Sample, sampled
from fam_bundle_model.schema import ConfigurationError
from hypothesis import given, settings
from hypothesis import strategies as st
import numpy as np
import pytest

ROOT = Path(__file__).resolve().parents[1]
README = ROOT / 'ros2_ws' / 'src' / 'fam_bundle_bringup' / 'README.md'

Write = Callable[[str], Path]


@pytest.fixture
def write(tmp_path: Path) -> Write:
    def written(text: str) -> Path:
        path = tmp_path / 'mine.yaml'
        path.write_text(text)
        return path

    return written


def cases(path: Path) -> list[Case]:
    return cases_of(read_study(path))


# ---- Cases ----


def test_cases_are_sample_by_grid_by_schemes(write: Write) -> None:
    found = cases(
        write("""
        changes: {reference.cycles: 3}
        schemes: [baseline, lag]
        grid:
          reference.amplitude: [0.04, 0.05]
          way:
            slow: {reference.frequency: 0.1}
            fast: {reference.frequency: 0.3, recruitment.minimum_dwell: 0.1}
        sample: {number: 3, seed: 1, ranges: {load.mass: [15, 20]}}
        """)
    )
    masses = list(dict.fromkeys(case.values['load.mass'] for case in found))
    assert len(masses) == 3
    made = [
        (
            case.values['load.mass'],
            case.values['reference.amplitude'],
            case.labels['way'],
            case.scheme,
        )
        for case in found
    ]
    ways, schemes = ('slow', 'fast'), ('baseline', 'lag')
    assert made == list(itertools.product(masses, (0.04, 0.05), ways, schemes))
    for case in found:
        assert case.setting is not None and case.situation is not None
        assert case.setting.believed.reference.cycles == 3
        assert case.setting.believed.load.mass == case.values['load.mass']
        assert case.setting.believed.recruitment.scheme == case.scheme
        slow = case.labels['way'] == 'slow'
        assert case.setting.believed.reference.frequency == (0.1 if slow else 0.3)
        # What a label leaves alone is as it was, and stands in the table.
        dwell = case.values['recruitment.minimum_dwell']
        assert dwell == case.setting.believed.recruitment.minimum_dwell == (0.3 if slow else 0.1)
        first = found[0].situation.believed.recruitment
        assert case.situation.believed.recruitment.scheme == first.scheme


def test_schemes_can_be_named_and_change_anything(write: Write) -> None:
    found = cases(
        write("""
        schemes:
          plain: {recruitment.scheme: baseline}
          early: {recruitment.scheme: baseline, recruitment.upshift_threshold: 0.6}
        """)
    )
    assert [case.scheme for case in found] == ['plain', 'early']
    thresholds = [case.setting.believed.recruitment.upshift_threshold for case in found]
    assert thresholds == [0.8, 0.6]
    assert found[1].situation.believed.recruitment.upshift_threshold == 0.8


def test_parameter_file_lies_beside_the_study_file(write: Write, tmp_path: Path) -> None:
    source = ROOT / 'ros2_ws/src/fam_bundle_bringup/config/lhacd.yaml'
    text = source.read_text().replace('mass: 18.8', 'mass: 12.5')
    (tmp_path / 'mine_too.yaml').write_text(text)
    (found,) = cases(write('config: mine_too.yaml'))
    assert found.setting.believed.load.mass == 12.5


def test_what_is_impossible_only_together_is_kept_with_its_reason(write: Write) -> None:
    found = cases(
        write("""
        grid:
          recruitment.upshift_threshold: [0.5, 0.8]
          recruitment.downshift_threshold: [0.4, 0.6]
        """)
    )
    impossible = [case for case in found if case.setting is None]
    assert len(found) == 4
    assert [list(case.values.values())[:2] for case in impossible] == [[0.5, 0.6]]
    assert 'must be < recruitment.upshift_threshold = 0.5' in impossible[0].reason


def test_example_in_the_readme_is_a_study(tmp_path: Path) -> None:
    (block,) = re.findall(r'```yaml\n(config: .*?)```', README.read_text(), re.DOTALL)
    config = ROOT / 'ros2_ws/src/fam_bundle_bringup/config/three_units.yaml'
    (tmp_path / 'three_units.yaml').write_bytes(config.read_bytes())
    (tmp_path / 'mine.yaml').write_text(block)
    found = cases(tmp_path / 'mine.yaml')
    assert len(found) == 100 * 2 * 2 * 2
    assert all(case.setting is not None for case in found)


@pytest.mark.parametrize('path', sorted((ROOT / 'studies').glob('*.yaml')), ids=lambda p: p.name)
def test_study_files_of_the_project_can_be_read(path: Path) -> None:
    assert cases(path)


# ---- The random sample ----


@settings(max_examples=40, deadline=None)
@given(number=st.integers(1, 60), seed=st.integers(0, 2**31 - 1))
def test_each_part_of_each_range_holds_one_point(number: int, seed: int) -> None:
    ranges = {
        'load.mass': Range(10.0, 30.0, False),
        'hose.length': Range(0.01, 10.0, True),
    }
    points = list(sampled(Sample(number, seed, ranges)))
    mass = np.array([point['load.mass'] for point in points])
    length = np.array([point['hose.length'] for point in points])
    parts = np.floor((mass - 10.0) / 20.0 * number).astype(int)
    assert sorted(parts.tolist()) == list(range(number))
    parts = np.floor((np.log10(length) + 2.0) / 3.0 * number).astype(int)
    assert sorted(parts.tolist()) == list(range(number))
    assert points == list(sampled(Sample(number, seed, ranges)))


def test_another_seed_gives_another_sample() -> None:
    ranges = {'load.mass': Range(10.0, 30.0, False)}
    assert list(sampled(Sample(5, 1, ranges))) != list(sampled(Sample(5, 2, ranges)))


def test_whole_numbers_are_equally_frequent_and_within_their_range() -> None:
    ranges = {'simulation.substeps': Range(2, 5, False)}
    drawn = [point['simulation.substeps'] for point in sampled(Sample(400, 3, ranges))]
    assert {drawn.count(value) for value in (2, 3, 4, 5)} == {100}


# ---- What is refused ----

REFUSED = [
    ('', 'study = None: must be a mapping'),
    ('[1, 2]', 'must be a mapping'),
    ('grid: {a: b: c}', 'not YAML'),
    ('gird: {}', 'gird: no such entry; did you mean grid?'),
    ('config: no.yaml', 'no.yaml: cannot be read'),
    ('config: [1]', 'config = [1]: must be the name of a file'),
    ('changes: {load.mas: 1}', 'changes: load.mas: no such parameter; did you mean load.mass?'),
    ('changes: {load: {mass: 1}}', 'changes: load: no such parameter'),
    ('changes: {load.mass: -1}', 'changes: load.mass = -1 kg: must be > 0'),
    ('changes: {run.pace: realtime}', 'changes: run.pace: changes no offline run'),
    ('changes: [load.mass]', 'changes = '),
    ('schemes: []', 'schemes: must hold at least one value'),
    ('schemes: [lag, lag]', 'schemes: holds a value twice'),
    ('schemes: [fast]', 'recruitment.scheme = fast: must be one of baseline, lag'),
    ('schemes: {mine: {load.mass: x}}', 'schemes: mine: load.mass = x kg: must be > 0'),
    ('grid: {load.mass: []}', 'grid: load.mass: must hold at least one value'),
    ('grid: {load.mass: [1, 2, 1.0]}', 'grid: load.mass: holds a value twice'),
    ('grid: {load.mass: [1, nan]}', 'grid: load.mass: load.mass = nan kg'),
    ('grid: {recruitment.scheme: [lag]}', 'grid: schemes have an entry of their own'),
    ('grid: {mine: [1, 2]}', 'grid: mine: mine: no such parameter'),
    ('grid: {mine: {}}', 'grid: mine: must hold at least one value'),
    ('grid: {mine: {a: {load.mass: 0}}}', 'grid: mine: a: load.mass = 0 kg: must be > 0'),
    ('grid: {a.b: {a: {load.mass: 1}}}', 'grid: a.b: the name of an axis with labels has no dot'),
    ('grid: {load.mass: [1], load.mass: [2]}', 'load.mass: stands twice'),
    ('{changes: {load.mass: 1}, grid: {load.mass: [1]}}', 'load.mass: is set by changes too'),
    (
        '{grid: {a: {x: {load.mass: 1}}, load.mass: [2]}}',
        'grid: load.mass: load.mass: is set by grid: a too',
    ),
    ('sample: {number: 3}', 'sample: seed: missing'),
    (
        'sample: {number: 0, seed: 1, ranges: {load.mass: [1, 2]}}',
        'sample: number = 0: must be >=',
    ),
    ('sample: {number: 2, seed: x, ranges: {load.mass: [1, 2]}}', 'sample: seed = x'),
    ('sample: {number: 2, sed: 1, ranges: {}}', 'sample: sed: no such entry; did you mean'),
    ('sample: {number: 2, seed: 1, ranges: {}}', 'must hold at least one parameter'),
    ('sample: {number: 2, seed: 1, ranges: {load.mass: [2, 1]}}', 'must be low < high'),
    ('sample: {number: 2, seed: 1, ranges: {load.mass: [1]}}', 'must be [low, high]'),
    ('sample: {number: 2, seed: 1, ranges: {load.mass: [1, 2, lag]}}', 'must be [low, high]'),
    ('sample: {number: 2, seed: 1, ranges: {load.mass: [0, 2]}}', 'load.mass = 0 kg: must be > 0'),
    (
        'sample: {number: 2, seed: 1, ranges: {load.damping: [0, 2, log]}}',
        'must be 0 < low < high',
    ),
    (
        'sample: {number: 2, seed: 1, ranges: {recruitment.scheme: [a, b]}}',
        'is no number; name its values under grid',
    ),
    ('changes: {rig.load.mas: 1}', 'changes: load.mas: no such parameter; did you mean'),
    ('changes: {rig.load.mass: 0}', 'rig.load.mass = 0 kg: must be > 0'),
    ('grid: {rig.recruitment.minimum_dwell: [1]}', 'a rig has no such parameter'),
    ('rivals: [me]', 'rivals = me: must be one of best_threshold, always_recruited'),
    ('rivals: [best_threshold, best_threshold]', 'rivals = best_threshold: stands twice'),
    ('heat_map: [load.mass, scheme]', 'heat_map = load.mass: must be one of scheme'),
    ('heat_map: [scheme]', 'heat_map = scheme: must be two axes'),
    (
        'sample: {number: 50001, seed: 1, ranges: {load.mass: [1, 2]}}\nschemes: [lag, pressure]',
        '100002 cases: must be <= 100000',
    ),
]


@pytest.mark.parametrize(('text', 'words'), REFUSED)
def test_bad_study_is_refused_before_anything_runs(
    text: str, words: str, write: Write, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    path = write(text)
    assert main(['study', str(path), '--out', str(tmp_path / 'out')]) == 2
    message = capsys.readouterr().err
    assert message.count('\n') == 1, message
    assert message.startswith(f'fam study: {path}: ')
    assert words in message
    assert not (tmp_path / 'out').exists()


WORDS = st.sampled_from(['grid', 'sample', 'load.mass', 'number', 'ranges', 'schemes', 'lag'])
LEAVES = st.none() | st.booleans() | st.integers(-3, 3) | st.floats() | WORDS
TREES = st.recursive(
    LEAVES, lambda inner: st.lists(inner, max_size=3) | st.dictionaries(WORDS | LEAVES, inner)
)


@settings(max_examples=80, deadline=None)
@given(TREES)
def test_any_other_content_is_refused_in_one_line_or_is_a_study(
    tmp_path_factory: pytest.TempPathFactory, content: object
) -> None:
    import yaml

    path = tmp_path_factory.getbasetemp() / 'any.yaml'
    path.write_text(yaml.safe_dump(content))
    try:
        found = cases(path)
    except ConfigurationError as error:
        assert '\n' not in str(error)
    else:
        assert found


@pytest.mark.parametrize(
    ('arguments', 'words'),
    [
        (['nothing.yaml'], 'nothing.yaml: cannot be read (No such file or directory)'),
        (['/'], '/: cannot be read'),
        (['x', '--workers', '0'], "--workers: '0': must be an integer from 1"),
        (['x', '--workers', 'all'], "--workers: 'all': must be an integer from 1"),
        (['x', '--dask', 'tcp://127.0.0.1:1', '--workers', '2'], '--workers: a Dask cluster'),
        ([], 'FILE'),
    ],
)
def test_bad_option_is_refused_in_one_line(
    arguments: list[str], words: str, capsys: pytest.CaptureFixture[str]
) -> None:
    try:
        status = main(['study', *arguments])
    except SystemExit as end:  # by the parser
        status = end.code
    message = capsys.readouterr().err
    assert status == 2
    assert message.count('\n') == 1, message
    assert words in message


def test_help_names_every_option(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        parser().parse_args(['study', '--help'])
    text = capsys.readouterr().out
    for word in ('FILE', '--out', '--workers', '--dask', '--csv', '--figures-only'):
        assert word in text


@pytest.mark.parametrize(
    'path', sorted((ROOT / 'studies').glob('*.yaml')), ids=lambda path: path.stem
)
def test_every_study_that_is_shipped_can_be_run(path: Path) -> None:
    found = cases_of(read_study(path))
    assert found
    assert not [case.reason for case in found if case.setting is None]


def test_table_of_chatter_counts_cases_by_allocation_and_noise(tmp_path: Path) -> None:
    import pandas as pd

    columns = ['recruitment.scheme', 'allocation.policy', 'sensors.strain_noise']
    cases = [
        ('lag', 'force', 1e-4, 5, 'ok'),
        ('lag', 'force', 1e-4, 0, 'ok'),
        ('lag', 'force', 1e-4, 1, 'ok'),
        ('lag', 'batch', 0.0, 0, 'ok'),
        ('lag', 'batch', 0.0, None, 'diverged'),
        ('baseline', 'batch', 0.0, 2, 'ok'),
    ]
    rows = pd.DataFrame(cases, columns=[*columns, 'needless_shifts', 'status'])
    (tmp_path / 'chatter').mkdir()
    rows.to_parquet(tmp_path / 'chatter' / 'study.parquet')
    tables = runpy.run_path(str(ROOT / 'studies' / 'tables.py'))
    assert tables['chatter'](tmp_path).splitlines() == [
        '| scheme | batch, noise 0 | force, noise 0.0001 |',
        '| --- | --- | --- |',
        '| lag | 0 of 1 | 2 of 3 |',
        '| baseline | 1 of 1 | - |',
    ]
