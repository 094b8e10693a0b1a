"""What a folder or file is, in sentences: `inspect`."""

from __future__ import annotations

import string
from collections.abc import Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from pathlib import Path
from typing import Any

from tumortrack.core import store
from tumortrack.core.config import findings_in
from tumortrack.core.errors import InputError
from tumortrack.core.renamed import in_report
from tumortrack.core.tables import read_table

Content = Mapping[str, Any]  # of a JSON file
_BAGS = (".mcap", ".db3", ".bag")
_TABLE = read_table("tumortrack.report", "inspect.toml", dict[str, dict[str, Any]])


def describe(path: str | Path) -> list[str]:
    """What a folder or file is and what is in it, as lines of text: of all that commands write, and
    of clouds, depth images, meshes, CTs and label maps.

    Raises:
        InputError, ArtifactError: it is missing, of no kind that is known here, or damaged.
    """
    path = Path(path)
    if not path.exists():
        raise InputError(f"{path} does not exist.")
    lines = [line.removesuffix(".") for line in (_folder if path.is_dir() else _file)(path)]
    if not lines:
        raise InputError(
            f"{path} is nothing that inspect knows. It knows {_TABLE['texts']['known']}."
        )
    return [f"{path}: {lines[0]}.", *(f"  {line}." for line in lines[1:])]


class _Words(string.Formatter):
    """Raises KeyError for an entry that is missing or empty."""

    def get_field(self, field_name: str, args: Sequence[Any], kwargs: Content) -> Any:
        value, first = super().get_field(field_name, args, kwargs)
        if value is None or (isinstance(value, str | list | dict) and not value):
            raise KeyError(field_name)
        return value, first


def _words(content: Content, sentences: Iterable[str | list[str]]) -> Iterator[str]:
    """Sentences of inspect.toml, filled from JSON; those with missing entries are left out."""
    for sentence in sentences:
        entry, template = ("", sentence) if isinstance(sentence, str) else sentence
        members: Any = content if entry else [{}]
        with suppress(KeyError, TypeError, IndexError, ValueError):
            for key in filter(None, entry.split(".")):
                members = members[key]
            pairs = members.items() if isinstance(members, dict) else enumerate(members)
            for name, value in pairs:
                own = value if isinstance(value, dict) else {}
                inner = {**content, **own, "name": name, "value": value}
                with suppress(KeyError, TypeError, IndexError, ValueError):
                    yield _Words().vformat(template, (), inner)


def _evaluation(report: Content) -> list[str]:
    from tumortrack.report.summary import conclusions, headlines

    try:
        lines = [*headlines(dict(report["summary"])), *conclusions(report["scenes"])]
    except (KeyError, TypeError, AttributeError):
        return [
            "an evaluation report",
            "Another version wrote it, or another program; `tumortrack evaluate` makes it again",
        ]
    return ["an evaluation report", *lines]


def _json(path: Path) -> list[str]:
    """Lines about a JSON file; none if its kind is unknown."""
    content = store.read_json(path)
    if content.keys() >= {"rule", "summary", "scenes"}:
        return _evaluation(content)
    for kind in _TABLE.values():
        if "keys" in kind and content.keys() >= {*kind["keys"]}:
            if kind is _TABLE["run"] and (old := in_report(content)):
                return [kind["name"], "An older version wrote it, whose keys differ", *old]
            filled = _words(_with_figures(content, path.parent), kind.get("sentences", ()))
            return [kind["name"], *filled]
    return []


def _with_figures(content: Content, folder: Path) -> Content:
    """The entries of a file, and what is computed from them."""
    figures: dict[str, Any] = {}
    if "up_lps" in content or "in_distribution" in content:
        about = content.get("provenance", content)
        figures["weak"] = [
            weakness.message for weakness in findings_in(about.get("warnings"), str(folder))
        ]
    if "up_lps" in content:  # a case
        figures["lies"] = _poses(content["rotations"], content["tilt_degrees"])
        figures |= _of_the_cases_model(folder)
    elif "in_distribution" in content:  # a model
        pose = content["config"]["scene"]["pose"]
        figures["lies"] = _poses(pose["rotations"], pose["tilt_deg"])
        method = "labels" if "network" in content["config"] else "registers"
        figures |= {"does": _TABLE["texts"][method], **_of_model(content, folder)}
        figures["part_names"] = ", ".join(content["parts"])
    elif content.keys() >= {"quality", "parts"}:
        import msgspec

        from tumortrack.core.assessment import Assessment
        from tumortrack.core.report import FitReport
        from tumortrack.report.seen import part_rows, row_words

        report = msgspec.convert(content, FitReport)
        assessment = msgspec.convert(content.get("assessment", {}), Assessment)
        if assessment.factor != 1.0:
            figures["factor_words"] = assessment.factor_words
        figures["rows"] = [row_words(row) for row in part_rows(report, assessment)]
    elif "updates" in content:
        counts = *content["estimates"].values(), content["no_estimate"]
        figures["share"] = [count / max(sum(counts), 1) for count in counts]
        figures["rate"] = sum(counts) / max(content["seconds"], 1e-9)
    return {**content, **figures}


def _poses(rotations: str, tilt_degrees: float) -> str:
    if rotations == "full":
        return "in any way"
    return f"turned about the line of sight, and tilted by up to {tilt_degrees:g} degrees"


def _of_the_cases_model(case: Path) -> Content:
    """Raises ArtifactError: it is damaged."""
    from tumortrack.io.case import Case
    from tumortrack.io.model_folder import is_model_of, read_model_manifest

    folder = case / Case.MODEL
    if not is_model_of(folder, case):
        return {"known": "none yet; the first command that needs one makes it"}
    return _of_model(read_model_manifest(folder), folder)


def _of_model(manifest: Content, folder: Path) -> Content:
    from tumortrack.assessment.bound_factor import read_factor
    from tumortrack.io.model_folder import reliability_warning, training_words

    about, found = manifest["provenance"], read_factor(folder)
    trained = "trained for " * ("network" in manifest["config"])
    known = {"known": trained + training_words(about), "weakness": reliability_warning(about)}
    return known if found is None else {**known, "factor_words": found.message}


def _artifact(folder: Path) -> Iterable[str]:
    """Lines about a folder with a manifest; of an unknown kind, its texts and numbers."""
    kind = str(store.read_json(folder / store.MANIFEST).get("kind"))
    manifest = store.read_manifest(folder, kind)
    yield (
        f"a {kind} (tumortrack {manifest['tumortrack']}; {manifest['units']}, {manifest['frame']} "
        "frame); all files are as they were written"
    )
    if isinstance(manifest.get("scenes"), dict):
        yield from _sealed_scenes(folder, manifest["scenes"])
    lines = _json(folder / _TABLE["described_by"].get(kind, store.MANIFEST))[1:]
    plain = ((k, v) for k, v in [*manifest.items()][5:] if isinstance(v, str | int | float))
    yield from lines or (f"{key.replace('_', ' ')}: {value}" for key, value in plain)
    yield f"files: {', '.join(manifest['files'])}"


def _sealed_scenes(folder: Path, scenes: Mapping[str, str]) -> Iterable[str]:
    """Lines about scenes whose digests the manifest has."""
    yield f"{len(scenes)} scenes: {', '.join(scenes)}"
    digests = {n: store.sha256_of(folder / n) for n in scenes if (folder / n).is_dir()}
    if changed := [name for name, digest in scenes.items() if digests.get(name) != digest]:
        yield f"CHANGED or missing since they were sealed: {', '.join(changed)}"
    else:
        yield "all as they were sealed; `tumortrack evaluate` reads them"


def _folder(path: Path) -> Iterable[str]:
    from tumortrack.io.dicom import NoSeries

    inside = {p.name for p in path.iterdir()}
    if store.MANIFEST in inside:
        return _artifact(path)
    scenes = sum((path / name / "cloud.ply").is_file() for name in inside)
    if "twin.json" in inside:
        return [f"twin scenes, not finished ({scenes} so far); the same `twin` command goes on"]
    if named := [kind["name"] for kind in _TABLE.values() if kind.get("file") in inside]:
        return named
    if "cloud.ply" in inside:
        return _scene(path)
    if "report.json" in inside:
        return _json(path / "report.json")
    bags = [name for name in inside if name == "metadata.yaml" or name.lower().endswith(_BAGS)]
    if any((path / name).is_file() for name in bags):
        return _recording(path)
    if scenes:
        return [f"{scenes} scene{'s' * (scenes != 1)}; `tumortrack evaluate` reads them"]
    if meshes := sum(_is_mesh(path / name) for name in inside):
        return [f"a folder of meshes ({meshes}); `tumortrack prepare` makes a case of them"]
    with suppress(InputError):
        return _recording(path)
    with suppress(NoSeries):
        return list(_volume(path))
    return []


def _file(path: Path) -> Iterable[str]:
    name = path.name.lower()
    if name.endswith(".json"):
        return _json(path)
    if name.endswith((".nii", ".nii.gz", ".nrrd")):
        return _volume(path)
    if name.endswith(_BAGS):
        return _recording(path)
    return _points(path)


def _scene(folder: Path) -> list[str]:
    from tumortrack.io.scene_folder import read_scene

    scene = read_scene(folder)
    parts = zip(scene.reference.names, scene.reference.parts, strict=True)
    volumes = ", ".join(f"{name} {part.volume_ml:.1f} ml" for name, part in parts)
    targets = f", {len(scene.targets.labels)} targets" if scene.targets else ""
    return [f"a scene with {len(scene.cloud.points_mm)} points; truth: {volumes}{targets}"]


def _recording(path: Path) -> list[str]:
    """Raises InputError: it is none, or nothing is installed that plays recordings."""
    from tumortrack.live.spec import SOURCES

    return SOURCES.config("recording", str(path)).describe(path)


def _volume(path: Path) -> Iterable[str]:
    import numpy as np

    from tumortrack.io.volume import is_label_map, read_raw

    raw = read_raw(path)
    names = {segment.number: f" ({segment.name})" for segment in raw.segments}
    spacing_mm = np.linalg.norm(raw.lps_from_index[:3, :3], axis=0)
    size, spacing = " x ".join(map(str, raw.array.shape)), [f"{mm:.3g}" for mm in spacing_mm]
    yield f"a {'label map' if is_label_map(raw) else 'CT'}; `tumortrack prepare` reads it"
    yield f"{size} voxels of {' x '.join(spacing)} mm"
    if is_label_map(raw):
        labels, counts = np.unique(raw.array[raw.array > 0], return_counts=True)
        for label, ml in zip(labels, counts * spacing_mm.prod() / 1000, strict=True):
            yield f"label {label:g}{names.get(int(label), '')}: {ml:.1f} ml"
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

    from tumortrack.io.depth_files import CLOUD_SUFFIXES, read_cloud, read_depth_png
    from tumortrack.io.mesh_files import read_mesh

    camera = path.with_name("intrinsics.json")
    if path.suffix.lower() == ".png" and camera.is_file():
        frame = read_depth_png(path, camera)
        depth_mm = frame.depth_mm
        near, far = np.nanpercentile(depth_mm, (1, 99))
        size = " x ".join(map(str, depth_mm.shape[::-1]))
        words = f"a depth image of {size} pixels, nearly all at {near:.0f} to {far:.0f} mm"
        return [words, *_noise(frame)]
    if _is_mesh(path):
        mesh = read_mesh(path)
        return [f"a mesh, {_size(mesh.box_mm)}; {mesh.volume_ml:.1f} ml if it is closed"]
    if path.suffix.lower() not in CLOUD_SUFFIXES:
        return []
    cloud, notes = read_cloud(path)
    points_mm = cloud.points_mm
    box_mm = np.array([points_mm.min(0), points_mm.max(0)])
    return [f"a cloud of {len(points_mm)} points, {_size(box_mm)}", *_noise(cloud), *notes]


def _noise(content: Any) -> list[str]:
    from tumortrack.segmentation.measured_noise import noise_of

    return [noise.message] if (noise := noise_of(content)) else []


def _size(box_mm: Any) -> str:
    size, middle = (
        [f"{mm:.0f}" for mm in each] for each in (box_mm[1] - box_mm[0], box_mm.mean(0))
    )
    return f"{' x '.join(size)} mm large round ({', '.join(middle)}) mm"
