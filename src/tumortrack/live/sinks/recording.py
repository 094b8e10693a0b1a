"""A recording of observations and results, to be played again."""

from __future__ import annotations

import json
import shutil
from pathlib import Path
from typing import ClassVar, Literal

import tumortrack
from tumortrack.core.errors import InputError, StorageError
from tumortrack.core.store import read_json
from tumortrack.live.recording.folders import FRAMES
from tumortrack.live.recording.frame_folders import INDEX, SHAPES, FrameFolders
from tumortrack.live.recording.mcap_file import McapFile
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult

_ABOUT = "recording.json"
_KIND = "recording"


class RecordingSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="recording"):
    """A new folder with every result.

    Attributes:
        format: mcap, a rosbag2 folder (depth images as 32FC1 in metres: float32 to 1e-5 mm;
            stamps exact); or files, a folder per frame (depth images in steps of 0.1 mm).
        frames: also what the source saw; otherwise the recording cannot be played.
        meshes_hz: mcap: surfaces at most so often; 0: with every result.
        overwrite: replace a recording of this kind.
    """

    target: ClassVar[str] = "path"
    queue_size: ClassVar[int] = 30

    path: Path
    format: Literal["mcap", "files"] = "mcap"
    frames: bool = True
    meshes_hz: float = 2.0
    overwrite: bool = False

    def __post_init__(self) -> None:
        if not 0 <= self.meshes_hz <= 1000:
            raise InputError(f"recording: meshes_hz is {self.meshes_hz:g}; allowed: 0..1000.")

    def open(self, context: SinkContext) -> RecordingSink:
        """
        Raises:
            InputError: the folder exists, and is no recording or ``overwrite`` was not given.
            StorageError: the disk refused.
        """
        _make_room(self.path, self.overwrite)
        try:
            self.path.parent.mkdir(parents=True, exist_ok=True)
            writer: McapFile | FrameFolders
            if self.format == "mcap":
                writer = McapFile(self.path, context, self.frames, self.meshes_hz)
            else:
                writer = FrameFolders(self.path, self.frames)
            text = json.dumps(self._about(context), indent=1)
            (self.path / _ABOUT).write_text(text + "\n", encoding="utf-8")
        except OSError as error:
            raise StorageError(f"cannot write {self.path}: {error.strerror or error}.") from error
        return RecordingSink(writer)

    def _about(self, context: SinkContext) -> dict:
        """What the recording is: recording.json."""
        frame = context.published_frame
        return {
            "kind": _KIND,
            "tumortrack": tumortrack.__version__,
            "format": self.format,
            "parts": list(context.parts),
            "frame_id": frame.frame_id,
            "published_from_camera": frame.published_from_camera.tolist(),
            # Plain files lie beside their depth images; messages are as they were published.
            "estimate_frame": "camera" if self.format == "files" else frame.frame_id,
        }


class RecordingSink:
    """Writes until the disk refuses.

    An MCAP is then left as it is, and every later result raises the same StorageError: it is not
    in the recording. Plain files go on with the next frame.
    """

    def __init__(self, writer: McapFile | FrameFolders) -> None:
        self._writer = writer
        self._refused: StorageError | None = None
        self._closed = False

    def publish(self, result: TrackingResult) -> None:
        if self._refused is not None:
            raise StorageError(str(self._refused))
        try:
            self._writer.write(result)
        except StorageError as error:
            if isinstance(self._writer, McapFile):
                self._refused = error
            raise

    def close(self) -> None:
        if not self._closed and self._refused is None:
            self._writer.close()
        self._closed = True


def _make_room(path: Path, overwrite: bool) -> None:
    """Refuse what exists; or take an older recording away, if nothing else lies in it."""
    if not path.exists():
        return
    if not overwrite:
        raise InputError(
            f"{path} exists already. Choose another folder, or give overwrite=true to replace the "
            "recording."
        )
    inside = {p.name for p in path.iterdir()} if path.is_dir() else {path.name}
    ours = {_ABOUT, INDEX, FRAMES, SHAPES, "metadata.yaml", f"{path.name}.mcap"}
    is_ours = _ABOUT in inside and read_json(path / _ABOUT).get("kind") == _KIND
    if inside and (inside - ours or not is_ours or not path.is_dir()):
        raise InputError(
            f"{path} is no recording of tumortrack's, or holds something else too, so it is not "
            "replaced. Choose another folder."
        )
    shutil.rmtree(path)
