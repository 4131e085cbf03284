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

"""Which reference is tracked: the configured one, live values, a goal, or what comes after it."""

from collections.abc import Mapping
from typing import Any

from fam_bundle_model.bundle import check_within_reach
from fam_bundle_model.parameters import (
    check_period,
    check_reference,
    Configuration,
    ReferenceParameters,
)
from fam_bundle_model.reference import (
    after,
    braked,
    Reference,
    reference_law,
    slewed,
    still,
)
from fam_bundle_model.schema import ConfigurationError, make_group

MOST_GOAL_SAMPLES = 1000  # more would hold the loop up while they are checked
MOST_GOAL_CYCLES = 500  # of random waypoints, for the same reason
LIVE, GOAL, RETURN, HOLD = 'topic', 'goal', 'return', 'hold'
FROM_OUTSIDE = (LIVE, GOAL, RETURN, HOLD)  # kinds of trajectory that no parameter tells


def goal_parameters(
    configured: ReferenceParameters, goal: Mapping[str, Any], period: float
) -> ReferenceParameters:
    """
    Return the parameters of a ``goal``: those of its fields that are not zero or empty.

    ``period`` is that of the ticks in s. Raises ConfigurationError where they are bad, do not fit
    together, or would take too long to check between two ticks.
    """
    for name in ('times', 'strains', 'multiples', 'weights', 'levels'):
        if len(goal.get(name, ())) > MOST_GOAL_SAMPLES:
            raise ConfigurationError(
                f'reference.{name}: {len(goal[name])} values; must be <= {MOST_GOAL_SAMPLES} in a '
                'goal'
            )
    given = {name: value for name, value in goal.items() if value}
    parameters = make_group(ReferenceParameters, 'reference', {**vars(configured), **given})
    if parameters.kind == LIVE:
        raise ConfigurationError('reference.kind = topic: must be another in a goal')
    if parameters.kind == 'random' and parameters.cycles > MOST_GOAL_CYCLES:
        raise ConfigurationError(
            f'reference.cycles = {parameters.cycles}: must be <= {MOST_GOAL_CYCLES} in a random '
            'goal'
        )
    check_reference(parameters)
    check_period(parameters, period)
    return parameters


class Trajectory:
    """
    The reference at present; times are those of the run in s.

    ``law`` is the trajectory and ``kind`` its name; ``busy`` tells that a goal is under way.
    """

    def __init__(self, configuration: Configuration, reach: tuple[float, float]) -> None:
        """Begin with the configured reference; ``reach`` is as from ``reachable``."""
        self._configured = configuration.reference
        self._reach, self._pressure = reach, configuration.source.nominal_pressure
        self._rest = configuration.simulation.initial_strain
        self._first = self.law = reference_law(self._configured)
        self.kind = self._configured.kind
        self._limits = self._configured
        self._live: float | None = None
        self.busy = False

    def begin(self) -> bool:
        """
        Go back to the configured reference for a new run; return whether that is a change.

        The last live value stays.
        """
        before = self.law
        self.kind, self.law, self.busy = self._configured.kind, self._first, False
        if self._live is not None:
            self.law = slewed(self.law, 0.0, self._live, self._configured.strain_rate)
        return self.law is not before

    def take_live(self, strain: float, time: float) -> str:
        """Go to a value from outside at the limited rate; return why not, or nothing."""
        low, high = self._reach
        if self.busy:
            return 'a goal is tracked'
        if not low <= strain <= high:  # nor is what is no number
            return f'strain = {strain:g}: must be >= {low:.4g} and <= {high:.4g}, what can be held'
        self.kind, self._live = self._configured.kind, strain
        self.law = slewed(self.law, time, strain, self._configured.strain_rate)
        return ''

    def plan(self, goal: ReferenceParameters, time: float) -> Reference:
        """
        Return the trajectory to and along ``goal`` from ``time`` on.

        Raises ConfigurationError where it leaves what the bundle can reach, or one is under way.
        """
        if self.busy:
            raise ConfigurationError('a goal is tracked already')
        limits = goal.strain_rate, goal.strain_acceleration, self._reach
        law = after(self.law, time, reference_law(goal), *limits)
        check_within_reach(law, 'goal', self._reach, self._pressure)
        return law

    def pursue(self, law: Reference, goal: ReferenceParameters) -> None:
        """Track a goal as planned."""
        self.kind, self.law, self._limits, self.busy = GOAL, law, goal, True

    def turn_back(self, time: float) -> None:
        """Go from a goal to the strain at which the run began, within the goal's limits."""
        limits = self._limits.strain_rate, self._limits.strain_acceleration, self._reach
        self.kind, self.law = RETURN, after(self.law, time, still(self._rest), *limits)

    def hold(self, time: float) -> None:
        """Brake a goal within its limits, and stay where it comes to rest."""
        acceleration = self._limits.strain_acceleration
        self.kind, self.law = HOLD, braked(self.law, time, acceleration, self._reach)

    def is_done(self, time: float) -> bool:
        """Return whether the goal, or the way back from it, has come to its end at ``time``."""
        return time >= self.law.start + self.law.end

    def settle(self) -> None:
        """End a goal: its last strain is held until something else comes."""
        self.busy = False


class Score:
    """What a goal's result says of the tracking; SI units."""

    def __init__(self) -> None:
        """Begin with no sample."""
        self.iae = self.max_error = 0.0
        self.samples = 0

    def note(self, error: float, dt: float) -> None:
        """Add the strain error of one tick, that stands for ``dt`` s."""
        self.iae += abs(error) * dt
        self.max_error = max(self.max_error, abs(error))
        self.samples += 1
