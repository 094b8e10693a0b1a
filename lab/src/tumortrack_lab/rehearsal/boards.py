"""Calibration data of a rehearsal: a board held before the camera, and one on a robot's tool, as
files that a real camera and a real robot would give."""

from __future__ import annotations

from pathlib import Path

import cv2
import numpy as np
from scipy.spatial.transform import Rotation

from tumortrack.core import store
from tumortrack.core.geometry import Affine, rigid
from tumortrack.core.types import DepthFrame
from tumortrack.sense.files import depth_png, intrinsics_json
from tumortrack.sense.noise import D405_NOISE, add_noise
from tumortrack_experiment.calibrate.board import Board
from tumortrack_experiment.calibrate.lens import lens_of
from tumortrack_experiment.calibrate.virtual_board import (
    board_depth_mm,
    board_picture,
    looks_at_board,
)
from tumortrack_lab.rehearsal.hands import Hands

# Of a commanded pose; a data sheet's repeatability (0.05 mm of a UR10e) is less than its accuracy.
ROBOT_MM, ROBOT_DEG = 0.1, 0.03
_TWICE = 2  # images of each pose; their difference shows the noise


def hold_board(hands: Hands, board: Board, folder: Path, count: int, seed: int) -> None:
    """Pictures and depth images of a board held by hand, for `calibrate camera`."""
    rng = np.random.default_rng(seed)
    for number, camera_from_board in enumerate(looks_at_board(board, count, rng)):
        for again in range(_TWICE):
            _shoot(hands, board, camera_from_board, folder / f"{number:02d}-{again}", rng)


def move_board(
    hands: Hands, board: Board, robot_from_camera: Affine, folder: Path, count: int, seed: int
) -> None:
    """Pictures of a board on the tool of a robot, and the robot's own poses, for `calibrate
    hand-eye --eye-to-hand`. The robot's poses have the errors of its accuracy."""
    rng = np.random.default_rng(seed)
    tool_from_board = rigid(
        Rotation.from_euler("xyz", rng.uniform(-20, 20, 3), degrees=True).as_matrix(),
        rng.uniform(-40, 40, 3) + [0, 0, 60],
    )
    rows = []
    looks = looks_at_board(board, count, rng, (130.0, 230.0))
    for number, camera_from_board in enumerate(looks):
        _shoot(hands, board, camera_from_board, folder / f"{number:02d}", rng, depth=False)
        stated = robot_from_camera @ camera_from_board @ np.linalg.inv(tool_from_board)
        wrong = Rotation.from_rotvec(np.radians(rng.normal(0, ROBOT_DEG, 3))).as_matrix()
        stated = stated @ rigid(wrong, rng.normal(0, ROBOT_MM, 3))
        rows.append(stated.tolist())
    poses = folder.with_suffix(".json")
    store.write_json(poses, {"frame_id": "base_link", "unit": "mm", "base_from_tool": rows})


def _shoot(
    hands: Hands,
    board: Board,
    camera_from_board: Affine,
    folder: Path,
    rng: np.random.Generator,
    depth: bool = True,
) -> None:
    errors = hands.errors
    lens = lens_of(hands.true, distortion=errors.distortion)
    folder.mkdir(parents=True)
    picture = board_picture(board, lens, camera_from_board, rng)
    store.write_atomically(folder / "infrared.png", cv2.imencode(".png", picture)[1].tobytes())
    if depth:
        depth_mm = board_depth_mm(board, lens_of(hands.true), camera_from_board)
        measured_mm = depth_mm * errors.depth_scale + errors.depth_offset_mm
        frame = add_noise(DepthFrame(measured_mm, hands.believed), D405_NOISE, rng)
        store.write_atomically(folder / "depth.png", depth_png(frame))
        store.write_json(folder / "intrinsics.json", intrinsics_json(hands.believed))
