"""Real organs and real deformations: the tables of docs/real.md and docs/data/.

    make real ARGS='DATA'         (hours; go on with the same command after an interruption)

DATA is a folder with the user's own copies: kits19/case_NNNNN/segmentation.nii.gz, dirqa/caseN.mat
and silicone/ (docs/real.md says where they come from). Cases, models and rows are kept under --out.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import cache, partial
from itertools import product
from pathlib import Path
from typing import Annotated, Any, Literal, get_args

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
from tumortrack.simulate.dataset import scene_maker
from tumortrack.tracking.tracker import Tracker
from tumortrack_lab.real import kidneys, lungs, silicone
from tumortrack_lab.real.judging import DRAGGED, by_tumor, judge, scene_of
from tumortrack_lab.study import scripts
from tumortrack_lab.study.document import ReportWriter, beside_rigid, spread_mm
from tumortrack_lab.study.methods import named_folders

Part = Literal["kidneys", "lungs", "silicone", "slab"]
KINDS = (*kidneys.KINDS, "between")  # of tumors


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
        """The rows with each tumor's kind."""
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
    """The parts, and after each its tables."""
    writer = options.begin("real")
    rows = kidneys.frozen()
    if unknown := set(options.kidneys) - {row["case"] for row in rows}:
        raise InputError(f"--kidneys {min(unknown)} is not in the list; see docs/real.md.")
    folders = {}
    if {"kidneys", "lungs"} & {*options.parts}:
        folders = kidneys.check(options.data, options.out / "cases", rows)
    names = [name for name in map(kidneys.name_of, options.kidneys) if name in folders]
    chosen = [Organ(name, folders[name], options) for name in names]
    given = named_folders(options.organs, folders).items()
    more = [Organ(name, folder, options) for name, folder in given]
    made = {
        "kidneys": lambda: kidneys_block(rows, chosen, writer),
        "lungs": lambda: lungs_block([*more, *chosen], options, writer),
        "silicone": lambda: silicone_block(options, writer),
        "slab": lambda: slab_block(options, writer),
    }
    for part in options.parts:
        made[part]()
        say(f"{part}: written to {options.document}")


def kidneys_block(listed: list[dict], organs: list[Organ], writer: ReportWriter) -> None:
    """Errors in dragged, squeezed and bent kidneys: by kind, and by kidney."""
    about = {
        kidneys.name_of(row["case"]): {
            "side": row["side"], "kind": row["kind"], "outer share": f"{row['outer_share']:.2f}",
            "kidney ml": f"{row['organ_ml']:.0f}", "largest tumor ml": f"{row['tumors_ml'][0]:.1f}",
            "slices mm": f"{row['spacing_mm'][0]:g}",
        }
        for row in listed
    }  # fmt: skip
    rows_of = dict(sorted((organ.name, organ.by_kind(_dragged(organ))) for organ in organs))
    every = [row for rows in rows_of.values() for row in rows]
    by_kidney = [{"kidney": name, **about[name], **summary(rows)} for name, rows in rows_of.items()]
    by_kind = [
        {"kidney": "all", "kind": kind, **summary(mine)}
        for kind in KINDS
        if (mine := _of(kind, every))
    ]
    _tables(writer, "real-kidneys", by_kidney + by_kind, by_kind)


def _of(kind: str, rows: list[dict]) -> list[dict]:
    """The rows with only the tumors of this kind."""
    some = [{**row, "tumors": [t for t in row["tumors"] if t["kind"] == kind]} for row in rows]
    return [row for row in some if row["tumors"]]


def _dragged(organ: Organ) -> list[dict]:
    count = organ.options.scenes
    about = organ.about() | {"scenes": count}

    def measure() -> list[dict]:
        case, tracker = organ.case, organ.tracker()
        make = scene_maker(case, DRAGGED, organ.options.seed)
        say(f"{organ.name}, dragged: {count} scenes")
        return [judge(tracker, case.anatomy, make(number)) for number in range(count)]

    return scripts.kept(organ.options.out / "dragged" / f"{organ.name}.json", about, measure)


def lungs_block(organs: list[Organ], options: Options, writer: ReportWriter) -> None:
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
    fields = []
    for patient, given in pairs.items():
        rng = np.random.default_rng([options.seed, patient])
        off_mm = lungs.held_out_mm(given, lungs.SMOOTHING, rng)
        mine = pd.DataFrame([row for row in rows if row["patient"] == patient])
        moved_mm = np.linalg.norm(given.inhaled_mm - given.exhaled_mm, axis=1)
        fields.append({
            "patient": patient, "pairs": len(moved_mm), "mean motion mm": moved_mm.mean(),
            "left-out pairs median mm": np.median(off_mm),
            "left-out pairs 95 % mm": np.percentile(off_mm, 95),
            **{f"rms {name} mm": mine[mine.variant == name].rms_mm.median()
               for name in lungs.VARIANTS},
            "least local volume": mine.least_stretch.min(),
            "most local volume": mine.most_stretch.max(),
            "folded states": (mine.verdict == "folded").sum(), "smallest scale": mine.scale.min(),
        })  # fmt: skip
    located = [row for row in rows if row["verdict"] != "folded"]
    groups = [("tumors", kind, _of(kind, located)) for kind in KINDS] + [
        (by, value, [row for row in located if row[by] == value])
        for by in ("organ", "patient")
        for value in dict.fromkeys(row[by] for row in located)
    ]
    lines = [
        {"by": by, "of": of, "deformation": name, **summary(mine)}
        for by, of, some in groups
        for name in lungs.VARIANTS
        if (mine := [row for row in some if row["variant"] == name])
    ]
    short = [line for line in lines if line["by"] == "tumors"]
    _tables(writer, "real-lungs", lines, short)
    sample = f"{len(pairs)} patients"
    writer.tables({"real-lungs-fields": pd.DataFrame(fields).round(2)}, sample=sample)


def _breathed(organ: Organ, patient: int, field, options: Options) -> list[dict]:
    path = lungs.landmark_file(options.data, patient)
    about = organ.about() | {
        "landmarks": store.sha256_of(path), "smoothing": lungs.SMOOTHING,
        "variants": {name: list(variant) for name, variant in lungs.VARIANTS.items()},
    }  # fmt: skip

    def measure() -> list[dict]:
        return list(_states(organ, patient, field(patient)))

    rows_path = options.out / "lungs" / f"{organ.name}-{patient}.json"
    return scripts.kept(rows_path, about, measure)


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


def summary(rows: list[dict]) -> dict[str, Any]:
    """Verdicts, and errors of every answer and of what was called good."""
    lines, verdicts = by_tumor(rows), [row["verdict"] for row in rows]
    answered, good = lines[lines.verdict != "refused"], lines[lines.verdict == "good"]
    ratio = spread_mm("error / stated", answered.middle_mm / answered.std_mm)
    return {
        "scenes": len(rows),
        **{verdict: verdicts.count(verdict) for verdict in ("good", "poor", "refused")},
        **spread_mm("centre", answered.middle_mm),
        **spread_mm("best rigid pose's centre", answered.rigid_middle_mm),
        **spread_mm("Hausdorff", answered.hausdorff_mm),
        **spread_mm("best rigid pose's Hausdorff", answered.rigid_hausdorff_mm),
        **spread_mm("rigid fit's centre", answered.rigid_fit_middle_mm),
        **spread_mm("good answers' centre", good.middle_mm),
        **{name.removesuffix(" mm"): value for name, value in ratio.items()},
    }


def _tables(writer: ReportWriter, name: str, rows: list[dict], short: list[dict]) -> None:
    """The short table, and all rows."""
    given = pd.DataFrame(short).rename(columns={"kind": "tumors", "of": "tumors"})
    head = given.columns.intersection(["tumors", "deformation", "scenes", "good"])
    shown = given[head].assign(**beside_rigid(given))
    tables = {name: shown, f"{name}-groups": pd.DataFrame(rows)}
    writer.tables(tables, sample=f"{int(given.scenes.sum())} scenes")


def silicone_block(options: Options, writer: ReportWriter) -> None:
    """The bent casts: distances of the scan to the estimated surface, seen and unseen."""
    data = options.data
    top = read_mesh(silicone.file(data, silicone.REST))
    files = {cast: silicone.file(data, name) for cast, name in silicone.BENT.items()}
    scans = {cast: partial(read_mesh, path) for cast, path in files.items()}
    rows = _bent("silicone", (top, silicone.UNDERSIDE_MM), files, scans, options)
    table = pd.DataFrame(_bent_rows("cast", rows)).round(1)
    writer.tables({"real-silicone": table}, sample=f"{len(silicone.BENT)} casts")


def slab_block(options: Options, writer: ReportWriter) -> None:
    """The bent slab: the same, and distances of the curve on it to its trace."""
    data = options.data
    files = {what: silicone.file(data, name) for what, name in silicone.SLAB.items()}
    given = {what: silicone.read_slab(data, what) for what in files}
    top = silicone.surface_over(given["flat scan"], np.inf)
    under_mm = float(np.median(top.vertices_mm[:, 2])) + silicone.THICK_MM
    scan = silicone.surface_over(given["bent scan"], silicone.HOLE_MM)
    views = dict.fromkeys(("1", "2", "3"), lambda: scan)
    curves = given["flat curve"], given["bent curve"]
    rows = _bent("slab", (top, under_mm), files, views, options, curves)
    lines = [
        {"distance of": what, **line}
        for what, of in {"surface": "", "curve": "curve_"}.items()
        for line in _bent_rows("view", rows, of)
    ]
    writer.tables({"real-slab": pd.DataFrame(lines).round(1)}, sample="1 slab")


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
            views = silicone.measured(tracker, anatomy, rest[0], read(), rng, curves)
            rows += [{"cast": which, **row} for row in views]
            say(f"{name} {which}: {rows[-1]}")
        return rows

    return scripts.kept(folder / "rows.json", about, measure)


def _bent_rows(first: str, rows: list[dict], of: str = "") -> Iterator[dict]:
    """A row for each view: verdict, and distances of surfaces (or of what ``of`` names)."""
    kinds = {"": (of, " mm"), "best rigid pose ": (f"rigid_{of}", " mm")}
    kinds |= {"error / stated ": ("ratio_", "")} if of else {}
    for row in rows:
        line = {
            first: row["cast"], "scan seen %": round(100 * row["share"]), "verdict": row["verdict"],
            "cost / usual": row["cost"], "stated deviation mm": row["std_mm"],
        }  # fmt: skip
        for where, (words, (key, unit)) in product(("seen", "unseen"), kinds.items()):
            values = row.get(f"{key}{where}_mm", (None,) * 3)
            names = (f"{words}{where} {name}{unit}" for name in ("median", "95 %", "worst"))
            line |= zip(names, values, strict=True)
        yield line


if __name__ == "__main__":
    scripts.run(main, Options)
