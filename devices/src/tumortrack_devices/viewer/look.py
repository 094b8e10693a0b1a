"""Views of the scene, its light, and the point under a click."""

from __future__ import annotations

from collections.abc import Iterable
from typing import TYPE_CHECKING, Literal

import numpy as np
from jaxtyping import Float

from tumortrack.core.geometry import Affine, unit
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import Mesh
from tumortrack.live.values import ControlState

if TYPE_CHECKING:
    from viser import CameraHandle, ClientHandle, ViserServer

View = Literal["organ", "tools", "arms"]

_FIRST_LOOK_MM = 130.0
_FOV_RADIANS = 0.9  # vertically; more in a narrow page, to keep this horizontally:
_LEAST_ACROSS, _SAME_RADIANS = 0.8, 1e-3
_ROUND_CUTS_MM = 120.0  # shown around the cuts: the organ, both tools
# Direction onto a workcell: from the front, somewhat from the left and above; its frame's z is up.
_OVERVIEW_FROM, _UP = np.array([-0.45, -1.0, 0.6]), np.array([0.0, 0.0, 1.0])
_ROOM = 0.85  # a cell is wide and flat: its box needs less room than its sphere
_NEAR_MM, _FAR_MM = 0.5, 20_000.0  # viser draws its background 1 before the eye
# In the camera's frame: one above and left of the camera, a weaker one behind the organ.
_LIGHTS = (("/light", 2.6, (-60.0, -120.0, -130.0)), ("/light_behind", 1.5, (60.0, -120.0, 130.0)))

_STEP_MM = 1.0  # along a line of sight: a tumor is thicker
_SAME_MM = 2.0  # of points this near the ray the foremost is meant
_MISSED_MM = 10.0


class Viewpoint:
    """New visitors look from the depth camera's position along its axis, its y axis down."""

    def __init__(self, server: ViserServer, pose: Affine) -> None:
        self._server, self._pose = server, pose  # published_from_camera
        self._aimed = False
        self._eye_mm = pose[:3, 3]  # of the visitor who moved last
        self._organ_mm = pose[:3, 3] + _FIRST_LOOK_MM * pose[:3, 2]
        self._control: ControlState | None = None  # the latest
        server.scene.set_up_direction(-pose[:3, 1])
        first = server.initial_camera
        first.fov, first.near, first.far = _FOV_RADIANS, _NEAR_MM, _FAR_MM
        self._begin_with("organ")
        # Light from the camera's side, as in an endoscope, some from behind, no shadows.
        server.scene.configure_default_lights(False)
        server.scene.configure_environment_map(None)
        server.scene.add_light_ambient("/ambient", intensity=0.9)
        for name, intensity, position in _LIGHTS:
            x, y, z = (pose[:3, :3] @ position).tolist()
            server.scene.add_light_directional(name, intensity=intensity, position=(x, y, z))
        server.on_client_connect(self._follow)

    def aim(self, depth_mm: float, pose: Affine) -> None:
        """From now on rotate about the organ, as its distance and the camera's pose are known."""
        if self._aimed:
            return
        self._aimed, moved = True, not np.array_equal(pose, self._pose)
        self._pose, self._organ_mm = pose, pose[:3, 3] + depth_mm * pose[:3, 2]
        if self._control is None:  # else they look at the whole workcell
            self._begin_with("organ")
            for client in self._server.get_clients().values():
                if moved:
                    self.turn(client, "organ")
                client.camera.look_at = self._organ_mm

    def show_control(self, control: ControlState) -> None:
        """The present workcell; at the first one all visitors look at its tools."""
        first, self._control = self._control is None, control
        if first:
            self._begin_with("tools")
            for client in self._server.get_clients().values():
                self.turn(client, "tools")

    def _begin_with(self, towards: View) -> None:
        """The view of new visitors."""
        camera = self._server.initial_camera
        camera.position, camera.look_at, camera.up = self._view(towards)

    def turn(self, client: ClientHandle, towards: View) -> None:
        """Turn a visitor's view to the organ, as the camera sees it, to the tools around the cuts,
        or to the whole workcell."""
        eye_mm, middle_mm, up = self._view(towards)
        with client.atomic():
            client.camera.up_direction = up
            client.camera.position = eye_mm
            client.camera.look_at = middle_mm

    def _view(self, towards: View) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, target, up."""
        box_mm = None if towards == "organ" or self._control is None else self._control.box_mm
        lines = [] if self._control is None else self._control.drawn_lines
        if towards == "tools" and lines:
            points_mm = np.concatenate([line.points_mm for line in lines])
            room_mm = np.array([[-_ROUND_CUTS_MM], [_ROUND_CUTS_MM]])
            box_mm = np.stack([points_mm.min(0), points_mm.max(0)]) + room_mm
        if box_mm is None:
            return self._pose[:3, 3], self._organ_mm, -self._pose[:3, 1]
        center_mm = box_mm.mean(0)
        radius_mm = float(np.linalg.norm(np.ptp(box_mm, axis=0))) / 2
        away_mm = _ROOM * radius_mm / np.tan(_FOV_RADIANS / 2) * unit(_OVERVIEW_FROM)
        return center_mm + away_mm, center_mm, _UP

    def last_drawn(self, surface: Mesh) -> Mesh:
        """The same triangles, and two unused vertices that put the centre of all into the eye of
        the visitor who moved last. Browsers draw translucent surfaces in the order of their
        centres: the organ must be the last, or it covers the margins inside."""
        half = np.abs(surface.vertices_mm - self._eye_mm).max(0)
        corners = [self._eye_mm - half, self._eye_mm + half]
        return Mesh(np.concatenate([surface.vertices_mm, corners]), surface.faces)

    def hidden(self, place_mm: Float[np.ndarray, " 3"], behind: Iterable[Mesh]) -> bool:
        """Whether a closed surface lies between a place and the eye of the visitor who moved
        last."""
        way_mm = self._eye_mm - place_mm
        steps_mm = np.arange(_STEP_MM, np.linalg.norm(way_mm), _STEP_MM)
        line_mm = place_mm + steps_mm[:, None] * unit(way_mm)
        return any(contains(surface, line_mm).any() for surface in behind)

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
    """The point nearest a ray, in the same frame; of several under it the foremost. None if the
    nearest is more than 10 mm off, or behind the ray's origin."""
    offset = points_mm - origin_mm
    along = offset @ (direction / np.linalg.norm(direction))
    squared = np.where(along > 0, np.maximum((offset**2).sum(1) - along**2, 0), np.inf)
    nearest = squared.min(initial=np.inf)
    if nearest > _MISSED_MM**2:
        return None
    under = squared <= max(_SAME_MM**2, nearest)
    return points_mm[np.where(under, along, np.inf).argmin()]
