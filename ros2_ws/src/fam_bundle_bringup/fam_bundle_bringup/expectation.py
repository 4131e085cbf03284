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

"""What the predictor expected in a run: its law once more, on the strains of the trace."""

from collections.abc import Callable

from fam_bundle_control.predictors import (
    expected_strain,
    FAR,
    predictor,
    predictor_start,
    predictor_step,
    STEPS,
)
from fam_bundle_io.trace import Trace
from fam_bundle_model.compile import direct
from fam_bundle_model.parameters import Configuration
from fam_bundle_model.reference import reference_law
import numpy as np
import numpy.typing as npt

Array = npt.NDArray[np.float64]


def expectation(configuration: Configuration, trace: Trace) -> Callable[[int, Array], Array]:
    """
    Return E(t) of equation 14: the strains expected at a tick, for times ahead of it in s.

    Of the configured predictor and reference. For times that have passed the line goes back at
    the present rate, as the laws have it for a limit that the strain is at already.
    """
    law, reference = predictor(configuration), reference_law(configuration.reference)
    step = direct(predictor_step, law, predictor_start(), reference, 0.0, 0.0, 1.0)
    near = FAR / STEPS

    def expected(tick: int, ahead: Array) -> Array:
        state, last = predictor_start(), -configuration.simulation.period
        times, strains = (trace[name][: tick + 1].tolist() for name in ('time', 'strain'))
        for time, strain in zip(times, strains, strict=True):
            state, last = step(law, state, reference, time, strain, time - last), time

        def at(seconds: float) -> float:
            return expected_strain(law, state, reference, seconds)

        rate = (at(near) - at(0.0)) / near
        return np.array([at(s) if s >= 0.0 else at(0.0) + rate * s for s in ahead.tolist()])

    return expected
