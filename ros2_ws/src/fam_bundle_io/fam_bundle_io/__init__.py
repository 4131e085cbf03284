# SPDX-License-Identifier: Apache-2.0
"""Recording, reading, metrics and figures of the runs of a bundle."""
