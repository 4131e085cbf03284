# SPDX-License-Identifier: Apache-2.0
"""What all nodes share: parameters from the schema, quality of service, executor."""
