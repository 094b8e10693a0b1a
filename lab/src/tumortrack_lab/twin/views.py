"""The scenes of one case: states, their turns about the camera's axis, and the camera's views."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import Float64
from msgspec import structs

from tumortrack.core.config import Config, to_builtins
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import Anatomy
from tumortrack.sense.camera import d405, project
from tumortrack.sense.cloud import CloudConfig, cloud_from_depth
from tumortrack.sense.noise import D405_NOISE, NoiseConfig, add_noise
from tumortrack.sense.render import render_depth
from tumortrack.simulate.scene_folder import Scene
from tumortrack_lab.twin.apparatus import moved
from tumortrack_lab.twin.equilibrium import Rod
from tumortrack_lab.twin.occluders import add_background, occlude, shaft_over

View = Literal["clean", "noise", "shaft", "clutter"]
VIEWS: tuple[View, ...] = get_args(View)


class Variant(NamedTuple):
    """A state of the bench, turned about the camera's axis."""

    state: str
    turn_degrees: int = 0


VARIANTS = {name: Variant(name) for name in ("D0", "D1", "D2", "D3")}
VARIANTS |= {f"Rot{turn}": Variant("D0", turn) for turn in (90, 180, 270)}
VARIANTS |= {name: Variant(name) for name in ("G1", "P1")}


class ViewConfig(Config, frozen=True, kw_only=True):
    """Camera, crop and disturbances."""

    # Above the support; the camera looks straight down at the middle of the organ in D0.
    camera_above_mm: float = 150.0
    # To the top of the undeformed organ, at least: over a taller organ the camera and far_mm are
    # raised (``for_organ``), or else the image would cut off its ends.
    nearest_mm: float = 85.0
    # Depths kept, exclusive. The paper's 110..150 mm would cut off the top of an organ that stands
    # 60 mm high under a camera 150 mm above its bed; this range keeps it all.
    near_mm: float = 50.0
    far_mm: float = 150.0
    width: int = 848
    height: int = 480
    n_points: int = 5000  # of the cloud; every method thins it by itself
    shaft_radius_mm: float = 4.0  # of the instrument in the view ``shaft``
    clutter_share: float = 0.03  # background points among all, in the view ``clutter``
    noise: NoiseConfig = D405_NOISE  # of the view ``noise``

    @property
    def crop(self) -> CloudConfig:
        return CloudConfig(near_mm=self.near_mm, far_mm=self.far_mm, n_points=self.n_points)


def for_organ(config: ViewConfig, height_mm: float) -> ViewConfig:
    """The views of an organ of this height, undeformed."""
    raised_mm = max(0.0, height_mm + config.nearest_mm - config.camera_above_mm)
    return structs.replace(
        config, camera_above_mm=config.camera_above_mm + raised_mm, far_mm=config.far_mm + raised_mm
    )


@dataclass(frozen=True, eq=False)
class EquilibriumState:
    """The anatomy at rest in one state, bench frame, mm, in the case's order of vertices."""

    state: str
    anatomy: Anatomy
    targets_mm: Float64[np.ndarray, "n 3"]  # the case's target points there
    bench_from_ct: Float64[np.ndarray, "4 4"]  # the rigid part of the way there
    report: dict  # the state's, plain JSON


def camera_from_bench(config: ViewConfig, turn_degrees: int = 0) -> Float64[np.ndarray, "4 4"]:
    """Straight down from above the bench's middle, turned about the camera's axis by a multiple of
    90 degrees. Unturned, the picture's right is the bench's x and its down the bench's -y."""
    cosine, sine = {0: (1, 0), 90: (0, 1), 180: (-1, 0), 270: (0, -1)}[turn_degrees % 360]
    turn = np.array([[cosine, -sine, 0], [sine, cosine, 0], [0, 0, 1.0]])
    return rigid(turn @ np.diag([1.0, -1.0, -1.0]), np.array([0, 0, config.camera_above_mm]))


def make_scene(
    state: EquilibriumState, name: str, view: View, config: ViewConfig, seed: int
) -> tuple[Scene, Float64[np.ndarray, "n 3"]]:
    """One variant's scene in one view, and the targets before its camera, mm.

    Random numbers depend on seed, variant and view alone. Raises NoEstimate: fewer than 200 points
    of the organ are seen; InputError: no room for background beside the organ.
    """
    variant = VARIANTS[name]
    to_camera = camera_from_bench(config, variant.turn_degrees)
    reference = moved(state.anatomy, to_camera)
    camera = d405(config.width, config.height)
    frame = render_depth(reference.organ.vertices_mm, reference.organ.faces, camera)
    pixels, _ = project(reference.organ.vertices_mm, camera)
    size = np.array([camera.width, camera.height])
    shares = {"in_image_share": float(((pixels > -0.5) & (pixels < size - 0.5)).all(1).mean())}
    if poke := state.report.get("poke"):  # the bench's rod
        tip_mm = transform_points(to_camera, np.array([poke["tip_mm"]], float))[0]
        axis = to_camera[:3, :3] @ np.array(poke["axis"], float)
        rod = Rod(tip_mm, axis, float(poke["radius_mm"]))
        frame, shares["rod_covers_share"] = occlude(frame, rod)
    rng = np.random.default_rng([seed, list(VARIANTS).index(name), VIEWS.index(view)])
    if view == "noise":
        frame = add_noise(frame, config.noise, rng)
    elif view == "shaft":
        shaft = shaft_over(frame, config.shaft_radius_mm, rng)
        frame, shares["shaft_covers_share"] = occlude(frame, shaft)
    elif view == "clutter":
        frame, share = add_background(frame, config.clutter_share, config.far_mm, rng)
        shares["background_share"] = share
    cloud = cloud_from_depth(frame, config.crop, rng)
    meta = {
        "variant": name,
        "view": view,
        "seed": seed,
        "state": state.report,
        "camera_from_ct": (to_camera @ state.bench_from_ct).tolist(),
        "camera_from_bench": to_camera.tolist(),
        "crop_mm": [config.near_mm, config.far_mm],
        "seen": shares,
        "view_config": to_builtins(config),
    }
    return Scene(cloud, reference, frame, meta), transform_points(to_camera, state.targets_mm)
