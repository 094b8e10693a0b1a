"""The body that a scene configuration needs, built once by whoever makes its scenes."""

from __future__ import annotations

import msgspec

from tumortrack.core.errors import InputError
from tumortrack.core.types import Anatomy
from tumortrack.simulate.deform import ChainConfig, DeformConfig, ElasticConfig
from tumortrack.simulate.elastic.body import BodyConfig, ElasticBody, build_body
from tumortrack.simulate.scene import SceneConfig


def body_for(
    anatomy_ct: Anatomy, up_lps: tuple[float, float, float], config: SceneConfig, seed: int
) -> ElasticBody | None:
    """The organ's body where a deformation of the configuration needs it, else None.

    Where every rotation of the organ is shown (``full``), its bed lies on any side of it.

    Raises:
        InputError: elastic deformations that ask for different bodies.
    """
    wanted = {body for model in config.deform for body in _bodies(model)}
    if len(wanted) > 1:
        raise InputError(
            "the scene configuration has elastic deformations with different bodies; give them "
            "all the same `body`."
        )
    if not wanted:
        return None
    kind = wanted.pop()
    if config.pose.rotations == "full":
        kind = msgspec.structs.replace(kind, bed_anywhere=1.0)
    return build_body(anatomy_ct, up_lps, kind, seed)


def _bodies(model: DeformConfig) -> list[BodyConfig]:
    links = model.links if isinstance(model, ChainConfig) else (model,)
    return [link.body for link in links if isinstance(link, ElasticConfig)]
