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

"""How a run ends early."""

from fam_bundle_io.trace import Trace


class RunFailed(RuntimeError):
    """A run that ended early; ``trace`` holds the ticks until then."""

    def __init__(self, message: str, trace: Trace) -> None:
        """Keep the trace beside the message."""
        super().__init__(message)
        self.trace = trace
