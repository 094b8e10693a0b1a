"""Does it cut the tumor out? Plans made on estimates, and on the truth itself, cut the truth."""

from __future__ import annotations

from dataclasses import asdict, dataclass, replace
from functools import cache, cached_property
from pathlib import Path

import numpy as np
from jaxtyping import Float64

import tumortrack
from tumortrack.core.config import Config, to_builtins
from tumortrack.core.errors import InputError, NoEstimate, NoPlan
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, OccupancyCloud
from tumortrack.plan.config import ResectionConfig
from tumortrack.plan.located import located
from tumortrack.plan.resection import plan_resection
from tumortrack.plan.values import Located
from tumortrack.plan.values import Method as PlanMethod
from tumortrack.registration.locator import QUERIES
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack_lab.cut.resection import VOXEL_MM, cut
from tumortrack_lab.peers.base import Fit, estimate_of
from tumortrack_lab.study.cells import provenance
from tumortrack_lab.study.measure import Job, StudyCase
from tumortrack_lab.study.methods import Answer, Method
from tumortrack_lab.study.paper import tumor_lies
from tumortrack_lab.study.peer_methods import code_sha256

TRUTH = "truth"
_FINE = 256  # voxels along the true organ: its points' labels err by 0.2 mm
MARGIN_MM = 5.0  # the paper's
SIGMAS = 2.0
_PLANNING = (
    "config", "exophytic", "located", "margin", "margin_kernels", "outline", "published",
    "resection", "values",
)  # fmt: skip


class Planner(Config, frozen=True):
    """One way to plan: by whose rules, and how many standard deviations of the estimate are added
    to the margin."""

    method: PlanMethod
    sigmas: float = 0.0
    margin_mm: float = MARGIN_MM

    @property
    def name(self) -> str:
        more = f" + {self.sigmas:g} sd" if self.sigmas else ""
        return f"{self.method}, {self.margin_mm:g} mm{more}"

    def config(self, found: Located, tumor: str) -> ResectionConfig:
        """The paper's planner has one margin for all of the tumor: it is given what the least
        certain place needs."""
        margin_mm, sigmas = self.margin_mm, self.sigmas
        if self.method == "published" and sigmas and tumor in found.std_mm:
            margin_mm, sigmas = margin_mm + sigmas * float(found.std_mm[tumor].max()), 0.0
        return ResectionConfig(method=self.method, tumor=tumor, margin_mm=margin_mm, sigmas=sigmas)


PLANNERS = tuple(Planner(method=m, sigmas=s) for m in ("published", "margin") for s in (0, SIGMAS))


@dataclass(frozen=True, eq=False)
class Truth(Method):
    """Answers what is so: the bound of every planner."""

    name: str = TRUTH
    device: str = "cpu"
    prepare_s: float | None = None

    @property
    def identity(self) -> dict:
        return {"kind": "bound", "name": self.name, "tumortrack": tumortrack.__version__}

    @property
    def about(self) -> dict:
        return {"prepare_s": None}

    def locate(self, scene: Scene, grid: int) -> Answer:
        still = Fit(lambda points: points, 0.0)
        estimate = estimate_of(still, scene.reference, scene.cloud.stamp_ns, max(grid, _FINE))
        return Answer(scattered(estimate), 0.0)


def scattered(estimate: Estimate) -> Estimate:
    """With a cloud as the tracker's: points at random in the organ's box, as many as it asks."""
    assert estimate.volume is not None
    labels, camera_from_index = estimate.volume.labels, estimate.volume.camera_from_index
    low, high = estimate.meshes["kidney"].box_mm
    points_mm = np.random.default_rng(0).uniform(low, high, (QUERIES, 3))
    index = np.rint(transform_points(np.linalg.inv(camera_from_index), points_mm)).astype(int)
    found = labels[tuple(np.clip(index, 0, np.array(labels.shape) - 1).T)]
    inside = found > 0
    cloud = OccupancyCloud(
        points_mm[inside], found[inside], np.ones(inside.sum()), estimate.cloud.stamp_ns
    )
    return replace(estimate, cloud=cloud)


@dataclass(frozen=True, eq=False)
class Cutting(Method):
    """A method whose estimates are planned on and cut: another cell than its accuracy's."""

    inner: Method

    @cached_property
    def identity(self) -> dict:
        planners = [to_builtins(planner) for planner in PLANNERS]
        cutting = {"planners": planners, "voxel_mm": VOXEL_MM, "code_sha256": _code_sha256()}
        return {**self.inner.identity, "cutting": cutting}

    @property
    def device(self) -> str:
        return self.inner.device

    @property
    def prepare_s(self) -> float | None:
        return self.inner.prepare_s

    @property
    def about(self) -> dict:
        return self.inner.about

    def locate(self, scene: Scene, grid: int) -> Answer:
        return self.inner.locate(scene, grid)


def cut_one(job: Job, name: str) -> dict:
    """One cell: ``plans`` by tumor and planner; what the cut did, or why there is none.

    Raises:
        InputError: a scene that does not say where the table is.
    """
    scene = read_scene(job.case.scene(job.variant, job.view))
    table_from_camera = table_of(scene, name)
    truth = Anatomy(
        tuple(
            part.moved(transform_points(table_from_camera, part.vertices_mm))
            for part in scene.reference.parts
        )
    )
    failed, answer = None, None
    plans: dict[str, dict] = {}
    try:
        answer = job.method.locate(scene, job.grid)
    except (NoEstimate, InputError) as error:
        failed = str(error)
    for tumor in exophytic_tumors(job.case):
        if answer is None:
            plans[tumor] = {planner.name: {"refused": failed} for planner in PLANNERS}
            continue
        estimate = answer.estimate
        found = located(estimate.cloud, estimate.meshes, estimate.motion, table_from_camera)
        plans[tumor] = {
            planner.name: planned_and_cut(truth, found, planner, tumor)
            for planner in PLANNERS
            if not planner.sigmas or found.std_mm  # others know no uncertainty
        }
    return {
        "plans": plans,
        "failed": failed,
        "frame_s": answer.frame_s if answer else None,
        "prepare_s": job.method.prepare_s,
        "method": job.method.about,
        "provenance": provenance(job.method.device),
    }


def planned_and_cut(truth: Anatomy, found: Located, planner: Planner, tumor: str) -> dict:
    """Plain JSON: ``refused`` and why, or what the cut did (``CutResult``)."""
    try:
        plan = plan_resection(found, planner.config(found, tumor))
    except (NoPlan, InputError) as error:
        return {"refused": str(error)}
    result = cut(truth, plan)
    more = {"hurt": list(result.hurt), "left_ml": result.left_ml, "promised_ml": plan.volumes_ml}
    return {**asdict(result), **more}


def table_of(scene: Scene, name: str) -> Float64[np.ndarray, "4 4"]:
    """``table_from_camera`` of a scene of the twin, whose bench is the table."""
    if "camera_from_bench" not in scene.meta:
        raise InputError(f"{name} does not say where its table is; make it with tumortrack twin.")
    return np.linalg.inv(np.array(scene.meta["camera_from_bench"], float))


@cache
def exophytic_tumors(case: StudyCase) -> tuple[str, ...]:
    """Parts' names, by the rule of the tables of accuracy."""
    lies = tumor_lies(case.anatomy_ct)
    return tuple(name for name, lie in lies.items() if lie.kind == "exophytic")


@cache
def _code_sha256() -> str:
    """Of what plans and cuts."""
    package = Path(tumortrack.__file__).parent
    paths = [package / "plan" / f"{name}.py" for name in _PLANNING]
    paths += [package / "evaluate" / f"{name}.py" for name in ("resection", "severing")]
    return code_sha256(paths)
