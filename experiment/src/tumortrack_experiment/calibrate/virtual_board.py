"""What a camera would see of a board: pictures and depth images to try calibrations with."""

from __future__ import annotations

import cv2
import numpy as np
from jaxtyping import Float32, Float64, UInt8

from tumortrack.core.geometry import Affine, rigid
from tumortrack_experiment.calibrate.board import CELLS, Board
from tumortrack_experiment.calibrate.lens import Lens, pixel_rays

_BLACK, _WHITE, _BEHIND = 35.0, 215.0, 110.0  # grey levels
_MARGIN = 1.0  # white round the board, in squares


def board_picture(
    board: Board,
    lens: Lens,
    camera_from_board: Affine,
    rng: np.random.Generator,
    blur_px: float = 0.6,
    noise: float = 2.0,
) -> UInt8[np.ndarray, "h w"]:
    """A grey picture of the board in an even background, through a lens with distortion;
    ``noise``: deviation of a pixel's grey level."""
    times = 3
    _, x, y = _on_board(lens, camera_from_board, times)
    white, cell_mm = board.cells(), board.square_mm / CELLS
    column, row = np.floor(x / cell_mm), np.floor(y / cell_mm)
    rim = _MARGIN * CELLS
    (rows, columns) = white.shape
    paper = (column >= -rim) & (column < columns + rim) & (row >= -rim) & (row < rows + rim)
    inside = (column >= 0) & (column < columns) & (row >= 0) & (row < rows)
    grey = np.where(paper, _WHITE, _BEHIND)
    grey[inside] = np.where(
        white[row[inside].astype(int), column[inside].astype(int)], _WHITE, _BLACK
    )
    grey = grey.reshape(lens.height, times, lens.width, times).mean((1, 3))
    grey = cv2.GaussianBlur(grey, (0, 0), blur_px) + rng.normal(0, noise, grey.shape)
    return np.clip(np.rint(grey), 0, 255).astype(np.uint8)


def board_depth_mm(
    board: Board, lens: Lens, camera_from_board: Affine, beside_mm: float = 10.0
) -> Float32[np.ndarray, "h w"]:
    """The true depth of the board and of what is level with it, up to so far beside it."""
    depth_mm, x, y = _on_board(lens, camera_from_board, 1)
    wide, high = board.size_mm
    there = (np.abs(x - wide / 2) < wide / 2 + beside_mm) & (
        np.abs(y - high / 2) < high / 2 + beside_mm
    )
    return np.where(there & (depth_mm > 0), depth_mm, np.nan).astype(np.float32)


def looks_at_board(
    board: Board,
    count: int,
    rng: np.random.Generator,
    distances_mm: tuple[float, float] = (70.0, 200.0),
    tilt_degrees: float = 35.0,
) -> list[Affine]:
    """``camera_from_board`` as one would hold it: near and far, tilted to all sides, turned about
    the line of sight, the middle of the view on the board's inner half."""
    looks = []
    for distance_mm in np.geomspace(*distances_mm, count):
        toward, tilt = rng.uniform(0, 2 * np.pi), np.radians(rng.uniform(0.2, 1) * tilt_degrees)
        tilted = cv2.Rodrigues(tilt * np.array([np.cos(toward), np.sin(toward), 0]))[0]
        turned = cv2.Rodrigues(np.array([0, 0, rng.uniform(-0.8, 0.8)]))[0]
        aim_mm = np.array([*(rng.uniform(0.25, 0.75, 2) * board.size_mm), 0])
        turn = tilted @ turned
        looks.append(rigid(turn, np.array([0, 0, distance_mm]) - turn @ aim_mm))
    return looks


def _on_board(
    lens: Lens, camera_from_board: Affine, times: int
) -> tuple[Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"], Float64[np.ndarray, "h w"]]:
    """Depth where each ray meets the board's plane, and where on it, x and y; mm."""
    rays = pixel_rays(lens, times)
    turn, shift = camera_from_board[:3, :3], camera_from_board[:3, 3]
    with np.errstate(divide="ignore"):
        depth_mm = (turn[:, 2] @ shift) / (rays @ turn[:, 2])
    on_mm = (rays * depth_mm[..., None] - shift) @ turn[:, :2]
    behind = depth_mm <= 0
    on_mm[behind] = np.inf
    return depth_mm, on_mm[..., 0], on_mm[..., 1]
