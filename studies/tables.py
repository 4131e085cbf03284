#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""
Prints the tables of docs/studies.md from the results of the studies.

python studies/tables.py runs/study     # the folder that holds grid, references, ...
"""

from collections.abc import Callable, Sequence
from pathlib import Path
import sys

import pandas as pd

SINGLE = ('iae', 'max_error')
Rows = pd.DataFrame


def load(folder: Path, study: str) -> Rows:
    """Return the cases of a study that ran."""
    rows = pd.read_parquet(folder / study / 'study.parquet')
    return rows[rows.status == 'ok']


def markdown(head: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    """Return a table."""
    lines = ['| ' + ' | '.join(row) + ' |' for row in (head, ['---'] * len(head), *rows)]
    return '\n'.join(lines)


COLOURS = '#D55E00, #0072B2, #009E73, #E69F00, #56B4E9'
NAMES = ('vermilion', 'blue', 'green', 'orange', 'light blue')


def chart(
    title: str, x: tuple[str, Sequence[str]], unit: str, lines: dict[str, Sequence[float]]
) -> str:
    """Return a line chart for Mermaid, and under it what its colours are: it knows no legend."""
    told = ', '.join(f'{colour}: {name}' for name, colour in zip(lines, NAMES, strict=False))
    labels = ', '.join(f'"{label}"' for label in x[1])
    top = 1.05 * max(max(values) for values in lines.values())
    drawn = [f'    line [{", ".join(f"{v:.4g}" for v in values)}]' for values in lines.values()]
    return '\n'.join(
        [
            '```mermaid',
            '%%{init: {"themeVariables": {"xyChart": {"plotColorPalette": "' + COLOURS + '"}}}}%%',
            'xychart-beta',
            f'    title "{title}"',
            f'    x-axis "{x[0]}" [{labels}]',
            f'    y-axis "{unit}" 0 --> {top:.2g}',
            *drawn,
            '```',
            f'*{told}*',
        ]
    )


def numbered(count: int) -> list[str]:
    """Return the numbers of the rows of a table: its labels would not fit under a chart."""
    return [str(k) for k in range(1, count + 1)]


def both(rows: Rows, names: Sequence[str] = SINGLE) -> str:
    """Return medians of two columns as one cell."""
    return ' / '.join(f'{rows[name].median():.4f}' for name in names)


def ratios(rows: Rows, rival: str) -> list[str]:
    """Return median and worst ratio of both columns to a rival, and the share that is as good."""
    names = [f'{rival}.{name}_ratio' for name in SINGLE]
    known = rows.dropna(subset=names)
    good = (known[names] <= 1.0).all(axis=1).mean()
    return [
        ' / '.join(f'{known[name].median():.2f}' for name in names),
        ' / '.join(f'{known[name].max():.2f}' for name in names),
        f'{good:.0%} of {len(known)}',
    ]


def against_rivals(rows: Rows) -> str:
    """Return each scheme against both rivals, with its chatter and its efficiency."""
    head = [
        'scheme',
        'to the best threshold: median (IAE / maximum)',
        'worst',
        'both at most 1',
        'to all units: median',
        'worst',
        'efficiency, median',
        'cases with needless shifts',
    ]
    table = []
    for scheme, found in rows.groupby('scheme', sort=False):
        to_all = ratios(found, 'always_recruited')[:2]
        table.append(
            [
                str(scheme),
                *ratios(found, 'best_threshold'),
                *to_all,
                f'{found.efficiency.median():.1%}',
                f'{(found.needless_shifts > 0).sum()} of {len(found)}',
            ]
        )
    return markdown(head, table)


def heat_map(rows: Rows, scheme: str, name: str, across: str, down: str) -> str:
    """Return one scheme's numbers over two axes."""
    found = rows[rows.scheme == scheme].pivot_table(index=down, columns=across, values=name)
    head = [f'{down.split(".")[-1]} \\ {across.split(".")[-1]}', *(f'{c:g}' for c in found)]
    return markdown(head, [[f'{i:g}', *(f'{v:.2f}' for v in row)] for i, row in found.iterrows()])


def grid(folder: Path) -> str:
    """Return what the grid says."""
    rows = load(folder, 'grid')
    axes = ('reference.amplitude', 'reference.frequency')
    parts = [against_rivals(rows)]
    for scheme in ('lag_pressure', 'force'):
        for name in SINGLE:
            parts.append(f'{scheme}, {name} over that of the best threshold:')
            parts.append(heat_map(rows, scheme, f'best_threshold.{name}_ratio', *axes))
    at = rows[rows['reference.amplitude'] == 0.06]
    lines = {
        scheme: (100.0 * at[at.scheme == scheme].max_error).tolist()
        for scheme in ('baseline', 'lag_pressure', 'force')
    }
    rival = at[at.scheme == 'baseline']['best_threshold.max_error']
    lines['best threshold'] = (100.0 * rival).tolist()
    frequencies = [f'{f:g}' for f in sorted(at['reference.frequency'].unique())]
    title = 'Maximum error at amplitude 0.06'
    parts.append(chart(title, ('frequency (Hz)', frequencies), 'error (% strain)', lines))
    base = rows[rows.scheme == 'baseline'].set_index(list(axes))
    for scheme in ('lag', 'lag_pressure'):
        found = rows[rows.scheme == scheme].set_index(list(axes))
        worse = {n: found[found[n] > base[n]].index.tolist() for n in SINGLE}
        parts.append(f'{scheme} is worse than baseline at (amplitude, frequency): {worse}')
    return '\n\n'.join(parts)


def references(folder: Path) -> str:
    """Return what the other references say."""
    rows = load(folder, 'references')
    schemes = rows.scheme.unique()
    table = []
    for label, found in rows.groupby('reference', sort=False):
        cells = []
        for scheme in schemes:
            one = found[found.scheme == scheme]
            up = int(one.upshifts.iloc[0])
            cells.append(f'{both(one)}, {up}')
        best = found.iloc[0]
        rival = '-'
        if best['best_threshold.iae'] == best['best_threshold.iae']:
            rival = ' / '.join(f'{best[f"best_threshold.{n}"]:.4f}' for n in SINGLE)
            rival += f' at {best["best_threshold.threshold"]:.0%}'
        table.append([str(label), *cells, rival])
    head = ['reference', *schemes, 'best threshold']
    lines = {
        scheme: rows[rows.scheme == scheme]['best_threshold.max_error_ratio'].tolist()
        for scheme in ('lag_pressure', 'force', 'orderly')
    }
    labels = numbered(rows.reference.nunique())
    title = 'Maximum error over that of the best threshold'
    drawn = chart(title, ('reference, as in the first table', labels), 'ratio', lines)
    return '\n\n'.join([markdown(head, table), against_rivals(rows), drawn])


def prediction(folder: Path) -> str:
    """Return the predictors' tracking over constant rate's on the same reference."""
    rows = load(folder, 'prediction')
    keys = ['sensors.strain_noise', 'reference']
    table = []
    for noise in rows['sensors.strain_noise'].unique():
        for suffix in ('', ', force'):
            base = rows[rows.scheme == f'constant rate{suffix}'].set_index(keys)
            for name in ('acceleration', 'sinusoid', 'preview'):
                found = rows[rows.scheme == f'{name}{suffix}'].set_index(keys)
                here = [k for k in found.index if k[0] == noise]
                cells = []
                for sines in (True, False):
                    some = [k for k in here if k[1].startswith('sine') == sines]
                    for column in SINGLE:
                        ratio = found.loc[some, column] / base.loc[some, column]
                        cells.append(
                            f'{ratio.median():.3f} ({ratio.min():.2f} to {ratio.max():.2f})'
                        )
                chatter = int((found.loc[here, 'needless_shifts'] > 0).sum())
                before = int((base.loc[here, 'needless_shifts'] > 0).sum())
                table.append([f'{noise:g}', f'{name}{suffix}', *cells, f'{chatter} ({before})'])
    head = ['noise', 'predictor', 'sines: IAE', 'maximum', 'others: IAE', 'maximum']
    clean = rows[rows['sensors.strain_noise'] == 0.0]
    base = clean[clean.scheme == 'constant rate'].set_index('reference').max_error
    lines = {
        name: (clean[clean.scheme == name].set_index('reference').max_error / base).tolist()
        for name in ('acceleration', 'sinusoid', 'preview')
    }
    title = 'lag_pressure, no noise: maximum error over that at constant rate'
    x = ('reference, as in the study file', numbered(len(base)))
    drawn = chart(title, x, 'ratio', lines)
    table_text = markdown([*head, 'cases with needless shifts (constant rate)'], table)
    return '\n\n'.join([table_text, drawn])


def wrong_model(folder: Path) -> str:
    """Return what a wrong model leaves."""
    rows = load(folder, 'wrong_model')
    parts = []
    for label, found in rows.groupby('reference', sort=False):
        table = []
        for scheme, one in found.groupby('scheme', sort=False):
            table.append(
                [
                    str(scheme),
                    both(one),
                    ' / '.join(f'{one[n].quantile(0.9):.4f}' for n in SINGLE),
                    ' / '.join(f'{one[n].max():.4f}' for n in SINGLE),
                    f'{(one.needless_shifts > 0).sum()} of {len(one)}',
                ]
            )
        head = ['scheme', 'median IAE / maximum', '90 %', 'worst']
        head += ['cases with needless shifts']
        parts += [f'{label}:', markdown(head, table)]
        shares = [k / 10.0 for k in range(11)]
        lines = {
            scheme: [100.0 * found[found.scheme == scheme].max_error.quantile(q) for q in shares]
            for scheme in ('threshold_54', 'lag_pressure', 'force', 'reserve')
        }
        percent = [f'{q:.0%}' for q in shares]
        title = f'Maximum error, {label}'
        parts.append(chart(title, ('share of the rigs', percent), 'error (% strain)', lines))
        force = found[found.scheme == 'force']
        varied = [c for c in rows.columns if c.startswith('rig.')]
        for name in SINGLE:
            ranks = {c: force[c].astype(float).corr(force[name], 'spearman') for c in varied}
            largest = sorted(ranks, key=lambda c: -abs(ranks[c]))[:4]
            told = ', '.join(f'{c.removeprefix("rig.")} {ranks[c]:+.2f}' for c in largest)
            parts.append(f'force, {name}, rank correlations: {told}')
    return '\n\n'.join(parts)


def reserve(folder: Path) -> str:
    """Return tracking and efficiency over the reserve."""
    rows = load(folder, 'reserve')
    parts = []
    for label, found in rows.groupby('reference', sort=False):
        schemes = list(found.scheme.unique())
        table = []
        for kept, one in found.groupby('recruitment.reserve'):
            cells = [
                f'{both(one[one.scheme == s])}, {one[one.scheme == s].efficiency.iloc[0]:.1%}'
                for s in schemes
            ]
            table.append([f'{kept / 1e3:g}', *cells])
        parts += [f'{label}:', markdown(['reserve (kPa)', *schemes], table)]
        rising = found.sort_values('recruitment.reserve')
        kept = [f'{k / 1e3:g}' for k in rising['recruitment.reserve'].unique()]
        lines = {
            scheme: (100.0 * rising[rising.scheme == scheme].max_error).tolist()
            for scheme in ('lag_pressure', 'force')
        }
        parts.append(chart(f'Maximum error, {label}', ('reserve (kPa)', kept), '% strain', lines))
    return '\n\n'.join(parts)


def ladder(folder: Path) -> str:
    """Return tracking and efficiency over the units that eight FAMs are split into."""
    rows = load(folder, 'ladder')
    parts = []
    for label, found in rows.groupby('reference', sort=False):
        schemes = list(found.scheme.unique())
        table = []
        for bundle, one in found.groupby('bundle', sort=False):
            cells = []
            for scheme in schemes:
                row = one[one.scheme == scheme].iloc[0]
                tracked = f'{row.iae:.4f} / {row.max_error:.4f}'
                cells.append(f'{tracked}, {row.efficiency:.1%}, {row.upshifts:.0f}')
            table.append([str(bundle), *cells])
        parts += [f'{label}:', markdown(['bundle', *schemes], table)]
        lines = {
            scheme: (100.0 * found[found.scheme == scheme].efficiency).tolist()
            for scheme in ('baseline', 'lag_pressure', 'orderly')
        }
        bundles = [str(bundle) for bundle in found.bundle.unique()]
        parts.append(chart(f'Efficiency, {label}', ('motor units', bundles), '%', lines))
    return '\n\n'.join(parts)


def chatter(folder: Path) -> str:
    """Return in how many cases each scheme shifts without need, by allocation and noise."""
    rows = load(folder, 'chatter')
    keys = ['allocation.policy', 'sensors.strain_noise']
    columns = list(rows.groupby(keys).groups)
    table = []
    for scheme, found in rows.groupby('recruitment.scheme', sort=False):
        cells = {
            key: f'{(one.needless_shifts > 0).sum()} of {len(one)}'
            for key, one in found.groupby(keys)
        }
        table.append([str(scheme), *(cells.get(column, '-') for column in columns)])
    return markdown(['scheme', *(f'{name}, noise {noise:g}' for name, noise in columns)], table)


STUDIES: tuple[Callable[[Path], str], ...] = (
    grid,
    references,
    prediction,
    wrong_model,
    reserve,
    ladder,
    chatter,
)


def main() -> None:
    """Print the tables of all results that there are."""
    if len(sys.argv) != 2:
        sys.exit(__doc__)
    folder = Path(sys.argv[1])
    for study in STUDIES:
        if (folder / study.__name__ / 'study.parquet').exists():
            print(f'## {study.__name__}\n\n{study(folder)}\n')


if __name__ == '__main__':
    main()
