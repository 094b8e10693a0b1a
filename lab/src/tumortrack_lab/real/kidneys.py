"""Kidneys of KiTS19, selected by geometry alone before any was located.

The rule: in order of case numbers, leaving out those in use (00000, 00002, 00003) and those set
aside for judging (``SET_ASIDE``), the first six of each kind whose tumor-bearing kidney passes all:
`tumortrack prepare` takes the label map as it is and knows the side; no label touches the map's
border; the kidney with its tumors has 100 to 400 ml, its largest tumor 1 to 100 ml. The kind is
given by the share of the largest tumor's surface within 2 mm of the organ's outer surface:
endophytic below 0.25, exophytic from 0.5 up; between them neither.

``kits19.json`` is what the rule gave: numbers only. Label maps: Heller et al. 2019
(arXiv:1904.00445), CC BY-NC-SA 4.0; they stay with the user.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from tumortrack import api
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_query import surface_samples
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.imaging.case import Case
from tumortrack.report.metrics import distance_to_surface

SET_ASIDE = (91, 93, 96, 146, 155)
NEAR_MM = 2.0
KINDS = {"endophytic": (0.0, 0.25), "exophytic": (0.5, 1.01)}  # of the share: from, below
ORGAN_ML, TUMOR_ML = (100.0, 400.0), (1.0, 100.0)
FROZEN = Path(__file__).with_name("kits19.json")
WHERE = "data/case_NNNNN/segmentation.nii.gz of https://github.com/neheller/kits19"


def name_of(number: int) -> str:
    return f"case_{number:05d}"


def label_map(data: Path, number: int) -> Path:
    """The user's copy. Raises InputError: it is missing, or the case is set aside."""
    if number in SET_ASIDE:
        raise InputError(f"{name_of(number)} is set aside for judging and is not loaded here.")
    path = data / "kits19" / name_of(number) / "segmentation.nii.gz"
    if not path.is_file():
        raise InputError(f"{path} is missing: put a copy of {WHERE} there.")
    return path


def outer_share(tumor: Mesh, organ: Mesh) -> float:
    """The share of a tumor's surface within ``NEAR_MM`` of the organ's outer surface."""
    points_mm, area_mm2 = surface_samples(tumor)
    near = distance_to_surface(points_mm, organ) <= NEAR_MM
    return float(area_mm2[near].sum() / area_mm2.sum())


def described(case: Case, path: Path) -> dict[str, Any]:
    """A case in numbers, as the list has it."""
    organ_ml, *tumors_ml = case.report["volumes_ml"].values()
    share = outer_share(case.anatomy.tumors[0], case.anatomy.organ) if tumors_ml else 1.0
    return {
        "sha256": store.sha256_of(path),
        "side": case.patient.side,
        "kind": kind_of(share),
        "outer_share": round(share, 3),
        "organ_ml": round(organ_ml, 1),
        "tumors_ml": [round(ml, 2) for ml in tumors_ml],
        "spacing_mm": [round(mm, 3) for mm in case.report["spacing_mm"]],
    }


def kind_of(share: float) -> str:
    kinds = (kind for kind, (low, high) in KINDS.items() if low <= share < high)
    return next(kinds, "between")


def with_kinds(rows: list[dict[str, Any]], anatomy: Anatomy) -> list[dict[str, Any]]:
    """The rows of a case's scenes, and of each tumor its kind."""
    kinds = [kind_of(outer_share(tumor, anatomy.organ)) for tumor in anatomy.tumors]
    for row in rows:
        for tumor, kind in zip(row["tumors"], kinds, strict=False):
            tumor["kind"] = kind
    return rows


def prepared(data: Path, number: int, folder: Path) -> Case:
    """The case by `tumortrack prepare`, with its default settings; made once."""
    path = label_map(data, number)
    if not folder.exists():
        return api.prepare(path, folder, patient=name_of(number))
    case = api.load_case(folder)
    if case.report.get("source_sha256") != store.sha256_of(path):
        raise InputError(f"{folder} was made from another label map; remove it.")
    return case


def in_turn(rows: Sequence[dict[str, Any]]) -> list[dict[str, Any]]:
    """The two kinds alternating, so that any part of the list has both."""
    kinds = [[row for row in rows if row["kind"] == kind] for kind in KINDS]
    return [row for pair in zip(*kinds, strict=True) for row in pair]


def frozen() -> list[dict[str, Any]]:
    """The list, in the order of work."""
    return in_turn(store.read_json(FROZEN)["kidneys"])


def check(data: Path, cases: Path, rows: Sequence[dict[str, Any]]) -> dict[str, Path]:
    """Prepare the listed kidneys from the user's copies, and compare them with the list.

    Returns:
        Case folders by name.

    Raises:
        InputError: a copy is missing or another file, or its kidney is not the one in the list.
    """
    folders = {}
    for row in rows:
        number = row["case"]
        path, folder = label_map(data, number), cases / name_of(number)
        if store.sha256_of(path) != row["sha256"]:
            raise InputError(f"{path} is not the file in the list; fetch {WHERE} again.")
        now = {"case": number, **described(prepared(data, number, folder), path)}
        if now != row:
            raise InputError(f"{folder}: {now} is prepared now, where the list has {row}.")
        folders[name_of(number)] = folder
    return folders
