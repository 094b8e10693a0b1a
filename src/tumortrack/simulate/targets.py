"""Target points: points inside the organ with known positions in the CT and before the camera.

targets.csv of a scene: label, ct_x, ct_y, ct_z (LPS, mm), camera_x, camera_y, camera_z (mm).
"""

from __future__ import annotations

import csv
import io
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from jaxtyping import Float, Float64, UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Anatomy
from tumortrack.simulate.occupancy import contains, labels_of

TARGETS = 200
_COLUMNS = ("label", *(f"{frame}_{axis}" for frame in ("ct", "camera") for axis in "xyz"))


@dataclass(frozen=True, eq=False)
class Targets:
    """Points in the undeformed CT (LPS, mm), their true places before the camera (mm), labels."""

    points_ct: Float64[np.ndarray, "n 3"]
    points_mm: Float[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]


@dataclass(frozen=True, eq=False)
class InnerPoints:
    """Points inside the undeformed anatomy, CT frame (LPS), mm, with their labels."""

    points_ct: Float64[np.ndarray, "n 3"]
    labels: UInt8[np.ndarray, " n"]

    def at(self, points_mm: Float[np.ndarray, "n 3"]) -> Targets:
        """These points as targets of a scene in which they lie there (camera frame)."""
        return Targets(self.points_ct, points_mm, self.labels)


def draw_targets(anatomy_ct: Anatomy, seed: int, count: int = TARGETS) -> InnerPoints:
    """Points spread evenly inside each part: half of them in the parenchyma, the others shared
    by the tumors (all in the organ where it has none).

    Raises:
        InputError: a tumor that others cover; a negative seed.
    """
    if seed < 0:
        raise InputError(f"seed {seed} must be 0 or more.")
    rng = np.random.default_rng([seed, 1000])
    n_tumors = len(anatomy_ct.tumors)
    inside = count // 2 if n_tumors else count
    each = np.full(n_tumors, (count - inside) // max(n_tumors, 1))
    each[: count - inside - each.sum()] += 1
    points, counts = [], [inside, *each.tolist()]
    for label, (part, wanted) in enumerate(zip(anatomy_ct.parts, counts, strict=True), start=1):
        found = np.zeros((0, 3))
        for _ in range(40):
            if len(found) >= wanted:
                break
            low, high = part.box_mm
            drawn = low + rng.random((4 * count, 3)) * (high - low)
            drawn = drawn[contains(part, drawn)]
            found = np.concatenate([found, drawn[labels_of(anatomy_ct, drawn) == label]])
        else:
            name = anatomy_ct.names[label - 1]
            raise InputError(f"{name} has no room for target points: other tumors cover it.")
        points.append(found[:wanted])
    labels = np.repeat(np.arange(1, len(counts) + 1, dtype=np.uint8), counts)
    return InnerPoints(np.concatenate(points), labels)


def write_targets(path: Path, targets: Targets) -> None:
    """Write targets.csv, to 0.01 micrometres.

    Raises:
        StorageError: the disk refused.
    """
    table = np.column_stack([targets.labels, targets.points_ct, targets.points_mm])
    text, numbers = io.StringIO(), ["%d", *["%.5f"] * 6]
    np.savetxt(text, table, numbers, delimiter=",", header=",".join(_COLUMNS), comments="")
    write_atomically(path, text.getvalue().encode())


def read_targets(path: Path) -> Targets:
    """Read targets.csv, ours or another program's; further columns are not looked at.

    Raises:
        InputError: a column or every row is missing, or a value is no finite number.
    """
    try:
        with path.open(encoding="utf-8-sig", newline="") as stream:
            rows = list(csv.DictReader(stream))
    except (OSError, UnicodeDecodeError, csv.Error) as error:
        raise InputError(f"{path} cannot be read as a table: {error}.") from error
    lacks = [name for name in _COLUMNS if not rows or name not in rows[0]]
    if lacks:
        raise InputError(
            f"{path} has no rows, or lacks the columns {', '.join(lacks)}. Targets need "
            f"{','.join(_COLUMNS)}; remove the file if the scene has none."
        )
    try:
        table = np.array([[float(row[name]) for name in _COLUMNS] for row in rows])
        if not np.isfinite(table).all():
            raise ValueError("NaN or infinite")
        labels = table[:, 0]
        if not np.isin(labels, np.arange(1, 256)).all():
            raise ValueError("labels must be 1 (organ), 2, 3, ... (tumors)")
    except (TypeError, ValueError, OverflowError) as error:
        raise InputError(f"{path} has a row that is no target: {error}.") from error
    return Targets(table[:, 1:4], table[:, 4:], labels.astype(np.uint8))
