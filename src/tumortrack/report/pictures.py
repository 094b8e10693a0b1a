"""Pictures that a surgeon can read: the estimate over the truth, here; a case, in ``qc``.

Orange is what was estimated, blue is the truth (a pair that every colour vision tells apart).
Nothing needs a display.
"""

from __future__ import annotations

import textwrap
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tumortrack.core.estimate import Estimate
from tumortrack.report.drawing import (
    ESTIMATED,
    KIDNEY,
    OBSERVED,
    TRUE,
    draw_lines,
    finish_view,
    new_figure,
    outline,
    save,
    section,
    section_mask,
    show_legend,
    tint,
)
from tumortrack.report.qc import qc_picture
from tumortrack.report.renderer import Body, ParallelView
from tumortrack.simulate.scene_folder import Scene

if TYPE_CHECKING:
    from matplotlib.axes import Axes

__all__ = ["qc_picture", "scene_picture"]

FROM_CAMERA = ParallelView("seen from the camera", (1.0, 0.0, 0.0), (0.0, 1.0, 0.0))
FROM_SIDE = ParallelView("seen from the side, camera above", (1.0, 0.0, 0.0), (0.0, 0.0, 1.0))
_CAMERA_AXES = {
    FROM_CAMERA: {"x": (1.0, 0.0), "y": (0.0, 1.0)},
    FROM_SIDE: {"x": (1.0, 0.0), "z": (0.0, 1.0)},
}
_SLICES = {FROM_CAMERA: "across the view", FROM_SIDE: "along the view"}


def scene_picture(
    scene: Scene, estimate: Estimate | None, entry: dict[str, Any], path: Path
) -> None:
    """Estimate over truth: two 3-D views, and two slices through each true tumor's centre.

    Args:
        scene: truth and observed cloud, camera frame.
        estimate: None where nothing was found; then the truth is shown alone.
        entry: this scene's entry of the report (name, parts, miou, failed), for the titles.
        path: PNG to write, atomically.
    """
    slices = [(name, view) for name in scene.reference.names[1:] for view in _SLICES]
    rows = -(-len(slices) // 4)
    height_in = 5.1 + 4.05 * rows
    figure = new_figure(14.0, height_in)
    figure.subplots_adjust(top=1 - 0.85 / height_in, bottom=0.15 / height_in)
    outer = figure.add_gridspec(2, 1, height_ratios=[4.1, 3.95 * max(rows, 0.01)], hspace=0.13)
    top = outer[0].subgridspec(1, 2, wspace=0.04)
    for column, view in enumerate(_SLICES):
        draw_solid_view(figure.add_subplot(top[column]), scene, estimate, view)
    below = outer[1].subgridspec(max(rows, 1), 4, wspace=0.06, hspace=0.2)
    for n, (name, view) in enumerate(slices):
        axes = figure.add_subplot(below[n // 4, n % 4])
        _draw_slice(axes, scene, estimate, name, view)
        what = f"{name.replace('_', ' ')}: {_SLICES[view]}"
        axes.set_title(f"{what}\n{_distances(entry, name)}", fontsize=9.5)
    figure.suptitle(_headline(entry), x=0.02, ha="left", fontsize=13, fontweight="bold")
    show_legend(figure, scene_legend(), 4, (0.985, 0.995))
    save(figure, path)


def draw_solid_view(
    axes: Axes, scene: Scene, estimate: Estimate | None, view: ParallelView
) -> None:
    """The estimate's surfaces, the truth's outlines and the observed points."""
    shown = estimate.meshes if estimate else {}
    everything = [*scene.reference.parts, *shown.values()]
    frame = view.frame_around(np.concatenate([m.vertices_mm for m in everything]), 6.0)
    frame = frame.widened(1.7)
    bodies = [Body(mesh, ESTIMATED) for name, mesh in shown.items() if name != "kidney"]
    if "kidney" in shown:
        bodies.append(Body(shown["kidney"], KIDNEY, 0.36))
    picture = view.draw(bodies, frame)
    axes.imshow(picture, extent=frame.extent, zorder=2, interpolation="bilinear")
    flat = view.project(scene.cloud.points_mm.astype(float))
    axes.scatter(flat[:, 0], flat[:, 1], s=2.5, color=OBSERVED, alpha=0.55, linewidths=0, zorder=3)
    for n, part in enumerate(scene.reference.parts):
        outline(axes, part, view, frame, TRUE, 1.2 if n == 0 else 2.2)
    for name, mesh in shown.items():
        if name != "kidney":
            u, v = view.project(mesh.box_mm.mean(0)[None])[0, :2]
            axes.text(u, v, name.split("_")[-1], ha="center", va="center", fontweight="bold")
    finish_view(axes, frame, _CAMERA_AXES[view])
    axes.set_title(view.name, fontsize=11)


def _draw_slice(
    axes: Axes, scene: Scene, estimate: Estimate | None, name: str, view: ParallelView
) -> None:
    truth = dict(zip(scene.reference.names, scene.reference.parts, strict=True))
    shown = estimate.meshes if estimate else {}
    through_mm = truth[name].box_mm.mean(0)
    around = [truth[name].vertices_mm] + ([shown[name].vertices_mm] if name in shown else [])
    frame = view.frame_around(np.concatenate(around), 12.0).widened(1.0)
    for part, mesh in shown.items():
        color, width = (KIDNEY, 1.4) if part == "kidney" else (ESTIMATED, 2.4)
        tint(axes, section_mask(mesh, view, frame, through_mm), frame, color)
        draw_lines(axes, section(mesh, view, through_mm), color=color, linewidth=width, zorder=3)
    for part, mesh in truth.items():
        width = 1.1 if part == "kidney" else 2.0
        draw_lines(axes, section(mesh, view, through_mm), color=TRUE, linewidth=width, zorder=4)
    flat, middle = view.project(scene.cloud.points_mm.astype(float)), view.project(through_mm[None])
    near = np.abs(flat[:, 2] - middle[0, 2]) < 1.5
    axes.scatter(flat[near, 0], flat[near, 1], s=7, color=OBSERVED, linewidths=0, zorder=5)
    finish_view(axes, frame, _CAMERA_AXES[view])


def _distances(entry: dict[str, Any], name: str) -> str:
    part = entry.get("parts", {}).get(name)
    if not part or not part["found"]:
        return "not found"
    return (
        f"Hausdorff {part['hausdorff_mm']:.1f} mm, centre {part['center_mm']:.1f} mm, "
        f"IoU {part['iou']:.2f}"
    )


def _headline(entry: dict[str, Any]) -> str:
    failed = "" if entry["failed"] is None else f"   {textwrap.shorten(entry['failed'], 60)}"
    errors = entry.get("tre_mm")
    targets = f"   target error {errors['mean']:.1f} mm" if errors else ""
    return f"{entry['name']}   mIoU {entry['miou']:.2f}{targets}{failed}"


def scene_legend() -> list[Any]:
    """Handles of what ``draw_solid_view`` shows."""
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Patch(facecolor=ESTIMATED, label="estimated tumor"),
        Patch(facecolor=(*KIDNEY, 0.5), label="estimated kidney"),
        Line2D([], [], color=TRUE, linewidth=2, label="truth (outline)"),
        Line2D([], [], color=OBSERVED, marker=".", linestyle="", label="observed point"),
    ]
