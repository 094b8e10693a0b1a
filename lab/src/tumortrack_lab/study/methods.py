"""Cases with their scenes, and methods to measure on them: the default method and peers.

Nothing heavy is made or loaded before a measurement needs it.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cache
from pathlib import Path
from typing import Any

import tumortrack
import tumortrack_lab.peers
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate
from tumortrack.core.patient import Patient
from tumortrack.core.types import Anatomy
from tumortrack.imaging.case import Case, load_case, save_case
from tumortrack.imaging.surface import surfaces
from tumortrack.phantom.digital import PhantomParameters, TumorParameters, phantom_labels
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.fingerprint import fingerprint
from tumortrack.tracking.model_files import make_model
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.peers.base import OneWay, estimate_of
from tumortrack_lab.peers.kinds import peer_kinds

_UP_LPS = (0.0, -1.0, 0.0)
_VOXEL_MM = 0.8  # of the phantoms' labels
CLINIC = "clinic"


def second_phantom() -> PhantomParameters:
    """Another kidney: three tumors, the deep one in the lower pole, one on the lateral rim."""
    return PhantomParameters(
        size_mm=(56.0, 47.0, 104.0),
        bend_mm=9.0,
        taper=0.04,
        hilum_depth_mm=16.0,
        shape_seed=7,
        tumors=(
            TumorParameters(diameter_mm=30.0, center_mm=(-3.0, 1.0, -20.0)),
            TumorParameters(diameter_mm=26.0, center_mm=(-20.0, -12.0, 17.0)),
            TumorParameters(diameter_mm=12.0, center_mm=(4.0, 2.0, 25.0)),
        ),
    )


@dataclass(frozen=True, eq=False)
class StudyCase:
    """A patient or phantom with its scenes."""

    name: str
    folder: Path
    scenes: Path
    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]

    def scene(self, variant: str, view: str) -> Path:
        """Raises InputError: there is none."""
        path = self.scenes / f"{variant}-{view}"
        if not path.is_dir():
            raise InputError(
                f"{path} does not exist; make the scenes with: tumortrack twin {self.folder} "
                f"{self.scenes}"
            )
        return path


def study_case(name: str, folder: Path, scenes: Path) -> StudyCase:
    """Raises ArtifactError: the folder is no case, or damaged."""
    case = load_case(folder)
    return StudyCase(name, folder, scenes, case.anatomy, case.up_lps)


def phantom_case(folder: Path, parameters: PhantomParameters) -> Path:
    """Write a phantom's case folder, unless it is there."""
    if not folder.exists():
        labels = phantom_labels(parameters, _VOXEL_MM)
        patient = Patient("PHANTOM", parameters.side)
        case = Case(surfaces(labels)[0], labels, _UP_LPS, {"kind": "phantom"}, patient=patient)
        with store.new_folder(folder) as aside:
            save_case(case, aside)
    return folder


def named_folders(texts: Iterable[str], taken: Iterable[str]) -> dict[str, Path]:
    """Folders by name, of options NAME=FOLDER. Raises InputError: an invalid or double name."""
    folders: dict[str, Path] = {}
    for text in texts:
        name, _, folder = text.partition("=")
        if not name.isidentifier() or not folder or name in (*taken, *folders):
            raise InputError(f"--case {text!r} must be NAME=FOLDER, with a name of its own.")
        folders[name] = Path(folder)
    return folders


@dataclass(frozen=True, eq=False)
class Method:
    """One way to locate, for one patient.

    ``identity``: everything else that the answers depend on (JSON). ``locate(scene, grid)``: the
    anatomy in a scene; ``grid``: voxels along the longest side of the volume. Raises NoEstimate:
    nothing can be said of the scene; InputError: the cloud cannot be used.
    """

    name: str
    identity: dict[str, Any]
    locate: Callable[[Scene, int], Estimate]
    seed: int = 0


def clinic(case: StudyCase, seed: int) -> Method:
    """The default method with a model by this seed, made when it is first asked."""
    tracker = cache(lambda: Tracker(make_model(load_case(case.folder), seed=seed)))
    identity = {"tumortrack": tumortrack.__version__, "fingerprint": fingerprint()}
    return Method(CLINIC, identity, lambda s, grid: tracker().locate(s.cloud, grid), seed)


def peer(name: str, case: StudyCase) -> Method:
    """A peer of one patient; it is prepared when it is first asked. Raises InputError: no such
    peer."""
    kinds = peer_kinds()
    if name not in kinds:
        raise InputError(f"peer {name!r} is unknown. Allowed: {', '.join(kinds)}.")
    kind, anatomy_ct = kinds[name], case.anatomy_ct
    made = cache(lambda: kind.made_for(anatomy_ct, case.up_lps))

    def locate(scene: Scene, grid: int) -> Estimate:
        fit = made().fit(scene)
        estimate = estimate_of(fit, anatomy_ct, scene.cloud.stamp_ns, grid)
        return replace(estimate, motion=OneWay(fit.carry))

    identity = {
        "settings": to_builtins(kind.config) if kind.config else {},
        "code_sha256": code_sha256(Path(tumortrack_lab.peers.__path__[0]).glob("*.py")),
        "versions": kind.versions,
        "tumortrack": tumortrack.__version__,
    }
    return Method(name, identity, locate)


def code_sha256(paths: Iterable[Path]) -> str:
    """Of source files: after a change, their measurements are made again."""
    return hashlib.sha256(b"\0".join(path.read_bytes() for path in sorted(paths))).hexdigest()
