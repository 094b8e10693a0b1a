"""One picture per scene of the twin: what the camera gets, over the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from tumortrack.report import drawing
from tumortrack.report.pictures import FROM_CAMERA, FROM_SIDE, draw_solid_view, scene_legend
from tumortrack.simulate.scene_folder import Scene


def twin_picture(scene: Scene, path: Path) -> None:
    """Depth image, and the cloud over the truth's outlines from the camera and from the side."""
    assert scene.depth is not None
    figure = drawing.new_figure(16.0, 4.4, top=0.8)
    axes = figure.add_subplot(1, 3, 1)
    depth_mm, (near, far) = scene.depth.depth_mm, scene.meta["crop_mm"]
    kept = np.where((depth_mm > near) & (depth_mm < far), depth_mm, np.nan)
    bar = figure.colorbar(axes.imshow(kept, cmap="viridis_r"), ax=axes, fraction=0.026, pad=0.015)
    bar.set_label("depth, mm", fontsize=9)
    bar.ax.invert_yaxis()
    axes.set(xticks=[], yticks=[], title=f"depth image, cropped to {near:g} .. {far:g} mm")
    for number, view in enumerate((FROM_CAMERA, FROM_SIDE), start=2):
        draw_solid_view(figure.add_subplot(1, 3, number), scene, None, view)
    words = f"{scene.meta['variant']}, {scene.meta['view']}"
    drawing.add_words(figure, words, handles=scene_legend()[-2:])
    drawing.save(figure, path)
