"""Options of `prepare`; the command line shows these texts. Nothing heavy is imported here."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, cast

from tumortrack.core.errors import InputError
from tumortrack.core.organ import Organ, check_name
from tumortrack.core.patient import UNKNOWN, Patient, Side

ORGAN_HU, TUMOR_HU = (-300.0, 300.0), (300.0, 1000.0)
MIN_TUMOR_ML = 0.2
_MOST_TILTED = 60.0  # degrees: two such tilts make 85, and more would show another side
_ALLOWED = {
    "rotations": ("limited", "full"), "sensor": ("d405", "stereo"), "unit": ("mm", "m", None),
}  # fmt: skip


@dataclass(frozen=True, kw_only=True)
class PrepareOptions:
    """How to read a CT, a label map or a folder of meshes.

    Attributes:
        organ_hu: HU window of the organ in a CT: low (inclusive) and high.
        tumor_hu: HU window of the tumors in a CT.
        labels: the input is a label map (mostly recognised by itself).
        side: of organs in pairs, the patient's one to take from a label map (default: the one
            with most tumor); of a CT or meshes, which one it is.
        organ: label number of the organ, again for each label that counts as organ too (default:
            by its name, where labels have names, else 1).
        tumor: likewise of the tumors; 0: none. Default: by name; in a map without names whose organ
            is 1, every label from 2 up.
        up: patient direction that faces the camera: anterior, left, ... or "x,y,z" in LPS.
        rotations: how the organ may lie then: turned about the line of sight and tilted by up to
            TILT, or in any way (full). What is excluded here is never the answer.
        tilt: degrees, about each axis across the line of sight.
        sensor: the camera that will see it: a RealSense D405, or a stereo endoscope, whose depth
            is matched.
        series: which DICOM series, if the folder holds several (UID or number in the list).
        unit: of mesh files.
        min_tumor_ml: smaller tumors are reported and dropped.
        patient: whose organ it is (default: DICOM's PatientID). It is stored in every folder and
            message that follows; a pseudonym keeps the PatientID out of them.
        name: which organ it is; its files, parts and topics bear this name.
        term: SNOMED CT code and meaning of the organ, where NAME is none of the usual ones.
        structure: NAME=NUMBER (a label) or NAME=PATH (a mesh, closed or open), again for every
            one: vessels and the like, which move with the organ.
        ct: of a label map or meshes: their CT, on the same grid, to be shown.
    """

    organ_hu: tuple[float, float] = ORGAN_HU
    tumor_hu: tuple[float, float] = TUMOR_HU
    labels: bool = False
    side: str | None = None
    organ: int | tuple[int, ...] = ()
    tumor: int | tuple[int, ...] = ()
    up: str = "anterior"
    rotations: Literal["limited", "full"] = "limited"
    tilt: float = 30.0
    sensor: Literal["d405", "stereo"] = "d405"
    series: str | None = None
    unit: str | None = None
    min_tumor_ml: float = MIN_TUMOR_ML
    patient: str | None = None
    name: str = "kidney"
    term: tuple[str, str] | None = None
    structure: tuple[str, ...] = ()
    ct: Path | None = None

    def __post_init__(self) -> None:
        from tumortrack.core.geometry import direction_lps

        if not (math.isfinite(self.min_tumor_ml) and self.min_tumor_ml >= 0):
            raise InputError(f"min_tumor_ml {self.min_tumor_ml} must be 0 or more (ml).")
        numbers = *self.organs, *(self.tumors or ())
        if not all(1 <= n <= 255 for n in numbers):
            raise InputError("label numbers must lie in 1..255 (tumor 0, and no other: none).")
        if len(set(numbers)) < len(numbers):
            raise InputError("--organ and --tumor name a label twice. Give each once.")
        if self.side not in (None, "left", "right"):
            raise InputError(f"side {self.side!r} is not allowed: left or right (the patient's).")
        self.organ_kind.check_side(self.side)
        parse_structures(self.structure, self.name)
        direction_lps(self.up)
        if not 0 <= self.tilt <= _MOST_TILTED:
            raise InputError(
                f"tilt is {self.tilt:g} degrees; allowed: 0 to {_MOST_TILTED:g}, or rotations full."
            )
        for name, allowed in _ALLOWED.items():
            if (value := getattr(self, name)) not in allowed:
                words = " or ".join(filter(None, allowed))
                raise InputError(f"{name} {value!r} is not allowed: {words}.")
        if self.patient is not None:
            Patient(self.patient)

    @property
    def organs(self) -> tuple[int, ...]:
        return _labels(self.organ)

    @property
    def tumors(self) -> tuple[int, ...] | None:
        """None: not stated."""
        stated = _labels(self.tumor)
        return () if stated == (0,) else stated or None

    @property
    def organ_kind(self) -> Organ:
        return Organ(name=self.name, term=self.term)

    @property
    def stated_side(self) -> Side:
        return cast(Side, self.side or UNKNOWN)  # it was checked above


def _labels(given: int | tuple[int, ...]) -> tuple[int, ...]:
    numbers = (given,) if isinstance(given, int | str) else tuple(given or ())
    if not all(isinstance(number, int) for number in numbers):
        raise InputError(f"labels are whole numbers, not {numbers}.")
    return numbers


def parse_structures(options: tuple[str, ...], organ: str) -> dict[str, int | Path]:
    """The label number or the mesh's path by name. Raises InputError: not NAME=NUMBER or NAME=PATH,
    a name twice, or one that is not allowed."""
    stated: dict[str, int | Path] = {}
    for option in options:
        name, _, value = option.partition("=")
        if not value:
            raise InputError(f"--structure {option!r} is not NAME=NUMBER or NAME=PATH.")
        check_name(name, "a structure", "--structure")
        if name in stated or name == organ:
            raise InputError(f"--structure {name}: that name is taken. Give another.")
        stated[name] = int(value) if value.isdecimal() else Path(value)
    return stated
