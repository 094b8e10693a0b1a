"""The options of public functions as their keywords, for editors and type checkers: each class has
the fields of the options that ``options_from`` makes of it, and paths may be strings."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Literal, TypedDict

from tumortrack.tracking.options import Device, SimulatedSensor

StrPath = str | Path
Side = Literal["left", "right"] | None
Box = tuple[float, float, float, float, float, float] | None


class PrepareKeywords(TypedDict, total=False):
    """See ``case.options.PrepareOptions``."""

    organ_hu: tuple[float, float]
    tumor_hu: tuple[float, float]
    labels: bool
    side: Side
    organ: int | tuple[int, ...]
    tumor: int | tuple[int, ...]
    up: str
    rotations: Literal["limited", "full"]
    tilt: float
    sensor: Literal["d405", "stereo"]
    series: str | None
    unit: Literal["mm", "m"] | None
    min_tumor_ml: float
    patient: str | None
    name: str
    term: tuple[str, str] | None
    structure: tuple[str, ...]
    ct: StrPath | None


class SimulateKeywords(TypedDict, total=False):
    """See ``SimulateOptions``."""

    scenes: int
    seed: int
    configuration: tuple[Literal[1, 2, 3, 4, 5, 6], ...]
    falloff: Literal["sigma", "variance"]
    rotations: Literal["limited", "full"]
    squeeze: bool
    noise: bool
    sensor: SimulatedSensor
    uncalibrated: bool
    tissue: bool
    elastic: bool


class ExportKeywords(TypedDict, total=False):
    """See ``ExportOptions``."""

    format: Literal["slicer", "vtk", "usd"]
    located: StrPath | None
    live: str | None
    dicom: StrPath | None
    series: str | None
    patient: str | None


class RecordingKeywords(TypedDict, total=False):
    """See ``io.ultrasound_files.RecordingOptions``."""

    masks: StrPath | None
    mask_part: str
    poses: StrPath | None
    mm_per_pixel: tuple[float, ...]
    image_to_probe: StrPath | None
    frame: str


class _RegionKeywords(TypedDict, total=False):
    patient: str | None
    side: Side
    box: Box
    whole: bool
    depth_error: str
    poses: StrPath | None
    advise: str
    seed: int
    device: Device


class LocateKeywords(_RegionKeywords, total=False):
    """See ``LocateOptions``."""

    range: tuple[float, float] | None
    at: tuple[int, int] | None
    mask: StrPath | None
    grid: int
    unit: Literal["mm", "m"]
    depth_unit: float | None
    intrinsics: StrPath | Sequence[StrPath]
    evidence: StrPath | Sequence[StrPath] | None
    frame: StrPath | None
    masks: StrPath | None
    mask_part: str
    mm_per_pixel: tuple[float, ...]
    image_to_probe: StrPath | None
    map: StrPath | None
    case: StrPath | None


class TrackKeywords(_RegionKeywords, total=False):
    """See ``TrackOptions``; ``range`` and ``seconds`` are keywords of ``track`` itself."""

    intrinsics: StrPath | None
    frame: StrPath | None
    views: tuple[str, ...]
    moving: str
    tool: tuple[str, ...]
    scan: bool
    smoothing: float
    rescan: float
    stale: float
    frozen: float
    give_up: float
    report: StrPath | None


class SessionKeywords(TrackKeywords, total=False):
    """Those of ``track``, and its own."""

    range: tuple[float, float] | None
    seconds: float
