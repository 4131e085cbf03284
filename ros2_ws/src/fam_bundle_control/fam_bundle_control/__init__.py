# SPDX-License-Identifier: Apache-2.0
"""Strain loop, pressure loop and recruitment of a bundle, with their nodes."""
