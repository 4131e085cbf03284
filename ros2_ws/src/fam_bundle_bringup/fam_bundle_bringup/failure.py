# SPDX-License-Identifier: Apache-2.0
"""How a run ends early."""

from fam_bundle_io.trace import Trace


class RunFailed(RuntimeError):
    """A run that ended early; ``trace`` holds the ticks until then."""

    def __init__(self, message: str, trace: Trace) -> None:
        """Keep the trace beside the message."""
        super().__init__(message)
        self.trace = trace
