"""Organs while a piece with a tumor is cut out of them: make scenes, and measure who is followed.

    make cut ARGS='OUT --organs 14 --seed 9'     (some hours on one core)

Makes random kidneys, their models and scenes in OUT/NUMBER, the evidence of the cut beside each
scene, and locates them with the cut told and not. The same command goes on where it was stopped;
after a change of the method everything is measured again. No patient's anatomy is in it.
"""

from __future__ import annotations

import io
from collections.abc import Iterator
from dataclasses import dataclass, replace
from itertools import islice
from pathlib import Path
from tempfile import TemporaryDirectory
from typing import Any, Literal, NamedTuple

import numpy as np
import pandas as pd
import tyro
from PIL import Image
from scipy.ndimage import binary_dilation, gaussian_filter
from scipy.spatial import cKDTree

from tumortrack import assessment, registration, tracking
from tumortrack.core import colours, store
from tumortrack.core.cloud import CloudConfig, cloud_from_depth
from tumortrack.core.errors import NoEstimate, TumortrackError
from tumortrack.core.estimate import Estimate
from tumortrack.core.evidence import Cut, Evidence, Grasp
from tumortrack.core.geometry import perpendicular, transform_points, turned_by, unit
from tumortrack.core.mesh_query import surface_distance
from tumortrack.core.render import render_depth
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.io import scene_folder
from tumortrack.io.case import load_case
from tumortrack.io.evidence_files import evidence_json, read_evidence
from tumortrack.registration.frame import estimate_of
from tumortrack.registration.model import RegistrationModel
from tumortrack.report import drawing
from tumortrack.report.pictures import scene_views, write_sheet
from tumortrack.tracking.follower import Follower, FollowerConfig
from tumortrack.tracking.tracker import Tracker
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.judging import rigid_centers_mm
from tumortrack_benchmarks.physics import crack
from tumortrack_benchmarks.physics.equilibrium import Rod
from tumortrack_benchmarks.physics.families import Deformed
from tumortrack_benchmarks.physics.kidneys import random_anatomy
from tumortrack_benchmarks.physics.occluders import rod_mesh
from tumortrack_benchmarks.physics.organ import Generator, transformed
from tumortrack_benchmarks.physics.scenes import random_case, simplified
from tumortrack_benchmarks.physics.tets import TETS
from tumortrack_benchmarks.physics.views import render_view
from tumortrack_benchmarks.scripting import cell
from tumortrack_experiment.kit.base import laid_down as bench_from_ct
from tumortrack_resection.drafts import plan_resection
from tumortrack_resection.located import of_estimate
from tumortrack_resection.values import ResectionConfig

_BARE_MM, _BARE = 0.7, 0.1  # a tumor is free so near to the organ's surface; share: exophytic
_DEEP_MM = (1.0, 10.0)  # of an endophytic tumor's nearest place
_TUMOR_ML = (1.0, 26.0)
_CLEAR_MM = 3.0  # of other tumors from the cut
_LEAN_DEGREES = 40.0  # of the way out from the vertical, at most
_GRID = 64  # of the volume on which the planner sees the organ
_LONG_MM, _ROD_MM = 20.0, 6.0  # the cup's length; radius of the rod behind it
_POINT_MM = 1.0  # error of a place of the cut, of the cup, of what it holds
_OWN_MM = 5.0  # depths that differ less from the true surface's are of it
_CROP = CloudConfig(near_mm=75.0, far_mm=330.0, n_points=2000)
_SMOKE_PX, _POOL_PX = 12.0, 6.0
_LEAST_SEEN, _VIEWS = 0.4, 20  # of the organ's pixels, before smoke; views among which one has that
_MOST, _STEPS = 0.85, 7  # of the surface that is cut; states of a sequence
_WRONG_MM = 5.0
_ASIDE_MM = 4.0  # of all places of a cut, any way, as a hand-eye calibration errs
# Frames of each state of a sequence: the first has what was cut, and the next, once no more comes,
# a body that knows it.
_FRAMES_S = (0.0, 0.7, 0.9, 1.1)
_STEP_S = 1.5
_FILM_MS = 350  # a frame's
_METHOD = assessment, registration, tracking  # packages: after a change there rows are made again
_COLOURS = {"nothing": "#b2182b", "the cut": "#2166ac", "both": "#67a9cf"}


@dataclass(frozen=True)
class Options:
    """Make scenes of organs that are being cut, and measure them."""

    out: tyro.conf.Positional[Path]
    """Folder of organs, scenes and rows."""
    organs: int = 14
    """So many."""
    seed: int = 9
    """Organs are numbered from 1000 times this."""
    plan: Literal["many", "sequence"] = "many"
    """Four states in six views each, some cut along planes; or cut and lift grow along the
    planner's, in two views."""
    states: int = 7
    """Of each organ, the first so many."""
    looks: int = 6
    """Of each state, likewise."""
    document: Path | None = None
    """A page that shows the tables, which go beside it."""


class Look(NamedTuple):
    """``view``: its number. ``cup``: the holder's cup and rod are on the flap; their pixels are
    left out, as the robot knows where they are. ``smoke``: so much of the image has no depth, in
    clouds; ``blood``: the like of the organ, in pools about the groove."""

    view: int = 0
    cup: bool = False
    smoke: float = 0.0
    blood: float = 0.0


LOOKS = {
    "many": {
        "bare": Look(0), "bare2": Look(1), "cup": Look(2, True), "cup2": Look(3, True),
        "smoke": Look(4, False, 0.1, 0.1), "cupsmoke": Look(5, True, 0.1, 0.1),
    },
    "sequence": {"bare": Look(), "cup": Look(cup=True)},
}  # fmt: skip


def asked(plan: str, rng: Generator) -> dict[str, tuple[float, crack.Lift]]:
    """The states of an organ: shares that are cut, and lifts."""
    if plan == "sequence":
        shares = np.linspace(0, _MOST, _STEPS).tolist()
        return {f"step{n}": (s, crack.Lift(10.0 * s / _MOST)) for n, s in enumerate(shares)}
    turn = crack.Lift(rng.uniform(0.0, 4.0), rng.uniform(15.0, 33.0))
    return {
        "half-4": (0.5, crack.Lift(4.0)),
        "most-10": (_MOST, crack.Lift(10.0)),
        "some": (rng.uniform(0.2, 0.9), crack.Lift(max(0.0, rng.uniform(-5.0, 10.0)))),
        "turned": (rng.uniform(0.6, 0.9), turn),
    }


def main(options: Options) -> None:
    """Make what is missing, then measure."""
    writer = scripting.begun("cut", options.document)
    folders, number = list[Path](), 1000 * options.seed
    while len(folders) < options.organs:
        try:
            make(options.out / str(number), number, options)
            folders.append(options.out / str(number))
        except TumortrackError as error:
            print(f"{number}: {error}", flush=True)
        number += 1
    rows = pd.DataFrame([row for folder in folders for row in _measured(folder, options.plan)])
    every = table(rows)
    tables = {f"cut-{options.plan}": every, f"cut-{options.plan}-short": beside(every)}
    print(*map(table_of, tables.values()), sep="\n\n")
    writer.tables(tables, sample=f"{len(folders)} organs, {rows.scene.nunique()} scenes")
    if options.plan == "sequence":
        path = options.out / "share.png" if options.document is None else writer.image("cut-share")
        picture(rows, path)
        film(folders[0], path.with_name("cut.gif"))


def make(folder: Path, number: int, options: Options) -> None:
    """An organ's case, model and scenes, as far as they are missing. Raises TumortrackError: it has
    no tumor that can be cut out."""
    rng, (anatomy, _) = np.random.default_rng([number, 0xC5]), random_anatomy(number)
    tumor, bare = _suited(anatomy, rng)
    lean, out = np.deg2rad(rng.uniform(0, _LEAN_DEGREES)), crack.way_out(anatomy, tumor)
    x, y, z = turned_by(lean * unit(np.cross(out, rng.normal(size=3)))) @ out
    turn, deep, planes = rng.uniform(0, 2 * np.pi), rng.uniform(0, 70.0), int(rng.integers(-8, 7))
    planes, name = 6 if options.plan == "sequence" else planes, anatomy.names[1 + tumor]

    def laid(anatomy_ct: Anatomy) -> tuple[np.ndarray, Anatomy, crack.CutSurface]:
        to_bench = bench_from_ct(anatomy_ct.organ, (x, y, z))
        there, way = transformed(anatomy_ct, to_bench), to_bench[:3, :3] @ out
        if planes > 0:
            shown = estimate_of(dict(zip(there.names, there.parts, strict=True)), _GRID)
            wanted = ResectionConfig(tumor=name, most_facets=planes, least_exophytic=0.0)
            cuts = plan_resection(of_estimate(shown), wanted)
            return to_bench, there, crack.facets(cuts.facets, cuts.lift)
        along = turned_by(turn * way) @ perpendicular(way)
        return to_bench, there, crack.shell(there.tumors[tumor], way, along, deep)

    _, there, surface = laid(anatomy)
    for other, part in enumerate(there.tumors):
        off = surface.distance(part.vertices_mm)[0]
        if other != tumor and off.min() < _CLEAR_MM and off.max() > -_CLEAR_MM:
            raise TumortrackError("the cut would meet another tumor.")
    few = simplified(load_case(random_case(folder, number, up_lps=(x, y, z))).anatomy)
    (to_bench, there, surface), inner = laid(few), scene_folder.draw_targets(few, number)
    incision = crack.Incision.of(there, surface, tumor, folder / TETS)
    about = {"family": "cut", "exophytic": bare > _BARE, "tumor": name,
             "surface": f"{planes} planes" if planes > 0 else "shell"}  # fmt: skip
    seen_as = dict(islice(LOOKS[options.plan].items(), options.looks))
    for state_name, (share, lift) in islice(asked(options.plan, rng).items(), options.states):
        looks = {folder / f"{state_name}-{view}": look for view, look in seen_as.items()}
        missing = {path: look for path, look in looks.items() if not path.exists()}
        try:
            state = crack.solve(incision, share, lift, number) if missing else None
            for path, look in missing.items():
                assert state is not None
                rng_of_view = np.random.default_rng([number, look.view, 7])
                scene, held = seen(state, to_bench, inner, look, rng_of_view)
                meta = {**scene.meta, **about, "state": state_name}
                with store.new_folder(path) as aside_path:
                    scene_folder.write_scene_files(aside_path, replace(scene, meta=meta))
                    known = evidence_json((*scene.evidence, held))
                    store.write_atomically(aside_path / "held.json", known)
        except TumortrackError as error:
            print(f"{number}, {state_name}: {error}", flush=True)


def _suited(anatomy: Anatomy, rng: Generator) -> tuple[int, float]:
    """A tumor that can be cut out, and the share of its surface that is bare."""
    for number in rng.permutation(len(anatomy.tumors)):
        part = anatomy.tumors[number]
        far_mm = surface_distance(anatomy.organ, part.vertices_mm)
        bare, fits = float(np.mean(far_mm < _BARE_MM)), _TUMOR_ML[0] < part.volume_mm3 / 1000
        inside = _DEEP_MM[0] < far_mm.min() < _DEEP_MM[1]
        if fits and part.volume_mm3 / 1000 < _TUMOR_ML[1] and (bare > _BARE or inside):
            return int(number), bare
    raise TumortrackError("it has no tumor that can be cut out.")


def seen(
    state: crack.Opened, to_bench: np.ndarray, inner: scene_folder.InnerPoints, look: Look,
    rng: Generator,
) -> tuple[scene_folder.Scene, Grasp]:  # fmt: skip
    """A view of a state, with the cut as evidence, and the cup's hold. The cloud is the organ's,
    flap and all. Raises NoEstimate: too little of the organ is seen."""
    organ, cup = state.incision.organ, state.forward(state.cup_mm[None])
    tumors = (part.with_vertices(state.forward(part.vertices_mm)) for part in organ.anatomy.tumors)
    truth = organ.anatomy.with_parts((state.organ_mm, *tumors))
    shown = Deformed(organ, state.nodes_mm, state.wound.mesh.tets, state.rim_mm, None, {})
    end = Rod(cup[0], state.axis, crack.CUP_MM, _LONG_MM)
    rod = Rod(cup[0] + _LONG_MM / 2 * state.axis, state.axis, _ROD_MM)
    tools = (rod_mesh(end), rod_mesh(rod)) if look.cup else ()
    for _ in range(_VIEWS):
        view = render_view(shown, truth.organ, 0.0, rng, tools)
        frame, to_camera = view.frame, view.camera_from_bench
        here = transformed(truth, to_camera)
        depth_mm, alone = frame.depth_mm.copy(), _depth(here.organ, frame)
        for tool in tools:
            there = tool.with_vertices(transform_points(to_camera, tool.vertices_mm))
            depth_mm[binary_dilation(np.isfinite(_depth(there, frame)), iterations=2)] = np.nan
        with np.errstate(invalid="ignore"):
            own = np.abs(depth_mm - alone) < _OWN_MM
        if own.sum() > _LEAST_SEEN * np.isfinite(alone).sum():
            break
    else:
        raise TumortrackError("the cup hides too much of the organ from everywhere.")
    depth_mm[
        _holes(transform_points(to_camera, state.forward(state.swept_mm)), own, frame, look, rng)
    ] = np.nan
    frame = frame.with_depth(depth_mm)
    only = frame.with_depth(np.where(own, depth_mm, np.float32(np.nan)))
    to_ct = np.linalg.inv(to_bench)

    def told(points_mm: np.ndarray, transform: np.ndarray) -> Any:
        off = rng.normal(0, _POINT_MM, points_mm.shape)
        return tuple(map(tuple, (transform_points(transform, points_mm) + off).tolist()))

    cuts = told(state.swept_mm, to_ct)
    held = Grasp(
        point_ct=told(state.cup_mm[None], to_ct)[0], place_mm=told(cup, to_camera)[0],
        point_std_mm=_POINT_MM, std_mm=_POINT_MM, tool="robot",
    )  # fmt: skip
    now = state.forward(transform_points(to_bench, inner.points_ct))
    meta = {
        **state.about, **view.about, **look._asdict(), "bench_from_ct": to_bench.tolist(),
        "camera_from_bench": to_camera.tolist(),
    }  # fmt: skip
    return scene_folder.Scene(
        cloud_from_depth(only, _CROP, rng), here, frame, meta,
        inner.at(transform_points(to_camera, now)),
        (Cut(points_ct=cuts, std_mm=_POINT_MM, kerf_mm=crack.KERF_MM),) if cuts else (),
    ), held  # fmt: skip


def _depth(mesh: Mesh, frame: Any) -> np.ndarray:
    return render_depth(mesh.vertices_mm, mesh.faces, frame.intrinsics).depth_mm


def _holes(
    groove_mm: np.ndarray, own: np.ndarray, frame: Any, look: Look, rng: Generator
) -> np.ndarray:
    """Pixels without a depth, by smoke, and by blood about the groove (camera frame)."""
    camera = frame.intrinsics
    smoke, pools = (gaussian_filter(rng.normal(size=own.shape), px) for px in (_SMOKE_PX, _POOL_PX))
    lost = smoke > np.quantile(smoke, 1 - look.smoke)
    if len(groove_mm):
        pixels = groove_mm[:, :2] / groove_mm[:, 2:] * [camera.fx, camera.fy]
        grid = np.argwhere(own)
        far = cKDTree(pixels + [camera.cx, camera.cy]).query(grid[:, ::-1])[0]
        far += _POOL_PX * pools[own] / pools.std()
        lost[tuple(grid[far < np.quantile(far, look.blood)].T)] = True
    return lost


def _measured(folder: Path, plan: str) -> list[dict[str, Any]]:
    """A row for each scene, or each frame of a sequence, and what was told."""
    scenes = [path for path in scene_folder.list_scenes(folder) if (path / "held.json").exists()]

    def measure() -> Iterator[dict[str, Any]]:
        tracker = scripting.tracker_of(folder / "case")
        for path in scenes:
            about = {"organ": folder.name, "scene": f"{folder.name}/{path.name}"}
            known = read_evidence(path / "held.json")[1]
            for row in _rows(tracker, scene_folder.read_scene(path), known):
                yield {**about, **row}

    def follow() -> Iterator[dict[str, Any]]:
        tracker = scripting.tracker_of(folder / "case")
        for look in LOOKS["sequence"]:
            steps = [path for path in scenes if path.name.endswith(f"-{look}")]
            of = {path: _about(tracker, scene_folder.read_scene(path)) for path in steps}
            for told in _COLOURS:
                for frame, (path, scene, found) in enumerate(_followed(tracker, steps, told)):
                    about = {"organ": folder.name, "scene": f"{folder.name}/{look}", **of[path]}
                    yield {**about, "told": told, "frame": frame, **_judged(found, scene)}

    # The method's fingerprint is of intact organs.
    code = [path for one in _METHOD for path in Path(one.__path__[0]).glob("*.py")]
    about = {"scenes": [path.name for path in scenes]}
    about |= {"code": scripting.code_sha256([Path(__file__), *code])}
    return scripting.kept(folder / "rows.json", about, follow if plan == "sequence" else measure)


def _followed(
    tracker: Tracker, steps: list[Path], told: str
) -> Iterator[tuple[Path, scene_folder.Scene, Estimate | None]]:
    """Frame by frame, from the organ as it is in the CT; once it is cut they are handed on."""
    follower = Follower(tracker, FollowerConfig())
    for step, path in enumerate(steps):
        scene, (*cuts, held) = scene_folder.read_scene(path), read_evidence(path / "held.json")[1]
        for frame, after_s in enumerate(_FRAMES_S):
            stamp_ns = round(1e9 * (1 + step * _STEP_S + after_s))
            new = (*([] if frame else cuts), *([held] if told == "both" else []))
            try:
                found = follower.locate(
                    replace(scene.cloud, stamp_ns=stamp_ns), scene.depth,
                    evidence=() if told == "nothing" else new,
                )  # fmt: skip
            except NoEstimate:
                found = None
            if cuts:
                yield path, scene, found


def film(folder: Path, path: Path) -> None:
    """A sequence as it is followed with cut and hold told, over the truth: an animated GIF."""
    steps = [each for each in scene_folder.list_scenes(folder) if each.name.endswith("-bare")]
    tracker, pictures = scripting.tracker_of(folder / "case"), list[Image.Image]()
    legend = {"tumor, estimated": colours.name_colour("tumor_1"), "truth (outline)": colours.TRUTH,
              "observed points": colours.SEEN}  # fmt: skip
    with TemporaryDirectory() as aside:
        for _, scene, found in _followed(tracker, steps, "both"):
            off_mm = _judged(found, scene)["off_mm"]
            said = (
                "no estimate" if found is None else f"{found.quality}, centre {off_mm:.1f} mm off"
            )
            state = (
                f"{scene.meta['share']:.0%} cut, lifted {scene.meta['lift_mm']:.1f} mm, SIMULATED"
            )
            meshes = {} if found is None else found.meshes
            colour = colours.VERDICTS["none" if found is None else found.quality]
            sheet = Path(aside) / "sheet.png"
            views = scene_views(scene, meshes)
            write_sheet(sheet, [(said, colour)], [state], legend, [views], width=900)
            pictures.append(Image.open(sheet).convert("P", palette=Image.Palette.ADAPTIVE))
    stream, more = io.BytesIO(), {"append_images": pictures[1:], "duration": _FILM_MS, "loop": 0}
    pictures[0].save(stream, format="GIF", save_all=True, **more)
    store.write_atomically(path, stream.getvalue())


def _about(tracker: Tracker, scene: scene_folder.Scene) -> dict[str, Any]:
    """What a row says of a scene."""
    assert isinstance(tracker.model, RegistrationModel)
    keys = ("state", "share", "lift_mm", "degrees", "exophytic", "surface", "cup", "smoke")
    about = {key: scene.meta[key] for key in (*keys, "tumor_moved_mm", "flap_turned_degrees")}
    return {**about, "rigid_mm": rigid_centers_mm(tracker.model, scene)[scene.meta["tumor"]]}


def _judged(found: Estimate | None, scene: scene_folder.Scene) -> dict[str, Any]:
    """How far the tumor's centre is off, and that of its places that is farthest off; and what was
    said: of all tumors, and of it alone."""
    if found is None:
        return {"quality": "none"} | dict.fromkeys(("off_mm", "largest_mm", "radius_mm", "why"))
    targets, motion = scene.targets, found.motion
    assert targets is not None
    assert motion is not None
    mine = targets.labels == 1 + scene.reference.names.index(scene.meta["tumor"])
    off_mm = motion.forward(targets.points_ct[mine]) - targets.points_mm[mine]
    bound = found.assessment.bounds.get(scene.meta["tumor"])
    return {
        "quality": found.quality, "off_mm": float(np.linalg.norm(off_mm.mean(0))),
        "largest_mm": float(np.linalg.norm(off_mm, axis=1).max()),
        "why": None if found.finding is None else found.finding.kind,
        "radius_mm": None if bound is None else bound.error_bound95_mm,
    }  # fmt: skip


def _rows(
    tracker: Tracker, scene: scene_folder.Scene, known: tuple[Evidence, ...]
) -> Iterator[dict[str, Any]]:
    about = _about(tracker, scene)
    cuts = [each for each in known if isinstance(each, Cut)]
    cut = tracker.with_cut(cuts) if cuts else tracker
    told = {
        "nothing": (tracker, ()), "the hold": (tracker, known[-1:]),
        "the cut": (cut, ()), "both": (cut, known[-1:]),
    }  # fmt: skip
    if cuts and about["state"] == "most-10":
        points_ct = np.array(cuts[0].points_ct)
        aside = _ASIDE_MM * unit(np.random.default_rng(len(points_ct)).normal(size=3))
        wrong = {f"the cut, {_ASIDE_MM:g} mm aside": points_ct + aside,
                 "a third of the cut": points_ct[::3]}  # fmt: skip
        told |= {n: (tracker.with_cut([cuts[0].of_ct(p)]), ()) for n, p in wrong.items()}
    for name, (using, evidence) in told.items():
        try:
            found = using.locate(scene.cloud, grid=16, full_view=scene.depth, evidence=evidence)
        except NoEstimate:
            found = None
        yield {**about, "told": name, **_judged(found, scene)}


def table(rows: pd.DataFrame) -> pd.DataFrame:
    """A line for each family and what was told."""
    most = rows.state == "most-10"
    families = {
        "all": rows.share >= 0, "half cut, 4 mm": rows.state == "half-4",
        "85 % cut, 10 mm": most & ~rows.cup, "the same, cup in view": most & rows.cup,
        "turned": rows.state == "turned", "endophytic": ~rows.exophytic,
        "along planes": rows.surface != "shell", "smoke and blood": rows.smoke > 0,
        "nothing cut": rows.share == 0,
    }  # fmt: skip
    if "frame" in rows:
        half = rows.share <= 0.5
        families = {"all frames": rows.share >= 0, "up to half cut": half, "more": ~half,
                    "cup in view": rows.cup}  # fmt: skip
    groups = {name: rows[chosen].groupby("told", sort=False) for name, chosen in families.items()}
    return pd.DataFrame(
        [_line(name, told, some) for name, group in groups.items() for told, some in group]
    )


def _line(family: str, told: Any, some: pd.DataFrame) -> dict[str, Any]:
    off, good, known = some.off_mm.astype(float), some.quality == "good", some.radius_mm.notna()
    return {
        "family": family, "told": told, "scenes": len(some),
        "median, mm": cell(off.median()), "95 %": cell(off.quantile(0.95)),
        "worst": cell(off.max()), "good %": cell(100 * good.mean(), 0),
        "good and over 5 mm off %": cell(100 * (good & (off > _WRONG_MM)).mean()),
        "covered by the bound %": cell(100 * (some.largest_mm <= some.radius_mm)[known].mean(), 0),
        "rigid fit: median, mm": cell(some.rigid_mm.median()),
        "its 95 %": cell(some.rigid_mm.quantile(0.95)),
    }  # fmt: skip


def beside(lines: pd.DataFrame) -> pd.DataFrame:
    """What was told, side by side: median / 95 % / worst, mm, and how many answers were good."""
    shown = []
    for family, some in lines.groupby("family", sort=False):
        by = some.set_index("told").loc[list(_COLOURS)]
        errors = by[["median, mm", "95 %", "worst"]].agg(" / ".join, axis=1)
        rigid = by[["rigid fit: median, mm", "its 95 %"]].agg(" / ".join, axis=1)
        shown.append({
            "family": family, "answers": by.scenes.iloc[0],
            **{f"told {told}": error for told, error in errors.items()},
            "rigid fit": rigid.iloc[0],
            **{f"good %, told {told}": good for told, good in by["good %"].items()},
        })  # fmt: skip
    return pd.DataFrame(shown)


def picture(rows: pd.DataFrame, path: Path) -> None:
    """Errors over the share that is cut: median and 95 % of all sequences' frames."""
    figure = drawing.new_figure(7.0, 4.2, left=0.1, right=0.97, top=0.95, bottom=0.14)
    axes = figure.add_subplot()
    for told, colour in _COLOURS.items():
        steps = rows[rows.told == told].groupby(rows.share.round(2)).off_mm
        for share, label, style in ((0.5, f"told: {told}, median", "-"), (0.95, "95 %", "--")):
            axes.plot(steps.quantile(share), style, color=colour, marker=".", label=label)
    axes.set(xlabel="share that is cut", ylabel="error of the tumor's centre, mm")
    axes.set_ylim(0, 1.3 * axes.get_ylim()[1])  # room for the legend
    axes.legend(frameon=False, ncols=3, fontsize="small", loc="upper left")
    drawing.save(figure, path)


if __name__ == "__main__":
    scripting.run(main, Options)
