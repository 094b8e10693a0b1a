"""The README's picture: the input, one depth image, beside the output.

    make pictures, or: python benchmarks/scripts/picture.py CASE OUT.png

CASE is the demo's (`make demo`: runs/demo/case). The scene is one of the ten that the package
brings; its true surfaces are outlined.
"""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import tyro

import tumortrack as tt
from tumortrack.core import colours
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import verdict_words
from tumortrack.report.pictures import depth_picture, scene_views, write_sheet
from tumortrack_benchmarks import scripting


@dataclass(frozen=True)
class Options:
    """Locate and draw."""

    case: tyro.conf.Positional[Path]
    """Folder that the demo made."""
    out: tyro.conf.Positional[Path]
    """PNG to write."""
    scene: str = "8-pulled"
    """Name of the scene."""


def main(options: Options) -> None:
    scenes = tt.datasets.phantom_scenes()
    scene = scenes.get(options.scene)
    if scene is None or scene.depth is None:
        raise InputError(f"there is no scene {options.scene!r}; allowed: {', '.join(scenes)}.")
    estimate = tt.Tracker(tt.load_case(options.case)).locate(scene.cloud)
    size = f"{scene.depth.intrinsics.width} x {scene.depth.intrinsics.height} pixels"
    panels = [(f"input: a depth image, {size}; near is bright", depth_picture(scene.depth))]
    panels += [(f"output, {way}", view) for way, view in scene_views(scene, estimate.meshes)]
    legend = {name.replace("_", " "): colours.name_colour(name) for name in estimate.meshes}
    legend |= {"truth (outline)": colours.TRUTH, "points that the camera saw": colours.SEEN}
    banner = verdict_words(estimate.quality, estimate.reason), colours.VERDICTS[estimate.quality]
    words = f"Scene {options.scene} of the built-in phantom, simulated."
    write_sheet(options.out, [banner], [words], legend, [panels], 2000)


if __name__ == "__main__":
    scripting.run(main, Options)
