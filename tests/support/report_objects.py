"""Balls as organ, tumor, scene and estimate of an evaluation."""

from __future__ import annotations

import numpy as np
import trimesh

from tumortrack.core.estimate import Estimate
from tumortrack.core.report import FitReport
from tumortrack.core.types import Anatomy, CameraLabels, Mesh, OccupancyCloud, SensorCloud
from tumortrack.io.scene_folder import Scene
from tumortrack.report.metrics import label_grid


def ball(radius_mm, center_mm=(0.0, 0.0, 0.0), subdivisions=3):
    solid = trimesh.creation.icosphere(subdivisions, radius_mm)
    return Mesh(solid.vertices + np.array(center_mm), solid.faces)


def anatomy(shift_mm=(0.0, 0.0, 0.0)):
    middle = np.array(shift_mm) + np.array([0, 0, 130])
    return Anatomy((ball(22, middle), ball(7, middle + np.array([6, 3, -2]))))


def scene():
    points = anatomy().organ.vertices_mm
    return Scene(SensorCloud(points[points[:, 2] < 130]), anatomy())


def estimate_of(parts, without=()):
    camera_from_index = np.eye(4)
    camera_from_index[:3, 3] = parts.organ.box_mm[0] - 2.5
    labels = label_grid(parts, camera_from_index, (50, 50, 50))
    for name in without:
        labels[labels == parts.names.index(name) + 1] = 1
    points = np.argwhere(labels) + camera_from_index[:3, 3]
    return Estimate(
        OccupancyCloud(points, labels[labels > 0], np.ones(len(points))),
        CameraLabels(labels, camera_from_index),
        {n: m for n, m in zip(parts.names, parts.parts, strict=True) if n not in without},
        FitReport(timings={"search": 0.002}),
    )
