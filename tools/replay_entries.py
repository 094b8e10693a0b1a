"""What tools/replay.py compares, as (key, array or bytes or JSON); runs in an empty folder."""

from __future__ import annotations

import gzip
import io
import json
from collections.abc import Iterable
from contextlib import redirect_stderr, redirect_stdout
from functools import cache
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from safetensors.numpy import load_file

from tumortrack.cli.main import run
from tumortrack.core import store
from tumortrack.core.types import SensorCloud
from tumortrack.imaging.case import Case, load_case, save_case
from tumortrack.imaging.surface import surfaces
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.sense.cloud import CloudConfig
from tumortrack.sense.files import read_cloud
from tumortrack.sense.region import Hints, RegionConfig, organ_points
from tumortrack.simulate.scene_folder import draw_targets
from tumortrack.tracking.files import report_entry
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.tracker import Follower, FollowerConfig, Tracker
from tumortrack_devices.sources.virtual import VirtualSourceConfig
from tumortrack_lab.twin.dataset import StateCache, TwinRun
from tumortrack_lab.twin.views import VIEWS, ViewConfig, make_scene
from tumortrack_occupancy.inference import Inference
from tumortrack_occupancy.presets import paper as paper_config
from tumortrack_occupancy.presets import quick as quick_config
from tumortrack_occupancy.training.stream import SceneStream
from tumortrack_occupancy.training.task import OccupancyTask
from tumortrack_occupancy.training.train import TrainingRun, train

Entries = Iterable[tuple[str, object]]
COMMANDS = (
    *("demo", "prepare", "export", "train", "locate", "track", "plan", "resect"),
    *("simulate", "twin", "evaluate", "bench", "compile", "onnx", "inspect", "doctor"),
)
STEPS = 100  # of `quick`
TRAINED = {"quick": quick_config, "paper": paper_config}
CPU, CLOUD = ("--device", "cpu"), Path("scenes/drag/0000/cloud.ply")


def under(prefix: object, entries: Entries) -> Entries:
    return ((f"{prefix}/{key}", value) for key, value in entries)


def files(folder: str | Path, names: str = "**/*") -> Entries:
    """What a folder holds: tensors one by one, compressed files by their content."""
    for path in sorted(path for path in Path(folder).glob(names) if path.is_file()):
        name, content = path.relative_to(folder).as_posix(), path.read_bytes()
        if path.suffix == ".safetensors":
            yield from under(name, sorted(load_file(path).items()))
        elif path.suffix == ".json":
            yield name, json.loads(content)
        else:
            yield name, gzip.decompress(content) if path.suffix == ".gz" else content


def fields(made: Any, names: str) -> Entries:
    return ((name, getattr(made, name)) for name in names.split())


def command(*arguments: object) -> str:
    """What a command says. It must succeed; a poor answer is one."""
    output = io.StringIO()
    with redirect_stdout(output), redirect_stderr(output):
        try:
            code: Any = run([str(argument) for argument in arguments])
        except SystemExit as left:  # --help
            code = left.code
    if code not in (None, 0, 4):
        raise SystemExit(f"tumortrack {' '.join(map(str, arguments))}: {output.getvalue()}")
    return output.getvalue()


def ran(out: str, *arguments: object) -> Entries:
    """The files that a command with the output folder ``out`` writes."""
    command(*arguments)
    return under(out, files(out))


@cache
def case() -> Case:
    """The built-in phantom on coarse voxels, also as a folder; scenes of it and points in it."""
    labels = phantom_labels(PhantomParameters(), voxel_mm=1.5)
    with store.new_folder(Path("case")) as aside:
        save_case(Case(surfaces(labels)[0], labels, (0.0, -1.0, 0.0)), aside)
    for kind, option in (("drag", "--noise"), ("squeeze", "--squeeze"), ("elastic", "--elastic")):
        command("simulate", "case", f"scenes/{kind}", "--scenes", 2, option)
    made = load_case(Path("case"))
    points = [f"{x},{y},{z}" for x, y, z in made.anatomy.organ.vertices_mm[::500].tolist()]
    Path("points.csv").write_text("\n".join(["x,y,z", *points]))
    return made


def of_case(preset: str, **changes: Any) -> TrainingRun:
    config = msgspec.structs.replace(TRAINED[preset](case().anatomy), **changes)
    return TrainingRun(case().anatomy, case().up_lps, "", config, steps=3, device="cpu", workers=0)


@cache
def model(preset: str) -> Path:
    """A model folder; of a network after few steps."""
    if preset == "paper":  # the thousands of scenes that it prepares take minutes
        train(of_case("paper", batch_size=4, validation_pairs=4), Path(preset), lambda status: None)
    elif case():
        steps = ("--steps", STEPS, "--seed", 0, "--workers", 0) if preset == "quick" else ()
        command("train", "case", preset, "--preset", preset, *steps, *CPU)
    return Path(preset)


@cache
def located() -> list[tuple[str, object]]:
    """A cloud of the clinic model's organ; also what `plan` reads."""
    cloud = "scenes/elastic/0000/cloud.ply"
    return list(ran("run", "locate", model("clinic"), cloud, "run", "--map", "points.csv", *CPU))


def help() -> Entries:
    yield "tumortrack", command("--help")
    yield from ((name, command(name, "--help")) for name in COMMANDS)


def scene() -> Entries:
    yield from under("case", files("case")) if case() else ()
    yield from under("test", files("scenes"))
    for preset in TRAINED:
        about = of_case(preset, batch_size=2)
        task, config = OccupancyTask(about, torch.device("cpu")), about.config.scene
        given = (about.anatomy_ct, about.up_lps, config, task.points, 0, "train", 2)
        stream = SceneStream(*given, task.body)  # type: ignore[arg-type]
        for index in (0, 7):
            made = stream.batch(index)
            named = fields(made, "clouds_mm points_mm labels")
            yield from under(f"{preset}/{index}", named)


def clinic() -> Entries:
    yield from under("model", files(model("clinic"), "*"))
    yield from located()
    depth, camera = (f"scenes/elastic/0001/{name}" for name in ("depth.png", "intrinsics.json"))
    yield from ran("depth", "locate", "clinic", depth, "depth", "--intrinsics", camera, *CPU)
    command("evaluate", "clinic", "scenes/elastic", "report", "--grid", 64, *CPU)
    yield "evaluate", store.read_json(Path("report/report.json"))["scenes"]
    for smoothing_s in (0.0, 0.2):
        config = FollowerConfig(smoothing_s=smoothing_s)
        yield from under(f"followed/{smoothing_s}", watched(config))


def watched(config: FollowerConfig) -> Entries:
    """Frames of the virtual camera, the organ found among instruments and background."""
    source = VirtualSourceConfig(case=Path("case"), seed=1).open()
    follower = Follower(Tracker(load_model(model("clinic"))), config)
    region_config = RegionConfig(crop=CloudConfig(near_mm=75, far_mm=340))
    for frame in range(3):
        observation = source.at(0.5 + 0.1 * frame, frame * 10**8)
        hints = Hints(last_box_mm=follower.last_box_mm(frame * 10**8))
        region = organ_points(observation.content, region_config, hints, np.random.default_rng(0))
        yield f"{frame}/image", observation.content.depth_mm  # type: ignore[union-attr]
        yield f"{frame}/region", region.taken
        yield from under(frame, followed(follower, region.cloud))


def followed(follower: Follower, cloud: SensorCloud) -> Entries:
    estimate = follower.locate(cloud)
    yield from fields(estimate.cloud, "points_mm labels probability")
    yield "report", report_entry(estimate)
    for name, mesh in estimate.meshes.items():
        yield from under(name, fields(mesh, "vertices_mm faces"))


def plan() -> Entries:
    located()
    yield from ran("margin", "plan", "run", "margin", "--accept-poor", "--accept-budget")
    yield from ran(
        "published",
        "plan",
        "run",
        "published",
        "--method",
        "published",
        "--no-arms",
        "--accept-poor",
        "--accept-budget",
    )


def quick() -> Entries:
    yield from under("weights", files(model("quick"), "*"))
    yield from ran("run-quick", "locate", "quick", CLOUD, "run-quick", *CPU)
    follower = Follower(Tracker(load_model(Path("quick"), "cpu")), FollowerConfig())
    points_mm = read_cloud(CLOUD)[0].points_mm
    for frame in range(3):
        moved = SensorCloud(points_mm + np.float32(frame), stamp_ns=frame * 10**8)
        yield from under(f"followed/{frame}", followed(follower, moved))


def paper() -> Entries:
    """So short a training finds no organ: logits at fixed points stand for the estimate."""
    yield from under("weights", files(model("paper"), "*"))
    points_mm = read_cloud(CLOUD)[0].points_mm
    trained: Any = load_model(Path("paper"), "cpu")
    rng, inference = np.random.default_rng(0), Inference(trained.network)
    queries = rng.normal(points_mm.mean(0), 30, (5000, 3)).astype(np.float32)
    yield "logits-for-an-estimate", inference.logits(inference.encode(points_mm), queries)


def twin(states: Path, recording: bool) -> Entries:
    """Views of a state that was solved when the digests were recorded."""
    targets = draw_targets(case().anatomy, 0)
    cache = StateCache(states, TwinRun(Path("case")), case(), targets)
    if not (recording or cache.has("D1")):
        print(f"twin: NOT COMPARED, for {states} has no state D1", flush=True)
        return
    states.mkdir(parents=True, exist_ok=True)
    state = cache.get("D1", lambda line: None)
    for view in VIEWS:
        scene, targets_mm = make_scene(state, "D1", view, ViewConfig(), 0)
        scene.write(Path("twin", view))
        yield f"{view}/targets", targets_mm
    yield from files("twin")


SECTIONS = {made.__name__: made for made in (help, scene, clinic, plan, quick, paper)}
