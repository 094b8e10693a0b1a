"""Which touches would tell most of a part's place: in closed form, from the fit's covariance.

A touch measures the organ's surface along its normal. By Kalman's update it narrows the covariance
of everything that moves with the surface there, before anybody touches it.
"""

from __future__ import annotations

import numpy as np

from tumortrack.core.report import NextTouch
from tumortrack.registration.motion import ElasticMotion

_CANDIDATES = 400  # places on the organ's surface
_ALREADY_MM = 10.0  # no two touches nearer to each other


def next_touches(
    motion: ElasticMotion, part: int, count: int = 3, std_mm: float = 1.0
) -> tuple[NextTouch, ...]:
    """The best places to touch in this order, each after those before it, for the middle of a part
    (its number); ``std_mm``: of a touch."""
    assert motion.covariance is not None
    name = motion.shape.anatomy_ct.names[part]
    vertices_ct = motion.shape.anatomy_ct.organ.vertices_mm
    some_ct = vertices_ct[:: max(1, len(vertices_ct) // _CANDIDATES)]
    places_mm = motion.carry(some_ct)
    rows = motion.residual_rows(places_mm)[:, :-1].astype(float)
    middle = motion.effects(motion.shape.middles_ct[[part]])[0]
    covariance, touches = motion.covariance, list[NextTouch]()
    free = np.ones(len(rows), bool)
    for _ in range(count):
        own = middle @ covariance @ middle.T
        shared = rows @ covariance  # what each touch shares with every unknown
        variances = (shared * rows).sum(1) + std_mm**2
        with_middle = shared @ middle.T
        after = own - with_middle[:, :, None] * with_middle[:, None, :] / variances[:, None, None]
        left = np.where(free, np.linalg.eigvalsh(after)[:, -1], np.inf)
        best = int(left.argmin())
        now_mm, then_mm = (float(np.sqrt(v)) for v in (np.linalg.eigvalsh(own)[-1], left[best]))
        x, y, z = map(float, places_mm[best])
        each = NextTouch(part=name, place_mm=(x, y, z), std_mm=now_mm, then_std_mm=then_mm)
        touches.append(each)
        covariance = covariance - np.outer(shared[best], shared[best]) / variances[best]
        free &= np.linalg.norm(places_mm - places_mm[best], axis=1) > _ALREADY_MM
    return tuple(touches)
