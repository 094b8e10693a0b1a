"""More organs and deformations that nature made: the tables of docs/real.md.

    make real ARGS='DATA'         (hours; go on with the same command after an interruption)

DATA is a folder with the user's own copies: kits19/case_NNNNN/segmentation.nii.gz, dirqa/caseN.mat
and silicone/ (docs/real.md says where they come from). Cases, models and rows are kept under --out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from pathlib import Path
from typing import Annotated, Literal, get_args

import numpy as np
import pandas as pd
import tyro

from tumortrack import api
from tumortrack.cli.console import model_folder, say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.mesh_files import read_mesh, write_mesh
from tumortrack.core.types import Mesh
from tumortrack.imaging.case import Case, load_case
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.real import kidneys, lungs, silicone
from tumortrack_lab.real.judging import DRAGGED, by_tumor, judge, quantiles, scene_of
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import table
from tumortrack_lab.study.methods import named_folders

Part = Literal["kidneys", "lungs", "silicone", "slab"]
KINDS = (*kidneys.KINDS, "between")  # of tumors
ERRORS = "median / 90 / 95 / worst, mm"


@dataclass(frozen=True, kw_only=True)
class Options(scripts.KeptOptions):
    """Real kidneys, real deformations, and silicone."""

    data: Annotated[Path, tyro.conf.Positional]
    """Folder of your own copies of the data."""
    parts: tuple[Part, ...] = get_args(Part)
    """Which tables to make."""
    kidneys: tuple[int, ...] = tuple(row["case"] for row in kidneys.frozen())
    """Which of the frozen list are located, by case number; all are prepared and checked."""
    organs: tuple[str, ...] = ()
    """More organs for the lungs' deformations, each NAME=CASE."""
    scenes: int = 10
    """Dragged scenes of each kidney."""
    seed: int = 0
    """Of scenes and places in the lungs."""
    out: Path = Path("runs/real")
    document: Path = Path("docs/real.md")


@dataclass(frozen=True, eq=False)
class Organ:
    """A prepared case, with its model."""

    name: str
    folder: Path
    options: Options

    @property
    def case(self) -> Case:
        return load_case(self.folder)

    def by_kind(self, rows: list[dict]) -> list[dict]:
        """The rows, and of each tumor its kind."""
        return kidneys.with_kinds(rows, self.case.anatomy)

    def tracker(self) -> Tracker:
        return Tracker(api.load_model(self.folder))

    def about(self) -> dict:
        """What rows depend on."""
        return {
            "case": store.sha256_of(self.folder / store.MANIFEST),
            "model": store.sha256_of(model_folder(self.folder) / store.MANIFEST),
            "seed": self.options.seed,
        }


def main(options: Options) -> None:
    """The parts, and after each its block."""
    writer = options.begin("real", *(f"real-{part}" for part in options.parts))
    rows = kidneys.frozen()
    if unknown := set(options.kidneys) - {row["case"] for row in rows}:
        raise InputError(f"--kidneys {min(unknown)} is not in the list; see docs/real.md.")
    folders = {}
    if {"kidneys", "lungs"} & {*options.parts}:
        folders = kidneys.check(options.data, options.out / "cases", rows)
    chosen = [
        Organ(name, folders[name], options)
        for name in map(kidneys.name_of, options.kidneys)
        if name in folders
    ]
    more = [
        Organ(name, folder, options)
        for name, folder in named_folders(options.organs, folders).items()
    ]
    made = {
        "kidneys": lambda: kidneys_block(rows, chosen),
        "lungs": lambda: lungs_block([*more, *chosen], options),
        "silicone": lambda: silicone_block(options),
        "slab": lambda: slab_block(options),
    }
    for part in options.parts:
        text = made[part]()
        writer.write({f"real-{part}": f"{text}\n\n`{writer.command}`"})
        say(f"{part}: block written to {options.document}")


def kidneys_block(listed: list[dict], organs: list[Organ]) -> str:
    """The frozen list, and how well the kidneys are found dragged, squeezed and bent."""
    found = {organ.name: organ.by_kind(_dragged(organ)) for organ in organs}
    head = ["case", "side", "kind", "tumor's outer share", "kidney, ml", "tumors, ml", "slices, mm"]
    body = [
        [
            kidneys.name_of(row["case"]), row["side"], row["kind"], f"{row['outer_share']:.2f}",
            f"{row['organ_ml']:.0f}", ", ".join(f"{ml:.1f}" for ml in row["tumors_ml"]),
            f"{row['spacing_mm'][0]:g}",
        ]
        for row in sorted(listed, key=lambda row: row["case"])
    ]  # fmt: skip
    every = [row for rows in found.values() for row in rows]
    groups = dict(sorted(found.items())) | {f"all {kind}": _of(kind, every) for kind in KINDS}
    return "\n\n".join([table(head, body, 3), _table("kidney", groups)])


def _of(kind: str, rows: list[dict]) -> list[dict]:
    """What the rows say of tumors of this kind."""
    some = [{**row, "tumors": [t for t in row["tumors"] if t["kind"] == kind]} for row in rows]
    return [row for row in some if row["tumors"]]


def _dragged(organ: Organ) -> list[dict]:
    count = organ.options.scenes
    about = organ.about() | {"scenes": count}

    def measure() -> list[dict]:
        case, tracker = organ.case, organ.tracker()
        make = api.scene_maker(case, DRAGGED, organ.options.seed)
        rows = [judge(tracker, case.anatomy, make(number)) for number in range(count)]
        say(f"{organ.name}, dragged: {quantiles(by_tumor(rows).middle_mm)}")
        return rows

    folder = organ.options.out / "dragged"
    folder.mkdir(exist_ok=True)
    return scripts.kept(folder / f"{organ.name}.json", about, measure)


def lungs_block(organs: list[Organ], options: Options) -> str:
    """Every organ at a place of every patient's lung."""
    pairs = {
        patient: lungs.read_landmarks(lungs.landmark_file(options.data, patient), patient)
        for patient in lungs.PATIENTS
    }
    field = cache(lambda patient: lungs.Field(pairs[patient]))
    rows = []
    for organ in organs:
        for patient in lungs.PATIENTS:
            rows += organ.by_kind(_breathed(organ, patient, field, options))
    both = pd.DataFrame(rows)
    body = []
    for patient, given in pairs.items():
        rng = np.random.default_rng([options.seed, patient])
        off_mm = lungs.held_out_mm(given, lungs.SMOOTHING, rng)
        mine = both[both.patient == patient]
        body.append([
            str(patient), f"{len(given.exhaled_mm):,}",
            f"{np.linalg.norm(given.inhaled_mm - given.exhaled_mm, axis=1).mean():.1f}",
            f"{np.median(off_mm):.2f}", f"{np.percentile(off_mm, 95):.2f}",
            *(f"{mine[mine.variant == name].rms_mm.median():.1f}" for name in lungs.VARIANTS),
            f"{mine.least_stretch.min():.2f} to {mine.most_stretch.max():.2f}",
            str((mine.verdict == "folded").sum()),
            f"{mine.scale.min():g}",
        ])  # fmt: skip
    head = ["patient", "pairs", "mean motion", "left-out pairs: median", "95 %"]
    head += [f"rms, {name}" for name in lungs.VARIANTS]
    head += ["volume by point, least to most", "folded, refused", "smallest scale"]
    seen = [row for row in rows if row["verdict"] != "folded"]
    by_variant = {name: [r for r in seen if r["variant"] == name] for name in lungs.VARIANTS}
    groups = {
        f"{name}, {kind}": _of(kind, some) for kind in KINDS for name, some in by_variant.items()
    }
    each = {
        f"{patient}, {name}": [row for row in some if row["patient"] == patient]
        for patient in pairs
        for name, some in by_variant.items()
    }
    by_organ = {
        f"{organ.name}, {name}": [row for row in some if row["organ"] == organ.name]
        for organ in organs
        for name, some in by_variant.items()
    }
    return "\n\n".join([
        table(head, body), _table("deformation, tumors", groups), _table("organ", by_organ),
        _table("patient", each),
    ])  # fmt: skip


def _breathed(organ: Organ, patient: int, field, options: Options) -> list[dict]:
    path = lungs.landmark_file(options.data, patient)
    about = organ.about() | {
        "landmarks": store.sha256_of(path), "smoothing": lungs.SMOOTHING,
        "variants": {name: list(variant) for name, variant in lungs.VARIANTS.items()},
    }  # fmt: skip

    def measure() -> list[dict]:
        return list(_states(organ, patient, field(patient)))

    folder = options.out / "lungs"
    folder.mkdir(exist_ok=True)
    return scripts.kept(folder / f"{organ.name}-{patient}.json", about, measure)


def _states(organ: Organ, patient: int, field: lungs.Field) -> Iterator[dict]:
    case, tracker = organ.case, organ.tracker()
    surface = case.anatomy.organ
    seed = int.from_bytes(organ.name.encode(), "little")  # another place for every organ
    rng = np.random.default_rng([organ.options.seed, patient, seed])
    for name, state in lungs.states(field, surface, rng).items():
        points = np.concatenate([part.vertices_mm[::10] for part in case.anatomy.parts])
        stretch = state.stretch(points)
        moved = state.apply(surface.vertices_mm)
        off_mm = np.linalg.norm(moved - surface.vertices_mm, axis=1)
        row = {
            "organ": organ.name, "patient": patient, "variant": name,
            "scale": round(float(np.cbrt(np.linalg.det(state.lung_from_ct[:3, :3]))), 3),
            "rms_mm": float(np.sqrt((off_mm**2).mean())), "most_mm": float(off_mm.max()),
            "volume": surface.moved(moved).volume_mm3 / surface.volume_mm3,
            "least_stretch": float(stretch.min()), "most_stretch": float(stretch.max()),
        }  # fmt: skip
        if stretch.min() <= 0:  # space is folded over: no body does that
            yield {**row, "verdict": "folded", "tumors": []}
            continue
        scene = scene_of(case.anatomy, case.up_lps, state, rng)
        yield {**row, **judge(tracker, case.anatomy, scene)}
        say(f"{organ.name} as lung {patient}, {name}: done")


def _table(what: str, groups: dict[str, list[dict]]) -> str:
    """Verdicts and errors by group; errors of what was called good, and of every answer."""
    head = [
        what, "scenes", "good", "poor", "refused", f"middle of tumors, {ERRORS}", "best rigid pose",
        "Hausdorff distance", "best rigid pose", "called good: middle", "error / stated",
    ]  # fmt: skip
    body = []
    for name, rows in groups.items():
        if not rows:
            continue
        lines, verdicts = by_tumor(rows), [row["verdict"] for row in rows]
        good = lines[lines.verdict == "good"]
        answered = lines[lines.verdict != "refused"]
        ratio = answered.middle_mm / answered.std_mm
        body.append([
            name, str(len(rows)),
            *(str(verdicts.count(verdict)) for verdict in ("good", "poor", "refused")),
            quantiles(answered.middle_mm), quantiles(answered.rigid_middle_mm),
            quantiles(answered.hausdorff_mm), quantiles(answered.rigid_hausdorff_mm),
            quantiles(good.middle_mm), quantiles(ratio),
        ])  # fmt: skip
    return table(head, body)


def silicone_block(options: Options) -> str:
    """The bent casts: how far the scan lies from the estimated surface, seen and unseen."""
    data = options.data
    top = silicone.read_surface(data, silicone.REST)
    files = {cast: silicone.file(data, name) for cast, name in silicone.BENT.items()}
    scans = {cast: partial(read_mesh, path) for cast, path in files.items()}
    rows = _bent("silicone", (top, silicone.UNDERSIDE_MM), files, scans, options)
    return _bent_table("cast", rows)


def slab_block(options: Options) -> str:
    """The bent slab: the same, and how far the curve on it lies from its trace."""
    data = options.data
    files = {what: silicone.file(data, name) for what, name in silicone.SLAB.items()}
    given = {what: silicone.read_slab(data, what) for what in files}
    top = silicone.surface_over(given["flat scan"], np.inf)
    under_mm = float(np.median(top.vertices_mm[:, 2])) + silicone.THICK_MM
    scan = silicone.surface_over(given["bent scan"], silicone.HOLE_MM)
    views = dict.fromkeys(("1", "2", "3"), lambda: scan)
    curves = given["flat curve"], given["bent curve"]
    rows = _bent("slab", (top, under_mm), files, views, options, curves)
    more = {f"error / stated, {where}": f"ratio_{where}_mm" for where in ("seen", "unseen")}
    return "\n\n".join([_bent_table("view", rows), _bent_table("view", rows, "curve_", more)])


def _bent(
    name: str, rest: tuple[Mesh, float], files: dict[str, Path],
    scans: dict[str, Callable[[], Mesh]], options: Options,
    curves: tuple[np.ndarray, np.ndarray] | None = None,
) -> list[dict]:  # fmt: skip
    """Rows of every scan, by a model of the top surface at rest over its underside's z, mm."""
    folder = options.out / name
    if not (folder / "case").exists():
        (folder / "meshes").mkdir(parents=True, exist_ok=True)
        write_mesh(folder / "meshes" / "kidney.ply", silicone.closed(*rest))
        up = ",".join(map(str, silicone.UP))
        api.prepare(folder / "meshes", folder / "case", up=up, patient=name)
    organ = Organ(name, folder / "case", options)
    about = organ.about() | {what: store.sha256_of(path) for what, path in files.items()}

    def measure() -> list[dict]:
        tracker, anatomy = organ.tracker(), organ.case.anatomy
        rows = []
        for number, (which, read) in enumerate(scans.items()):
            rng = np.random.default_rng([options.seed, number])
            found = silicone.measured(tracker, anatomy, rest[0], read(), rng, curves)
            rows += [{"cast": which, **row} for row in found]
            say(f"{name} {which}: {rows[-1]}")
        return rows

    return scripts.kept(folder / "rows.json", about, measure)


def _bent_table(
    first: str, rows: list[dict], of: str = "", more: dict[str, str] | None = None
) -> str:
    """A line a view: what was said of it, and how far the surfaces (or what ``of`` says) lie off;
    ``more``: columns, and what they show."""
    columns = {
        f"{which}{where}, mm": f"{key}{of}{where}_mm"
        for where in ("seen", "unseen")
        for which, key in {"": "", "best rigid, ": "rigid_"}.items()
    } | (more or {})
    head = [first, "scan seen", "verdict", "cost / usual", "stated deviation, mm", *columns]
    body = [
        [
            row["cast"], f"{row['share']:.0%}", row["verdict"], f"{row['cost']:.1f}",
            f"{row['std_mm']:.1f}",
            *(" / ".join(f"{mm:.1f}" for mm in row.get(key, ())) or "–"
              for key in columns.values()),
        ]
        for row in rows
    ]  # fmt: skip
    return table(head, body, 3)


if __name__ == "__main__":
    scripts.run(main, Options)
