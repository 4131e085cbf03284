# SPDX-License-Identifier: Apache-2.0
"""Physics of a variable-recruitment bundle of fluidic artificial muscles."""
