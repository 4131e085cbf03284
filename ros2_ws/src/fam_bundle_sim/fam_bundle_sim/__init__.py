# SPDX-License-Identifier: Apache-2.0
"""Simulated plant and sensors of a bundle, with the plant simulator node."""
