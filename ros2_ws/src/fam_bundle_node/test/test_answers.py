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

"""A command is taken once, for a sample that waits, and everything else is counted."""

from fam_bundle_node.answers import Answers, LEFTOVERS
from fam_bundle_node.ticks import TickCounts, TickError
import pytest


def answers(sample: int, answered: int, *, realtime: bool = True) -> tuple[Answers, TickCounts]:
    counts = TickCounts()
    found = Answers(counts, realtime=realtime)
    found.sample, found.answered = sample, answered
    return found, counts


def test_in_lockstep_only_the_newest_sample_is_answered() -> None:
    found, _ = answers(7, 6, realtime=False)
    with pytest.raises(TickError, match='tick 6 came, expected 7'):
        found.admit(6)
    assert found.admit(7)
    assert found.answered == 7


def test_the_first_answer_is_that_of_tick_0() -> None:
    found, counts = answers(0, -1)
    assert not found.admit(5)
    assert counts.late == 1
    assert found.admit(0)


def test_what_comes_twice_or_late_or_after_a_gap_is_counted() -> None:
    found, counts = answers(1000, 990)
    assert not found.admit(990)
    assert not found.admit(980)
    assert found.admit(995)
    assert found.admit(1000)
    assert (counts.duplicate, counts.out_of_order, counts.late, counts.missing) == (1, 1, 1, 8)


def test_an_answer_to_what_was_not_asked_is_refused_once_no_run_before_explains_it() -> None:
    young, counts = answers(LEFTOVERS - 1, LEFTOVERS - 2)
    assert not young.admit(LEFTOVERS + 10)
    assert counts.late == 1
    old, _ = answers(LEFTOVERS, LEFTOVERS - 1)
    with pytest.raises(TickError, match='came before its sample'):
        old.admit(LEFTOVERS + 1)
