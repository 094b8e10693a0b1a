"""What lies in a folder or file, in sentences: `inspect`."""

from __future__ import annotations

import string
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from tyro.conf import Positional

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError

Content = Mapping[str, Any]  # of a JSON file
# A sentence with entries in braces; or of each member of an entry, with its {name} and {value}.
Sentence = str | tuple[str, str]

_KNOWN = (
    "folders that commands write (cases, models, runs, plans, scenes, recordings, evaluations, "
    "fleets, kits, calibrations), their reports, calibration and intrinsics files, clouds, depth "
    "images beside intrinsics.json, meshes, CTs and label maps"
)


@dataclass(frozen=True, kw_only=True)
class Inspect:
    """Say what a folder or file is, and what is in it.

    Attributes:
        path: what a command wrote or reads.
    """

    path: Positional[Path]

    def run(self) -> None:
        for line in describe(self.path):
            say(line)


def describe(path: Path) -> list[str]:
    """Lines about a folder or file. Raises InputError: nothing that is known here; ArtifactError:
    it is damaged."""
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    lines = [line.removesuffix(".") for line in (_folder if path.is_dir() else _file)(path)]
    if not lines:
        raise InputError(f"{path} is nothing that inspect knows. It knows {_KNOWN}.")
    return [f"{path}: {lines[0]}.", *(f"  {line}." for line in lines[1:])]


class _Words(string.Formatter):
    """Raises KeyError for an entry that is missing or empty."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Content) -> Any:
        found, first = super().get_field(field_name, args, kwargs)
        if found is None or (isinstance(found, str | list | dict) and not found):
            raise KeyError(field_name)
        return found, first


def _words(content: Content, sentences: Iterable[Sentence]) -> Iterator[str]:
    """Sentences filled from JSON; left out are those whose entries are missing or empty."""
    for sentence in sentences:
        entry, template = ("", sentence) if isinstance(sentence, str) else sentence
        members: Any = content
        with suppress(KeyError, TypeError, IndexError, ValueError):
            for key in filter(None, entry.split(".")):
                members = members[key]
            some = members.items() if entry and isinstance(members, dict) else enumerate(members)
            for name, value in some if entry else [("", "")]:
                inner = value if isinstance(value, dict) else {}
                yield _Words().vformat(template, (), {**content, **inner, "name": name,
                                                      "value": value})  # fmt: skip


_PATIENT = "patient {patient[id]}, side {patient[side]}"
_CASE: tuple[Sentence, ...] = (
    _PATIENT,
    "made from a {report[kind]}, {report[source]}",
    "voxels of {report[spacing_mm][0]:.3g} x {report[spacing_mm][1]:.3g} x "
    "{report[spacing_mm][2]:.3g} mm",
    ("report.volumes_ml", "{name}: {value:.1f} ml"),
    ("structures", "{value} moves with it"),
    "WARNING: {report[half_turn][warning]}",
    ("report.notes", "note: {value}"),
)
_RUN: tuple[Sentence, ...] = (
    "verdict: {quality[verdict]}",
    "because {quality[reason]}",
    _PATIENT,
    ("parts", "{name}: {volume_ml:.1f} ml, centre ({center_mm[0]:.1f}, {center_mm[1]:.1f}, "
     "{center_mm[2]:.1f}) mm"),
    ("parts", "{name}: one standard deviation of its centre is {center_std_mm:.1f} mm"),
    ("missing", "{value}: not found"),
    "{margin_words}",
)  # fmt: skip
_PLAN: tuple[Sentence, ...] = (
    _PATIENT,
    "{plan[tumor]}, {plan[volumes_ml][tumor]:.1f} ml: {plan[volumes_ml][piece]:.1f} ml come away, "
    "of that {plan[volumes_ml][healthy]:.1f} ml healthy tissue",
    "margin {plan[margin_mm]:.1f} mm; the cuts keep {budget[margin_mm]:.1f} mm from the tumor as "
    "it was located, which may be off by {budget[tracking_mm]:.1f} mm",
    "two arms carry it out in {seconds:.0f} s",
    ("plan.notes", "note: {value}"),
)
_RESECT = ("arms: {resection[state]}", ("resection.halts", "halted ({value} x): {name}"))
_TRACK: tuple[Sentence, ...] = (
    "{updates} updates in {seconds:.1f} s, {rate:.1f} a second: {share[0]:.0%} good, "
    "{share[1]:.0%} poor, {share[2]:.0%} none",
    _PATIENT,
    "from {source}",
    ("sinks", "to {name}: {delivered} delivered, {dropped} missed"),
    ("reasons", "no estimate in {value} of {updates}: {name}"),
    "latency {latency_ms[p50]:.1f} ms (median; 95 %: {latency_ms[p95]:.1f} ms)",
    ("center_error_mm", "{name}: centre off by {p50:.1f} mm (median; 95 %: {p95:.1f} mm)"),
    *_RESECT,
)
_FILES: tuple[Sentence, ...] = (  # --frame, --poses, --intrinsics
    "frame {frame_id}",
    "off by up to {error_mm:g} mm",
    "{width:g} x {height:g} pixels, focal lengths {fx:.1f} and {fy:.1f} pixels",
    "one step of its depth images: {depth_unit_mm:g} mm",
    "depths are corrected: {depth_scale:g} times what is measured, {depth_offset_mm:+g} mm",
)


def _run(report: Content) -> Iterator[str]:
    from tumortrack.models.margins import margin_words

    missing = [name for name, part in report["parts"].items() if not part["found"]]
    margin = margin_words(report.get("margin"))
    return _words({**report, "missing": missing, "margin_words": margin}, _RUN)


def _track(report: Content) -> Iterator[str]:
    counts = *report["estimates"].values(), report["no_estimate"]
    share = [count / max(sum(counts), 1) for count in counts]
    rate = sum(counts) / max(report["seconds"], 1e-9)
    return _words({**report, "share": share, "rate": rate}, _TRACK)


def _evaluation(report: Content) -> Iterable[str]:
    return [f"{k}: {v}" for k, v in report["summary"].items()]


# What JSON files are, by keys that they have, the most telling first.
_BY_KEYS: tuple[tuple[set[str], str, Callable[[Content], Iterable[str]]], ...] = (
    ({"rule", "summary", "scenes"}, "an evaluation report", _evaluation),
    ({"quality", "parts"}, "a report of `locate`", _run),
    ({"updates", "estimates"}, "a report of `track`", _track),
    ({"resection"}, "a report of `resect`", lambda found: _words(found, _RESECT)),
    ({"table_from_camera", "plan"}, "a plan", lambda found: _words(found, _PLAN)),
    ({"margins", "sha256"}, "margins; inspect their model's folder", lambda _: ()),
    ({"fixed_from_camera"}, "poses of cameras (--poses)", lambda found: _words(found, _FILES)),
    ({"frame_id", "unit"}, "a calibration (--frame)", lambda found: _words(found, _FILES)),
    ({"width", "fx"}, "a camera (--intrinsics)", lambda found: _words(found, _FILES)),
)
_BY_NAME = {  # of a file that lies in a folder
    "twin.json": "twin scenes that are not finished; the same `twin` command resumes them",
    "training": "a training that has not ended; the same command resumes it",
    "patients.parquet": "a fleet's results: index.html shows them, look.csv names who needs a look",
    "scene.mrb": "a scene for 3D Slicer, by `export`; open scene.mrb there",
}


def _json(path: Path) -> list[str]:
    """Of a JSON file; nothing where it is not known."""
    content = store.read_json(path)
    known = ([name, *lines(content)] for keys, name, lines in _BY_KEYS if content.keys() >= keys)
    return next(known, [])


def _artifact(folder: Path) -> Iterable[str]:
    """Of a folder with a manifest; of other distributions' kinds, what is a word or a number."""
    kind = str(store.read_json(folder / store.MANIFEST).get("kind"))
    manifest = store.read_manifest(folder, kind)
    name = {"pretrained": "pretrained weights"}.get(kind, f"a {kind}")  # where it is no noun
    yield (
        f"{name} (tumortrack {manifest['tumortrack']}; {manifest['units']}, {manifest['frame']} "
        "frame); all files are as they were written"
    )
    if kind == "case":
        yield from _words(manifest, _CASE)
    elif kind == "model":
        yield from _model(folder, manifest)
    elif kind in ("run", "plan"):
        yield from _json(folder / {"run": "report.json"}.get(kind, "plan.json"))[1:]
    elif isinstance(manifest.get("scenes"), dict):
        yield from _sealed_scenes(folder, manifest["scenes"])
    else:
        for key, value in [*manifest.items()][5:]:  # behind kind, schema, version, units and frame
            if isinstance(value, str | int | float):
                yield f"{key.replace('_', ' ')}: {value}"
    yield f"files: {', '.join(manifest['files'])}"


def _model(folder: Path, manifest: Content) -> Iterable[str]:
    from tumortrack.cli.margins import described
    from tumortrack.models.folder import training_words, weakness_of
    from tumortrack.models.margins import UNKNOWN, read_margins

    about, network = manifest["provenance"], manifest["config"]["network"]
    yield from _words(about, [_PATIENT])
    encoder, decoder = (network.get(n, {}).get("type", "?") for n in ("encoder", "decoder"))
    does = "labels points; it does not know which point of the CT lies where (no `--map`)"
    if decoder == "warp":
        does = "places the organ of the CT; `locate --map` says where points of the CT are"
    yield f"{encoder} + {decoder}: {does}"
    yield f"parts: {', '.join(manifest['parts'])}"
    yield f"trained for {training_words(about)}"
    yield from _words({"weakness": weakness_of(about)}, ["WARNING: {weakness}"])
    margins = read_margins(folder)
    yield from described(margins) if margins else [UNKNOWN]


def _sealed_scenes(folder: Path, scenes: Mapping[str, str]) -> Iterable[str]:
    """With the digests that they were sealed by."""
    yield f"{len(scenes)} scenes: {', '.join(scenes)}"
    digests = {n: store.sha256_of(folder / n) for n in scenes if (folder / n).is_dir()}
    if changed := [name for name, digest in scenes.items() if digests.get(name) != digest]:
        yield f"CHANGED or missing since they were sealed: {', '.join(changed)}"
    else:
        yield "all as they were sealed; `tumortrack evaluate` reads them"


def _folder(path: Path) -> Iterable[str]:
    from tumortrack.live.recording.bags import bag_files
    from tumortrack.live.recording.folders import folder_frames

    inside = {p.name for p in path.iterdir()}
    if store.MANIFEST in inside:
        return _artifact(path)
    if words := [words for name, words in _BY_NAME.items() if name in inside]:
        return words
    if "cloud.ply" in inside:
        return _scene(path)
    if "report.json" in inside:
        return _json(path / "report.json")
    if bag_files(path):
        return _recording(path)
    if scenes := sum((path / name / "cloud.ply").is_file() for name in inside):
        return [f"{scenes} scenes; `tumortrack evaluate` reads them"]
    if meshes := sum(_is_mesh(path / name) for name in inside):
        return [f"{meshes} meshes; `tumortrack prepare` makes a case of them"]
    with suppress(InputError):
        frames = len(folder_frames(path, 30.0, "mm"))
        return [f"{frames} frames, a file each; `track` plays them from recording:{path}"]
    return _volume(path) if inside else []


def _file(path: Path) -> Iterable[str]:
    from tumortrack.live.recording.bags import SUFFIXES

    name = path.name.lower()
    if name.endswith(".json"):
        return _json(path)
    if name.endswith((".nii", ".nii.gz", ".nrrd")):
        return _volume(path)
    if name.endswith(SUFFIXES):
        return _recording(path)
    if name == "margins.jsonl":
        from tumortrack.report.calibration_table import read_table

        doubts = [row.doubt for row in read_table(path)[1]]
        return [f"a table of `margins`: {len(doubts)} states, {doubts.count('')} answered as good"]
    return _points(path)


def _scene(folder: Path) -> list[str]:
    from tumortrack.simulate.scene_folder import read_scene

    scene = read_scene(folder)
    parts = zip(scene.reference.names, scene.reference.parts, strict=True)
    volumes = ", ".join(f"{name} {part.volume_mm3 / 1000:.1f} ml" for name, part in parts)
    targets = f", {len(scene.targets.labels)} targets" if scene.targets else ""
    return [f"a scene with {len(scene.cloud.points_mm)} points; truth: {volumes}{targets}"]


def _recording(path: Path) -> Iterable[str]:
    from tumortrack.live.recording.bags import bag_contents
    from tumortrack.live.recording.folders import ABOUT

    about = (path if path.is_dir() else path.parent) / ABOUT
    frames, seconds = bag_contents(path)
    files = [path] if path.is_file() else path.rglob("*")
    size_mb = sum(file.stat().st_size for file in files) / 2**20
    yield f"a recording of {seconds:.1f} s, {size_mb:.1f} MB"
    yield from _words(store.read_json(about) if about.is_file() else {}, [_PATIENT])
    for topic, count in frames.items():
        yield f"{topic}: {count} frames, {count / max(seconds, 1e-9):.1f} a second"


def _volume(path: Path) -> Iterable[str]:
    import numpy as np

    from tumortrack.imaging.volume import is_label_map, read_raw

    raw = read_raw(path)
    spacing_mm = np.linalg.norm(raw.lps_from_index[:3, :3], axis=0)
    size, spacing = " x ".join(map(str, raw.array.shape)), [f"{mm:.3g}" for mm in spacing_mm]
    yield f"a {'label map' if is_label_map(raw) else 'CT'}; `tumortrack prepare` reads it"
    yield f"{size} voxels of {' x '.join(spacing)} mm"
    if is_label_map(raw):
        labels, counts = np.unique(raw.array[raw.array > 0], return_counts=True)
        for label, ml in zip(labels, counts * spacing_mm.prod() / 1000, strict=True):
            yield f"label {label:g}: {ml:.1f} ml"
    else:
        yield f"{raw.array.min():g} to {raw.array.max():g} HU"


def _is_mesh(path: Path) -> bool:
    """A PLY without faces is a cloud."""
    suffix = path.suffix.lower()
    if suffix != ".ply" or not path.is_file():
        return suffix in (".stl", ".obj")
    with path.open("rb") as stream:
        return b"element face" in stream.read(4096)


def _points(path: Path) -> list[str]:
    import numpy as np

    from tumortrack.core.mesh_files import read_mesh
    from tumortrack.sense.files import CLOUD_SUFFIXES, read_cloud, read_depth_png

    camera, notes = path.with_name("intrinsics.json"), ()
    if path.suffix.lower() == ".png" and camera.is_file():
        depth_mm = read_depth_png(path, camera).depth_mm
        near, far = np.nanpercentile(depth_mm, (1, 99))
        size = " x ".join(map(str, depth_mm.shape[::-1]))
        return [f"a depth image of {size} pixels, nearly all at {near:.0f} to {far:.0f} mm"]
    if _is_mesh(path):
        mesh = read_mesh(path)
        points_mm = mesh.vertices_mm
        what = f"a mesh of {len(mesh.faces)} triangles, {mesh.volume_mm3 / 1000:.1f} ml if closed"
    elif path.suffix.lower() in CLOUD_SUFFIXES:
        cloud, notes = read_cloud(path)
        points_mm, what = cloud.points_mm, f"a cloud of {len(cloud.points_mm)} points"
    else:
        return []
    size_mm = " x ".join(f"{mm:.0f}" for mm in np.ptp(points_mm, axis=0))
    middle = ", ".join(f"{mm:.1f}" for mm in (points_mm.min(0) + points_mm.max(0)) / 2)
    return [f"{what}; {size_mm} mm large, its middle at ({middle}) mm", *notes]
