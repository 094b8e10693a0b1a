"""Recordings of a tracked ultrasound probe: images with poses, and masks of parts in them.

Transforms are named as PLUS names them: ``AToB`` carries A into B, and ``Image`` is in pixels of
images in the orientation MF (https://pluslib.readthedocs.io, Coordinate system definitions).
"""

from __future__ import annotations

import glob
import re
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Literal, NamedTuple

import numpy as np
from jaxtyping import Bool, Float64, UInt8

from tumortrack.core.config import Config, from_builtins
from tumortrack.core.errors import InputError, readable
from tumortrack.core.geometry import Affine, spacing_mm
from tumortrack.core.store import natural, read_json
from tumortrack.core.ultrasound import PIXEL_MM, ProbeRecording, part_borders_px
from tumortrack.io.csv_tables import read_pose_table
from tumortrack.io.depth_files import open_picture
from tumortrack.io.plus_files import read_plus
from tumortrack.io.segments import is_organ, is_tumor, painted
from tumortrack.io.sequence_files import (
    LARGEST_HEADER,
    Image,
    ImageSequence,
    as_mf,
    read_sequence,
)
from tumortrack.io.volume import nrrd_header, read_raw

_SHARED_STD_MM = 1.0  # of a shift of all places, where no calibration states its error (assumed)
_PICTURES, _SEQUENCES = (".png", ".bmp", ".tif", ".tiff"), (".mha", ".mhd", ".nrrd")
_LARGEST_FILE, _MOST_PIXELS = 16 * 2**20, 2**24  # bytes of a mask; its pixels
_EDGE_PX = 2  # a mask that ends so near the edge of what the probe sees was cut there
_MOST_LABELS = 32  # distinct values: ultrasound has more
_NO_PART = 255  # in a table of labels: a value that no part has
_SINGULAR, _NOT_RIGID, _FARTHEST_MM = 1e-9, 1e-3, 5000.0  # the last two as in ``core.geometry``
_LARGEST_MM = 500.0  # an image's side: no probe sees so far
_TRANSFORM = re.compile(r"(?!Seq_Frame)(\w+?)To([A-Z]\w*?)Transform")
_IMAGE, _PROBE, _GOALS = "Image", "Probe", ("Reference", "Tracker")
_STATED = "UltrasoundImageOrientation"
_Edges = dict[tuple[str, str], np.ndarray]  # from a, to b: 4 x 4, or one for each frame


class ImageCalibration(Config, frozen=True, kw_only=True):
    """``probe_from_image``: 4 x 4 rows from (column, row, 0) in pixels, or with --mm-per-pixel in
    the ``unit``, to the frame ``probe`` in it."""

    probe_from_image: tuple[tuple[float, float, float, float], ...]
    unit: Literal["mm", "m"]
    probe: str = _PROBE


@dataclass(frozen=True, kw_only=True)
class RecordingOptions:
    """What a recording does not say itself.

    Attributes:
        masks: of a sequence's frames, if its own images are none: a folder or pattern of images, a
            segmentation, another sequence.
        mask_part: what every value but 0 is.
        poses: CSV with a row for each mask; or the masks' names carry stamps (ns).
        mm_per_pixel: a pixel's width, and its height where that differs.
        image_to_probe: JSON (``ImageCalibration``), or a PLUS configuration with transforms.
        frame: where places are to be; default: Reference, else Tracker, else the only one.
    """

    masks: Path | None = None
    mask_part: str = ""
    poses: Path | None = None
    mm_per_pixel: tuple[float, ...] = ()
    image_to_probe: Path | None = None
    frame: str = ""


class _Poses(NamedTuple):
    """Stamps of all frames, NaN of those that are left out, and the transforms that are known."""

    stamps_s: Float64[np.ndarray, " m"]
    edges: _Edges
    notes: list[str]


class _Masks(NamedTuple):
    """Images of labels in their order, the ``numbers`` that their names carry, and ``label_of``
    each value, where a segmentation names them."""

    images: Iterable[Image]
    total: int
    numbers: Sequence[int] = ()
    label_of: dict[int, int] | None = None
    orientation: str = ""


def is_recording(path: Path) -> bool:
    """Whether this is a sequence, a mask, or a folder or pattern of them, by its name."""
    by_suffix = path.suffix.lower() in (*_PICTURES, *_SEQUENCES)
    return by_suffix or path.is_dir() or glob.has_magic(str(path))


def read_recording(path: Path, parts: Sequence[str], asked: RecordingOptions) -> ProbeRecording:
    """Borders of parts in a tracked probe's images. ``path``: a sequence with poses; with poses of
    a table masks alone. ``parts``: names of labels 1 (the organ), 2, ...

    Raises InputError: missing, damaged or too large; a transform is missing, or none; no mask has a
    pose; a value of a mask is no part's.
    """
    of_table = asked.poses is not None
    sequence = _sequence(path, asked)
    known = _of_sequence(sequence) if sequence is not None else _of_table(asked.poses or path)
    goal, steps, edges = _steps(known.edges, asked, path)
    probe_from_image, frame_from_probe = _chained(edges, steps, asked.mm_per_pixel, path)
    right = _rigid(frame_from_probe)
    usable, notes = right & np.isfinite(known.stamps_s), known.notes
    if not right.all():
        notes.append(f"{path.name}: {(~right).sum()} of {len(right)} poses are invalid: left out.")
    if usable.sum() < 2:
        raise InputError(f"{path} has {usable.sum()} valid poses in {goal}; two are needed.")
    masks = asked.masks or path
    drawn = _masks(masks, parts, notes)
    stamps_s = _stamps_of(drawn, known.stamps_s, of_table, masks)
    field, size = None, None
    if asked.masks is not None and sequence is not None and sequence.has_images:
        field, size = _field(sequence), sequence.shape[:2]
    names, table = _table_of(drawn, parts, asked.mask_part)
    orientation = drawn.orientation or ("MF" if sequence is None else sequence.orientation)
    pixel_mm = spacing_mm(probe_from_image)[:2]
    places_px, part, plane = [np.zeros((0, 2))], list[int](), list[int]()
    for number, (image, stamp_s) in enumerate(zip(drawn.images, stamps_s, strict=True)):
        where = f"{masks}, image {number}"
        size = size or image.shape[:2]
        _check_size(image, pixel_mm, size, where)
        if np.isfinite(stamp_s):
            turned = as_mf(image, orientation, path)
            for name, places in _borders(turned, table, names, pixel_mm, field, where).items():
                places_px.append(places)
                part += [names.index(name)] * len(places)
                plane += [number] * len(places)
    made = ProbeRecording(
        tool=steps[0][1] if len(steps) > 1 else _PROBE,
        frame=goal,
        stamps_s=known.stamps_s[usable],
        frame_from_probe=frame_from_probe[usable],
        probe_from_image=probe_from_image,
        parts=names,
        places_px=np.concatenate(places_px),
        part=np.array(part, np.int64),
        plane=np.array(plane, np.int64),
        image_stamps_s=stamps_s[np.array(plane, np.int64)],
        shared_std_mm=_SHARED_STD_MM,
    )
    lost = {*plane} - {*made.plane[np.isfinite(made.places_mm()).all(1)].tolist()}
    if len(lost) == len({*plane}):
        lack = "has a pose near its stamp" if plane else f"shows a border of {', '.join(names)}"
        raise InputError(f"{masks}: none of {drawn.total} images {lack}.")
    if lost:
        notes.append(f"{masks.name}: {len(lost)} images have no pose within 0.5 s: left out.")
    return replace(made, notes=tuple(notes))


def _sequence(path: Path, asked: RecordingOptions) -> ImageSequence | None:
    """None: a table has the poses."""
    if asked.poses is not None:
        if asked.masks is not None:
            raise InputError("--masks are of a sequence with poses; with --poses give masks alone.")
        return None
    if path.suffix.lower() not in _SEQUENCES:
        raise InputError(f"{path} are masks: nothing says where the probe was. Give --poses TABLE.")
    return read_sequence(path)


def recorded_transforms(path: Path) -> _Edges:
    """What a sequence says, by (from, to): 4 x 4, or one for each frame, NaN where it is invalid.
    Raises InputError: missing, damaged or too large."""
    return _of_sequence(read_sequence(path)).edges


def _of_table(path: Path) -> _Poses:
    table = read_pose_table(path)
    return _Poses(table.stamps_ns * 1e-9, {(_PROBE, table.frame_id): table.poses}, [])


def _of_sequence(sequence: ImageSequence) -> _Poses:
    """What the fields of its frames say."""
    path, frames, notes = sequence.path, sequence.frames, list[str]()
    keys = [key for key in ("Timestamp", "UnfilteredTimestamp") if any(key in f for f in frames)]
    if not keys:
        raise InputError(
            f"{path} has no Seq_Frame0000_Timestamp, so its poses have no time. Give the recording "
            "itself, and this as its --masks; or --poses TABLE.csv."
        )
    if sequence.has_images and _STATED not in sequence.fields:
        notes.append(f"{path.name} has no {_STATED}: taken as MF.")
    edges: _Edges = {}
    for name, value in sequence.fields.items():
        if match := _TRANSFORM.fullmatch(name):
            edges[match[1], match[2]] = _matrix(value.split(), f"{path}: {name}")
    with readable(path, "has a damaged field of a frame"):
        stamps_s = np.array([float(frame.get(keys[0], "nan")) for frame in frames])
        for name in {name for frame in frames for name in frame}:
            if match := _TRANSFORM.fullmatch(name):
                edges[match[1], match[2]] = _poses(name, frames)
    before_s = np.maximum.accumulate(np.r_[-np.inf, np.nan_to_num(stamps_s, nan=-np.inf)[:-1]])
    rising = (stamps_s > before_s) & np.isfinite(stamps_s)
    shown = np.array([frame.get("ImageStatus", "OK").upper() == "OK" for frame in frames], bool)
    for lost, why in ((~rising, "has no stamp after all before"), (~shown, "shows nothing")):
        if lost.any():
            notes.append(f"{path.name}: {lost.sum()} of {len(frames)} frames left out: it {why}.")
    return _Poses(np.where(rising & shown, stamps_s, np.nan), edges, notes)


def _poses(name: str, frames: Sequence[dict[str, str]]) -> Float64[np.ndarray, "m 4 4"]:
    """One for each frame; NaN where it is missing, invalid or singular."""
    poses = np.full((len(frames), 4, 4), np.nan)
    for pose, frame in zip(poses, frames, strict=True):
        if name in frame and frame.get(f"{name}Status", "OK").upper() == "OK":
            pose[:] = np.reshape(frame[name].split(), (4, 4)).astype(float)
    with np.errstate(invalid="ignore"):
        poses[~(np.abs(np.linalg.det(poses)) > _SINGULAR)] = np.nan
    return poses


def read_image_to_probe(path: Path) -> Affine:
    """The probe's frame, mm, from the image's: JSON (``ImageCalibration``) or a PLUS configuration.
    Raises InputError: there is none, or several."""
    found = [each for (start, _), each in _calibration(path).items() if start == _IMAGE]
    if len(found) != 1:
        raise InputError(f"{path} has {len(found)} transforms from {_IMAGE}; it must have one.")
    return found[0]


def _matrix(given: object, where: str) -> Affine:
    """Raises InputError: it is no affine transform that can be inverted."""
    with readable(where, "is no matrix of 16 numbers"):
        matrix = np.array(given, float).reshape(4, 4)
    sizes = np.linalg.norm(matrix[:3, :3], axis=0)
    affine = np.isfinite(matrix).all() and np.array_equal(matrix[3], [0, 0, 0, 1])
    if not affine or abs(np.linalg.det(matrix)) <= _SINGULAR * sizes.prod():
        raise InputError(f"{where} is singular, not finite, or has another last row than 0 0 0 1.")
    return matrix


def _calibration(path: Path) -> _Edges:
    """Constant transforms of a PLUS configuration, or that from the image of a JSON file."""
    if path.suffix.lower() != ".xml":
        given = from_builtins(read_json(path), ImageCalibration, str(path))
        matrix = _matrix(given.probe_from_image, str(path))
        matrix[:3] *= 1000.0 if given.unit == "m" else 1.0
        return {(_IMAGE, given.probe): matrix}
    return {(each.of, each.to): _matrix(each.rows, str(path)) for each in read_plus(path)}


def _steps(
    edges: _Edges, asked: RecordingOptions, path: Path
) -> tuple[str, list[tuple[str, str]], _Edges]:
    """The frame to which places go, the shortest way to it, and the transforms it is among."""
    moving = [pair for pair, each in edges.items() if each.ndim == 3]
    if asked.image_to_probe is not None:
        stated = _calibration(asked.image_to_probe)
        if any(_IMAGE in pair for pair in stated):  # it counts, not what was recorded with
            edges = {pair: each for pair, each in edges.items() if _IMAGE not in pair}
        edges = {**stated, **edges}
    ends = {end for _, end in moving}
    goals = [asked.frame] * bool(asked.frame) or [g for g in _GOALS if any(g in p for p in moving)]
    if not goals and len(ends) != 1:
        raise InputError(
            f"{path} has poses in {', '.join(sorted(ends)) or 'no frame'}; allowed: in "
            "Reference or Tracker, or in one frame alone."
        )
    goal, new = (goals or [*ends])[0], [_IMAGE]
    ways: dict[str, tuple[str, ...]] = {_IMAGE: (_IMAGE,)}
    for here in new:  # which grows
        for pair in edges:
            there = pair[pair[0] == here]
            if here in pair and there not in ways:
                ways[there] = (*ways[here], there)
                new.append(there)
    if goal not in ways or goal == _IMAGE:
        raise InputError(
            f"{path}: no transform leads from {' or '.join(ways)} to {goal}; known: "
            f"{', '.join(map('To'.join, edges)) or 'none'}. Give ImageToProbe by "
            "--image-to-probe, and call the camera's frame (frame_id) as the recording does."
        )
    return goal, [*zip(ways[goal], ways[goal][1:], strict=False)], edges


def _chained(
    edges: _Edges, steps: Sequence[tuple[str, str]], mm_per_pixel: tuple[float, ...], path: Path
) -> tuple[Affine, Float64[np.ndarray, "m 4 4"]]:
    """What is constant from the image on, in mm, and the poses that follow."""
    ways = [edges[s] if s in edges else np.linalg.inv(edges[s[::-1]]) for s in steps]
    probe_from_image, poses = np.eye(4), np.eye(4)
    for way in ways:
        if poses.ndim == way.ndim == 2:
            probe_from_image = way @ probe_from_image
        else:
            poses = way @ poses
    if poses.ndim == 2:
        raise InputError(f"{path}: nothing says how the probe moved in {steps[-1][1]}.")
    if ways[0].ndim == 3:  # poses of the image, in pixels
        pixel_mm = np.linalg.norm(poses[:, :3, :3], axis=1)
        pixel_mm = pixel_mm[np.isfinite(pixel_mm).all(1)]
        probe_from_image = np.diag([*(pixel_mm[0] if len(pixel_mm) else np.ones(3)), 1.0])
        poses = poses @ np.linalg.inv(probe_from_image)
    if mm_per_pixel:
        probe_from_image = probe_from_image @ np.diag([mm_per_pixel[0], mm_per_pixel[-1], 1, 1])
    sides_mm, (low, high) = spacing_mm(probe_from_image)[:2], PIXEL_MM
    if len(mm_per_pixel) > 2 or not low <= sides_mm.min() <= sides_mm.max() <= high:
        raise InputError(
            f"{path}: pixels of {' x '.join(f'{side:.4g}' for side in sides_mm)} mm; allowed: "
            f"{low} to {high}. Correct --image-to-probe or --mm-per-pixel (width, and height)."
        )
    return probe_from_image, poses


def _rigid(poses: Float64[np.ndarray, "m 4 4"]) -> Bool[np.ndarray, " m"]:
    """Which are, and within a room."""
    turns = poses[:, :3, :3]
    off = np.abs(turns @ turns.transpose(0, 2, 1) - np.eye(3)).max((1, 2))
    near = np.abs(poses[:, :3, 3]).max(1) <= _FARTHEST_MM
    with np.errstate(invalid="ignore"):
        return (off < _NOT_RIGID) & (np.linalg.det(turns) > 0) & near


def _masks(path: Path, parts: Sequence[str], notes: list[str]) -> _Masks:
    suffix = path.suffix.lower()
    is_nrrd = suffix == ".nrrd" and path.is_file()
    if is_nrrd and "segment0_id" in nrrd_header(path, LARGEST_HEADER)[0]:
        return _segmentation(path, parts, notes)
    if suffix in _SEQUENCES:
        drawn = read_sequence(path)
        stated = drawn.orientation if _STATED in drawn.fields else ""
        return _Masks(drawn.images(), len(drawn.frames), orientation=stated)
    inside = path.iterdir() if path.is_dir() else map(Path, glob.glob(str(path)))
    files = sorted((p for p in inside if p.suffix.lower() in _PICTURES), key=natural)
    if not files:
        raise InputError(f"{path} holds no masks; allowed: {', '.join((*_PICTURES, *_SEQUENCES))}.")
    digits = [re.findall(r"[0-9]{1,19}", file.stem) for file in files]
    numbers = [int(each[-1]) for each in digits if each]
    return _Masks(map(_picture, files), len(files), numbers * (len({*numbers}) == len(files)))


def _table_of(
    drawn: _Masks, parts: Sequence[str], mask_part: str
) -> tuple[tuple[str, ...], UInt8[np.ndarray, " 256"]]:
    """Names of labels 1, 2, ..., and the label of each value."""
    table = np.full(256, 1 if mask_part else _NO_PART, np.uint8)
    table[0] = 0
    if mask_part:
        return (mask_part,), table
    for value, label in (drawn.label_of or {n: n for n in range(1, len(parts) + 1)}).items():
        table[value] = label
    return tuple(parts), table


def _picture(path: Path) -> Image:
    with readable(path, "is no image that can be read"):
        image = open_picture(path, _LARGEST_FILE)
        if image.width * image.height > _MOST_PIXELS:
            raise InputError(f"{path} is {image.width} x {image.height} pixels: too large.")
        opaque = {"RGBA": "RGB", "LA": "L", "PA": "P"}.get(image.mode)
        return np.asarray(image.convert(opaque) if opaque else image)


def _segmentation(path: Path, parts: Sequence[str], notes: list[str]) -> _Masks:
    """Of 3D Slicer, whose slices are the frames; not of a part of the images."""
    raw = read_raw(path)
    label_of = _labels_of({s.number: s.name for s in raw.segments}, parts, path, notes)
    organ = tuple(number for number, label in label_of.items() if label == 1)
    tumors = tuple(number for number, label in label_of.items() if label > 1)
    labels = painted(raw.array.shape, raw.segments, organ, tumors)[0].T
    return _Masks(labels, len(labels), label_of=label_of)


def _labels_of(
    names: dict[int, str], parts: Sequence[str], path: Path, notes: list[str]
) -> dict[int, int]:
    """Of a segmentation's values, by the names of its segments; 0: it is no part."""
    label_of = dict[int, int]()
    if not all(0 < value < _NO_PART for value in names):
        raise InputError(f"{path} has segments with labels {[*names]}; allowed: 1 to 254.")
    for value, name in names.items():
        digits = re.findall(r"[0-9]+", name)
        tumor = f"tumor_{int(digits[-1])}" if digits else "tumor_1" if len(parts) == 2 else ""
        called = parts[0] if is_organ(name, parts[0]) else tumor if is_tumor(name) else name
        if is_tumor(name) and called not in parts:
            raise InputError(f"{path}: which is {name!r}? Name it as one of {', '.join(parts)}.")
        if called not in parts:
            notes.append(f"{path.name}: {name!r} is no part, and left out.")
        label_of[value] = parts.index(called) + 1 if called in parts else 0
    return label_of


def _stamps_of(
    drawn: _Masks, stamps_s: Float64[np.ndarray, " m"], of_table: bool, path: Path
) -> Float64[np.ndarray, " n"]:
    """Of each mask; NaN where it does not count."""
    numbers = np.array(drawn.numbers, np.float64)
    if of_table and len(numbers):
        said_s = numbers * 1e-9
        if stamps_s[0] <= said_s.min() and said_s.max() <= stamps_s[-1]:
            return said_s
    if drawn.total == len(stamps_s):
        return stamps_s
    if not of_table and len(numbers) and numbers.max() < len(stamps_s):
        return stamps_s[numbers.astype(int)]
    raise InputError(
        f"{path} has {drawn.total} images for {len(stamps_s)} poses; allowed: as many, or names "
        "with the number of the frame, from 0; with --poses with the stamp in ns."
    )


def _field(sequence: ImageSequence) -> Bool[np.ndarray, "h w"] | None:
    """What the probe sees: what is ever bright, without its edge. None: these are labels."""
    from scipy import ndimage

    most = np.zeros(sequence.shape[:2], sequence.dtype.newbyteorder("="))
    for image in sequence.images():
        np.maximum(most, image if image.ndim == 2 else image.max(2), out=most)
    if len(np.unique(most)) <= _MOST_LABELS:
        return None
    seen = ndimage.binary_fill_holes(as_mf(most, sequence.orientation, sequence.path) > 0)
    return ndimage.binary_erosion(seen, iterations=_EDGE_PX, border_value=1)


def _check_size(
    image: Image, pixel_mm: Float64[np.ndarray, " 2"], size: tuple[int, ...], where: str
) -> None:
    rows, columns = image.shape[:2]
    if (rows, columns) != size:
        raise InputError(f"{where} is {columns} x {rows}, the sequence's {size[1]} x {size[0]}.")
    wide_mm, deep_mm = (pixel_mm * [columns, rows]).tolist()
    if max(wide_mm, deep_mm) > _LARGEST_MM:
        raise InputError(
            f"{where} is {wide_mm:.0f} x {deep_mm:.0f} mm, as no probe sees. Give --mm-per-pixel, "
            "or an --image-to-probe from pixels."
        )


def _borders(
    image: Image,
    table: UInt8[np.ndarray, " 256"],
    names: tuple[str, ...],
    pixel_mm: Float64[np.ndarray, " 2"],
    field: Bool[np.ndarray, "h w"] | None,
    where: str,
) -> dict[str, Float64[np.ndarray, "k 2"]]:
    """By part; works on the box of what is labelled, with a pixel about it. ``table``: the label of
    each value, with one part 1 for all."""
    flat = image if image.ndim == 2 else image[..., 0]
    if image.ndim == 3 and (image != image[..., :1]).any():
        raise InputError(f"{where} is in colour; a mask has one number for each pixel.")
    rows = np.flatnonzero(flat.any(1))
    if not len(rows):
        return {}
    columns = np.flatnonzero(flat[rows[0] : rows[-1] + 1].any(0))
    top, left = max(rows[0] - 1, 0), max(columns[0] - 1, 0)
    box = slice(top, rows[-1] + 2), slice(left, columns[-1] + 2)
    with np.errstate(invalid="ignore"):
        values = (given := flat[box]).astype(np.uint8)
    if (values != given).any():
        raise InputError(f"{where} has values that are no whole numbers of 0..255.")
    labels = table.take(values)  # twice as fast as an index
    if (wrong := values[labels == _NO_PART]).size:
        said = ", ".join(f"{n} {name}" for n, name in enumerate(names, 1))
        raise InputError(
            f"{where} has the value {wrong[0]}; allowed: 0 and {said}. Of masks with one value say "
            "what they show (--mask-part tumor_1); images themselves need --masks."
        )
    if len(names) == 1 and np.ptp(values[values > 0]):
        raise InputError(f"{where} has several values; with --mask-part it must have one beside 0.")
    seen = None if field is None else field[box]
    sides = float(pixel_mm[0]), float(pixel_mm[1])
    found = part_borders_px(labels, dict(enumerate(names, 1)), sides, seen)
    return {name: places + [left, top] for name, places in found.items()}
