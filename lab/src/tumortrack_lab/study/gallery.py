"""A gallery: the estimate over the truth, a row for each variant, a column for each method."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

from tumortrack.core.errors import InputError, NoEstimate
from tumortrack.core.estimate import Estimate
from tumortrack.report.drawing import new_figure, save
from tumortrack.report.pictures import FROM_SIDE, draw_solid_view, scene_legend
from tumortrack.report.protocol import compare
from tumortrack.simulate.scene_folder import Scene, read_scene
from tumortrack_lab.study.measure import StudyCase
from tumortrack_lab.study.methods import Method
from tumortrack_lab.study.tables import label_of

if TYPE_CHECKING:
    from matplotlib.axes import Axes

_PANEL_IN = (4.4, 2.75)


def gallery(
    case: StudyCase,
    methods: list[Method],
    scenes: list[tuple[str, str]],
    grid: int,
    path: Path,
) -> None:
    """Draw every method on every scene (variant, view), seen from the side.

    Raises:
        InputError: a scene cannot be read.
        StorageError: the disk refused.
    """
    width, height = _PANEL_IN
    total = len(scenes) * height + 1.0
    drawing = new_figure(width * len(methods) + 0.5, total)
    panels = drawing.subplots(len(scenes), len(methods), squeeze=False)
    drawing.subplots_adjust(
        left=0.045, right=0.99, top=1 - 0.98 / total, bottom=0.1 / total, wspace=0.04, hspace=0.16
    )
    for row, (variant, view) in enumerate(scenes):
        scene = read_scene(case.scene(variant, view))
        for column, method in enumerate(methods):
            axes = panels[row, column]
            _panel(axes, scene, method, grid)
            if column == 0:
                axes.set_ylabel(variant, fontsize=13, fontweight="bold")
            if row == 0:
                axes.text(
                    0.5,
                    1.17,
                    label_of(method.identity["name"]),
                    transform=axes.transAxes,
                    ha="center",
                    fontsize=12,
                    fontweight="bold",
                )
    drawing.legend(
        handles=scene_legend(),
        loc="upper right",
        ncols=4,
        frameon=False,
        bbox_to_anchor=(0.99, 0.999),
    )
    save(drawing, path)


def _panel(axes: Axes, scene: Scene, method: Method, grid: int) -> None:
    estimate: Estimate | None = None
    try:
        estimate = method.locate(scene, grid).estimate
    except (NoEstimate, InputError):
        title = "nothing found"
    else:
        title = _numbers(estimate, scene)
    draw_solid_view(axes, scene, estimate, FROM_SIDE)
    axes.set_title(title, fontsize=9.5)


def _numbers(estimate: Estimate, scene: Scene) -> str:
    parts = {name: part for name, part in compare(estimate, scene).items() if name != "kidney"}
    texts = [
        f"{name.replace('_', ' ')} {part['hausdorff_mm']:.1f} mm"
        if part["found"]
        else f"{name.replace('_', ' ')} not found"
        for name, part in parts.items()
    ]
    return "Hausdorff: " + ", ".join(texts)
