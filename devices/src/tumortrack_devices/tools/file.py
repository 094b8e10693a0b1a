"""A tool's poses and contacts from a table, by their stamps."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Affine
from tumortrack.io.csv_tables import COLUMNS, CONTACT
from tumortrack.live.poses import FilePoses
from tumortrack.live.values import SinkContext
from tumortrack_devices.tools.tip import TipConfig, TipTool


class FileToolConfig(TipConfig, frozen=True, kw_only=True, tag="file"):
    """A table of stamped poses (CSV; docs/conventions.md) with one more column, ``contact``: 1
    while the tip touches, else 0."""

    target: ClassVar[str] = "path"

    path: Path

    def open(self, context: SinkContext, name: str) -> FileTool:
        return FileTool(self, context, name)


class FileTool(TipTool):
    """Raises InputError: there is no such table, it is damaged, or it lacks contacts."""

    def __init__(self, config: FileToolConfig, context: SinkContext, name: str) -> None:
        table = FilePoses(config.path)
        super().__init__(config, context, name, table.frame_id)
        if not table.touches and not config.shaft_mm:
            raise InputError(
                f"{config.path} does not say when the tip touches: its first line must be "
                f"{COLUMNS}{CONTACT}."
            )
        self._poses, self._ahead = table.poses, iter(table.touches)
        self._next = next(self._ahead, None)

    def refresh(self, stamp_ns: int) -> None:
        while self._next is not None and self._next[0] <= stamp_ns:
            self.contact(*self._next)
            self._next = next(self._ahead, None)

    def pose(self, stamp_ns: int) -> Affine:
        return self._poses.at(stamp_ns)
