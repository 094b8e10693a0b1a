"""What is known beside the clouds of `locate`: files of evidence, and tracked ultrasound."""

from __future__ import annotations

import glob
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.evidence import CAMERA, Evidence
from tumortrack.tracking.options import LocateOptions

if TYPE_CHECKING:
    from tumortrack.core.ultrasound import ProbeRecording


class KnownEvidence(NamedTuple):
    """The frame of all of it; pieces; notes on reading; and what a report says of its files."""

    frame: str
    pieces: tuple[Evidence | ProbeRecording, ...]
    notes: tuple[str, ...]
    sha256: dict[str, Any]


def read_known(options: LocateOptions, parts: Sequence[str], with_camera: bool) -> KnownEvidence:
    """Raises InputError: a file is missing or damaged, frames differ, or options do not fit."""
    of_probe = options.poses is not None and options.poses.suffix.lower() == ".csv"
    probe = {
        "frame": options.frame,
        "masks": options.masks,
        "image_to_probe": options.image_to_probe,
        "poses": options.poses if of_probe else None,
    }
    files = {name: path for name, path in probe.items() if path is not None}
    asked = bool(files or options.mask_part or options.mm_per_pixel)
    if not options.evidence and not asked:
        return KnownEvidence(CAMERA, (), (), {})
    from tumortrack.io.evidence_files import read_evidence
    from tumortrack.io.ultrasound_files import is_recording

    recorded = [path for path in options.evidence if is_recording(path)]
    if asked and not recorded:
        raise InputError(
            "--frame, --masks, --mask-part, --mm-per-pixel, --image-to-probe and a table of --poses"
            " are of tracked ultrasound: give it as --evidence."
        )
    if recorded and with_camera and options.frame is None:
        raise InputError(
            f"where the camera is in the frame of {recorded[0]} is not known: give --frame FILE,"
            " or - instead of the cloud."
        )
    frames, notes = set[str](), list[str]()
    pieces: list[Evidence | ProbeRecording] = []
    for path in options.evidence:
        if path in recorded:
            recording = _recording(path, parts, options, probe["poses"])
            frames.add(recording.frame if options.frame is None else CAMERA)
            pieces, notes = [*pieces, recording], [*notes, *recording.notes]
        else:
            frame, evidence = read_evidence(path, with_camera)
            frames.add(frame)
            pieces += evidence
    if len(frames) > 1:
        raise InputError(f"--evidence is in the frames {', '.join(sorted(frames))}; give one.")
    digests = [digest for path in options.evidence for digest in _sha256(path)]
    about: dict[str, Any] = {"evidence_sha256": digests[0] if len(digests) == 1 else digests}
    if files:
        about["ultrasound_sha256"] = {name: _sha256(path) for name, path in files.items()}
    return KnownEvidence(frames.pop(), tuple(pieces), tuple(notes), about)


def _recording(
    path: Path, parts: Sequence[str], options: LocateOptions, poses: Path | None
) -> ProbeRecording:
    """In the camera's frame, if it is known where that is."""
    from tumortrack.io.ultrasound_files import RecordingOptions, read_recording
    from tumortrack.live.calibration_file import read_frames

    asked = RecordingOptions(
        masks=options.masks,
        mask_part=options.mask_part,
        poses=poses,
        mm_per_pixel=options.mm_per_pixel,
        image_to_probe=options.image_to_probe,
    )
    if options.frame is None:
        return read_recording(path, parts, asked)
    published = read_frames(options.frame)
    recording = read_recording(path, parts, replace(asked, frame=published.frame_id))
    pose = np.linalg.inv(published.published_from_camera)
    recording = replace(recording, camera_from_frame=pose)
    away_mm = float(np.linalg.norm(recording.known_mm, axis=1).max())
    error_mm = published.error_at(away_mm)
    return recording if error_mm is None else replace(recording, shared_std_mm=error_mm)


def _sha256(path: Path) -> list[str]:
    """Of a file, a folder, or each file of a pattern."""
    paths = [path] if path.exists() else sorted(map(Path, glob.glob(str(path))), key=store.natural)
    return [store.sha256_of(each) for each in paths]
