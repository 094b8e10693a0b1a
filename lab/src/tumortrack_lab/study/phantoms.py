"""The built-in phantoms as cases: the paper's, and a second kidney for the deformation study."""

from __future__ import annotations

from pathlib import Path

from tumortrack.core import store
from tumortrack.imaging.case import Case, load_case, save_case
from tumortrack.imaging.surface import surfaces
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack_lab.study.measure import StudyCase

UP_LPS = (0.0, -1.0, 0.0)


def phantom_case(folder: Path, parameters: PhantomParameters, voxel_mm: float) -> None:
    """Write a phantom's case folder from its exact labels; one that is there stays."""
    if folder.exists():
        return
    labels = phantom_labels(parameters, voxel_mm)
    anatomy, _ = surfaces(labels)
    with store.new_folder(folder) as aside:
        save_case(Case(anatomy, labels, UP_LPS, {"kind": "phantom"}), aside)


def study_case(name: str, folder: Path, scenes: Path, is_paper: bool = False) -> StudyCase:
    """A case folder and its scenes as the study takes them.

    Raises:
        ArtifactError: ``folder`` is no case, or damaged.
    """
    case = load_case(folder)
    return StudyCase(name, folder, scenes, case.anatomy, case.up_lps, is_paper)
