"""RViz's markers, and how often they are sent. Metres."""

from __future__ import annotations

import time
from typing import Any

import numpy as np
from jaxtyping import Float

from tumortrack.core.colours import Colour
from tumortrack.live.ros.messages import Messages

MARKERS = "visualization_msgs/msg/MarkerArray"
ADD, DELETE, DELETE_ALL = 0, 2, 3  # Marker's actions
LINE, TEXT, TRIANGLES = 4, 9, 11  # and types
# Markers vanish by themselves if nothing follows: a stopped loop leaves nothing that looks fresh.
MARKER_LIFETIME_S = 2.0


class Rate:
    """Lets things happen at most ``hz`` times a second; 0: each time."""

    def __init__(self, hz: float) -> None:
        self._every_s = 1 / hz if hz > 0 else 0.0
        self._next_s = 0.0

    def due(self) -> bool:
        now = time.monotonic()
        if now < self._next_s:
            return False
        self._next_s = now + self._every_s
        return True


def marker(messages: Messages, header: Any, **values: Any) -> Any:
    """A Marker with that header; its lifetime is ours."""
    seconds, rest = divmod(MARKER_LIFETIME_S, 1)
    lifetime = messages.make(
        "builtin_interfaces/msg/Duration", sec=int(seconds), nanosec=round(rest * 1e9)
    )
    return messages.make(
        "visualization_msgs/msg/Marker", header=header, lifetime=lifetime, **values
    )


def pose(
    messages: Messages,
    position_m: Float[np.ndarray, " 3"],
    wxyz: Float[np.ndarray, " 4"] | None = None,
) -> Any:
    """A Pose; not turned, where no quaternion is given."""
    turn = {"w": 1.0} if wxyz is None else dict(zip("wxyz", wxyz.tolist(), strict=True))
    return messages.make(
        "geometry_msgs/msg/Pose",
        position=point(messages, position_m),
        orientation=messages.make("geometry_msgs/msg/Quaternion", **turn),
    )


def point(messages: Messages, position_m: Float[np.ndarray, " 3"]) -> Any:
    x, y, z = (float(v) for v in position_m)
    return messages.make("geometry_msgs/msg/Point", x=x, y=y, z=z)


def colour(messages: Messages, shade: Colour, opacity: float = 1.0) -> Any:
    r, g, b = (value / 255 for value in shade)
    return messages.make("std_msgs/msg/ColorRGBA", r=r, g=g, b=b, a=opacity)
