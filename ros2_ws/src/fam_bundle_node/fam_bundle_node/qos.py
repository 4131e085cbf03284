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

"""The qualities of service of the graph's topics."""

from rclpy.qos import DurabilityPolicy, HistoryPolicy, QoSProfile, ReliabilityPolicy

# A slow recorder must still get from the writer what its reader has no room for yet.
WRITER_DEPTH = 2000


def _reliable(depth: int, durability: DurabilityPolicy) -> QoSProfile:
    return QoSProfile(
        history=HistoryPolicy.KEEP_LAST,
        depth=depth,
        reliability=ReliabilityPolicy.RELIABLE,
        durability=durability,
    )


# Transient local: whoever is discovered a moment late still gets the tick that waits for its
# answer, so that no order of start-up can stall the loop.
LOOP_PUBLISHER = _reliable(WRITER_DEPTH, DurabilityPolicy.TRANSIENT_LOCAL)
LOOP_SUBSCRIPTION = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
# On a clock the next tick does not wait for the last one's reader: room for a tenth of a second,
# though what is older than five command time-outs is not answered. No more in the writer either:
# whoever joins a running loop is sent all of it at once, and 2000 samples hold the loop up.
REALTIME_PUBLISHER = _reliable(100, DurabilityPolicy.TRANSIENT_LOCAL)
REALTIME_SUBSCRIPTION = _reliable(100, DurabilityPolicy.TRANSIENT_LOCAL)
RECORDER_SUBSCRIPTION = _reliable(5 * WRITER_DEPTH, DurabilityPolicy.TRANSIENT_LOCAL)
REPORTS = _reliable(10, DurabilityPolicy.VOLATILE)
LATCHED = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
# Latched too, with room for a recorder that is behind: changes can come one upon the other.
CHANGES = _reliable(100, DurabilityPolicy.TRANSIENT_LOCAL)
# From outside, by whatever tool: transient local would refuse what most of them offer.
NEWEST = _reliable(1, DurabilityPolicy.VOLATILE)
