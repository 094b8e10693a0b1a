"""Cases of the study: patients and the built-in phantoms, with their scenes."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass
from pathlib import Path

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack.imaging.case import Case, load_case, save_case
from tumortrack.imaging.surface import surfaces
from tumortrack.phantom.digital import PhantomParameters, phantom_labels

_UP_LPS = (0.0, -1.0, 0.0)
_VOXEL_MM = 0.8  # of the phantoms' labels


@dataclass(frozen=True, eq=False)
class StudyCase:
    """A patient or phantom with its scenes; ``is_paper`` where the paper's figures apply."""

    name: str
    folder: Path
    scenes: Path
    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    is_paper: bool = False

    def scene(self, variant: str, view: str) -> Path:
        return self.scenes / f"{variant}-{view}"


def study_case(name: str, folder: Path, scenes: Path, is_paper: bool = False) -> StudyCase:
    """A case folder and its scenes as the study takes them.

    Raises:
        ArtifactError: ``folder`` is no case, or damaged.
    """
    case = load_case(folder)
    return StudyCase(name, folder, scenes, case.anatomy, case.up_lps, is_paper)


def phantom_case(folder: Path, parameters: PhantomParameters) -> Path:
    """Write a phantom's case folder from its exact labels; one that is there stays."""
    if not folder.exists():
        labels = phantom_labels(parameters, _VOXEL_MM)
        case = Case(surfaces(labels)[0], labels, _UP_LPS, {"kind": "phantom"})
        with store.new_folder(folder) as aside:
            save_case(case, aside)
    return folder


def named_folders(texts: Iterable[str], taken: Iterable[str]) -> dict[str, Path]:
    """Folders by name, of options that read NAME=FOLDER.

    Raises:
        InputError: a name that is none, or stands twice.
    """
    folders: dict[str, Path] = {}
    for text in texts:
        name, _, folder = text.partition("=")
        if not name.isidentifier() or not folder or name in (*taken, *folders):
            raise InputError(f"--case {text!r} must be NAME=FOLDER, with a name of its own.")
        folders[name] = Path(folder)
    return folders
