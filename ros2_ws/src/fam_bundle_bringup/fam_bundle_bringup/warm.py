# SPDX-License-Identifier: Apache-2.0
"""Compile every law once, so that no run has to wait for it."""

import dataclasses

from fam_bundle_bringup.experiment import default_configuration
from fam_bundle_bringup.offline import run_offline
from fam_bundle_model.lag_table import build_lag_table
from fam_bundle_model.parameters import Configuration, load_configuration


def warm(configuration: Configuration) -> None:
    """Compile what runs of ``configuration`` need and leave it in the cache."""
    reference = dataclasses.replace(configuration.reference, frequency=10.0, cycles=1)
    short = dataclasses.replace(configuration, reference=reference)
    run_offline(short, table=build_lag_table(short))


if __name__ == '__main__':
    warm(load_configuration(default_configuration()))
