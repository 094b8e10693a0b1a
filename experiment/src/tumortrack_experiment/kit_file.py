"""What a printed kit is known by to everything that comes after it: ``kit.json``.

The base frame: mm, right-handed, z up, against gravity; z = 0 is the top of the base plate, on
which the organ lies, its origin the plate's middle. Beads in dimples of the plate fix this frame in
a CT, in a depth image and for a robot that points at them.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
from jaxtyping import Float64

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import read_rigid
from tumortrack.core.store import MANIFEST, read_json, sha256_of
from tumortrack.io.case import Case, load_case

KIT_FILE = "kit.json"
LEAST_BEADS = 4  # three fix a frame; the fourth shows that one of them is wrong

Point = tuple[float, float, float]
Rows = tuple[tuple[float, float, float, float], ...]


class Bead(Config, frozen=True, kw_only=True):
    """A ball in its dimple. ``center_mm``: its middle, base frame."""

    name: str
    center_mm: Point


class KitPart(Config, frozen=True, kw_only=True):
    """A printed part. ``file``: STL beside ``kit.json``; ``base_from_part``: where it stands on the
    base when it is in use there (4 x 4 rows), as plates, stands and the base itself do."""

    name: str
    file: str
    purpose: str
    volume_ml: float
    base_from_part: Rows | None = None
    state: str = ""
    """The state that this part imposes (D1, say); empty: it is there in all of them, or in none."""


class Kit(Config, frozen=True, kw_only=True):
    """A printed kit, base frame, mm. ``organ_ml`` and ``tumors_ml``: what its molds cast, the organ
    with its tumors; ``base_from_ct``: where the organ lies at rest, as designed (4 x 4 rows)."""

    case_sha256: str
    bead_diameter_mm: float
    beads: tuple[Bead, ...]
    base_from_ct: Rows
    organ_ml: float
    tumors_ml: tuple[float, ...]
    states: tuple[str, ...] = ("rest",)
    parts: tuple[KitPart, ...] = ()

    def __post_init__(self) -> None:
        self.check_between("kit:", bead_diameter_mm=(1, 30))
        if len(self.beads) < LEAST_BEADS:
            raise InputError(f"kit: {len(self.beads)} beads; at least {LEAST_BEADS} are needed.")

    @property
    def beads_mm(self) -> Float64[np.ndarray, "n 3"]:
        """Their middles, base frame."""
        return np.array([bead.center_mm for bead in self.beads], np.float64)


def kit_path(folder: Path) -> Path:
    """``kit.json`` of a kit's folder, or that file itself."""
    return folder / KIT_FILE if folder.is_dir() else folder


def read_kit(folder: Path) -> Kit:
    """The kit of a folder that `tumortrack phantom-kit` wrote, or of its ``kit.json``. Raises
    ArtifactError or InputError: there is none, or it is damaged."""
    path = kit_path(folder)
    kit = from_builtins(read_json(path), Kit, str(path))
    read_rigid(kit.base_from_ct, "mm", f"{path}: base_from_ct")
    return kit


def case_of_kit(folder: Path, kit: Kit) -> Case:
    """The case in a folder. Raises InputError: none, or not the one that the kit was made of."""
    case = load_case(folder)
    if sha256_of(folder / MANIFEST) != kit.case_sha256:
        raise InputError(
            f"{folder} is not the case that this kit was made of, so its tumors lie elsewhere. "
            "Give the case that `tumortrack phantom-kit` was given."
        )
    return case
