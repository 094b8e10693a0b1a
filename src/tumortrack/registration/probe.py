"""What is wrong in all images of a tracked probe alike, found beside the organ's motion.

Images are late, and lengths in them are longer or shorter than their pixels say: the one shifts
places along the probe's path, the other along the beam. Both, and a shift that all places share,
are unknowns beside the motion, of which the prior is what else is known. The most likely values
minimise (Gauss-Newton)

    the sum of weight * (distance of a place to its part's surface)^2
    + the squared Mahalanobis distances of motion, shift and errors from their priors' means.

What a recording leaves open, as the lag of a single steady sweep without anything else, remains in
the deviations of its places (``believed``): the pose must not take it up.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Bool, Float64

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points
from tumortrack.core.report import ProbeReport
from tumortrack.core.ultrasound import NO_ERRORS, ImageErrors, ProbeRecording
from tumortrack.registration.evidence import SURFACE_MM, EvidenceTerms
from tumortrack.registration.motion import ElasticMotion

# Of lag (s), depth and width before anything is known: of real recordings one was late by half a
# second, and depths were 8 to 12 % off; widths are the transducer's, and hardly depend on tissue.
PRIOR_STD = np.array([0.5, 0.1, 0.05])
_STARTS_S = (0.0, -0.6, 0.6)  # of the lag: a descent from farther off may end beside the right one
# Of numerical derivatives; of the lag over so many seconds that a tracker's noise, which differs
# from pose to pose, does not look like a probe that changes its speed, and so tells the lag.
_DIFFERENCE = np.array([0.5, 0.005, 0.005])
_STEPS, _ROBUST_STEPS = 20, 6  # at most; so many before places are judged as true or false
_ENOUGH = 0.002  # of the priors' deviations: the last step
_FEWEST = 0.5  # share of the places that must have a pose
_LARGEST_MM = 20.0  # of what a place may be off: farther away it tells nothing


@dataclass(frozen=True, eq=False)
class FoundErrors:
    """The most likely errors of a recording and their ``covariance``; ``cost``: -2 log of their
    probability, up to a constant."""

    errors: ImageErrors
    covariance: Float64[np.ndarray, "3 3"]
    cost: float

    def left_open_mm(self, recording: ProbeRecording) -> tuple[float, float]:
        """Standard deviations that they leave: of all places alike, along the worst axis, and of
        each beside that, along any."""
        places_mm, by_errors = _places(recording, self.errors)
        by_errors = by_errors[np.isfinite(places_mm).all(1)]
        mean = by_errors.mean(0)
        away = by_errors - mean
        alike_mm2 = np.linalg.eigvalsh(mean @ self.covariance @ mean.T)[-1]
        own_mm2 = np.einsum("nke,ef,nkf->n", away, self.covariance, away).mean() / 3
        return float(np.sqrt(alike_mm2)), float(np.sqrt(own_mm2))

    def report(self, recording: ProbeRecording, alone: bool) -> ProbeReport:
        """``alone``: no camera saw the organ, so that what all places share shifts the answer."""
        lag, depth, width = np.sqrt(np.diag(self.covariance)).tolist()
        return ProbeReport(
            tool=recording.tool,
            places=len(recording.plane),
            planes=len(np.unique(recording.plane)),
            lag_s=self.errors.lag_s,
            lag_std_s=lag,
            depth=self.errors.depth,
            depth_std=depth,
            width=self.errors.width,
            width_std=width,
            shift_std_mm=self.left_open_mm(recording)[0] if alone else 0.0,
        )


UNKNOWN = FoundErrors(NO_ERRORS, np.diag(PRIOR_STD**2), 0.0)


def believed(recording: ProbeRecording, found: FoundErrors) -> ProbeRecording:
    """With the deviations that errors leave which are known so well: what they do to all places
    alike is shared, the rest is each one's."""
    alike_mm, own_mm = found.left_open_mm(recording)
    own_mm = min(math.hypot(recording.std_mm, own_mm), _LARGEST_MM)
    shared_mm = min(math.hypot(recording.shared_std_mm, alike_mm), _LARGEST_MM)
    return replace(recording, std_mm=own_mm, shared_std_mm=shared_mm)


def find_errors(
    recording: ProbeRecording,
    motion: ElasticMotion,
    precision: Float64[np.ndarray, "p p"],
    off: Float64[np.ndarray, " p"],
) -> FoundErrors:
    """``motion`` lies ``off`` the mean of its prior, which is what is known without the recording
    and has this ``precision``."""
    smooth = recording.smoothed()
    starts = (ImageErrors(lag_s=lag_s) for lag_s in _STARTS_S)
    found = [_descend(smooth, motion, precision, off, start) for start in starts]
    best = min(found, key=lambda each: each.cost)
    return UNKNOWN if math.isinf(best.cost) else best


def _descend(
    recording: ProbeRecording,
    motion: ElasticMotion,
    of_motion: Float64[np.ndarray, "p p"],
    off_motion: Float64[np.ndarray, " p"],
    errors: ImageErrors,
) -> FoundErrors:
    count = len(of_motion)
    shared_mm = max(recording.shared_std_mm, 0.1)
    precision = np.diag([*[0.0] * count, *[shared_mm**-2] * 3, *PRIOR_STD**-2])
    precision[:count, :count] = of_motion
    off = np.concatenate([off_motion, np.zeros(3), errors])  # from the priors' means
    for step in range(_STEPS):
        places_mm, by_errors = _places(recording, errors)
        known = np.isfinite(places_mm).all(1)
        if known.mean() <= _FEWEST:
            return FoundErrors(errors, UNKNOWN.covariance, math.inf)
        places_mm, by_errors = places_mm[known] + off[count : count + 3], by_errors[known]
        terms = _terms(recording, motion, places_mm, known).at(motion)
        terms = terms.judged if step >= _ROBUST_STEPS else terms
        by_place = -terms.by_motion[:, :3] @ motion.rotation.T
        by_errors = np.einsum("nk,nke->ne", by_place, by_errors)
        rows = np.column_stack([terms.by_motion, by_place, by_errors])
        weighted = rows * terms.weights[:, None]
        curvature = weighted.T @ rows + precision
        slope = weighted.T @ terms.residuals_mm + precision @ off
        change = -np.linalg.solve(curvature, slope)
        # What no pose is known for may fit as well as the rest does.
        cost = float(terms.cost / known.mean() + off @ precision @ off)
        motion, off = motion.changed(change[:count]), off + change
        errors = ImageErrors(*off[count + 3 :].tolist())
        moved = np.abs(change[count + 3 :]) / PRIOR_STD
        if step > _ROBUST_STEPS and (moved < _ENOUGH).all():
            break
    # Places of one plane err together; how much is measured (clustered errors; Liang and Zeger
    # 1986, doi 10.1093/biomet/73.1.13).
    pulls = np.zeros((int(terms.piece.max()) + 1, len(curvature)))
    np.add.at(pulls, terms.piece, weighted * (terms.residuals_mm + rows @ change)[:, None])
    inverse = np.linalg.inv(curvature)
    together = (inverse @ (pulls.T @ pulls + precision) @ inverse)[count + 3 :, count + 3 :]
    # Not less than by the deviations that are stated.
    more = np.sqrt(np.maximum(np.diag(inverse)[count + 3 :] / np.diag(together), 1.0))
    return FoundErrors(errors, together * more * more[:, None], cost)


def _places(
    recording: ProbeRecording, errors: ImageErrors
) -> tuple[Points, Float64[np.ndarray, "n 3 3"]]:
    """And what each error does to them: nothing, where no pose is known beside theirs."""
    places_mm, by_errors = recording.places_mm(errors), list[Points]()
    for number, by in enumerate(_DIFFERENCE.tolist()):
        ends, known = list[Points](), np.zeros(len(places_mm))
        for sign in (-1, 1):
            changed = np.array(errors)
            changed[number] += sign * by
            moved_mm = recording.places_mm(ImageErrors(*changed.tolist()))
            inside = np.isfinite(moved_mm).all(1)
            ends.append(np.where(inside[:, None], moved_mm, places_mm))
            known += inside
        by_errors.append((ends[1] - ends[0]) / (by * np.maximum(known, 1))[:, None])
    return places_mm, np.stack(by_errors, axis=2)


def _terms(
    recording: ProbeRecording,
    motion: ElasticMotion,
    places_mm: Points,
    known: Bool[np.ndarray, " n"],
) -> EvidenceTerms:
    """Of some of its places; a plane is a piece."""
    names = list(motion.shape.anatomy_ct.closed)
    if unknown := sorted({*recording.parts} - {*names}):
        raise InputError(f"{recording.tool} shows {unknown[0]!r}; this organ has {names}.")
    numbers = np.array([names.index(name) for name in recording.parts])
    zeros, none = np.zeros(len(places_mm)), np.zeros((0, 3))
    return EvidenceTerms(
        places_mm=places_mm,
        part=numbers[recording.part[known]],
        offset_mm=zeros,
        free=zeros.astype(bool),
        points_ct=none,
        points_mm=none,
        std_mm=zeros + np.hypot(recording.std_mm, SURFACE_MM),
        piece=recording.plane[known],
        tool=zeros.astype(int),
        shared_mm=np.zeros(1),
    )
