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
