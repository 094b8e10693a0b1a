"""A made-up workcell: a table, two arms of boxes that move, a kidney, cuts; the table's frame."""

from __future__ import annotations

from dataclasses import replace
from functools import cache

import numpy as np
import trimesh
from scipy.spatial.transform import Rotation

from live_objects import STAMP_NS, small_setting, small_update
from tumortrack.core.geometry import rigid
from tumortrack.core.types import Mesh
from tumortrack.live.values import (
    ControlState,
    Polyline,
    PublishedFrame,
    RigidShape,
    SinkContext,
    TrackingResult,
)

UR = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
# The camera of the small objects looks straight down onto their middle, 130 mm away.
TABLE = PublishedFrame("table", rigid(np.diag([1.0, -1.0, -1.0]), np.array([0.0, 0.0, 160.0])))
CUTTER, HOLDER, TOP = (40, 190, 70), (70, 150, 240), (200, 205, 212)
CUT = (255, 40, 160)
REASON = "PLAYBACK of a stored plan: nothing is tracked"


@cache
def box(x: float, y: float, z: float) -> Mesh:
    """Centred; the same object for the same size."""
    made = trimesh.creation.box((x, y, z))
    return Mesh(made.vertices, made.faces)


def bar(
    name: str,
    start: np.ndarray,
    end: np.ndarray,
    colour: tuple[int, int, int],
    wide: float = 60.0,
) -> RigidShape:
    """From one point to another; its length in whole millimetres."""
    along = end - start
    turn = Rotation.align_vectors([along / np.linalg.norm(along)], [[0, 0, 1]])[0].as_matrix()
    mesh = box(wide, wide, round(float(np.linalg.norm(along))))
    return RigidShape(name, mesh, rigid(turn, (start + end) / 2), colour)


def arm(name: str, base: float, tip: np.ndarray, colour: tuple[int, int, int]) -> list[RigidShape]:
    """Two bars from a base beside the table over an elbow to a tip, and the tip."""
    foot = np.array([base, 250.0, 0.0])
    elbow = np.array([0.75 * base, 200.0, 420.0])
    return [
        bar(f"{name}/upper_arm", foot, elbow, colour),
        bar(f"{name}/forearm", elbow, tip + [0.1 * base, 80.0, 60.0], colour),
        bar(f"{name}/tool", tip + [0.1 * base, 80.0, 60.0], tip, (200, 205, 210), 14.0),
        RigidShape(f"{name}/tip", box(8.0, 8.0, 8.0), rigid(np.eye(3), tip), (250, 230, 60)),
    ]


def workcell(
    progress: float = 0.0,
    halted: str = "",
    around_mm: tuple[float, float, float] = (14.0, 3.0, 40.0),
    radius_mm: float = 12.0,
) -> ControlState:
    """``progress``: 0..1 along a circle round a place: by default the small objects' first
    tumor."""
    middle = np.array(around_mm)
    ring = 2 * np.pi * np.append(np.linspace(0, 1, 41), progress)
    circle = middle + radius_mm * np.stack([np.cos(ring), np.sin(ring), 0 * ring], axis=1)
    circle, tip = circle[:-1], circle[-1]
    shapes = (
        RigidShape(
            "table", box(1300.0, 800.0, 20.0), rigid(np.eye(3), np.array([0, 0, -10.0])), TOP
        ),
        *arm("cutter", 480.0, tip, CUTTER),
        *arm("holder", -480.0, middle + [0, 0, 18.0], HOLDER),
    )
    joints = {
        f"{arm}_{joint}_joint": 0.1 * k + 0.2 * progress + (0.5 if arm == "holder" else 0.0)
        for arm in ("cutter", "holder")
        for k, joint in enumerate(UR)
    }
    lines = (Polyline("cut/1", circle, CUT, 2.0), Polyline("cut/2", circle - [0, 0, 8.0], CUT, 2.0))
    return ControlState("sweep 1", halted, joints_rad=joints, shapes=shapes, lines=lines)


def working(sequence: int = 0, progress: float = 0.0, halted: str = "") -> TrackingResult:
    """An update with an estimate and a workcell."""
    update = small_update(sequence, STAMP_NS + sequence * 33_000_000, TABLE)
    return replace(update, control=workcell(progress, halted))


def virtual(sequence: int = 0, progress: float = 0.0, halted: str = "") -> TrackingResult:
    """A stored plan being shown: a workcell, and no estimate."""
    return TrackingResult(
        sequence,
        STAMP_NS + sequence * 33_000_000,
        reason=REASON,
        published_frame=TABLE,
        control=workcell(progress, halted),
        playback=True,
    )


class Arms:
    """A controller that does nothing."""

    ended = False

    def act(self, result: TrackingResult) -> TrackingResult:
        return result

    def evidence(self, camera_from_published: np.ndarray, stamp_ns: int) -> tuple[()]:
        return ()

    def stop(self, why: str, words: str = "") -> None:
        self.ended = True

    def summary(self) -> dict[str, str]:
        return {}

    def tip_mm(self, arm: str, joints_rad: np.ndarray) -> np.ndarray:
        """Of an arm that reaches a metre from its shoulder, and turns about that and its wrist."""
        pan, wrist = joints_rad[0], joints_rad[0] + joints_rad[5]
        return 900 * np.array([np.cos(pan), np.sin(pan), 0]) + 100 * np.array(
            [np.cos(wrist), np.sin(wrist), 0]
        )


def with_arms() -> SinkContext:
    return replace(small_setting(), published_frame=TABLE, controller=Arms())
