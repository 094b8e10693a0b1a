"""The views of the scene, its light, and which point a click means."""

from __future__ import annotations

from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from tumortrack.core.types import Mesh
from tumortrack.live.values import Workcell

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle, ViserServer

View = Literal["organ", "tools", "arms"]

_FIRST_LOOK_MM = 130.0
_FOV_RADIANS = 0.9  # up and down; of a narrow page more, so that it sees as much sideways:
_LEAST_ACROSS, _SAME_RADIANS = 0.8, 1e-3
_ROUND_CUTS_MM = 120.0  # what is looked at round the cuts: the organ, both tools
# Onto a workcell: from before it, somewhat from the left and from above; its frame's z is up.
_OVERVIEW_FROM, _UP = np.array([-0.45, -1.0, 0.6]), np.array([0.0, 0.0, 1.0])
_ROOM = 0.85  # a cell is wide and flat: its box fits into less than its sphere
_NEAR_MM, _FAR_MM = 0.5, 20_000.0  # viser draws its background 1 before the eye
# In the camera's frame: one above the camera and left of it, a weaker one from behind the organ.
_LIGHTS = (("/light", 2.6, (-60.0, -120.0, -130.0)), ("/light_behind", 1.5, (60.0, -120.0, 130.0)))

_SAME_MM = 2.0  # points this near the ray are all under the pointer: the foremost is meant
_MISSED_MM = 10.0


class Viewpoint:
    """New visitors look from the depth camera's place along its axis, its y axis down."""

    def __init__(self, server: ViserServer, way: Float[np.ndarray, "4 4"]) -> None:
        self._server, self._way = server, way  # published_from_camera
        self._aimed = False
        self._eye_mm = way[:3, 3]  # of whoever moved last
        self._organ_mm = way[:3, 3] + _FIRST_LOOK_MM * way[:3, 2]
        self._cell: Workcell | None = None  # the last there was
        server.scene.set_up_direction(-way[:3, 1])
        first = server.initial_camera
        first.fov, first.near, first.far = _FOV_RADIANS, _NEAR_MM, _FAR_MM
        first.position, first.look_at, first.up = self._view("organ")
        # Light from the camera's side, as an endoscope gives it, some from behind, no shadows.
        server.scene.configure_default_lights(False)
        server.scene.configure_environment_map(None)
        server.scene.add_light_ambient("/ambient", intensity=0.9)
        for name, intensity, place in _LIGHTS:
            x, y, z = (way[:3, :3] @ place).tolist()
            server.scene.add_light_directional(name, intensity=intensity, position=(x, y, z))
        server.on_client_connect(self._follow)

    def aim(self, depth_mm: float, way: Float[np.ndarray, "4 4"]) -> None:
        """Turn about the organ from now on, once its distance is known, and the camera's place."""
        if self._aimed:
            return
        self._aimed, moved = True, not np.array_equal(way, self._way)
        self._way, self._organ_mm = way, way[:3, 3] + depth_mm * way[:3, 2]
        if self._cell is None:  # else they look at the whole workcell
            camera = self._server.initial_camera
            camera.position, camera.look_at, camera.up = self._view("organ")
            for client in self._server.get_clients().values():
                if moved:
                    self.turn(client, "organ")
                client.camera.look_at = self._organ_mm

    def oversee(self, cell: Workcell) -> None:
        """There is a workcell: when it comes first, all look at where it works."""
        first, self._cell = self._cell is None, cell
        if first:
            camera = self._server.initial_camera
            camera.position, camera.look_at, camera.up = self._view("tools")
            for client in self._server.get_clients().values():
                self.turn(client, "tools")

    def turn(self, client: ClientHandle, towards: View) -> None:
        """Let a visitor look at the organ from the camera's place, at the tools round the cuts, or
        at the whole workcell."""
        eye_mm, middle_mm, up = self._view(towards)
        with client.atomic():
            client.camera.up_direction = up
            client.camera.position = eye_mm
            client.camera.look_at = middle_mm

    def _view(self, towards: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Eye, what it looks at, up."""
        box_mm = None if towards == "organ" or self._cell is None else self._cell.box_mm
        lines = [] if self._cell is None else self._cell.drawn_lines
        if towards == "tools" and lines:
            points_mm = np.concatenate([line.points_mm for line in lines])
            room_mm = np.array([[-_ROUND_CUTS_MM], [_ROUND_CUTS_MM]])
            box_mm = np.stack([points_mm.min(0), points_mm.max(0)]) + room_mm
        if box_mm is None:
            return self._way[:3, 3], self._organ_mm, -self._way[:3, 1]
        middle_mm = box_mm.mean(0)
        radius_mm = float(np.linalg.norm(np.ptp(box_mm, axis=0))) / 2
        away = _OVERVIEW_FROM / np.linalg.norm(_OVERVIEW_FROM)
        return middle_mm + _ROOM * radius_mm / np.tan(_FOV_RADIANS / 2) * away, middle_mm, _UP

    def last_drawn(self, surface: Mesh) -> Mesh:
        """The same triangles, and two idle vertices that put the middle of all into the eye of
        whoever moved last. Browsers draw translucent surfaces in the order of their middles: the
        organ must be the last, or it covers the margins that lie within."""
        half = np.abs(surface.vertices_mm - self._eye_mm).max(0)
        corners = [self._eye_mm - half, self._eye_mm + half]
        return Mesh(np.concatenate([surface.vertices_mm, corners]), surface.faces)

    def _follow(self, client: ClientHandle) -> None:
        def moved(camera: CameraHandle) -> None:
            self._eye_mm = camera.position
            across = 2 * np.arctan(np.tan(_LEAST_ACROSS / 2) / camera.aspect)
            if abs(camera.fov - (fov := max(_FOV_RADIANS, float(across)))) > _SAME_RADIANS:
                camera.fov = fov

        moved(client.camera)
        client.camera.on_update(moved)


def point_under(
    points_mm: Float[np.ndarray, "n 3"],
    origin_mm: Float[np.ndarray, " 3"],
    direction: Float[np.ndarray, " 3"],
) -> Float[np.ndarray, " 3"] | None:
    """The point nearest a ray, all in one frame; of several under it the foremost. None if the
    nearest is more than 10 mm off, or behind the ray's origin."""
    offset = points_mm - origin_mm
    along = offset @ (direction / np.linalg.norm(direction))
    squared = np.where(along > 0, np.maximum((offset**2).sum(1) - along**2, 0), np.inf)
    nearest = squared.min(initial=np.inf)
    if nearest > _MISSED_MM**2:
        return None
    under = squared <= max(_SAME_MM**2, nearest)
    return points_mm[np.where(under, along, np.inf).argmin()]
