"""Pictures of an estimate over the truth, and of a prepared case.

Every part has its own colour (core/colours.py); dark blue outlines are the truth. No display is
needed.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Shaped
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch

from tumortrack.core.colours import name_colour, structure_colour
from tumortrack.core.estimate import NO_CHECK_FAILED, UNVERIFIED
from tumortrack.core.geometry import DIRECTIONS_LPS, transform_points
from tumortrack.core.organ import is_tumor, organ_name
from tumortrack.core.types import Anatomy, LabelVolume, Mesh, Volume
from tumortrack.report import drawing
from tumortrack.report.drawing import CENTRED, OBSERVED, ORGAN, TRUE
from tumortrack.report.renderer import RGB, Body, Frame, ParallelView, rgb
from tumortrack.report.summary import scene_note, words
from tumortrack.simulate.scene_folder import Scene

FROM_CAMERA = ParallelView("seen from the camera", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
FROM_SIDE = ParallelView("seen from the side, camera above", (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
_CAMERA_AXES = {
    FROM_CAMERA: {"x": (1.0, 0.0), "y": (0.0, 1.0)},
    FROM_SIDE: {"x": (1.0, 0.0), "z": (0.0, 1.0)},
}
_SLICES = {FROM_CAMERA: "across the view", FROM_SIDE: "along the view"}
# A case's slices in LPS. Radiological convention: the patient's right is on the picture's left
# (axial seen from the feet, coronal from the front); sagittal with anterior on the left.
PLANES = (
    ParallelView("axial", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0)),
    ParallelView("coronal", (1.0, 0.0, 0.0), (0.0, 0.0, -1.0)),
    ParallelView("sagittal", (0.0, 1.0, 0.0), (0.0, 0.0, -1.0)),
)
_SOFT_TISSUE_HU = (-160.0, 240.0)
_MARGIN_MM, _ASPECT = 18.0, 1.22
_MAX_ROWS = 6  # tumors with slices of their own
_NEAR_BORDER = {
    **{"left": (0.025, 0.5), "right": (0.975, 0.5)},
    **{"top": (0.5, 0.965), "bottom": (0.5, 0.035)},
}


def scene_picture(
    scene: Scene, shown: Mapping[str, Mesh], entry: dict[str, Any], path: Path
) -> None:
    """Write a PNG, atomically: the estimate's meshes over the truth in two 3-D views, and in two
    slices through each true tumor's centre. ``entry``: of the scene in the report."""
    slices = [(name, view) for name in scene.reference.names[1:] for view in _SLICES]
    rows = -(-len(slices) // 4)
    height_in = 4.6 + 4.05 * rows
    figure = drawing.new_figure(14.0, height_in, top=1 - 0.35 / height_in, bottom=0.15 / height_in)
    outer = figure.add_gridspec(2, 1, height_ratios=[4.1, 3.95 * max(rows, 0.01)], hspace=0.13)
    above = outer[0].subgridspec(1, 2, wspace=0.04)
    for column, view in enumerate(_SLICES):
        draw_solid_view(figure.add_subplot(above[column]), scene, shown, view)
    below = outer[1].subgridspec(max(rows, 1), 4, wspace=0.06, hspace=0.2)
    for n, (name, view) in enumerate(slices):
        axes = figure.add_subplot(below[n // 4, n % 4])
        _draw_slice(axes, scene, shown, name, view)
        part, errors = entry["parts"][name], "not found"
        if part["found"]:
            errors = f"Hausdorff {part['hausdorff_mm']:.1f} mm\ncentre {part['center_mm']:.1f} mm, "
            errors += f"IoU {part['iou']:.2f}"
        axes.set_title(f"{words(name)}: {_SLICES[view]}\n{errors}", fontsize=9.5)
    good = entry["quality"] == "good"
    reason = f"{NO_CHECK_FAILED}; {UNVERIFIED}" if good else entry["reason"]
    verdict = f"{entry['quality'].upper()}: {reason}"
    title = f"{entry['name']}   {verdict}" if good else entry["name"]
    handles = scene_legend(*scene.reference.names)
    failed = entry["failed"] if entry["quality"] != "none" else None  # else it is the reason
    warnings = [] if failed is None else [f"FAILED: {failed}"]
    warnings += [] if good else [verdict]
    drawing.add_words(figure, title, warnings, [scene_note(entry)], handles)
    drawing.save(figure, path)


def draw_solid_view(
    axes: Axes, scene: Scene, meshes: Mapping[str, Mesh], view: ParallelView
) -> None:
    """The estimate's surfaces, the truth's outlines and the observed points."""
    shown = dict(meshes)
    everything = [mesh.vertices_mm for mesh in (*scene.reference.parts, *shown.values())]
    frame = view.frame_around(np.concatenate(everything), 6.0).widened(1.7)
    name = organ_name(shown)
    organ = [] if name is None else [Body(shown.pop(name), ORGAN, 0.36)]
    tumors = [Body(mesh, rgb(name_colour(part))) for part, mesh in shown.items()]
    drawing.show_bodies(axes, view, [*tumors, *organ], frame)
    flat = view.project(scene.cloud.points_mm.astype(float))
    axes.scatter(flat[:, 0], flat[:, 1], s=2.5, color=OBSERVED, alpha=0.55, linewidths=0, zorder=3)
    for n, part in enumerate(scene.reference.parts):
        drawing.outline(axes, part, view, TRUE, 1.2 if n == 0 else 2.2)
    for name, mesh in shown.items():
        u, v = view.project(mesh.box_mm.mean(0)[None])[0, :2]
        axes.text(u, v, name.split("_")[-1], fontweight="bold", **CENTRED)
    drawing.finish_view(axes, frame, _CAMERA_AXES[view])
    axes.set_title(view.name, fontsize=11)


def _draw_slice(
    axes: Axes, scene: Scene, shown: Mapping[str, Mesh], name: str, view: ParallelView
) -> None:
    truth = dict(zip(scene.reference.names, scene.reference.parts, strict=True))
    through_mm = truth[name].box_mm.mean(0)
    around = [meshes[name].vertices_mm for meshes in (truth, shown) if name in meshes]
    frame = view.frame_around(np.concatenate(around), 12.0).widened(1.0)
    tints = []
    for part, mesh in shown.items():
        color, width = rgb(name_colour(part)), 2.4 if is_tumor(part) else 1.4
        tints.append((drawing.section_mask(mesh, view, frame, through_mm), color))
        lines = drawing.section(mesh, view, through_mm)
        drawing.draw_lines(axes, lines, color=color, linewidth=width, zorder=3)
    if tints:
        drawing.tint(axes, tints, frame)
    for part, mesh in truth.items():
        width = 2.0 if is_tumor(part) else 1.1
        lines = drawing.section(mesh, view, through_mm)
        drawing.draw_lines(axes, lines, color=TRUE, linewidth=width, zorder=4)
    flat, middle = view.project(scene.cloud.points_mm.astype(float)), view.project(through_mm[None])
    near = np.abs(flat[:, 2] - middle[0, 2]) < 1.5
    axes.scatter(flat[near, 0], flat[near, 1], s=7, color=OBSERVED, linewidths=0, zorder=5)
    drawing.finish_view(axes, frame, _CAMERA_AXES[view])


def scene_legend(organ: str = "kidney", *tumors: str) -> list[Any]:
    """Handles for ``draw_solid_view``: the parts by name, then the truth and the points."""
    return [
        Patch(facecolor=(*ORGAN, 0.5), label=f"estimated {words(organ)}"),
        *(Patch(facecolor=rgb(name_colour(tumor)), label=words(tumor)) for tumor in tumors),
        Line2D([], [], color=TRUE, linewidth=2, label="truth (outline)"),
        Line2D([], [], color=OBSERVED, marker=".", linestyle="", label="observed point"),
    ]


def qc_picture(
    case_labels: LabelVolume,
    ct: Volume | None,
    anatomy: Anatomy,
    path: Path,
    patient: str = "",
    warnings: Sequence[str] = (),
) -> None:
    """Orthogonal slices with outlines, a row through each tumor, and a 3-D view: is everything
    outlined, and on the right side?

    All in the patient's frame (LPS, mm). Without a CT the labels are shown in grey. Of more than
    six tumors the six largest have rows. ``patient`` is in the title, the ``warnings`` above it.
    The PNG is written atomically.
    """
    order = sorted(range(len(anatomy.tumors)), key=lambda n: -abs(anatomy.tumors[n].volume_mm3))
    rows = {anatomy.names[n + 1]: anatomy.tumors[n] for n in sorted(order[:_MAX_ROWS])}
    rows = rows or {anatomy.names[0]: anatomy.organ}
    height = 3.85 * len(rows) + 0.4
    borders = {"left": 0.025, "right": 0.99, "bottom": 0.05 / height}
    figure = drawing.new_figure(18.0, height, top=1 - 0.35 / height, **borders)
    grid = figure.add_gridspec(len(rows), 4, wspace=0.03, hspace=0.12)
    shown: LabelVolume | Volume = ct if ct is not None else case_labels
    window = _window(shown, anatomy)
    for row, (name, part) in enumerate(rows.items()):
        for column, view in enumerate(PLANES):
            axes = figure.add_subplot(grid[row, column])
            through_mm = in_voxels(part.box_mm.mean(0), shown.lps_from_index)
            _draw_plane(axes, (shown, window), anatomy, view, through_mm)
            if column == 0:
                axes.set_ylabel(f"through {words(name)}", fontsize=12, fontweight="bold")
    axes, view = figure.add_subplot(grid[:, 3]), PLANES[1]
    frame = view.frame_around(anatomy.organ.vertices_mm, 8.0).widened(_ASPECT)
    colors = _part_colors(anatomy)
    tumors = [Body(*tumor) for tumor in zip(anatomy.tumors, colors[1:], strict=True)]
    tumors += [Body(mesh, color) for _, mesh, color in _structures(anatomy)]
    drawing.show_bodies(axes, view, [*tumors, Body(anatomy.organ, ORGAN, 0.38)], frame)
    drawing.finish_view(axes, frame)
    _write_letters(axes, view, "black")
    axes.set_title("3-D, seen from the front", fontsize=10.5)
    what = "CT" if ct is not None else "label map"
    dropped = len(order) > _MAX_ROWS
    note = f" (slices through the {_MAX_ROWS} largest of {len(order)} tumors)" if dropped else ""
    title = f"Prepared case over its {what}{note}" + (f": {patient}" if patient else "")
    handles = [
        Patch(facecolor=color, label=f"{words(name)} {part.volume_ml:.1f} ml")
        for color, name, part in zip(colors, anatomy.names, anatomy.parts, strict=True)
    ]
    handles += [Patch(facecolor=c, label=words(name)) for name, _, c in _structures(anatomy)]
    drawing.add_words(figure, title, warnings, (), handles)
    drawing.save(figure, path)


def _draw_plane(
    axes: Axes,
    background: tuple[Volume | LabelVolume, tuple[float, float]],
    anatomy: Anatomy,
    view: ParallelView,
    through_mm: Float[np.ndarray, " 3"],
) -> None:
    """A slice, at the same scale in all planes."""
    half = anatomy.organ.longest_mm / 2 + _MARGIN_MM
    right, down, _ = view.project(anatomy.organ.box_mm.mean(0)[None])[0].tolist()
    frame = Frame(right - _ASPECT * half, right + _ASPECT * half, down - half, down + half)
    shown, (low, high) = background
    array = shown.hu if isinstance(shown, Volume) else shown.labels
    values = slice_volume(array, shown.lps_from_index, view, frame, through_mm)
    axes.imshow(np.ma.masked_invalid(values), cmap="gray", vmin=low, vmax=high, extent=frame.extent)
    structures = ((color, mesh) for _, mesh, color in _structures(anatomy))
    for color, part in (*zip(_part_colors(anatomy), anatomy.parts, strict=True), *structures):
        lines = drawing.section(part, view, through_mm)
        drawing.draw_lines(axes, lines, color=color, linewidth=1.7)
    drawing.finish_view(axes, frame, background="black")
    _write_letters(axes, view, "white")
    axis = int(np.argmax(np.abs(view.axes[2])))
    letter = ("LPS" if through_mm[axis] >= 0 else "RAI")[axis]
    axes.set_title(f"{view.name}, {letter} {abs(through_mm[axis]):.1f} mm", fontsize=10.5)


def in_voxels(
    point_mm: Float[np.ndarray, " 3"], lps_from_index: Float[np.ndarray, "4 4"]
) -> Float[np.ndarray, " 3"]:
    """The centre of the nearest voxel: a plane through it cuts voxels in their middle, so that the
    slice and the outlines match."""
    index = np.rint(transform_points(np.linalg.inv(lps_from_index), point_mm[None]))
    return transform_points(lps_from_index, index)[0]


def slice_volume(
    array: Shaped[np.ndarray, "i j k"],
    lps_from_index: Float[np.ndarray, "4 4"],
    view: ParallelView,
    frame: Frame,
    through_mm: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, "h w"]:
    """A volume's values (nearest voxel, NaN outside) in the view's plane through a point.

    Row 0 is the frame's top, column 0 its left, as in ``ParallelView.draw``.
    """
    x, y = np.meshgrid(*frame.pixel_centres())
    depth = view.project(through_mm[None])[0, 2]
    lps = np.stack([x, y, np.full_like(x, depth)], axis=-1).reshape(-1, 3) @ view.axes
    index = np.floor(transform_points(np.linalg.inv(lps_from_index), lps) + 0.5).astype(int)
    inside = ((index >= 0) & (index < array.shape)).all(1)
    values = np.full(len(index), np.nan)
    values[inside] = array[tuple(index[inside].T)]
    return values.reshape(x.shape)


def _window(shown: Volume | LabelVolume, anatomy: Anatomy) -> tuple[float, float]:
    """Grey range: soft tissue, extended upwards to the organ's and tumors' values."""
    if isinstance(shown, LabelVolume):
        return 0.0, float(shown.labels.max()) * 1.6 + 1e-6
    low, high = _SOFT_TISSUE_HU
    inner = np.concatenate([0.7 * p.vertices_mm + 0.3 * p.box_mm.mean(0) for p in anatomy.parts])
    index = np.rint(transform_points(np.linalg.inv(shown.lps_from_index), inner)).astype(int)
    index = index[((index >= 0) & (index < shown.hu.shape)).all(1)]
    brightest = float(np.percentile(shown.hu[tuple(index.T)], 98)) if len(index) else high
    return low, max(high, 1.15 * brightest)


def border_letters(view: ParallelView) -> dict[str, str]:
    """The picture's left, right, top, bottom -> the patient's side there: L R A P S I."""
    right, down, _ = view.axes
    towards = {"right": right, "left": -right, "bottom": down, "top": -down}
    names = {tuple(np.array(v)): n[0].upper() for n, v in DIRECTIONS_LPS.items()}
    return {border: names[tuple(v)] for border, v in towards.items()}


def _write_letters(axes: Axes, view: ParallelView, color: str) -> None:
    style = {**CENTRED, "fontsize": 13, "fontweight": "bold", "color": color}
    for border, letter in border_letters(view).items():
        axes.text(*_NEAR_BORDER[border], letter, transform=axes.transAxes, gid=border, **style)


def _structures(anatomy: Anatomy) -> list[tuple[str, Mesh, RGB]]:
    """Name, surface and colour of each."""
    return [
        (name, mesh, rgb(structure_colour(number)))
        for number, (name, mesh) in enumerate(anatomy.structures.items())
    ]


def _part_colors(anatomy: Anatomy) -> list[RGB]:
    return [rgb(name_colour(name)) for name in anatomy.names]
