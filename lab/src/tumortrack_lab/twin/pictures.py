"""One picture per scene of the twin: what the camera gets, and what stands on the bench."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from tumortrack.core.types import Anatomy, Mesh
from tumortrack.report import drawing
from tumortrack.report.pictures import FROM_CAMERA
from tumortrack.report.renderer import Body, Frame, ParallelView
from tumortrack.sense.camera import project
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.twin.apparatus import COMPRESSION_MM
from tumortrack_lab.twin.views import EquilibriumState

if TYPE_CHECKING:
    from matplotlib.axes import Axes

FROM_FRONT = ParallelView("bench from the front", (1.0, 0.0, 0.0), (0.0, 0.0, -1.0))
FROM_END = ParallelView("bench from its end", (0.0, 1.0, 0.0), (0.0, 0.0, -1.0))
_STEEL = (0.62, 0.65, 0.7)
_REST = "0.35"
_AROUND_MM = 14.0  # of the organ: background beside it shows, points far off do not
_ROD_SHOWN_MM = 45.0
_PLATE_SHOWN_MM = 9.0


def twin_picture(scene: Scene, state: EquilibriumState, rest_organ: Mesh, path: Path) -> None:
    """Depth image, cloud over truth, and two side views of the bench with the undeformed organ's
    outline. The scene is in the camera frame, the rest on the bench."""
    figure = drawing.new_figure(14.0, 9.6)
    figure.subplots_adjust(left=0.02, right=0.985, top=0.875, bottom=0.03)
    grid = figure.add_gridspec(2, 2, hspace=0.13, wspace=0.05)
    _depth_view(figure.add_subplot(grid[0, 0]), scene)
    _cloud_view(figure.add_subplot(grid[0, 1]), scene)
    for column, view in enumerate((FROM_FRONT, FROM_END)):
        axes = figure.add_subplot(grid[1, column])
        _bench_view(axes, state, rest_organ, view)
        _apparatus(axes, {**scene.meta["bench_config"], **state.report}, view)
    figure.suptitle(
        f"{scene.meta['variant']}, {scene.meta['view']}: {_TEXT[scene.meta['variant']]}",
        x=0.02, y=0.985, ha="left", fontsize=13, fontweight="bold",
    )  # fmt: skip
    figure.text(0.02, 0.945, _numbers(scene, state), ha="left", va="top", fontsize=10)
    drawing.show_legend(figure, _legend(), 5, (0.99, 1.0))
    drawing.save(figure, path)


def _depth_view(axes: Axes, scene: Scene) -> None:
    """The depth image as the sensor gave it, with the true tumors' outlines."""
    from matplotlib import colormaps

    assert scene.depth is not None
    depth_mm = scene.depth.depth_mm
    near, far = scene.meta["crop_mm"]
    kept = np.where((depth_mm > near) & (depth_mm < far), depth_mm, np.nan)
    colors = colormaps["viridis_r"].with_extremes(bad="white")
    picture = axes.imshow(kept, cmap=colors, interpolation="nearest")
    height, width = depth_mm.shape
    for tumor in scene.reference.tumors:
        pixels, _ = project(tumor.vertices_mm, scene.depth.intrinsics)
        flat = Mesh(np.column_stack([pixels, np.zeros(len(pixels))]), tumor.faces)
        frame = Frame(-0.5, width - 0.5, -0.5, height - 0.5)
        mask = FROM_CAMERA.silhouette(flat, frame, 2.0)
        x, y = np.meshgrid(*frame.pixel_centres(2.0))
        for color, line in (("white", 3.2), (drawing.TRUE, 1.4)):  # a halo: seen on any depth
            axes.contour(x, y, mask, levels=[0.5], colors=[color], linewidths=line)
    axes.set(xlim=(-0.5, width - 0.5), ylim=(height - 0.5, -0.5), xticks=[], yticks=[])
    for spine in axes.spines.values():
        spine.set_color("0.8")
    bar = axes.figure.colorbar(picture, ax=axes, fraction=0.026, pad=0.015)
    bar.set_label("depth, mm", fontsize=9)
    bar.ax.invert_yaxis()
    bar.ax.tick_params(labelsize=8)
    title = f"depth image, {width} x {height}, cropped to {near:g} .. {far:g} mm"
    axes.set_title(title, fontsize=11)


def _cloud_view(axes: Axes, scene: Scene) -> None:
    flat = FROM_CAMERA.project(scene.cloud.points_mm.astype(float))
    frame = FROM_CAMERA.frame_around(scene.reference.organ.vertices_mm, _AROUND_MM).widened(1.6)
    _paint(axes, scene.reference, FROM_CAMERA, frame)
    dot: dict[str, Any] = {"s": 2.0, "color": drawing.OBSERVED, "alpha": 0.5, "linewidths": 0}
    axes.scatter(flat[:, 0], flat[:, 1], zorder=3, **dot)
    drawing.finish_view(axes, frame)
    axes.set_title(f"{FROM_CAMERA.name}: {len(flat)} points over the truth", fontsize=11)


def _bench_view(axes: Axes, state: EquilibriumState, rest_organ: Mesh, view: ParallelView) -> None:
    anatomy = state.anatomy
    everything = np.concatenate([anatomy.organ.vertices_mm, rest_organ.vertices_mm])
    everything = np.concatenate([everything, everything.mean(0)[None] * [1, 1, 0] + [0, 0, -12.0]])
    frame = view.frame_around(everything, 8.0).widened(1.75)
    _paint(axes, anatomy, view, frame)
    drawing.outline(axes, rest_organ, view, frame, _REST, 1.3, linestyles=["dashed"])
    axes.axhspan(0, frame.bottom, color="0.3", alpha=0.13, zorder=2.2, linewidth=0)
    axes.axhline(0, color="0.45", linewidth=1.2, zorder=2.5)
    drawing.finish_view(axes, frame)
    axes.set_title(view.name, fontsize=11)


def _paint(axes: Axes, anatomy: Anatomy, view: ParallelView, frame: Frame) -> None:
    bodies = [Body(tumor, drawing.TRUE) for tumor in anatomy.tumors]
    picture = view.draw([*bodies, Body(anatomy.organ, drawing.KIDNEY, 0.4)], frame)
    axes.imshow(picture, extent=frame.extent, zorder=2, interpolation="bilinear")


def _apparatus(axes: Axes, report: dict, view: ParallelView) -> None:
    """Plate and rod, where the state has them; their far ends are left out."""
    from matplotlib.patches import FancyBboxPatch, Polygon

    if "plate_z_mm" in report:
        left, right = axes.get_xlim()
        half = report["plate_mm"] / 2 if view is FROM_FRONT else 0.46 * (right - left)
        middle = 0.0 if view is FROM_FRONT else (left + right) / 2
        style = f"round,pad=0,rounding_size={report['rounding_mm']}"
        upper = report["plate_z_mm"] + _PLATE_SHOWN_MM
        shape = FancyBboxPatch(
            (middle - half, -upper), 2 * half, _PLATE_SHOWN_MM, boxstyle=style,
            facecolor=_STEEL, edgecolor="0.3", alpha=0.8, zorder=4,
        )  # fmt: skip
        axes.add_patch(shape)
    if "poke" in report:
        tip, axis, radius = (np.array(report["poke"][k]) for k in ("tip_mm", "axis", "radius_mm"))
        end = view.project(np.stack([tip + radius * axis, tip + _ROD_SHOWN_MM * axis]))[:, :2]
        along = end[1] - end[0]
        along = along / max(np.linalg.norm(along), 1e-9)
        angle = np.linspace(np.pi / 2, 3 * np.pi / 2, 24)
        across = np.array([-along[1], along[0]])
        cap = radius * (np.outer(np.cos(angle), along) + np.outer(np.sin(angle), across))
        far = end[1] + radius * np.stack([-across, across])
        outline = np.concatenate([end[0] + cap, far])
        axes.add_patch(Polygon(outline, facecolor=_STEEL, edgecolor="0.3", zorder=4, alpha=0.85))


_TEXT = {
    "D0": "undeformed",
    **{name: f"midsection compressed by {mm:g} mm" for name, mm in COMPRESSION_MM.items()},
    **{f"Rot{n}": f"undeformed, turned by {n} degrees" for n in (90, 180, 270)},
    "G1": "sunk after an incision",
    "P1": "poked by a rod",
}


def _numbers(scene: Scene, state: EquilibriumState) -> str:
    """What was measured of this scene, in one line."""
    measured = {**state.report, **scene.meta["seen"]}
    if "volume_change" in measured:
        measured["volume_change"] *= 100
    texts = {
        "volume_change": "volume {:+.2f} %",
        "largest_displacement_mm": "largest displacement {:.1f} mm",
        "rod_covers_share": "rod hides {:.1%} of what is visible",
        "shaft_covers_share": "shaft hides {:.1%} of what is visible",
        "background_share": "{:.1%} background points",
    }
    return "   ".join(text.format(measured[key]) for key, text in texts.items() if key in measured)


def _legend() -> list:
    from matplotlib.lines import Line2D
    from matplotlib.patches import Patch

    return [
        Patch(facecolor=(*drawing.KIDNEY, 0.5), label="kidney"),
        Patch(facecolor=drawing.TRUE, label="tumor"),
        Line2D([], [], color=_REST, linestyle="dashed", label="undeformed"),
        Patch(facecolor=_STEEL, edgecolor="0.3", label="plate, rod"),
        Line2D([], [], color=drawing.OBSERVED, marker=".", linestyle="", label="point"),
    ]
