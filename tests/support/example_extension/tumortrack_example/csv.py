"""Centres of the parts as CSV: ``csv:FILE``."""

from __future__ import annotations

from pathlib import Path
from typing import ClassVar

from tumortrack.core.errors import InputError
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult


class CsvSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="csv"):
    """A row per result and part that was found; published frame, mm.

    Attributes:
        path: the new file.
        digits: after the decimal point.
    """

    target: ClassVar[str] = "path"
    queue_size: ClassVar[int] = 30  # every result counts, as far as the disk keeps up

    path: Path
    digits: int = 2

    def open(self, context: SinkContext) -> CsvSink:
        if self.path.exists():
            raise InputError(f"csv: {self.path} exists already. Choose another file.")
        return CsvSink(self, context)


class CsvSink:
    def __init__(self, config: CsvSinkConfig, context: SinkContext) -> None:
        self._parts, self._digits = context.parts, config.digits
        self._file = config.path.open("w", encoding="utf-8")
        self._file.write("stamp_ns,quality,part,x_mm,y_mm,z_mm\n")

    def publish(self, result: TrackingResult) -> None:
        for part in self._parts:
            center_mm = result.center_mm(part)
            if center_mm is not None:
                numbers = ",".join(f"{number:.{self._digits}f}" for number in center_mm)
                self._file.write(f"{result.stamp_ns},{result.quality},{part},{numbers}\n")

    def close(self) -> None:
        self._file.close()
