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

"""
Which samples have been answered: judges every command by its tick. Pure Python.

Owned by whoever takes the samples, the plant simulator or the hardware bridge.
"""

from fam_bundle_node.ticks import TickCounts, TickError

LEFTOVERS = 200  # ticks into a run in which commands of the run before may still come


class Answers:
    """Ticks of the newest ``sample`` and of the newest command that ``answered`` one; -1: none."""

    def __init__(self, counts: TickCounts, *, realtime: bool) -> None:
        """Count in ``counts`` what cannot be used; in lock-step that is an error."""
        self.sample = self.answered = -1
        self._counts, self._realtime = counts, realtime

    def begin(self) -> None:
        """Begin a new run."""
        self.sample = self.answered = -1

    def admit(self, tick: int) -> bool:
        """
        Return whether a command answers a sample that waits for it, and count it if not.

        Raises TickError for one that nothing can explain, in lock-step for every other one.
        """
        if not self._realtime:
            if tick != self.sample:
                raise TickError(f'valve_command: tick {tick} came, expected {self.sample}')
            self.answered = tick
            return True
        counts, ahead = self._counts, tick > self.sample
        if (self.answered < 0 and tick != 0) or (ahead and self.sample < LEFTOVERS):
            counts.late += 1  # of the run before, still in the controller's history
            return False
        if ahead:
            raise TickError(f'valve_command: tick {tick} came before its sample')
        if tick <= self.answered:
            again = tick == self.answered
            counts.duplicate += again
            counts.out_of_order += not again
            return False
        counts.missing += tick - self.answered - 1
        counts.late += tick < self.sample
        self.answered = tick
        return True
