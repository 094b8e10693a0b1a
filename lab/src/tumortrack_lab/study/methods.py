"""What can be measured: cases with their scenes; trained models and peers, as methods that locate.

A method has an identity, and turns a scene's cloud into an estimate. Nothing heavy is made or
loaded before a measurement needs it. Models are trained by a preset's rules for a fixed number of
steps, and kept.
"""

from __future__ import annotations

import ast
import hashlib
import math
from abc import ABC, abstractmethod
from collections.abc import Callable, Iterable
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import NamedTuple

from msgspec.structs import replace as changed

import tumortrack
import tumortrack_lab.peers
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Estimate, OneWay
from tumortrack.core.patient import Patient
from tumortrack.core.types import Anatomy
from tumortrack.imaging.case import Case, load_case, save_case
from tumortrack.imaging.surface import surfaces
from tumortrack.models.config import TrainConfig
from tumortrack.models.folder import is_finished
from tumortrack.models.model import Model
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.registration.model import RegistrationModel
from tumortrack.sense.clutter import ClutterConfig
from tumortrack.sense.noise import CalibrationConfig
from tumortrack.sense.occlusion import OcclusionConfig
from tumortrack.simulate.deform import DragConfig
from tumortrack.simulate.deform.drag import CONFIGURATIONS
from tumortrack.simulate.scene_folder import Scene
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.model import load_model
from tumortrack.training.train import TrainingRun, TrainingStatus, train
from tumortrack_lab.peers.base import Fit, Peer, estimate_of
from tumortrack_lab.peers.kinds import PeerKind, peer_kinds

_UP_LPS = (0.0, -1.0, 0.0)
_VOXEL_MM = 0.8  # of the phantoms' labels
# A preset: anatomy and rotations (limited, full) -> training configuration.
Preset = Callable[[Anatomy, str], TrainConfig]
Report = Callable[[str, TrainingStatus], None]
MODELS = {"M_lim": "limited", "M_full": "full"}  # of the preset quick
CLINIC = "clinic"
UNREFINED = "_unrefined"  # how the names of models end whose warps are not laid on the cloud
ABLATED = ("clinic_drags", "clinic_clean", "clinic_pointnet", "quick_elastic")
_DRAGS = 10  # kinds of drags beside one elastic kind, all with equal chance
_LIVE_STAGES = ("encode", "coarse", "refine", "fine")  # of a live frame: without the dense volume


@dataclass(frozen=True, eq=False)
class StudyCase:
    """A patient or phantom with its scenes; ``is_paper``: a phantom, after the paper's."""

    name: str
    folder: Path
    scenes: Path
    anatomy_ct: Anatomy
    up_lps: tuple[float, float, float]
    is_paper: bool = False

    def scene(self, variant: str, view: str) -> Path:
        return self.scenes / f"{variant}-{view}"


def study_case(name: str, folder: Path, scenes: Path, is_paper: bool = False) -> StudyCase:
    """Raises ArtifactError: the folder is no case, or damaged."""
    case = load_case(folder)
    return StudyCase(name, folder, scenes, case.anatomy, case.up_lps, is_paper)


def phantom_case(folder: Path, parameters: PhantomParameters) -> Path:
    """Write a phantom's case folder; one that is there stays."""
    if not folder.exists():
        labels = phantom_labels(parameters, _VOXEL_MM)
        patient = Patient("PHANTOM", parameters.side)
        case = Case(surfaces(labels)[0], labels, _UP_LPS, {"kind": "phantom"}, patient=patient)
        with store.new_folder(folder) as aside:
            save_case(case, aside)
    return folder


def named_folders(texts: Iterable[str], taken: Iterable[str]) -> dict[str, Path]:
    """Folders by name, of options NAME=FOLDER; InputError for a name that is none, or double."""
    folders: dict[str, Path] = {}
    for text in texts:
        name, _, folder = text.partition("=")
        if not name.isidentifier() or not folder or name in (*taken, *folders):
            raise InputError(f"--case {text!r} must be NAME=FOLDER, with a name of its own.")
        folders[name] = Path(folder)
    return folders


class Answer(NamedTuple):
    """An estimate, and what a live frame of it costs."""

    estimate: Estimate
    frame_s: float


class Method(ABC):
    """One way to locate, for one patient."""

    device: str = "cpu"

    # Spent once for a patient, before the first frame: training, or a peer's own work.
    prepare_s: float | None

    @property
    @abstractmethod
    def identity(self) -> dict:
        """``kind``, ``name`` and everything else that decides the answers (JSON)."""

    @property
    def about(self) -> dict:
        """What else a reader wants to know of it (JSON)."""
        return {"prepare_s": self.prepare_s}

    @abstractmethod
    def locate(self, scene: Scene, grid: int) -> Answer:
        """The anatomy in a scene; ``grid``: voxels along the longest side of the volume. Raises
        NoEstimate: nothing can be said of the scene; InputError: the cloud cannot be used."""


def answer_of(fit: Fit, anatomy_ct: Anatomy, scene: Scene, grid: int) -> Answer:
    estimate = estimate_of(fit, anatomy_ct, scene.cloud.stamp_ns, grid)
    return Answer(replace(estimate, motion=OneWay(fit.carry)), fit.seconds)


@dataclass(frozen=True)
class Network(Method):
    """A trained model under a name such as M_lim; ``unrefined``: its warps as the network says
    them, not laid on the cloud."""

    name: str
    folder: Path
    want_device: str = "auto"
    locate_seed: int = 0
    unrefined: bool = False

    @cached_property
    def identity(self) -> dict:
        named = {"unrefined": True} if self.unrefined else {}  # older measurements have no such key
        return {
            "kind": "network",
            "name": self.name,
            **{key: self._provenance[key] for key in ("seed", "steps")},
            "locate_seed": self.locate_seed,
            "model_sha256": store.sha256_of(self.folder / store.MANIFEST),
            **named,
        }

    @cached_property
    def _provenance(self) -> dict:
        return store.read_json(self.folder / store.MANIFEST)["provenance"]

    @cached_property
    def _tracker(self) -> Tracker:
        model = load_model(self.folder, self.want_device)
        return Tracker(without_refinement(model) if self.unrefined else model)

    @property
    def device(self) -> str:  # type: ignore[override]
        return str(next(self._tracker.model.network.parameters()).device.type)

    @property
    def prepare_s(self) -> float | None:  # type: ignore[override]
        return self._provenance["training_s"]

    @property
    def about(self) -> dict:
        keys = ("seed", "steps", "training_s", "device", "validation_miou")
        return {key: self._provenance[key] for key in keys}

    def locate(self, scene: Scene, grid: int) -> Answer:
        estimate = self._tracker.locate(scene.cloud, grid, self.locate_seed)
        seconds = estimate.report["timings"]
        return Answer(estimate, sum(seconds.get(stage, 0.0) for stage in _LIVE_STAGES))


def without_refinement(model: Model) -> RegistrationModel:
    """The warp model that takes its network's word; only which way round an organ lies, where the
    network is in doubt, is still decided by the cloud. Any fit is familiar and usual to it, for
    validation knew refined ones. Raises InputError: the model is no warp."""
    if not isinstance(model, RegistrationModel):
        raise InputError("only warps are refined; an occupancy model has no unrefined form.")
    return replace(
        model,
        config=changed(model.config, refine=changed(model.config.refine, steps=0)),
        in_distribution=changed(model.in_distribution, fit_mm=math.inf),
        calibration=changed(model.calibration, usual_cost=math.inf),
    )


@dataclass(frozen=True, eq=False)
class PeerMethod(Method):
    """A peer of one patient as a method."""

    name: str
    kind: PeerKind
    case: StudyCase

    @cached_property
    def identity(self) -> dict:
        settings = to_builtins(self.kind.config) if self.kind.config else {}
        if self.kind.program_sha256:
            settings["program"] = self.kind.program_sha256  # wherever it lies
        return {
            "kind": "peer",
            "name": self.name,
            "settings": settings,
            "code_sha256": code_sha256(Path(tumortrack_lab.peers.__path__[0]).glob("*.py")),
            "versions": self.kind.versions,
            "tumortrack": tumortrack.__version__,
        }

    @cached_property
    def peer(self) -> Peer:
        return self.kind.made_for(self.case.anatomy_ct, self.case.up_lps)

    @property
    def prepare_s(self) -> float | None:  # type: ignore[override]
        return self.peer.prepare_s

    def locate(self, scene: Scene, grid: int) -> Answer:
        return answer_of(self.peer.fit(scene), self.case.anatomy_ct, scene, grid)


def code_sha256(paths: Iterable[Path]) -> str:
    """Of files of code without comments and docstrings: after a change of what they do, it is
    measured anew; after a change of words it is not."""
    digest = hashlib.sha256()
    for path in sorted(paths):
        tree = ast.parse(path.read_text(encoding="utf-8"))
        for node in ast.walk(tree):
            if isinstance(node, ast.Module | ast.ClassDef | ast.FunctionDef) and ast.get_docstring(
                node
            ):
                node.body = node.body[1:]
        digest.update(f"{path.name}\0{ast.dump(tree)}\n".encode())
    return digest.hexdigest()


def peer_method(name: str, case: StudyCase, bcpd: Path | None = None) -> PeerMethod:
    """The peer with this name for a case; ``bcpd`` is the built program of that peer. Raises
    InputError: no such peer, or no program for ``bcpd``."""
    kinds = peer_kinds(bcpd)
    if name not in kinds:
        raise InputError(f"peer {name!r} is unknown. Allowed: {', '.join(kinds)}.")
    return PeerMethod(name, kinds[name], case)


class Presets(NamedTuple):
    quick: Preset
    clinic: Preset


def train_config(name: str, case: StudyCase, presets: Presets) -> TrainConfig:
    """How the model of a name is trained. Raises InputError: no such model."""
    quick = presets.quick(case.anatomy_ct, MODELS.get(name, "limited"))
    if name in MODELS:
        return quick
    drags = {number: DragConfig(steps=steps) for number, steps in CONFIGURATIONS.items()}
    if name.startswith("configuration_"):
        return _with_scene(quick, deform=(drags[int(name.rpartition("_")[2])],))
    own = presets.clinic(case.anatomy_ct, "limited")
    match name:
        case "clinic":
            return own
        case "clinic_drags":
            # Some stay elastic: the body's modes and its library of states must be known.
            both = (drags[3], drags[6]) * (_DRAGS // 2)
            return _with_scene(own, deform=(*both, *own.scene.deform))
        case "clinic_clean":
            clean = {"occlusion": OcclusionConfig(), "clutter": ClutterConfig()}
            return _with_scene(own, **clean, calibration=CalibrationConfig())
        case "clinic_pointnet":
            return changed(own, network=changed(own.network, encoder=quick.network.encoder))
        case "quick_elastic":
            return changed(quick, scene=changed(own.scene, occupancy=quick.scene.occupancy))
    raise InputError(
        f"model {name!r} is unknown. Allowed: {', '.join((*MODELS, CLINIC, *ABLATED))}, each "
        f"warp also with {UNREFINED}, and configuration_1 to {max(CONFIGURATIONS)}."
    )


def _with_scene(config: TrainConfig, **fields: object) -> TrainConfig:
    return changed(config, scene=changed(config.scene, **fields))


@dataclass(frozen=True)
class Trainer:
    """Trains what is not trained yet, or was killed. Steps decide the end, not minutes: a loaded
    machine gives the same model, only later."""

    folder: Path
    presets: Presets
    device: str = "auto"
    workers: int | None = None
    report: Report = lambda *_: None

    def steps_for(self, case: StudyCase, name: str, scenes: int) -> int:
        """Steps after which a model has seen so many scenes."""
        config = train_config(name.removesuffix(UNREFINED), case, self.presets)
        return max(1, scenes // config.batch_size)

    def model(self, case: StudyCase, name: str, seed: int, steps: int) -> Network:
        """The model under FOLDER/CASE/NAME-seed-steps; an unrefined one is the refined one's.
        Raises InputError: no such model; ArtifactError: what lies there belongs to another case or
        configuration; StorageError: the disk refused; Interrupted: Ctrl-C, the state is saved."""
        import torch

        trained = name.removesuffix(UNREFINED)
        folder = self.folder / case.name / f"{trained}-seed{seed}-{steps}steps"
        run = TrainingRun(
            anatomy_ct=case.anatomy_ct,
            up_lps=case.up_lps,
            case_sha256=store.sha256_of(case.folder / store.MANIFEST),
            patient=load_case(case.folder).patient,
            config=train_config(trained, case, self.presets),
            seed=seed,
            steps=steps,
            device=self.device,  # type: ignore[arg-type]
            workers=self.workers,
        )
        # A finished model of another run is refused by training, with a clear text.
        about = store.read_json(folder / store.MANIFEST) if is_finished(folder) else {}
        if about.get("provenance", {}).get("run_sha256") != run.identity:
            threads = torch.get_num_threads()
            label = f"{case.name} {trained} seed {seed}"
            train(run, folder, lambda status: self.report(label, status))
            torch.set_num_threads(threads)  # training leaves some cores to its workers
        return Network(name, folder, self.device, unrefined=trained != name)
