"""With which noise, cameras and distances are answers still good, and how far off are tumors?

    make noise ARGS='OUT --kidneys 4'

Makes random kidneys in OUT, their models and simulated scenes, whose true organs are seen again
under every condition, with the same seeds. Clouds are the organ's, and not searched for it. Rows
are kept, a file for each kidney and condition; the same command goes on where it was stopped.
"""

from __future__ import annotations

import time
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import msgspec
import numpy as np
import pandas as pd
from jaxtyping import Float
from matplotlib.lines import Line2D

import tumortrack.simulation
from tumortrack.core.camera import d405, deproject, with_depth_error
from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.geometry import rigid
from tumortrack.core.render import render_depth
from tumortrack.core.types import Anatomy, DepthError, DepthFrame, SensorCloud
from tumortrack.io.scene_folder import Scene, read_scene
from tumortrack.registration.model import RegistrationModel
from tumortrack.report import drawing
from tumortrack.report.baselines import best_rigid_pose, rigid_fit
from tumortrack.segmentation import Hints, organ_points
from tumortrack.simulation.sensors import FIGURES, SensorConfig, depth_error_of, simulated
from tumortrack.tracking.tracker import Tracker, region_for
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import share_words, table_of
from tumortrack_benchmarks.judging import centers_off_mm
from tumortrack_benchmarks.physics.organ import transformed
from tumortrack_benchmarks.physics.scenes import simulated_scenes
from tumortrack_benchmarks.scripting import NOTHING, KidneyOptions, cell

_WIDE_MM = 5.0
_CONDITIONS = (
    "white:0", "white:0.5", "white:1", "white:2",
    "correlated:0.5:3", "correlated:1:3", "correlated:2:3",
    "correlated:0.5:8", "correlated:1:8", "correlated:2:8",
    "d405-measured@150", "d405-measured@300", "d405-measured@500", "d405-measured:0@500",
    "d435@300", "zed@400", "zed:0@400", "azure-kinect@400", "structured-light@500",
    "scale:3", "depth:4", "uncalibrated-d405-measured@150", "uncalibrated-d405-measured@300",
    "uncalibrated-d435@300", "uncalibrated-azure-kinect@400", "uncalibrated-structured-light@500",
    "cloud:1", "cloud:2", "outliers:20", "outliers:40", "fat:15",
)  # fmt: skip
_COLUMNS = ["case", "condition", "quality", "check", "off_mm", "rigid_mm", "beyond", "seconds"]
CLOUDS = "cloud", "outliers", "fat"
_POINTS = 3000  # of a cloud, from all pixels of the organ
_WIDER = 1.5  # the box of outliers than the organ's
_LUMP_MM = 14.0  # radius of a lump of fat at the organ's outline
BIASES = {"scale": "%", "depth": "mm"}
_PARTS = "white", "correlated", *BIASES, *CLOUDS
_UNCALIBRATED = "uncalibrated-"


@dataclass(frozen=True)
class Options(KidneyOptions):
    """Disturb, locate, compare."""

    conditions: tuple[str, ...] = _CONDITIONS
    """white:MM, correlated:MM:PX, cloud:MM, outliers:%, fat:%, scale:%, depth:MM, CAMERA,
    uncalibrated-CAMERA, or CAMERA:TIMES its noise, and
    from where: @MM."""
    count: int = 16
    """Scenes of each."""


def main(options: Options) -> None:
    """Make missing rows, then table and picture."""
    writer = scripting.begun("noise", options.document)
    work = [(options.out, n, options.count, options.conditions) for n in options.numbers]
    frame = pd.DataFrame(scripting.together(_rows, work), columns=_COLUMNS)
    shown = table(frame)
    print(table_of(shown))
    good = frame[frame.quality == "good"]
    wide = share_words(int((good.off_mm > _WIDE_MM).sum()), len(good)) if len(good) else NOTHING
    sample = f"{frame.case.nunique()} organs, {len(frame)} images and clouds"
    writer.tables({"noise": shown}, sample=sample, interval=f"over 5 mm {wide} of good")
    if options.document is not None:
        draw(frame, writer.image("noise"))


def _rows(out: Path, number: int, count: int, conditions: tuple[str, ...]) -> list[dict[str, Any]]:
    """Of one kidney, under all conditions."""
    sensors, folder = Path(tumortrack.simulation.__path__[0]) / "sensors.toml", out / str(number)
    paths = simulated_scenes(folder, number, count)
    about = scripting.about_scenes(folder / "case", paths, [Path(__file__), sensors])
    tracker, scenes = scripting.tracker_of(folder / "case"), [read_scene(path) for path in paths]
    found = []
    for text in conditions:
        file = folder / "noise" / f"{text.replace(':', '-')}.json"
        measure = partial(measured, tracker, scenes, Condition.read(text))
        rows = scripting.kept(file, about | {"condition": text}, measure)
        found += [{"case": str(number), "condition": text, **row} for row in rows]
    return found


def table(frame: pd.DataFrame) -> pd.DataFrame:
    """A line for each condition."""
    frame, lines = scripting.ordered(frame, ["condition"]), []
    for text, rows in frame.groupby("condition", observed=True):
        condition, good = Condition.read(text), rows[rows.quality == "good"]
        answers = rows[rows.quality != "none"]
        share, interval = share_words(len(good), len(rows)).rstrip(")").split(" % (")
        lines.append({
            "noise": condition.name, "at mm": f"{condition.distance_mm:g}",
            "depth's noise mm": f"{condition.noise_mm:.1f}", "scenes": len(rows),
            "good %": share, "its 95 % interval": interval,
            "no answer": len(rows) - len(answers),
            "worst tumor off mm: median": cell(answers.off_mm.median()),
            "95 %": cell(answers.off_mm.quantile(0.95)),
            "95 % of good": cell(good.off_mm.quantile(0.95)),
            "rigid fit: median": cell(answers.rigid_mm.median()),
            "its 95 %": cell(answers.rigid_mm.quantile(0.95)),
            "good, over 5 mm": int((good.off_mm > _WIDE_MM).sum()),
            "good, beyond its bound": int(good.beyond.eq(True).sum()),
            "median s": f"{rows.seconds.median():.1f}",
        })  # fmt: skip
    return pd.DataFrame(lines)


def draw(frame: pd.DataFrame, path: Path) -> None:
    """Good answers and median errors, of rigid fits dashed, against noise and for cameras."""
    of = {text: Condition.read(text) for text in frame.condition.unique()}
    figure = drawing.new_figure(8.0, 5.8, left=0.08, right=0.98, top=0.92, bottom=0.25)
    (good, other), (off, off_other) = figure.subplots(2, 2, sharey="row")
    groups = frame.groupby("condition")
    share = 100 * groups.quality.agg(lambda quality: (quality == "good").mean())
    lines, errors = [], groups[["off_mm", "rigid_mm"]].median()
    for number, (kind, px) in enumerate((("white", 0), ("correlated", 3), ("correlated", 8))):
        at_150 = [(c.amount, text, c) for text, c in of.items() if c.distance_mm == 150]
        known = [(mm, t) for mm, t, c in at_150 if (c.kind, c.length_px) == (kind, px)]
        none = [(mm, t) for mm, t, c in at_150 if c.name == "none"]
        mm, texts = zip(*sorted({*none, *known}), strict=True) if none or known else ((), ())
        style = {"color": f"C{number}", "marker": "o", "markersize": 4}
        lines += good.plot(mm, share[[*texts]], label=f"{kind}, {px} px" if px else kind, **style)
        off.plot(mm, errors.off_mm[[*texts]], **style)
        off.plot(mm, errors.rigid_mm[[*texts]], "--", color=f"C{number}", linewidth=1)
    cameras = [t for t, c in of.items() if c.kind in FIGURES and c.amount == 1]
    cameras = [text for text in cameras if not of[text].uncalibrated]
    names = [f"{of[text].name}, {of[text].distance_mm:g} mm" for text in cameras]
    for axes, values in ((other, share), (off_other, errors.off_mm)):
        axes.plot(range(len(cameras)), values[cameras], "o", color="0.2")
        axes.set_xticks(range(len(cameras)), names, rotation=35, ha="right", fontsize=8)
    off_other.plot(range(len(cameras)), errors.rigid_mm[cameras], "_", color="0.2", markersize=11)
    for axes in (good, other, off, off_other):
        axes.grid(color="0.9")
        axes.set_ylim(0, 103 if axes in (good, other) else None)
        axes.tick_params(labelbottom=axes in (off, off_other))
    good.set_ylabel("good answers, %")
    off.set(xlabel="noise of a depth at 150 mm, mm", ylabel="tumor off, median, mm")
    lines.append(Line2D([], [], color="0.2", linestyle="--", label="rigid fit (dashed, or a bar)"))
    drawing.show_legend(figure, lines, 4, (0.98, 1.0))
    drawing.save(figure, path)


@dataclass(frozen=True)
class Condition:
    """``kind``: white, correlated, cloud (mm of white noise), outliers or fat (% of the points), or
    a camera of ``simulation.sensors``; ``amount``: mm, %, or so many times a camera's noise (0: its
    edges, holes and steps alone); ``length_px``: where the correlation is 1/e; ``distance_mm``: the
    median of the organ's depths. Calibrated, and stated, but ``scale`` (%) and ``depth`` (mm), by
    which depths err to either side, and ``uncalibrated`` cameras, of which the kind is said."""

    kind: str
    amount: float = 0.0
    distance_mm: float = 150.0
    length_px: float = 0.0
    uncalibrated: bool = False

    @classmethod
    def read(cls, text: str) -> Condition:
        """``white:1``, ``correlated:1:8`` (mm, px), ``outliers:20``, ``scale:3``, ``zed@400`` (mm),
        ``zed:0@400``, ``uncalibrated-zed@400``. Raises InputError: it is none of these."""
        camera = text.removeprefix(_UNCALIBRATED)
        what, _, distance = camera.partition("@")
        kind, *numbers = what.split(":")
        try:
            amount, length_px = [*map(float, numbers), 0.0, 0.0][:2] if numbers else (1.0, 0.0)
            at_mm, raw = float(distance or 150.0), camera != text
            condition = cls(kind, amount, at_mm, length_px, raw)
        except ValueError as error:
            raise InputError(f"{text} is no condition: {error}.") from error
        allowed, given = (*_PARTS, *FIGURES), (amount, length_px, condition.distance_mm)
        if kind not in (FIGURES if camera != text else allowed) or not all(
            0 <= value < np.inf for value in given
        ):
            raise InputError(
                f"{text} is no condition. Allowed: {', '.join(allowed)}, with positive "
                "numbers: white:1, correlated:1:8, zed@400."
            )
        return condition

    @property
    def name(self) -> str:
        """It, for people."""
        if self.kind == "white" and not self.amount:
            return "none"
        if self.kind not in _PARTS:
            kind = f"{self.kind}, uncalibrated" if self.uncalibrated else self.kind
            return kind if self.amount == 1 else f"{kind}, noise times {self.amount:g}"
        if self.kind in BIASES:
            return f"depths off by {self.amount:g} {BIASES[self.kind]}"
        across = f", {self.length_px:g} px" if self.length_px else ""
        return f"{self.kind} {self.amount:g} {'%' if self.kind in CLOUDS[1:] else 'mm'}{across}"

    def sensor(self, unit: int) -> SensorConfig:
        """What disturbs an image of it; ``unit``: which camera of its kind."""
        if self.kind not in _PARTS:
            camera = simulated(self.kind, unit=unit, uncalibrated=self.uncalibrated)
            assert isinstance(camera, SensorConfig)
            px, mm = ("temporal_px", "frozen_px"), ("temporal_mm", "frozen_mm")
            scaled: dict[str, Any] = {key: self.amount * getattr(camera, key) for key in px}
            for key in mm:
                scaled[key] = tuple(self.amount * value for value in getattr(camera, key))
            return msgspec.structs.replace(camera, **scaled)
        white = self.kind == "white"
        return SensorConfig(
            native_px=d405().width,
            temporal_mm=(self.amount if self.kind in ("white", "correlated") else 0.0,),
            white_share=float(white),
            temporal_length_px=self.length_px or 1.0,
        )

    @property
    def noise_mm(self) -> float:
        """Standard deviation of one depth at this distance, its random and frozen parts."""
        if self.kind in (*CLOUDS, *BIASES):
            return self.amount if self.kind == "cloud" else 0.0
        return float(np.hypot(*self.sensor(0).noise_mm(self.distance_mm)))


def placed(reference: Anatomy, distance_mm: float) -> tuple[Anatomy, DepthFrame]:
    """The organ in the middle of a D405's image, this far off in the median, and the image."""
    shift, camera = -reference.organ.box_mm.mean(0) + [0.0, 0.0, distance_mm], d405()
    for _ in range(2):
        there = transformed(reference, rigid(np.eye(3), shift))
        frame = render_depth(there.organ.vertices_mm, there.organ.faces, camera)
        off_mm = distance_mm - float(np.nanmedian(frame.depth_mm))
        shift = shift + [0.0, 0.0, off_mm]
    return there, frame


def disturbed(frame: DepthFrame, condition: Condition, seed: int) -> DepthFrame | SensorCloud:
    """What is seen instead of a clean image."""
    if condition.kind in BIASES:
        off = condition.amount if seed % 2 else -condition.amount
        by = (1 + off / 100, 0.0) if condition.kind == "scale" else (1.0, off)
        return frame.with_depth(frame.depth_mm * np.float32(by[0]) + np.float32(by[1]))
    if condition.kind not in CLOUDS:
        camera = condition.sensor(seed)
        error = depth_error_of(condition.kind) if condition.uncalibrated else camera.depth_error
        return with_depth_error(camera.measured(frame, seed), error)
    rng, points = np.random.default_rng((seed, 1)), deproject(frame).astype(float)
    points = rng.choice(points, min(_POINTS, len(points)), replace=False)
    count = round(len(points) * condition.amount / 100)
    if condition.kind == "cloud":
        points += condition.amount * rng.standard_normal(points.shape)
    elif condition.kind == "outliers":
        low, high = points.min(0), points.max(0)
        points[:count] = (low + high) / 2 + _WIDER * (rng.random((count, 3)) - 0.5) * (high - low)
    else:
        points = np.concatenate([points, _lump(points, count, rng)])
    return SensorCloud(points.astype(np.float32), depth_error=DepthError())


def _lump(
    points: Float[np.ndarray, "n 3"], count: int, rng: np.random.Generator
) -> Float[np.ndarray, "m 3"]:
    """The visible half of a ball about a point of the outline."""
    outwards = (points - points.mean(0))[:, :2] @ rng.standard_normal(2)
    ball = rng.standard_normal((count, 3))
    ball *= _LUMP_MM / np.linalg.norm(ball, axis=1)[:, None]
    ball[:, 2] = -np.abs(ball[:, 2])
    return points[outwards.argmax()] + ball


def measured(tracker: Tracker, scenes: list[Scene], condition: Condition) -> list[dict[str, Any]]:
    """A row a scene (JSON): ``quality`` of the answer (none: there is none) and ``check`` that it
    failed; ``off_mm``, the largest error of a tumor's centre, and ``rigid_mm``, the rigid fit's to
    the same points (``report.baselines``); ``beyond``: whether a tumor lies farther off than
    its bound; ``seconds`` from the image to the answer."""
    return [_row(tracker, scene, condition, seed) for seed, scene in enumerate(scenes)]


def _row(tracker: Tracker, scene: Scene, condition: Condition, seed: int) -> dict[str, Any]:
    model = tracker.model
    assert isinstance(model, RegistrationModel)
    true, frame = placed(scene.reference, condition.distance_mm)
    seen, start = disturbed(frame, condition, seed), time.perf_counter()
    try:
        cloud = seen
        if isinstance(seen, DepthFrame):
            rng = np.random.default_rng(0)
            cloud = organ_points(seen, region_for(model), Hints(), rng).cloud
        assert isinstance(cloud, SensorCloud)
        estimate = tracker.locate(cloud, grid=16, full_view=seen)
    except NoEstimate as error:
        check = error.finding.check if error.finding else "none"
        return {"quality": "none", "check": check, "seconds": time.perf_counter() - start}
    seconds, shape = time.perf_counter() - start, model.shape
    pose, _ = best_rigid_pose(shape.anatomy_ct, Scene(cloud, true))
    pose = rigid_fit(shape.distances[0], cloud, pose)
    posed = transformed(shape.anatomy_ct, pose)
    off, rigid_off = (centers_off_mm(parts, true) for parts in (estimate.meshes, posed.closed))
    bounds = {name: each.error_bound95_mm for name, each in estimate.assessment.bounds.items()}
    return {
        "quality": estimate.quality, "check": estimate.finding.check if estimate.finding else "",
        "off_mm": max(off.values()), "rigid_mm": max(rigid_off.values()),
        "beyond": any(mm > bounds.get(name, np.inf) for name, mm in off.items()),
        "seconds": seconds,
    }  # fmt: skip


if __name__ == "__main__":
    scripting.run(main, Options)
