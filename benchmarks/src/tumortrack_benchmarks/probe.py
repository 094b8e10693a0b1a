"""Recordings of a tracked ultrasound probe that sweeps over an organ forth and back, simulated: in
each image the borders of parts, as a reader draws them. Independent of how they are fitted."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from jaxtyping import Float64
from scipy.spatial.transform import Rotation

from tumortrack.core.geometry import Affine, rigid, transform_points, unit
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.core.ultrasound import ImageErrors, ProbeRecording, spread_px

_PIXEL_MM, _WIDE_PX = 0.4, 260
_GAP_MM = 12.0  # from the probe to the organ
_PERIODS_S = 7.0, 11.0  # of a hand's slow turns, with any phase


@dataclass(frozen=True, kw_only=True)
class Sweep:
    """``passes`` over four fifths of the organ's length, each in the other direction.

    Attributes:
        errors: of all images alike.
        tilt_deg: by which a hand turns the probe on the way.
        pose_std_mm: of the tracker, each pose by itself.
        reader_std_mm: of a drawn border, smooth along it, each image by itself.
        calibration_std: of the image's place in the probe, mm, and a hundredth of it in rad.
    """

    errors: ImageErrors
    passes: int = 3
    mm_per_s: float = 10.0
    hz: float = 20.0
    tilt_deg: float = 8.0
    pose_std_mm: float = 0.2
    reader_std_mm: float = 0.5
    calibration_std: float = 0.5


def record(organ: Anatomy, sweep: Sweep, rng: np.random.Generator) -> ProbeRecording:
    """Of an organ at rest, in the frame of its surfaces; ``parts``: it and its tumors."""
    vertices = organ.organ.vertices_mm.astype(float)
    middle = vertices.mean(0)
    along = np.linalg.svd(vertices - middle, full_matrices=False)[2][0]
    deep = unit((turn := rng.normal(size=3)) - along * (turn @ along))
    across = np.cross(deep, along)
    low, high = np.percentile((vertices - middle) @ along, (10, 90))
    count = int(sweep.passes * (high - low) / sweep.mm_per_s * sweep.hz)
    stamps_s = np.arange(count) / sweep.hz
    share = stamps_s * sweep.mm_per_s / (high - low) % 2
    ways_mm = low + (high - low) * np.minimum(share, 2 - share)
    turns = [
        np.deg2rad(sweep.tilt_deg) * np.sin(2 * np.pi * (stamps_s / period + rng.uniform()))
        for period in _PERIODS_S
    ]
    rotations = (
        np.column_stack([across, deep, np.cross(across, deep)])
        @ Rotation.from_rotvec(np.column_stack([turns[0], np.zeros(count), turns[1]])).as_matrix()
    )
    face_mm = ((vertices - middle) @ deep).min() - _GAP_MM
    starts = middle + ways_mm[:, None] * along + face_mm * deep
    starts -= rotations[:, :, 0] * _WIDE_PX * _PIXEL_MM / 2
    poses = np.array([rigid(*each) for each in zip(rotations, starts, strict=True)])
    found = [
        (plane, part, _drawn(section_mm(mesh, pose), sweep.reader_std_mm, rng))
        for plane, pose in enumerate(poses)
        for part, mesh in enumerate(organ.parts)
    ]
    counts = [len(places) for _, _, places in found]
    plane, part = (np.repeat([each[n] for each in found], counts) for n in (0, 1))
    longer = 1 + np.array([sweep.errors.width, sweep.errors.depth])
    poses[:, :3, 3] += rng.normal(0, sweep.pose_std_mm, (count, 3))
    off = rng.normal(0, sweep.calibration_std, (2, 3))
    calibration = rigid(Rotation.from_rotvec(off[0] / 100).as_matrix(), off[1])
    return ProbeRecording(
        tool="probe",
        frame="Tracker",
        stamps_s=stamps_s,
        frame_from_probe=poses @ calibration,
        probe_from_image=np.diag([*(_PIXEL_MM / longer), 1.0, 1.0]),
        parts=organ.names,
        places_px=np.concatenate([places for _, _, places in found]) / _PIXEL_MM,
        part=part,
        plane=plane,
        image_stamps_s=stamps_s[plane] + sweep.errors.lag_s,
        shared_std_mm=1.0,
    )


def section_mm(mesh: Mesh, frame_from_image: Affine) -> Float64[np.ndarray, "n 2"]:
    """Where a surface's edges cross the plane of an image: across and deep."""
    there = transform_points(np.linalg.inv(frame_from_image), mesh.vertices_mm)
    edges = np.concatenate([mesh.faces[:, [n, (n + 1) % 3]] for n in range(3)])
    ends = there[edges]
    crossing = (ends[:, 0, 2] < 0) & (ends[:, 1, 2] >= 0)
    a, b = ends[crossing, 0], ends[crossing, 1]
    share = a[:, 2:] / (a[:, 2:] - b[:, 2:])
    return (a + share * (b - a))[:, :2]


def _drawn(
    places_mm: Float64[np.ndarray, "n 2"], std_mm: float, rng: np.random.Generator
) -> Float64[np.ndarray, "m 2"]:
    """As a reader draws them: off by a smooth wave around their middle."""
    places_mm = spread_px(places_mm, (1.0, 1.0))
    away = places_mm - places_mm.mean(0) if len(places_mm) else places_mm
    angle, wave = np.arctan2(away[:, 1], away[:, 0]), np.zeros(len(away))
    for number, (height, phase) in enumerate(
        zip(rng.normal(size=3), rng.uniform(size=3), strict=True), 1
    ):
        wave += height * np.cos(number * angle + 2 * np.pi * phase) * (2 / 3) ** 0.5
    lengths = np.maximum(np.linalg.norm(away, axis=1, keepdims=True), 1e-9)
    return places_mm + std_mm * wave[:, None] * away / lengths
