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

"""What every card must do, whoever made it: the same sentences for each backend."""

from benches import PERIOD, SAFE_VOLTS
import numpy as np
import pytest

SAFE = list(SAFE_VOLTS)
OPEN = [4.0, -3.5]  # volts of valves that are partly open


def ready(bench):
    bench.backend.configure(bench.setup)
    return bench.backend


def armed(bench):
    backend = ready(bench)
    backend.arm()
    return backend


def refused(call, *arguments):
    """Return the words of what must be an OSError with a code and words in one line."""
    with pytest.raises(OSError) as caught:
        call(*arguments)
    assert isinstance(caught.value.errno, int)
    assert caught.value.strerror and '\n' not in caught.value.strerror
    return caught.value


def test_a_configured_card_holds_the_safe_volts_and_these_are_not_zero(bench):
    ready(bench)
    assert bench.outputs() == SAFE
    assert bench.setup.safe_volts.tolist() == SAFE
    assert 0.0 not in SAFE


def test_nothing_works_before_configure_but_close(bench):
    backend, volts = bench.backend, bench.setup.safe_volts
    backend.close()
    for call in (backend.arm, backend.make_safe, backend.reload_watchdog):
        assert 'not configured' in refused(call).strerror
    assert 'not configured' in refused(backend.read, bench.read_volts).strerror
    assert 'not configured' in refused(backend.write, volts).strerror


def test_a_card_that_is_not_armed_can_be_read_and_not_written(bench):
    backend = ready(bench)
    backend.read(bench.read_volts)
    assert 'not armed' in refused(backend.write, np.array(OPEN)).strerror
    assert 'not armed' in refused(backend.reload_watchdog).strerror
    assert bench.outputs() == SAFE


def test_an_armed_card_puts_out_what_is_written_to_the_bit(bench):
    backend = armed(bench)
    for volts in (OPEN, [0.1, 0.7], [-9.125, 9.375]):
        backend.write(np.array(volts))
        assert bench.outputs() == volts


def test_a_read_fills_the_callers_array_with_volts_in_range(bench):
    backend = ready(bench)
    volts = np.full(bench.setup.inputs.size, np.nan)
    backend.read(volts)
    assert np.all((bench.setup.input_minimum <= volts) & (volts <= bench.setup.input_maximum))


def test_the_caller_keeps_its_array_of_commands(bench):
    backend, volts = armed(bench), np.array(OPEN)
    backend.write(volts)
    volts[:] = 1.0
    backend.read(bench.read_volts)
    assert bench.outputs() == OPEN


@pytest.mark.parametrize('call', ['read', 'write'])
@pytest.mark.parametrize('fault', ['type', 'gaps', 'length', 'shape'])
def test_an_array_that_a_vendor_would_read_as_garbage_is_refused(bench, call, fault):
    backend = armed(bench)
    size = bench.setup.inputs.size if call == 'read' else bench.setup.outputs.size
    volts = {
        'type': np.zeros(size, dtype=np.int32),
        'gaps': np.zeros(2 * size)[::2],
        'length': np.zeros(size + 1),
        'shape': np.zeros((size, 1)),
    }[fault]
    assert 'float64' in refused(getattr(backend, call), volts).strerror
    assert bench.outputs() == SAFE


def test_make_safe_puts_the_safe_volts_out_and_disarms(bench):
    backend = armed(bench)
    backend.write(np.array(OPEN))
    backend.make_safe()
    assert bench.outputs() == SAFE
    assert 'not armed' in refused(backend.write, np.array(OPEN)).strerror
    backend.make_safe()
    backend.arm()
    backend.write(np.array(OPEN))
    assert bench.outputs() == OPEN


def test_after_make_safe_the_watchdog_rests_and_reads_go_on(bench):
    backend = armed(bench)
    backend.make_safe()
    bench.let_pass(5.0 * bench.setup.watchdog_timeout)
    backend.read(bench.read_volts)


def test_a_watchdog_that_is_reloaded_in_time_does_not_expire(bench):
    backend = armed(bench)
    backend.write(np.array(OPEN))
    for _ in range(10):
        bench.let_pass(0.5 * bench.setup.watchdog_timeout)
        assert backend.reload_watchdog() is True
    assert bench.outputs() == OPEN


def test_an_expired_watchdog_puts_the_safe_volts_out_by_itself(bench):
    backend = armed(bench)
    backend.write(np.array(OPEN))
    bench.let_pass(bench.setup.watchdog_timeout + 2 * PERIOD)
    assert bench.outputs() == SAFE
    assert backend.reload_watchdog() is False


def test_after_expiry_everything_is_refused_until_configure_clears_it(bench):
    backend = armed(bench)
    backend.write(np.array(OPEN))
    bench.let_pass(bench.setup.watchdog_timeout + 2 * PERIOD)
    backend.reload_watchdog()
    for _ in range(3):
        refused(backend.write, np.array(OPEN))
        refused(backend.read, bench.read_volts)
        refused(backend.make_safe)
        refused(backend.arm)
        assert bench.outputs() == SAFE
    backend.configure(bench.setup)
    assert bench.outputs() == SAFE
    backend.read(bench.read_volts)
    backend.arm()
    backend.write(np.array(OPEN))
    assert bench.outputs() == OPEN


def test_expiry_is_refused_also_where_nobody_has_asked_the_watchdog(bench):
    backend = armed(bench)
    bench.let_pass(bench.setup.watchdog_timeout + 2 * PERIOD)
    refused(backend.write, np.array(OPEN))
    refused(backend.read, bench.read_volts)
    assert bench.outputs() == SAFE


@pytest.mark.parametrize('call', ['read', 'write'])
def test_a_failing_call_raises_with_the_vendors_code(bench, call):
    backend = armed(bench)
    bench.fail(call, 5)
    volts = bench.read_volts if call == 'read' else np.array(OPEN)
    assert refused(getattr(backend, call), volts).errno == 5
    bench.mend()
    getattr(backend, call)(volts)


def test_where_the_safe_volts_cannot_be_written_the_watchdog_brings_them(bench):
    backend = armed(bench)
    backend.write(np.array(OPEN))
    bench.fail('write', 5)
    refused(backend.make_safe)
    assert bench.outputs() == OPEN
    bench.let_pass(bench.setup.watchdog_timeout + 2 * PERIOD)
    assert bench.outputs() == SAFE


def test_close_leaves_the_safe_volts_and_a_card_that_can_be_opened_again(bench):
    backend = armed(bench)
    backend.write(np.array(OPEN))
    backend.close()
    assert bench.outputs() == SAFE
    backend.close()
    refused(backend.read, bench.read_volts)
    ready(bench).read(bench.read_volts)


def test_close_is_never_refused_and_waits_for_the_watchdog_where_it_must(bench):
    backend = armed(bench)
    backend.write(np.array(OPEN))
    bench.fail('write', 5)
    backend.close()
    assert bench.outputs() == SAFE
    bench.mend()
    backend.configure(bench.setup)
    assert bench.outputs() == SAFE


def test_configure_anew_ends_what_was_armed(bench):
    backend = armed(bench)
    backend.write(np.array(OPEN))
    backend.configure(bench.setup)
    assert bench.outputs() == SAFE
    refused(backend.write, np.array(OPEN))
