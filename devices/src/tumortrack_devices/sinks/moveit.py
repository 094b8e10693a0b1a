"""Organ, tumors and margins as obstacles in MoveIt's planning scene, over ROS 2."""

from __future__ import annotations

from dataclasses import replace
from typing import Any, ClassVar

import numpy as np

from tumortrack.core.colours import PICKED, Colour, name_colour
from tumortrack.core.errors import InputError
from tumortrack.core.types import Mesh
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult
from tumortrack_devices.network import Rate
from tumortrack_devices.ros.bus import Via, check_topic, open_bus
from tumortrack_devices.ros.messages import MM_PER_M, Messages, PointBlock
from tumortrack_devices.ros.results import ORGAN_OPACITY

SCENE = "moveit_msgs/msg/PlanningScene"
_MARGIN_OPACITY = 0.25
_HERE = {"orientation": {"w": 1.0}}


class MoveItSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="moveit"):
    """Changes of the scene on ``topic``, at most ``hz`` times a second (0: with every result).
    ``detail_mm``: approximate edges of the obstacles' triangles. ``margin_mm``: an obstacle around
    each tumor, the convex hull of all within that distance; 0: none."""

    target: ClassVar[str] = "topic"

    topic: str = "/planning_scene"
    hz: float = 1.0
    detail_mm: float = 3.0
    margin_mm: float = 0.0
    via: Via = "auto"

    def __post_init__(self) -> None:
        check_topic("topic", self.topic)
        limits = {"hz": (0, 100), "detail_mm": (0.5, 20), "margin_mm": (0, 50)}
        self.check_between("moveit:", **limits)

    def open(self, context: SinkContext) -> MoveItSink:
        if not context.published_frame.calibrated:
            raise InputError(
                "moveit: MoveIt does not know the camera's frame; give --frame FILE: where the "
                "camera is in the robot's."
            )
        return MoveItSink(self, context)


class MoveItSink:
    """Only good estimates move the obstacles, and nothing removes them, not even the end: a planner
    that forgot the organ would lead an arm through it."""

    def __init__(self, config: MoveItSinkConfig, context: SinkContext) -> None:
        self._config, self._context, self._rate = config, context, Rate(config.hz)
        self._bus = open_bus(config.via)
        self.notes = (self._bus.note,)
        self._send = self._bus.publisher(config.topic, SCENE)

    def publish(self, result: TrackingResult) -> None:
        if result.transformed is None or result.quality != "good" or not self._rate.due():
            return
        messages = self._bus.messages
        header = messages.header(result.stamp_ns, result.published_frame.frame_id)
        objects, colours = [], []
        for name, mesh, colour, opacity in self._obstacles(result.transformed.meshes):
            rgb = dict(zip("rgb", (value / 255 for value in colour), strict=True))
            colours.append({"id": name, "color": {**rgb, "a": opacity}})
            poses = {"pose": _HERE, "mesh_poses": [_HERE]}  # operation 0: ADD
            meshes = [_mesh_fields(messages, mesh)]
            objects.append({"id": name, "header": header, "meshes": meshes, **poses})
        scene = messages.make(
            SCENE,
            is_diff=True,
            robot_state={"is_diff": True},
            world={"collision_objects": objects},
            object_colors=colours,
        )
        self._send(messages.to_bytes(scene))

    def close(self) -> None:
        self._bus.close()

    def _obstacles(self, meshes: dict[str, Mesh]) -> list[tuple[str, Mesh, Colour, float]]:
        """Name, surface, colour and opacity of each, published frame."""
        organ, *tumors = self._context.parts
        obstacles = []
        for name, mesh in meshes.items():
            opacity = ORGAN_OPACITY if name == organ else 1.0
            coarse = coarser(mesh, self._config.detail_mm)
            obstacles.append((f"tumortrack/{name}", coarse, name_colour(name), opacity))
            if name in tumors and self._config.margin_mm:
                hull = widened_hull(mesh, self._config.margin_mm)
                obstacles.append((f"tumortrack/{name}/margin", hull, PICKED, _MARGIN_OPACITY))
        return obstacles


def coarser(mesh: Mesh, cell_mm: float) -> Mesh:
    """The surface with one vertex in each cube of space, the mean of those inside: open surfaces
    stay open, and no point moves by more than the cube's diagonal."""
    cubes = np.floor(mesh.vertices_mm / cell_mm).astype(np.int64)
    _, cube_of, sizes = np.unique(cubes, axis=0, return_inverse=True, return_counts=True)
    cube_of = cube_of.ravel()
    sums = [np.bincount(cube_of, axis) for axis in mesh.vertices_mm.T]
    faces = cube_of[mesh.faces]
    whole = (faces != np.roll(faces, 1, axis=1)).all(1)
    return Mesh(np.stack(sums, axis=1) / sizes[:, None], faces[whole])


def widened_hull(mesh: Mesh, margin_mm: float) -> Mesh:
    """A convex body that holds every point within ``margin_mm`` of the surface."""
    from trimesh import PointCloud
    from trimesh.creation import icosphere

    ball = icosphere(2)
    inscribed = np.einsum("ij,ij->i", ball.triangles_center, ball.face_normals).min()  # radius
    corners = PointCloud(mesh.vertices_mm).convex_hull.vertices
    points = corners[:, None] + ball.vertices * (margin_mm / inscribed)
    hull = PointCloud(points.reshape(-1, 3)).convex_hull
    return Mesh(hull.vertices, hull.faces)


def _mesh_fields(messages: Messages, mesh: Mesh) -> dict[str, Any]:
    """Of a shape_msgs/Mesh, metres."""
    triangle = messages.make("shape_msgs/msg/MeshTriangle")
    faces = [replace(triangle, vertex_indices=face) for face in mesh.faces.astype(np.uint32)]
    return {"vertices": PointBlock(mesh.vertices_mm / MM_PER_M), "triangles": faces}
