# SPDX-License-Identifier: Apache-2.0
"""The Fast DDS profiles: each carries the loop, to the last bit."""

from collections.abc import Callable
import os
from pathlib import Path

from ament_index_python.packages import get_package_share_directory
from fam_bundle_bringup import graph
from fam_bundle_bringup.offline import run_offline
from fam_bundle_bringup.this_machine import loopback
from fam_bundle_model.parameters import Configuration
import pytest

CONFIG = Path(get_package_share_directory('fam_bundle_bringup'), 'config')


@pytest.mark.parametrize('name', ['fastdds_shared_memory.xml', 'fastdds_unicast_peers.xml'])
def test_loop_runs_with_profile(
    name: str, quick: Callable[..., Configuration], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    chosen = {**loopback(), 'FASTRTPS_DEFAULT_PROFILES_FILE': str(CONFIG / name)}
    monkeypatch.setattr(graph, 'stay_on_this_machine', lambda: os.environ.update(chosen))
    configuration = quick(reference={'amplitude': 0.06, 'frequency': 1.0, 'cycles': 1})
    trace, alone = graph.run_graph(configuration, tmp_path), run_offline(configuration)
    assert len(trace['time']) == 1000
    # A profile that cannot be read is ignored, and every network is used in its place.
    assert not [log for log in (tmp_path / 'log').iterdir() if b'XMLPARSER' in log.read_bytes()]
    for signal, values in alone.items():
        assert trace[signal].tobytes() == values.tobytes(), signal
