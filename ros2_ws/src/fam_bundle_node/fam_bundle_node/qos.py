# SPDX-License-Identifier: Apache-2.0
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


LOOP_PUBLISHER = _reliable(WRITER_DEPTH, DurabilityPolicy.VOLATILE)
LOOP_SUBSCRIPTION = _reliable(1, DurabilityPolicy.VOLATILE)
RECORDER_SUBSCRIPTION = _reliable(5 * WRITER_DEPTH, DurabilityPolicy.VOLATILE)
LATCHED = _reliable(1, DurabilityPolicy.TRANSIENT_LOCAL)
