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

"""The strongest rival of an anticipatory scheme: a threshold tuned on the very reference."""

from collections.abc import Callable
import contextlib
import dataclasses
from typing import NamedTuple

from fam_bundle_bringup.experiment import measure_tracking
from fam_bundle_bringup.failure import RunFailed
from fam_bundle_bringup.offline import run_offline
from fam_bundle_io.metrics import needless_shifts, Tracking
from fam_bundle_model.lag_table import cached_lag_table
from fam_bundle_model.parameters import check_allocation, Configuration
import numpy as np

THRESHOLDS = tuple(np.round(np.arange(0.40, 0.951, 0.01), 2).tolist())


class Rival(NamedTuple):
    """The best upshift threshold, how well it tracks, and how many thresholds do not chatter."""

    threshold: float
    tracking: Tracking
    steady: int


def with_threshold(configuration: Configuration, threshold: float) -> Configuration:
    """
    Return the baseline of ``configuration`` with another upshift threshold.

    Raises ConfigurationError where its allocation does not go with thresholds.
    """
    recruitment = dataclasses.replace(
        configuration.recruitment, scheme='baseline', upshift_threshold=threshold
    )
    check_allocation(recruitment, configuration.allocation)
    return dataclasses.replace(configuration, recruitment=recruitment)


def best_threshold(
    configuration: Configuration,
    progress: Callable[[int], None] | None = None,
    actual: Configuration | None = None,
) -> Rival | None:
    """
    Return the threshold with the least IAE among those that do not chatter, if there is one.

    The runs are offline, ``actual`` as in ``run_offline``; one that diverges is no rival.
    ``progress`` is called with the thresholds tried so far.
    """
    table = cached_lag_table(configuration)
    steady: dict[float, Tracking] = {}
    for k, threshold in enumerate(THRESHOLDS, 1):
        if threshold > configuration.recruitment.downshift_threshold:
            tried = with_threshold(configuration, threshold)
            with contextlib.suppress(RunFailed):
                trace = run_offline(tried, table=table, actual=actual)
                if not needless_shifts(trace):
                    steady[threshold] = measure_tracking(tried, trace)
        if progress is not None:
            progress(k)
    if not steady:
        return None
    best = min(steady, key=lambda threshold: steady[threshold].iae)
    return Rival(best, steady[best], len(steady))
