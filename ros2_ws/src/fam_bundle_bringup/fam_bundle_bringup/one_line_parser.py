# SPDX-License-Identifier: Apache-2.0
"""A parser that refuses in one line."""

import argparse
from typing import Any


class Parser(argparse.ArgumentParser):
    """A parser that refuses in one line."""

    def error(self, message: str) -> Any:
        """Print one line and exit with status 2."""
        self.exit(2, f'{self.prog}: {message}; see {self.prog} --help\n')
