# SPDX-License-Identifier: Apache-2.0
"""Progress on the terminal; without one, a line at the start and at the end."""

import contextlib
import sys
import time
from collections.abc import Callable, Iterator


@contextlib.contextmanager
def progress_bar(label: str, total: int) -> Iterator[Callable[[int], None]]:
    """Give a function that takes how much of ``total`` is done."""
    from rich.console import Console
    from rich.progress import (
        BarColumn,
        MofNCompleteColumn,
        Progress,
        TextColumn,
        TimeElapsedColumn,
        TimeRemainingColumn,
    )

    console = Console(stderr=True)
    begin = time.monotonic()
    if not console.is_terminal:
        print(f'{label} ...', file=sys.stderr, flush=True)
        yield lambda done: None
        print(f'{label}: {time.monotonic() - begin:.1f} s', file=sys.stderr, flush=True)
        return
    columns = (
        TextColumn('{task.description}'),
        BarColumn(),
        MofNCompleteColumn(),
        TimeElapsedColumn(),
        TimeRemainingColumn(),
    )
    with Progress(*columns, console=console) as progress:
        task = progress.add_task(label, total=total)
        yield lambda done: progress.update(task, completed=done)
        progress.update(task, completed=total)
