"""`inspect`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional

from tumortrack.cli.console import say


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """Say what a folder or file is, and what is in it.

    Attributes:
        path: what a command wrote or reads.
    """

    path: Positional[Path]

    def run(self) -> None:
        from tumortrack import api

        for line in api.describe(self.path):
            say(line)
