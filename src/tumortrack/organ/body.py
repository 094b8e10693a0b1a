"""An elastic body: an organ's displacement modes and typical states, fast enough for every frame.

Finite elements (``finite``) of the organ respond to random loads; the principal components of the
responses are its modes (``modes``). In their space the organ is loaded in its bed (``loads``),
which gives a library of states. See docs/method.md, section "The elastic body".
"""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, replace
from functools import cached_property
from typing import TYPE_CHECKING

import numpy as np
from jaxtyping import Float, Float32, Float64

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import unit
from tumortrack.core.organ import KIDNEY
from tumortrack.core.types import Anatomy
from tumortrack.organ.flow import LatticeField, combine, follow, project, steps_for

if TYPE_CHECKING:
    from tumortrack.organ.modes import ReducedModel

Points = Float[np.ndarray, "n 3"]
Moved = Float32[np.ndarray, "n 3"]
Field = Float32[np.ndarray, "i j k 3"]
_KIDNEY_MM = 115.0  # length
_RIDGE = 1e-4  # mm2, added to the covariance's diagonal
_ARRAYS = ("origin_mm", "spacing_mm", "center_ct", "modes", "states", "compliance")
_COMPLIANCE_MODES = 32  # 24 leave hardly larger errors, 48 and 120 the same


class BodyConfig(Config, frozen=True):
    """How an organ's body is built. ``bed_anywhere``: fraction of states with the bed on any side
    of the organ, instead of opposite to the direction that faces the camera."""

    cells: int = 1000  # cubes in the organ's volume; sets the spacing
    modes: int = 48
    responses: int = 480
    contrasts: tuple[float, ...] = (1.0, 3.0, 10.0)  # of tumors' stiffness, among the responses
    poisson: float = 0.49
    patches: int = 600
    states: int = 2000
    bed_anywhere: float = 0.15


@dataclass(frozen=True, eq=False)
class ElasticBody:
    """Modes of an organ (CT frame, LPS mm) and a library of states under random loads.

    A state is a vector of coefficients; points follow the velocity ``modes @ coefficients`` for
    one unit of time. Outside the organ space follows smoothly.
    """

    origin_mm: Float32[np.ndarray, " 3"]  # node (0, 0, 0) of the lattice
    spacing_mm: float
    center_ct: Float64[np.ndarray, " 3"]  # the organ's centre of mass
    # Displacement at each node; a unit coefficient moves the organ by 1 mm rms. Free of rigid
    # motion; the last one swells, the others keep volume.
    modes: Float32[np.ndarray, "i j k 3 m"]
    states: Float32[np.ndarray, "s m"]  # the library
    # Displacements by forces on the surface (``modes.compliance_modes``); none of a scene's body.
    compliance: Float32[np.ndarray, "i j k 3 c"] | None = None

    def __post_init__(self) -> None:
        shapes = (self.modes.ndim, self.states.ndim, self.modes.shape[-1])
        if shapes != (5, 2, self.states.shape[-1]) or min(self.modes.shape[:3]) < 2:
            raise InputError(
                f"a body's modes {self.modes.shape} and states {self.states.shape} do not fit; "
                "build it again."
            )
        if self.compliance is not None and self.compliance.shape[:4] != self.modes.shape[:4]:
            raise InputError(f"a body's compliance {self.compliance.shape} does not fit its modes.")
        for name in ("origin_mm", "center_ct", "modes", "states", "compliance"):
            array = getattr(self, name)
            if array is None:
                continue
            if not np.isfinite(array).all():
                raise InputError(f"a body's {name} has NaN or infinite values; build it again.")
            array.flags.writeable = False

    @cached_property
    def mean(self) -> Float64[np.ndarray, " m"]:
        return self.states.mean(0, dtype=float)

    @cached_property
    def covariance(self) -> Float64[np.ndarray, "m m"]:
        """Covariance of the library, with a small ridge that keeps it invertible."""
        return np.cov(self.states.T.astype(float)) + _RIDGE * np.eye(self.states.shape[1])

    @cached_property
    def compliant(self) -> ElasticBody:
        """The body with its compliance as the last of its modes. Raises InputError: it has none."""
        if self.compliance is None:
            raise InputError("the body has no compliance; build it again.")
        modes = np.concatenate([self.modes, self.compliance], axis=-1)
        none = np.zeros((len(self.states), self.compliance.shape[-1]), np.float32)
        return replace(self, modes=modes, states=np.concatenate([self.states, none], axis=1))

    @cached_property
    def precision(self) -> Float64[np.ndarray, "m m"]:
        return np.linalg.inv(self.covariance)

    def velocity(self, coefficients: Float[np.ndarray, " m"]) -> Field:
        """The field that points follow, mm per unit of time."""
        return combine(self.modes, np.asarray(coefficients, np.float32))

    def forward(self, coefficients: Float[np.ndarray, " m"], points_ct: Points) -> Moved:
        """Points in or near the undeformed organ in a state; of negative coefficients, back."""
        return self.follow(self.velocity(coefficients), points_ct)

    def follow(self, velocity_mm: Field, points: Points, steps: int | None = None) -> Moved:
        """Points moved for one unit of time by a velocity field on this body's lattice, integrated
        in ``steps`` (None: as many as the field needs)."""
        if steps is None:
            steps = steps_for(velocity_mm, self.spacing_mm)
        return follow(self._field(velocity_mm), np.ascontiguousarray(points, np.float32), steps)

    def modes_at(self, points: Points) -> Float32[np.ndarray, "n 3 m"]:
        """The modes at points of the CT frame."""
        place, field = np.ascontiguousarray(points, np.float32), self.mode_field
        axes = np.eye(3, dtype=np.float32)
        along = [project(field, place, np.tile(axis, (len(place), 1))) for axis in axes]
        return np.stack(along, 1)

    @property
    def mode_field(self) -> LatticeField:
        """The modes on their lattice."""
        return self._field(self.modes)

    def _field(self, values: Float32[np.ndarray, "i j k ..."]) -> LatticeField:
        return LatticeField(values, self.origin_mm, np.float32(self.spacing_mm))

    def to_arrays(self) -> dict[str, np.ndarray]:
        arrays = {name: getattr(self, name) for name in _ARRAYS}
        return {name: np.asarray(value) for name, value in arrays.items() if value is not None}

    @classmethod
    def from_arrays(cls, arrays: dict[str, np.ndarray]) -> ElasticBody:
        """The inverse of ``to_arrays``. Raises InputError: an array is missing or misshapen."""
        missing = [name for name in _ARRAYS if name not in arrays]
        if missing:
            raise InputError(f"a body lacks {', '.join(missing)}; build it again.")
        names = ("origin_mm", "modes", "states", "compliance")
        origin_mm, modes, states, compliance = (
            np.ascontiguousarray(arrays[name], np.float32) for name in names
        )
        spacing_mm, center_ct = float(arrays["spacing_mm"]), np.asarray(arrays["center_ct"], float)
        return cls(origin_mm, spacing_mm, center_ct, modes, states, compliance)


def build_body(
    anatomy_ct: Anatomy, up_lps: tuple[float, float, float], config: BodyConfig, seed: int
) -> ElasticBody:
    """Finite elements of an organ, its modes, and a library of states under random loads.

    Takes seconds on one core. The same arguments give the same body on the same machine; on others
    last digits differ, and with them possibly the order of modes of equal energy.

    Raises:
        InputError: a surface that turns inward, or a configuration that allows no body.
    """
    from tumortrack.organ.loads import random_states
    from tumortrack.organ.modes import compliance_modes

    rng = np.random.default_rng([seed, 0xE1A57])
    up = unit(np.asarray(up_lps, float))
    reduced = reduced_organ(anatomy_ct, up, config, rng)
    with ThreadPoolExecutor(1) as pool:  # while states are drawn, which takes one core
        compliance = pool.submit(
            compliance_modes, reduced.solid, reduced.patches, _COMPLIANCE_MODES
        )
        states = random_states(reduced, up, config.bed_anywhere, rng, config.states)
    if len(states) < config.states:
        raise InputError(
            f"only {len(states)} of {2 * config.states} loads leave this organ at rest; its "
            "surface may be torn. Look at the case's pictures, and prepare it again."
        )
    return body_of(reduced, np.array(states, np.float32), compliance.result())


def length_over_kidney(anatomy_ct: Anatomy) -> float:
    """An organ's length over a typical kidney's, to scale what is meant for kidneys (there 1)."""
    kidney = anatomy_ct.organ_kind.name == KIDNEY.name
    return 1.0 if kidney else anatomy_ct.organ.longest_mm / _KIDNEY_MM


def reduced_organ(
    anatomy_ct: Anatomy, up: Float64[np.ndarray, " 3"], config: BodyConfig, rng: np.random.Generator
) -> ReducedModel:
    """An organ in the space of its modes; ``up`` is a unit vector. Raises as ``build_body``."""
    from tumortrack.organ.finite import ElementLattice, LatticeSolid
    from tumortrack.organ.modes import ReducedModel, modes_of, patches_of, random_loads

    organ = anatomy_ct.organ
    if organ.volume_mm3 <= 0:
        raise InputError("the organ's surface has no volume inside; its faces must turn outward.")
    if not (
        config.cells >= 50
        and 2 <= config.modes <= min(config.responses, config.cells)
        and config.states >= 2
        and config.patches >= 20
        and 0 <= config.poisson < 0.5
        and len(config.contrasts) > 0
        and min(config.contrasts) > 0
    ):
        raise InputError(
            f"{config} makes no body: it needs at least 50 cells, 20 patches, 2 states, 2 modes "
            "(no more than responses and cells), contrasts above 0, a Poisson ratio in 0..0.5."
        )
    spacing_mm = float(np.cbrt(organ.volume_mm3 / config.cells))
    lattice = ElementLattice.around(organ.box_mm, spacing_mm)
    solid = LatticeSolid(anatomy_ct, lattice, config.poisson)
    patches = patches_of(organ, config.patches, rng)
    loads = random_loads(solid, patches, up, config.responses, rng)
    modes = modes_of(solid, patches, config.modes, config.contrasts, loads)
    return ReducedModel(solid, modes, patches, length_over_kidney(anatomy_ct))


def body_of(
    reduced: ReducedModel,
    states: Float32[np.ndarray, "s m"],
    compliance: Float64[np.ndarray, "f c"] | None = None,
) -> ElasticBody:
    """The body of a reduced organ with these states as its library."""
    solid, lattice = reduced.solid, reduced.solid.lattice
    place = lattice.origin_mm.astype(np.float32), lattice.spacing_mm, solid.center_mm
    modes = solid.spread(reduced.modes).astype(np.float32)
    more = None if compliance is None else solid.spread(compliance).astype(np.float32)
    return ElasticBody(*place, modes, states, more)
