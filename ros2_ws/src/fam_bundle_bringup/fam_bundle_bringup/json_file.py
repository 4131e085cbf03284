# SPDX-License-Identifier: Apache-2.0
"""JSON files, whole or not at all."""

import json
from pathlib import Path
from typing import Any

from fam_bundle_model.files import whole_file


def write_json(content: Any, path: Path) -> None:
    """Write ``content`` as JSON."""
    with whole_file(path) as file:
        file.write(json.dumps(content, indent=1, allow_nan=False).encode() + b'\n')
