# SPDX-License-Identifier: Apache-2.0
"""The strongest rival of an anticipatory scheme: a threshold tuned on the very reference."""

import dataclasses
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from fam_bundle_bringup.experiment import measure_tracking
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.metrics import Tracking, shift_times
from fam_bundle_io.trace import Trace
from fam_bundle_model.lag_table import cached_lag_table
from fam_bundle_model.parameters import Configuration

THRESHOLDS = tuple(np.round(np.arange(0.40, 0.951, 0.01), 2).tolist())


class Rival(NamedTuple):
    """The best upshift threshold, and how well the baseline tracks with it."""

    threshold: float
    tracking: Tracking


def with_threshold(configuration: Configuration, threshold: float) -> Configuration:
    """Return the baseline of ``configuration`` with another upshift threshold."""
    recruitment = dataclasses.replace(
        configuration.recruitment, scheme='baseline', upshift_threshold=threshold
    )
    return dataclasses.replace(configuration, recruitment=recruitment)


def chatters(configuration: Configuration, trace: Trace) -> bool:
    """Return whether a run shifted more than once up and once down per cycle."""
    up, down = shift_times(trace)
    cycles = configuration.reference.cycles
    return len(up) > cycles or len(down) > cycles


def best_threshold(
    configuration: Configuration, progress: Callable[[int], None] | None = None
) -> Rival | None:
    """Return the threshold with the least IAE among those that do not chatter, if there is one.

    The runs are offline. ``progress`` is called with the thresholds tried so far.
    """
    table = cached_lag_table(configuration)
    best: Rival | None = None
    for k, threshold in enumerate(THRESHOLDS, 1):
        if threshold <= configuration.recruitment.downshift_threshold:
            continue
        tried = with_threshold(configuration, threshold)
        trace = run_offline(tried, table=table)
        found = measure_tracking(tried, trace)
        better = best is None or found.iae < best.tracking.iae
        if better and not chatters(tried, trace):
            best = Rival(threshold, found)
        if progress is not None:
            progress(k)
    return best
