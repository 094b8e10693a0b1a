"""Registrations as ``save_registration`` of github.com/jhu-dvrk/dvrk_camera_registration writes
them; the numbers are of its sample PSM2_registration_small_grid.json."""

from __future__ import annotations

import json

import numpy as np

CAMERA_FROM_BASE_M = np.array(
    [
        [-0.7172557689882004, 0.6454485151900569, -0.2625649940340444, -0.06523892953065114],
        [0.6742015917793325, 0.5476249936838803, -0.4955391810290533, -0.1626265756746227],
        [-0.17605787541419746, -0.53245007327606, -0.8279496023146331, 0.0581928318264872],
        [0.0, 0.0, 0.0, 1.0],
    ]
)
_TO_DVRK = np.diag([-1.0, -1.0, 1.0, 1.0])


def _base_frame(transform: np.ndarray, frame: str) -> str:
    data = {"reference-frame": frame, "transform": transform.tolist()}
    return f'"base-frame": {json.dumps(data)}'


def open_cv(frame: str = "/decklink_frame") -> str:
    return "{\n" + _base_frame(CAMERA_FROM_BASE_M, frame) + "\n}\n"


def dvrk(frame: str = "/decklink_frame") -> str:
    """Without braces: to be pasted into a system's JSON."""
    return _base_frame(_TO_DVRK @ CAMERA_FROM_BASE_M, frame) + "\n"


def of_ecm() -> str:
    return json.dumps({"name": "PSM2", "measured_cp": CAMERA_FROM_BASE_M.tolist()}) + "\n"
