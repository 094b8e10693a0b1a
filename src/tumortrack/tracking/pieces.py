"""Which piece of an image is the organ: the one in which it is found."""

from __future__ import annotations

import time
from collections.abc import Callable, Sequence
from dataclasses import replace

import numpy as np

from tumortrack.assessment.bound import POOR_MM
from tumortrack.assessment.sight import log_likelihood
from tumortrack.core.assessment import deciding
from tumortrack.core.errors import NoEstimate, NotThisOrgan
from tumortrack.core.estimate import Estimate
from tumortrack.core.types import DepthFrame, View

_UNDETERMINED = 2.0  # times the radius that makes an answer poor
_BESIDE_MM, _SAME_MM = 15.0, 2.0  # from a flap to its rest; from a point to others of its piece
_ELSEWHERE = "fit", "outliers", "seen_through", "size"  # checks that speak for another piece


def select_piece(
    views: Sequence[View], located: Callable[[Sequence[View]], Estimate], most: int | None = None
) -> tuple[Estimate, Sequence[View]]:
    """The estimate in the first view's points or, where these are not the organ, in another piece
    of its image (``SensorCloud.others``, up to ``most``); and the views with that piece.
    ``located``: finds and judges it. Raises NotThisOrgan: none is the organ."""
    found: list[tuple[Estimate, Sequence[View]]] = []
    first: NotThisOrgan | None = None
    main, start_s = views[0], time.perf_counter()
    alone = main.full_view is main.cloud
    for number, cloud in enumerate((main.cloud, *main.cloud.others[:most])):
        tried: Sequence[View] = (
            replace(main, cloud=cloud, full_view=cloud if alone else main.full_view),
            *views[1:],
        )
        try:
            estimate = located(tried).reporting(piece=number)
        except NotThisOrgan as error:
            first = first or error
            continue
        except NoEstimate:
            if not number:
                raise
            continue  # another piece that cannot be an organ
        found.append((estimate, tried))
        if _sure(estimate) or (not number and not _doubted(estimate)):
            break
    if first is not None and not found:
        raise first
    estimate, tried = found[0] if len(found) == 1 else max(found, key=_likelihood)
    timings = estimate.report.timings
    if (other_s := time.perf_counter() - start_s - timings["total"]) > 0 and number:
        total_s = timings["total"] + other_s
        estimate = estimate.reporting(timings={**timings, "pieces": other_s, "total": total_s})
    return estimate, tried


def with_flap_joined(view: View) -> View:
    """Of an organ that was cut: where pieces of the image lie beside the likeliest, they may be one
    organ, a flap and the rest; all of them together are tried first."""
    from scipy.spatial import cKDTree

    cloud = view.cloud
    if not cloud.others or not len(cloud.candidates_mm):
        return view
    mine = cKDTree(cloud.points_mm)
    beside = [
        other.points_mm
        for other in cloud.others
        if mine.query(other.points_mm, distance_upper_bound=_BESIDE_MM)[0].min() < np.inf
    ]
    if not beside:
        return view
    away_mm = cKDTree(np.concatenate(beside)).query(cloud.candidates_mm)[0]
    near = away_mm < _SAME_MM  # candidates are as dense as points
    joined = replace(
        cloud,
        points_mm=np.concatenate([cloud.points_mm, cloud.candidates_mm[near]]),
        candidates_mm=cloud.candidates_mm[~near],
        others=(replace(cloud, others=()), *cloud.others),
    )
    alone = view.full_view is cloud
    return replace(view, cloud=joined, full_view=joined if alone else view.full_view)


def _doubted(estimate: Estimate) -> bool:
    return estimate.finding is not None and estimate.finding.check in _ELSEWHERE


def _sure(estimate: Estimate) -> bool:
    """Whether nothing speaks for another piece, and the tumors' places are determined."""
    bounds = deciding(estimate.assessment.bounds).values()
    bounds_mm = [bound.error_bound95_mm for bound in bounds]
    return not _doubted(estimate) and max(bounds_mm, default=0.0) < _UNDETERMINED * POOR_MM


def _likelihood(found: tuple[Estimate, Sequence[View]]) -> tuple[bool, float]:
    """Whether it is sure; and of the image with the organ there. Of a cloud the points that do not
    stray are counted."""
    estimate, (view, *_) = found
    if isinstance(view.full_view, DepthFrame):
        return _sure(estimate), log_likelihood(estimate.organ_mesh, view)
    cost = estimate.report.fit_cost
    outliers = 0.0 if cost is None else cost.outliers
    return _sure(estimate), len(view.cloud.points_mm) * (1 - outliers)
