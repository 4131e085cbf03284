# SPDX-License-Identifier: Apache-2.0
"""The hardware bridge without ROS: cards behind one protocol, calibration, limits, safety."""
