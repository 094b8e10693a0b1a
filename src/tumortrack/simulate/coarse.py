"""Coarser scenes, made in a third of the time, for networks that cannot tell the difference.

A height map of 32 x 32 pixels, some 5 mm each and drawn from at most 1,000 points, needs neither a
depth image of 100,000 pixels nor a surface of 30,000 triangles; and a state of the elastic body
serves several poses. docs/training.md has what each saves, and what is learnt from such scenes.
"""

from __future__ import annotations

import msgspec

from tumortrack.core.config import Config
from tumortrack.core.types import Anatomy
from tumortrack.simulate.scene import SceneConfig

_LENGTHS_PX = ("correlation_px", "edge_px", "hole_px")  # of the noise: whole pixels
_WIDTHS_PX = ("fatten_px", "shadow_px_mm")


class CoarseConfig(Config, frozen=True):
    """How much coarser: so many ``pixels`` along each axis of the image become one, the organ's
    surface may be ``surface_mm`` off, and so many ``views`` in a row show the same state."""

    pixels: int = 2
    surface_mm: float = 0.3
    views: int = 4

    def __post_init__(self) -> None:
        self.check_between("coarse scenes'", pixels=(1, 8), surface_mm=(0.0, 5.0), views=(1, 64))


def coarsened(
    anatomy_ct: Anatomy, scene: SceneConfig, coarse: CoarseConfig | None
) -> tuple[Anatomy, SceneConfig]:
    """The anatomy and the configuration for coarser scenes; as they are without ``coarse``.

    Raises:
        InputError: the organ's surface is not closed; ``views`` of deformations that depend on the
            view.
    """
    if coarse is None:
        return anatomy_ct, scene
    from tumortrack.imaging.meshes import mesh_of, solid_of

    organ = anatomy_ct.organ
    if coarse.surface_mm:
        organ = mesh_of(solid_of(organ, "organ").simplify(coarse.surface_mm))
    wide = {n: getattr(scene.noise, n) / coarse.pixels for n in (*_LENGTHS_PX, *_WIDTHS_PX)}
    whole = {name: max(1, round(wide[name])) for name in _LENGTHS_PX}
    config = msgspec.structs.replace(
        scene,
        width=scene.width // coarse.pixels,
        height=scene.height // coarse.pixels,
        noise=msgspec.structs.replace(scene.noise, **{**wide, **whole}),
        views=coarse.views,
    )
    return anatomy_ct.of((organ, *anatomy_ct.tumors)), config
