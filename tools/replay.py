# ruff: noqa: E402
"""Has any number changed? Digests of scenes, weights, estimates, plans and help texts.

python tools/replay.py record FILE.json     on this machine, before a change of the code
python tools/replay.py compare FILE.json    after it; exit status 1 where anything differs
--quick leaves out the presets quick and paper; --only SECTION ... runs these and what they need.

Digests are of one machine and one set of installed libraries. No two runs have the same timings,
so these are left out, and so are versions and hashes of files that hold timings. The twin's solver
fills the organ with tetrahedra by threads, never twice alike: one solved state is kept in
replay-state/ beside FILE, and its scenes are made from there.
"""

from __future__ import annotations

import os

# Sums hang on the number of threads; help texts on the width of the terminal.
THREADS = ("OMP", "OPENBLAS", "MKL", "NUMBA")
os.environ.update({f"{name}_NUM_THREADS": "1" for name in THREADS})
os.environ.update(COLUMNS="100", NO_COLOR="1", TERM="dumb", CUDA_VISIBLE_DEVICES="")
os.environ.pop("FORCE_COLOR", None)

import argparse
import gzip
import hashlib
import io
import json
import platform
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import redirect_stderr, redirect_stdout
from functools import cached_property
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import torch
from safetensors.numpy import load_file

from tumortrack.app.cli import COMMANDS, run
from tumortrack.app.presets import PRESETS, pretraining
from tumortrack.core import store
from tumortrack.core.types import SensorCloud
from tumortrack.evaluate.twin.bench import Bench, BenchConfig
from tumortrack.evaluate.twin.pictures import twin_picture
from tumortrack.evaluate.twin.stock import Stock
from tumortrack.evaluate.twin.variants import VIEWS, ViewConfig, for_organ, make_scene
from tumortrack.imaging.case import Case, load_case, save_case
from tumortrack.imaging.surface import surfaces
from tumortrack.learn.course import course_of
from tumortrack.learn.inference import Inference
from tumortrack.learn.model import load_model
from tumortrack.learn.pretrain import Pretraining, kidney_stream
from tumortrack.learn.train import Run, train
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.sense.cloud import CloudConfig
from tumortrack.sense.files import read_cloud
from tumortrack.sense.region import Hints, RegionConfig, organ_points
from tumortrack.simulate.batched.stream import DeviceStream, why_not
from tumortrack.simulate.dataset import SceneStream
from tumortrack.simulate.scene_folder import write_scene
from tumortrack.simulate.targets import draw_targets
from tumortrack.track.estimate import Estimate
from tumortrack.track.follower import Follower, FollowerConfig
from tumortrack.track.sources.virtual import Virtual
from tumortrack.track.tracker import Tracker

Entries = Iterator[tuple[str, object]]
CPU = torch.device("cpu")
STATE, STEPS = "P1", {"clinic": 60, "quick": 100}
# Of JSON: what is never twice the same, or is a hash of that. Tables of files name their hashes.
VOLATILE = {"timings", "training_s", "tumortrack", "seconds_left", "model_sha256", "inputs"}


def digest(value: object) -> str:
    """Of an array with type and shape, of bytes, or of anything that JSON can say."""
    if isinstance(value, torch.Tensor):
        value = value.numpy(force=True)
    if isinstance(value, np.ndarray):
        value = f"{value.dtype} {value.shape} ".encode() + np.ascontiguousarray(value).tobytes()
    if not isinstance(value, bytes):
        value = json.dumps(steady(value), sort_keys=True).encode()
    return hashlib.sha256(value).hexdigest()


def steady(value: Any) -> Any:
    """JSON without what changes from run to run."""
    if isinstance(value, dict):
        kept = {key: steady(inner) for key, inner in value.items() if key not in VOLATILE}
        return {**kept, "files": sorted(kept["files"])} if "files" in kept else kept
    return [steady(inner) for inner in value] if isinstance(value, list | tuple) else value


def files(folder: Path, names: str = "**/*") -> Entries:
    """Everything in a folder; weights one by one, compressed files by their content."""
    for path in sorted(path for path in folder.glob(names) if path.is_file()):
        name = path.relative_to(folder).as_posix()
        if path.suffix == ".json":
            yield name, json.loads(path.read_bytes())
        elif path.suffix == ".safetensors":
            yield from ((f"{name}/{key}", array) for key, array in sorted(load_file(path).items()))
        else:
            yield (
                name,
                gzip.decompress(path.read_bytes()) if path.suffix == ".gz" else (path.read_bytes()),
            )


def command(*arguments: object) -> str:
    """What a command says. It must succeed."""
    said = io.StringIO()
    with redirect_stdout(said), redirect_stderr(said):
        try:
            code: Any = run([str(argument) for argument in arguments])
        except SystemExit as left:  # --help
            code = left.code
    if code:
        raise SystemExit(f"tumortrack {' '.join(map(str, arguments))}: {said.getvalue()}")
    return said.getvalue()


def under(prefix: object, entries: Entries) -> Entries:
    return ((f"{prefix}/{key}", value) for key, value in entries)


def estimated(estimate: Estimate) -> Entries:
    """One frame of a followed sequence."""
    cloud = estimate.cloud
    yield from (("points", cloud.points_mm), ("labels", cloud.labels), ("p", cloud.probability))
    yield "report", estimate.report
    for name, mesh in estimate.meshes.items():
        yield f"{name}/vertices", mesh.vertices_mm
        yield f"{name}/faces", mesh.faces


class Replay:
    """One method a section, in the order they run; what they share is made once, in ``work``."""

    def __init__(self, work: Path, states: Path, recording: bool) -> None:
        self.work, self.states, self.recording = work, states, recording

    @cached_property
    def case(self) -> Case:
        """The built-in phantom on coarse voxels, also as a folder."""
        labels = phantom_labels(PhantomParameters(), voxel_mm=1.5)
        with store.new_folder(self.work / "case") as aside:
            save_case(Case(surfaces(labels)[0], labels, (0.0, -1.0, 0.0)), aside)
        return load_case(self.work / "case")

    @cached_property
    def scenes(self) -> Path:
        """Test scenes: dragged, squeezed as a whole too, and elastic."""
        made, case = self.work / "scenes", self.case
        for kind, option in (
            ("drag", "--noise"),
            ("squeeze", "--squeeze"),
            ("elastic", "--elastic"),
        ):
            command("simulate", self.work / "case", made / kind, "--scenes", 2, option)
        middles = [f"{x},{y},{z}\n" for x, y, z in case.anatomy.organ.vertices_mm[::500].tolist()]
        (self.work / "points.csv").write_text("x,y,z\n" + "".join(middles))
        return made

    def model(self, preset: str) -> Path:
        """A model folder of a few steps, by the command line."""
        folder, options = self.work / preset, ("--workers", 0, "--seed", 0, "--device", "cpu")
        if not folder.exists():
            assert self.case
            steps = ("--preset", preset, "--steps", STEPS[preset])
            command("train", self.work / "case", folder, *steps, *options)
        return folder

    def help(self) -> Entries:
        yield "tumortrack", command("--help")
        yield from ((name, command(name, "--help")) for name in COMMANDS)

    def scene(self) -> Entries:
        yield from under("case", self.case and files(self.work / "case"))
        yield from under("test", files(self.scenes))
        for name, preset in PRESETS.items():
            config = msgspec.structs.replace(preset(self.case.anatomy, "limited"), batch_size=2)
            about = Run(self.case.anatomy, self.case.up_lps, "", config)
            course = course_of(about, CPU)
            given = (self.case.anatomy, self.case.up_lps, config.scene, course.points, 0)
            stream = SceneStream(*given, "train", config.batch_size, course.body)
            for index in (0, 7):
                yield from under(f"{name}/{index}", batch(stream.batch(index)))
            if why_not(stream) is None:  # as a GPU makes them, here by the CPU
                made = DeviceStream(stream, CPU).batch(3)
                yield from ((f"{name}/batched/{n}", part) for n, part in enumerate(made))

    def pretraining(self) -> Entries:
        config = msgspec.structs.replace(pretraining(), batch_size=2)
        kidneys = kidney_stream(Pretraining(config, anatomies=1, steps=1))
        yield from under("scene", batch(kidneys.batch(1)))
        folder, options = self.work / "pretrained", ("--workers", 0, "--device", "cpu")
        command("pretrain", folder, "--anatomies", 1, "--steps", 3, *options)
        yield from under("weights", files(folder, "*"))

    def clinic(self) -> Entries:
        model, elastic = self.model("clinic"), self.scenes / "elastic"
        yield from under("weights", files(model, "*"))
        cloud, depth = elastic / "0000" / "cloud.ply", elastic / "0001"
        asked = ("--map", self.work / "points.csv", "--device", "cpu")
        command("locate", model, cloud, self.work / "run", *asked)
        yield from under("cloud", files(self.work / "run"))
        camera = ("--intrinsics", depth / "intrinsics.json", "--device", "cpu")
        command("locate", model, depth / "depth.png", self.work / "run-depth", *camera)
        yield from under("depth", files(self.work / "run-depth"))
        command("evaluate", model, elastic, self.work / "report", "--grid", 64, "--device", "cpu")
        yield "evaluate", json.loads((self.work / "report" / "report.json").read_bytes())["scenes"]
        for smoothing_s in (0.0, 0.2):
            yield from under(f"followed/{smoothing_s}", self._followed(model, smoothing_s))

    def _followed(self, model: Path, smoothing_s: float) -> Entries:
        """Three frames of the virtual camera, the organ found among instruments and background."""
        source = Virtual(case=self.work / "case", seed=1).open()
        follower = Follower(
            Tracker(load_model(model, "cpu")), FollowerConfig(smoothing_s=smoothing_s)
        )
        config = RegionConfig(crop=CloudConfig(near_mm=75, far_mm=340))
        for frame in range(3):
            seen, rng = source.at(0.5 + 0.1 * frame, frame * 10**8), np.random.default_rng(0)
            hints = Hints(last_box_mm=follower.last_box_mm(frame * 10**8))
            yield f"{frame}/image", seen.content.depth_mm
            region = organ_points(seen.content, config, hints, rng)
            yield from (
                (f"{frame}/region", region.taken),
                (f"{frame}/cloud", region.cloud.points_mm),
            )
            yield from under(frame, estimated(follower.locate(region.cloud)))

    def plan(self) -> Entries:
        if not (self.work / "run").exists():
            list(self.clinic())
        command("plan", self.work / "run", self.work / "plan")
        yield from under("margin", files(self.work / "plan"))
        published = ("--method", "published", "--no-arms")
        command("plan", self.work / "run", self.work / "published", *published)
        yield from under("published", files(self.work / "published"))

    def quick(self) -> Entries:
        model, cloud = self.model("quick"), self.scenes / "drag" / "0000" / "cloud.ply"
        yield from under("weights", files(model, "*"))
        command("locate", model, cloud, self.work / "run-quick", "--device", "cpu")
        yield from under("cloud", files(self.work / "run-quick"))
        follower, points_mm = Follower(Tracker(load_model(model, "cpu")), FollowerConfig()), None
        points_mm = read_cloud(cloud)[0].points_mm
        for frame in range(3):
            moved = SensorCloud(points_mm + np.float32(frame), stamp_ns=frame * 10**8)
            yield from under(f"followed/{frame}", estimated(follower.locate(moved)))

    def paper(self) -> Entries:
        """Few scenes of the preset: its thousands take minutes. So short a training finds no organ;
        logits at fixed points stand for the estimate."""
        few = {"batch_size": 4, "validation_pairs": 4}
        config = msgspec.structs.replace(PRESETS["paper"](self.case.anatomy, "limited"), **few)
        about = Run(
            self.case.anatomy, self.case.up_lps, "", config, steps=3, device="cpu", workers=0
        )
        train(about, self.work / "paper", lambda status: None)
        yield from under("weights", files(self.work / "paper", "*"))
        cloud = read_cloud(self.scenes / "drag" / "0000" / "cloud.ply")[0].points_mm
        inference = Inference(load_model(self.work / "paper", "cpu").network)
        queries = np.random.default_rng(0).normal(cloud.mean(0), 30, (5000, 3)).astype(np.float32)
        yield "logits", inference.logits(inference.encode(cloud), queries)

    def twin(self) -> Entries:
        """Of a state that was solved when the digests were recorded."""
        anatomy, up_lps = self.case.anatomy, self.case.up_lps
        targets = draw_targets(anatomy, 0)
        stock = Stock(
            self.states, anatomy, targets.points_ct, lambda: Bench(anatomy, up_lps, BenchConfig())
        )
        if not (stock.has(STATE) or self.recording):
            print(f"twin: NOT COMPARED, there is no {STATE} in {self.states}", flush=True)
            return
        self.states.mkdir(parents=True, exist_ok=True)
        settled = stock.get(STATE, lambda line: None)
        config = for_organ(ViewConfig(), float(np.ptp(anatomy.organ.vertices_mm[:, 1])))
        for view in VIEWS:
            scene, targets_mm = make_scene(settled, STATE, view, config, 0)
            folder = self.work / "twin" / view
            write_scene(folder, scene)
            yield from under(view, files(folder))
            yield f"{view}/targets", targets_mm
        twin_picture(scene, settled, anatomy.organ, self.work / "twin.png")
        yield "picture", (self.work / "twin.png").read_bytes()


def batch(made: Any) -> Entries:
    return ((name, getattr(made, name)) for name in made.__dataclass_fields__)


SECTIONS = ("help", "scene", "pretraining", "clinic", "plan", "quick", "paper", "twin")
SLOW = ("quick", "paper")


def main() -> int:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])  # type: ignore[union-attr]
    parser.add_argument("action", choices=("record", "compare", "either"))
    parser.add_argument("file", type=Path)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--only", nargs="+", choices=SECTIONS, default=SECTIONS)
    options = parser.parse_args()
    recording = options.action == "record" or (
        options.action == "either" and not options.file.exists()
    )
    print(f"{'recording to' if recording else 'comparing with'} {options.file}", flush=True)
    sections = [name for name in options.only if not (options.quick and name in SLOW)]
    machine = {"processor": platform.machine(), "cpu": platform.processor(),
               "python": sys.version, "torch": torch.__version__, "numpy": np.__version__}  # fmt: skip
    found: dict[str, str] = {}
    with tempfile.TemporaryDirectory() as work:
        replay = Replay(Path(work), options.file.parent / "replay-state", recording)
        for name in sections:
            start = time.perf_counter()
            made = {f"{name}/{key}": digest(value) for key, value in getattr(replay, name)()}
            found |= made
            print(f"{name}: {len(made)} in {time.perf_counter() - start:.0f} s", flush=True)
    if recording:
        options.file.parent.mkdir(parents=True, exist_ok=True)
        options.file.write_text(json.dumps({"machine": machine, "entries": found}, indent=1))
        print(f"{len(found)} entries recorded")
        return 0
    recorded = json.loads(options.file.read_bytes())
    if recorded["machine"] != machine:
        print(f"ANOTHER MACHINE OR LIBRARY: {recorded['machine']}, now {machine}")
    ran = {key.split("/")[0] for key in found}
    known = {k: v for k, v in recorded["entries"].items() if k.split("/")[0] in ran}
    differing = sorted(key for key in found.keys() | known if found.get(key) != known.get(key))
    for key in differing:
        how = "differs" if key in found and key in known else "new" if key in found else "missing"
        print(f"{how}: {key}")
    print(f"{len(found.keys() & known) - sum(k in found and k in known for k in differing)} "
          f"entries equal, {len(differing)} differ")  # fmt: skip
    return 1 if differing else 0


if __name__ == "__main__":
    sys.exit(main())
