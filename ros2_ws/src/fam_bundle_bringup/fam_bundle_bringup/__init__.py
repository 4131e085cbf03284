# SPDX-License-Identifier: Apache-2.0
"""Configuration and the experiment runner of a bundle."""
