# SPDX-License-Identifier: Apache-2.0
"""Lets the tests of this folder import what they share."""

import importlib.util
import sys
from pathlib import Path

# pytest's import mode leaves this folder out of the path.
_spec = importlib.util.spec_from_file_location('damage', Path(__file__).with_name('damage.py'))
assert _spec is not None
assert _spec.loader is not None
sys.modules['damage'] = importlib.util.module_from_spec(_spec)
_spec.loader.exec_module(sys.modules['damage'])
