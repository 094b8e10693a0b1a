"""The answers that tools/replay.py compares: of clouds, images, evidence, frames and the rest.

All are of the built-in phantom on coarse voxels, in scenes of `simulate` and of the virtual camera,
so that any machine makes the same ones (to about 1e-5 mm).
"""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Iterator, Sequence
from contextlib import redirect_stderr, redirect_stdout
from dataclasses import replace
from functools import cache, partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np

from tumortrack.case.surface import surfaces
from tumortrack.cli.main import run
from tumortrack.core import store
from tumortrack.core.cloud import CloudConfig
from tumortrack.core.errors import NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Grasp, Landmark, Outline, Touch
from tumortrack.core.geometry import plane_section
from tumortrack.core.report import FitReport
from tumortrack.core.types import SensorCloud
from tumortrack.io.case import Case, save_case
from tumortrack.io.scene_folder import Scene
from tumortrack.segmentation import Hints, RegionConfig, organ_points
from tumortrack.simulation.dataset import scene_maker
from tumortrack.simulation.deform.elastic import ElasticConfig
from tumortrack.simulation.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.simulation.scene import SceneConfig
from tumortrack.tracking.follower import Follower, FollowerConfig
from tumortrack.tracking.tracker import Tracker

Numbers = dict[str, Any]
Answer = tuple[str, Callable[[], Numbers]]
SEED = 3
REGION = RegionConfig(crop=CloudConfig(near_mm=75, far_mm=340))
PLACES = 8  # of the organ's surface, beside the tumors' centres


@cache
def phantom() -> Case:
    labels = phantom_labels(PhantomParameters(), voxel_mm=1.5)
    return Case(surfaces(labels)[0], labels, (0.0, -1.0, 0.0))


@cache
def tracker() -> Tracker:
    return Tracker(phantom())


@cache
def maker(kind: str) -> Callable[[int], Scene]:
    elastic = SceneConfig(deform=(ElasticConfig(),))
    return scene_maker(phantom(), SceneConfig() if kind == "dragged" else elastic, SEED)


def measured(report: FitReport) -> dict[str, float]:
    """What an answer says of its fit; larger is worse."""
    deviations = [part.surface_std_mm for part in report.tumors.values()]
    known, cost = [std_mm for std_mm in deviations if std_mm is not None], report.fit_cost
    values = {
        "fit_cost": None if cost is None else cost.now / cost.usual,
        # By the name under which it is recorded: the file's bytes are the fingerprint.
        "rarity": None if report.motion is None else report.motion.normalized_mahalanobis,
        "unseen": report.unseen,
        "seen_through": report.seen_through,
        "unsure_mm": max(known, default=None),
    }
    return {name: float(value) for name, value in values.items() if value is not None}


def record(locate: Callable[[], Estimate], points_mm: np.ndarray) -> Numbers:
    """What is kept of an answer. ``input_mm``: tells another answer from another question."""
    spread = [*points_mm.mean(0), *points_mm.std(0)] if len(points_mm) else []
    numbers: Numbers = {"input_mm": {str(n): round(float(v), 3) for n, v in enumerate(spread)}}
    try:
        estimate = locate()
    except NoEstimate as error:
        return {**numbers, "verdict": f"none: {error.finding.kind if error.finding else ''}"}
    report, organ = estimate.report, phantom().anatomy.organ.vertices_mm
    assert estimate.motion is not None
    places = [estimate.motion.forward(organ[:: len(organ) // PLACES][:PLACES])]
    places += [[part.center_mm] for part in report.tumors.values() if part.center_mm]
    bounds = {name: each.error_bound95_mm for name, each in estimate.assessment.bounds.items()}
    return {
        **numbers,
        "places_mm": np.round(np.concatenate(places), 3).tolist(),
        "bounds_mm": {name: round(value, 3) for name, value in bounds.items()},
        "figures": {name: float(f"{value:.4g}") for name, value in measured(report).items()},
        "verdict": f"poor: {estimate.finding.kind}" if estimate.finding else "good",
    }


def changed(cloud: SensorCloud, kind: str, number: int) -> SensorCloud:
    rng = np.random.default_rng([SEED, number])
    points_mm = cloud.points_mm
    if kind == "noisy":
        points_mm = points_mm + rng.normal(0, 0.5, points_mm.shape).astype(np.float32)
    elif kind == "sparse":
        points_mm = points_mm[::4]
    elif kind == "hidden":
        along = points_mm @ rng.normal(size=3)
        points_mm = points_mm[along < np.quantile(along, 0.65)]
    return replace(cloud, points_mm=points_mm)


def of_cloud(kind: str, number: int) -> Numbers:
    scene = maker("dragged" if kind == "dragged" else "elastic")(number)
    cloud = changed(scene.cloud, kind, number)
    return record(lambda: tracker().locate(cloud, grid=32), cloud.points_mm)


def of_image(number: int) -> Numbers:
    """The virtual camera's, with instrument, table and noise: the organ is found in it first."""
    frame: Any = camera(number // 10).at(1.7 * (number % 10), number).content
    seen_mm = frame.depth_mm[np.isfinite(frame.depth_mm)][:, None]

    def locate() -> Estimate:
        region = organ_points(frame, REGION, Hints(), np.random.default_rng(0))
        return tracker().locate(region.cloud, grid=32, full_view=frame)

    return record(locate, seen_mm)


def of_evidence(kind: str, number: int) -> Numbers:
    scene = maker("elastic")(number)
    cloud = changed(scene.cloud, "hidden", number)
    pieces = drawn(scene, kind, np.random.default_rng([SEED, number, 1]))
    return record(lambda: tracker().locate(cloud, grid=32, evidence=pieces), cloud.points_mm)


def drawn(scene: Scene, kind: str, rng: np.random.Generator) -> Sequence[Any]:
    """Evidence that is true to about 1 mm. Not as the benchmarks draw it: what changes there would
    be another question here."""
    organ, targets = scene.reference.organ, scene.targets
    assert targets is not None

    def near(places_mm: np.ndarray) -> list[tuple[float, ...]]:
        told = places_mm + rng.normal(0, 1.0, places_mm.shape)
        return [tuple(place) for place in np.atleast_2d(told).tolist()]

    if kind == "touches":
        places = near(organ.vertices_mm[rng.choice(len(organ.vertices_mm), 12)])
        return [Touch(place_mm=place, std_mm=1.0) for place in places]
    if kind == "outline":
        tumor = scene.reference.tumors[0]
        middle = tumor.vertices_mm.mean(0)
        cut = plane_section(tumor.vertices_mm, tumor.faces, rng.normal(size=3), middle).mean(1)
        places = near(cut[:: max(len(cut) // 12, 1)])
        return [Outline(places_mm=tuple(places), part="tumor_1", std_mm=1.0)]
    chosen = rng.choice(len(targets.points_mm), 3 if kind == "landmarks" else 1)
    pairs = list(
        zip(targets.points_ct[chosen].tolist(), near(targets.points_mm[chosen]), strict=True)
    )
    if kind == "landmarks":
        return [Landmark(point_ct=tuple(a), place_mm=b, std_mm=1.0) for a, b in pairs]
    return [Grasp(point_ct=tuple(a), place_mm=b, std_mm=1.0) for a, b in pairs]


@cache
def camera(seed: int) -> Any:
    from tumortrack_devices.sources.virtual import VirtualSourceConfig

    if not Path("case").exists():
        with store.new_folder(Path("case")) as aside:
            save_case(phantom(), aside)
    return VirtualSourceConfig(case=Path("case"), seed=seed).open()


def frames(run: int, count: int) -> Iterator[Answer]:
    """Followed, each from the last; so they are asked in order."""
    smoothed = FollowerConfig(smoothing_s=0.2 if run % 2 else 0.0)
    follower = Follower(tracker(), smoothed)

    def of_frame(number: int) -> Numbers:
        stamp_ns = (1 + number) * 10**8
        frame: Any = camera(run).at(3.0 + 0.1 * number, stamp_ns).content
        hints = Hints(last_box_mm=follower.last_box_mm(stamp_ns))

        def locate() -> Estimate:
            region = organ_points(frame, REGION, hints, np.random.default_rng(0))
            return follower.locate(region.cloud, frame)

        return record(locate, frame.depth_mm[np.isfinite(frame.depth_mm)][:, None])

    return ((f"live/{run}/{number}", partial(of_frame, number)) for number in range(count))


def answers(clouds: int, images: int, pieces: int, runs: int) -> Iterator[Answer]:
    """So many clouds of each kind, images, answers with evidence of each kind, and runs of 20
    frames; few are the first of many."""
    for kind in ("plain", "dragged", "noisy", "sparse", "hidden"):
        yield from ((f"clouds/{kind}/{n}", partial(of_cloud, kind, n)) for n in range(clouds))
    yield from ((f"images/{n}", partial(of_image, n)) for n in range(images))
    for kind in ("touches", "outline", "landmarks", "held"):
        yield from ((f"evidence/{kind}/{n}", partial(of_evidence, kind, n)) for n in range(pieces))
    for number in range(runs):
        yield from frames(number, 20 if runs > 1 else 3)


def plan() -> Numbers:
    """Volumes and clearances of a plan with the arms."""
    from tumortrack.io.scene_folder import write_scene_files

    camera(0)
    cloud = Path("scene/cloud.ply")
    with store.new_folder(Path("scene")) as aside:
        write_scene_files(aside, maker("elastic")(0))
    command("locate", "case", cloud, "--out", "run")
    command("plan", "run", "plan", "--accept-poor", "--accept-budget")
    made = json.loads(Path("plan/plan.json").read_text())["plan"]
    return {
        "places_mm": [made["grasp_mm"]],
        "figures": {name: float(f"{ml:.5g}") for name, ml in made["volumes_ml"].items()},
        "verdict": f"{len(made['cuts'])} cuts",
    }


def network() -> Numbers:
    """Logits of the paper's network after three steps, at fixed points."""
    import torch

    from tumortrack.tracking.model_files import load_model
    from tumortrack_occupancy.inference import Inference
    from tumortrack_occupancy.presets import quick
    from tumortrack_occupancy.training.train import TrainingRun, train

    torch.set_num_threads(1)
    case = phantom()
    config = msgspec.structs.replace(quick(case.anatomy), batch_size=2)
    given = TrainingRun(case.anatomy, case.up_lps, "", config, steps=3, device="cpu", workers=0)
    train(given, Path("network"), lambda status: None)
    trained: Any = load_model(Path("network"), "cpu")
    points_mm, inference = maker("elastic")(0).cloud.points_mm, Inference(trained.network)
    queries = np.random.default_rng(0).normal(points_mm.mean(0), 30, (50, 3)).astype(np.float32)
    logits = inference.logits(inference.encode(points_mm), queries)
    return {"figures": {str(n): float(f"{v:.4g}") for n, v in enumerate(np.ravel(logits))}}


def command(*arguments: object) -> None:
    """It must succeed; a poor answer is one."""
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        code = run([str(argument) for argument in arguments])
    if code not in (None, 0, 4):
        raise SystemExit(f"tumortrack {' '.join(map(str, arguments))}: {output.getvalue()}")
