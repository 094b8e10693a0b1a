"""A ChArUco board: drawn at its true size, and found in pictures.

Board frame, as OpenCV's since 4.6: origin at a corner of the board, x along its columns, y along
its rows, z away from who looks at it; mm.
"""

from __future__ import annotations

import io
from collections.abc import Sequence
from pathlib import Path
from typing import Any, NamedTuple

import cv2
import numpy as np
from jaxtyping import Bool, Float64, UInt8

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.store import write_atomically

# A square is 8 x 8 cells: a marker (4 x 4 bits in a black frame of one cell) in a frame of white.
CELLS, _MARKER_CELLS = 8, 6
_DICTIONARY, _MARKERS = cv2.aruco.DICT_4X4_250, 250
_LEAST_CORNERS = 10
_PAGES_MM = (210.0, 297.0), (297.0, 420.0), (420.0, 594.0), (594.0, 841.0)  # A4 to A1
_BORDER_MM = 24.0  # for rulers, and what printers leave white, on both sides


class Corners(NamedTuple):
    """Corners of squares that a picture shows: on the board (z = 0), and their pixels."""

    board_mm: Float64[np.ndarray, "n 3"]
    pixels: Float64[np.ndarray, "n 2"]


class Board(Config, frozen=True, kw_only=True):
    """``columns`` x ``rows`` squares of this size. Raises InputError: it can't be made."""

    columns: int = 15
    rows: int = 21
    square_mm: float = 12.0

    def __post_init__(self) -> None:
        self.check_between("board:", columns=(4, 60), rows=(4, 60), square_mm=(1, 200))
        if self.columns * self.rows // 2 > _MARKERS:
            raise InputError(
                f"board: {self.columns} x {self.rows} squares need {self.columns * self.rows // 2} "
                f"markers; there are {_MARKERS}. Take fewer, larger squares."
            )

    @property
    def size_mm(self) -> tuple[float, float]:
        return self.columns * self.square_mm, self.rows * self.square_mm

    def charuco(self) -> Any:
        """OpenCV's board."""
        marker_mm = self.square_mm * _MARKER_CELLS / CELLS
        markers = cv2.aruco.getPredefinedDictionary(_DICTIONARY)
        size = self.columns, self.rows
        return cv2.aruco.CharucoBoard(size, self.square_mm, marker_mm, markers)

    def cells(self) -> Bool[np.ndarray, "down right"]:
        """Which cells are white, ``CELLS`` a square."""
        size = self.columns * CELLS, self.rows * CELLS
        return self.charuco().generateImage(size, marginSize=0, borderBits=1) > 0


def find_boards(pictures: Sequence[UInt8[np.ndarray, "h w"]], board: Board) -> list[Corners | None]:
    """The board's corners in grey pictures; None where fewer than 10 show. Raises InputError, which
    says what may be wrong: it is in none of them."""
    charuco = board.charuco()
    detector, on_board_mm = cv2.aruco.CharucoDetector(charuco), charuco.getChessboardCorners()
    found: list[Corners | None] = []
    markers = 0
    for picture in pictures:
        pixels, numbers, _, seen = detector.detectBoard(picture)
        markers = max(markers, 0 if seen is None else len(seen))
        enough = numbers is not None and len(numbers) >= _LEAST_CORNERS
        if not enough or charuco.checkCharucoCornersCollinear(numbers):
            found.append(None)
            continue
        on_mm = on_board_mm[numbers.ravel()].astype(np.float64)
        found.append(Corners(on_mm, pixels.reshape(-1, 2).astype(np.float64)))
    if not any(found):
        size = f"{board.columns} x {board.rows} squares of dictionary DICT_4X4_250"
        why = "no marker is seen: is it in focus, evenly lit, and near enough?"
        mirrored = [detector.detectBoard(np.ascontiguousarray(p[:, ::-1])) for p in pictures[:8]]
        if any(numbers is not None for _, numbers, _, _ in mirrored):
            why = "it is mirrored: print it, or take the pictures, the right way round"
        elif markers >= _LEAST_CORNERS:
            why = f"{markers} markers are seen, but not in this order: give its true --squares"
        raise InputError(f"the board ({size}) is in none of {len(pictures)} pictures: {why}.")
    return found


def draw_board(board: Board, path: Path) -> None:
    """A page to print at 100 %, with rulers that show if it was (.pdf, .svg; .png of 300 dpi).
    Raises InputError: another suffix, or no page is large enough."""
    from tumortrack.report.drawing import new_figure

    kind = path.suffix.lower().removeprefix(".")
    if kind not in ("pdf", "svg", "png"):
        raise InputError(f"{path}: a board is written as .pdf, .svg or .png.")
    wide, high = board.size_mm
    pages = [(w, h) for w, h in _PAGES_MM if wide + _BORDER_MM <= w and high + _BORDER_MM <= h]
    if not pages:
        raise InputError(
            f"a board of {wide:g} x {high:g} mm fits no page up to A1 (turned upright); take fewer "
            "or smaller squares."
        )
    (page_w, page_h), cell_mm = pages[0], board.square_mm / CELLS
    left, top = (page_w - wide) / 2, (page_h - high) / 2
    figure = new_figure(page_w / 25.4, page_h / 25.4)
    axes = figure.add_axes((left / page_w, top / page_h, wide / page_w, high / page_h))
    for row, black in enumerate(~board.cells()):
        runs = np.flatnonzero(np.diff(np.pad(black, 1).astype(int))).reshape(-1, 2) * cell_mm
        bars = [(begin, end - begin) for begin, end in runs]
        axes.broken_barh(bars, (row * cell_mm, cell_mm), color="black", linewidth=0)
    axes.set(xlim=(0, wide), ylim=(high, 0))
    axes.set(xticks=np.arange(0, wide + 1, 10), yticks=np.arange(0, high + 1, 10))
    axes.tick_params(labelsize=5)
    for side in axes.spines.values():
        side.set(position=("outward", 9), linewidth=0)
    words = (
        f"ChArUco {board.columns} x {board.rows}, squares {board.square_mm:g} mm, DICT_4X4_250. "
        "Print at 100 %, glue on glass. Measure both rulers (mm): where they are off, so is "
        "--square-mm."
    )
    figure.text(left / page_w, 1 - (top - 5) / page_h, words, fontsize=7)
    stream = io.BytesIO()
    figure.savefig(stream, format=kind, dpi=300)
    write_atomically(path, stream.getvalue())
