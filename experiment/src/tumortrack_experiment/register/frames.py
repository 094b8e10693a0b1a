"""Depth images of a state, from a recording or from plain folders, and the beads in them."""

from __future__ import annotations

import json
from itertools import islice
from pathlib import Path

import numpy as np

from tumortrack.core.config import from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.store import natural
from tumortrack.core.types import DepthFrame
from tumortrack.io.depth_files import read_depth_png
from tumortrack_devices.recording.folders import folder_frames
from tumortrack_experiment.kit_file import KIT_FILE, Kit
from tumortrack_experiment.record.read import Moment, Recorded, read_recorded
from tumortrack_experiment.register.beads import CAMERA, NamedBeads, name_beads
from tumortrack_experiment.register.in_depth import find_balls_seen

_MOST_FRAMES = 30  # the median of so many has a fifth of one's noise
_HALVES = 6  # with fewer frames nothing is said about movement while they were taken
_STILL_MM = 1.0  # beads of two halves of a state's frames differ by less where nothing moved


def states_in(recording: Path, kit: Kit) -> dict[str, Recorded | Path]:
    """The states of a recording, and where their frames are: what `tumortrack record` wrote, or a
    folder with one for each state, of depth images or scene folders. Raises InputError: none, or
    it says itself that it is of another kit."""
    if not recording.is_dir():
        raise InputError(f"{recording} is not a folder. Give one that `tumortrack record` wrote.")
    if any(recording.glob("*.mcap")):
        recorded = read_recorded(recording)
        check_kit(recorded, kit)
        return dict.fromkeys(recorded.states, recorded)
    inside = sorted((path for path in recording.iterdir() if path.is_dir()), key=natural)
    states = {path.name: path for path in inside if any(path.rglob("*.png"))}
    if not states:
        raise InputError(
            f"{recording} holds no recording, and no folder with a state's depth images. Record "
            "with: tumortrack record."
        )
    return dict(states)


def check_kit(recorded: Recorded, kit: Kit) -> None:
    """InputError: the beads of the kit that the recording was made with lie elsewhere."""
    data = recorded.attachments.get(KIT_FILE)
    if data is None:
        return
    where = f"{recorded.folder}: {KIT_FILE}"
    try:
        content = json.loads(data)
    except ValueError as error:
        raise InputError(f"{where} cannot be read as JSON: {error}.") from error
    if from_builtins(content, Kit, where).beads != kit.beads:
        raise InputError(
            f"{recorded.folder} was recorded with another kit, whose beads lie elsewhere (another "
            "case, --bed or --states makes another kit). Give that one."
        )


def one_of(states: dict[str, Recorded | Path], state: str | None, recording: Path) -> str:
    """The state, or the only one. Raises InputError: there is no such state."""
    if state is None and len(states) == 1:
        return next(iter(states))
    if state is None or state not in states:
        raise InputError(
            f"{recording}: choose one of its states with --state: {', '.join(states)}."
        )
    return state


def moments_in(view: Path, state: str | None, kit: Kit) -> list[Moment]:
    """Of a recording's state, or a folder of depth images. Raises InputError as ``moments_of``
    and ``states_in``."""
    if state is None and not any(view.glob("*.mcap")):
        return moments_of(view, "")
    states = states_in(view, kit)
    name = one_of(states, state, view)
    return moments_of(states[name], name)


def moments_of(where: Recorded | Path, state: str, most: int = _MOST_FRAMES) -> list[Moment]:
    """The first of a state. Raises InputError: no depth images, or damaged ones."""
    if isinstance(where, Recorded):
        return list(islice(where.moments(state), most))
    if (where / "depth.png").is_file():
        return [Moment(read_depth_png(where / "depth.png", where / "intrinsics.json"))]
    found = [frame.load().content for frame in folder_frames(where, 30.0, "mm")[:most]]
    images = [content for content in found if isinstance(content, DepthFrame)]
    if not images:
        raise InputError(f"{where} holds clouds; depth images are needed to see beads.")
    return [Moment(image) for image in images]


def median_of(frames: list[DepthFrame]) -> DepthFrame:
    """The median pixel by pixel, no return where fewer than half have one; of the first frame's
    stamp. Raises InputError: the camera's intrinsics changed."""
    if len({frame.intrinsics for frame in frames}) > 1:
        raise InputError("the depth images are of cameras with different intrinsics.")
    depths_mm = np.array([frame.depth_mm for frame in frames])
    seen = np.isfinite(depths_mm).sum(0) * 2 >= len(frames)
    median_mm = np.full(depths_mm.shape[1:], np.nan, np.float32)
    median_mm[seen] = np.nanmedian(depths_mm[:, seen], axis=0)
    return DepthFrame(median_mm, frames[0].intrinsics, frames[0].stamp_ns)


def beads_in_view(kit: Kit, frame: DepthFrame) -> NamedBeads:
    """The kit's beads in a depth image, camera frame. Raises InputError: as ``name_beads``, or the
    base is seen from below."""
    found = name_beads(kit, find_balls_seen(frame, kit.bead_diameter_mm), CAMERA)
    camera_from_base = found.device_from_base
    if camera_from_base[:3, 2] @ camera_from_base[:3, 3] > 0:
        raise InputError(
            "camera: the beads would have the base seen from below. Bring more of them into view."
        )
    return found


def still_beads(kit: Kit, moments: list[Moment], state: str) -> tuple[DepthFrame, NamedBeads]:
    """The median depth image of a state and the beads in it. Raises InputError: as
    ``beads_in_view``, or camera or base moved while it was recorded."""
    frames = [moment.depth for moment in moments]
    if len(frames) >= _HALVES:
        halves = frames[: len(frames) // 2], frames[len(frames) // 2 :]
        poses = [beads_in_view(kit, median_of(half)).device_from_base for half in halves]
        if (moved_mm := distance_mm(kit, *poses)) > _STILL_MM:
            raise InputError(
                f"{state}: the camera or the base moved by {moved_mm:.1f} mm while it was recorded "
                f"(at most {_STILL_MM:g} mm is noise). Record it again."
            )
    median = median_of(frames)
    return median, beads_in_view(kit, median)


def distance_mm(kit: Kit, first_from_base: np.ndarray, second_from_base: np.ndarray) -> float:
    """How far apart two poses of the base put a bead, rms."""
    places = [transform_points(pose, kit.beads_mm) for pose in (first_from_base, second_from_base)]
    return float(np.sqrt(((places[0] - places[1]) ** 2).sum(1).mean()))
