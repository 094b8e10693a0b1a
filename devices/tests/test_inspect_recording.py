"""`inspect` of recordings."""

from __future__ import annotations

import numpy as np
import pytest

from tumortrack.core import store
from tumortrack.core.geometry import HERE
from tumortrack.core.types import DepthFrame
from tumortrack.live.values import Observation
from tumortrack.report.inspection import describe
from tumortrack.sense.camera import d405
from tumortrack_devices.recording.mcap import McapBag, camera_messages
from tumortrack_devices.ros.messages import Messages


@pytest.mark.parametrize("ended", [True, False])
def test_a_recording_its_length_rate_and_whether_its_depths_were_corrected(tmp_path, ended):
    """Also one without its end, as a killed recorder leaves it."""
    folder, messages = tmp_path / "seen", Messages()
    bag = McapBag(folder, messages, "")
    for n in range(11):
        depth = DepthFrame(np.full((240, 424), 150.0, np.float32), d405(424, 240), 10**18 + n)
        seen = Observation(depth, 10**18 + n * 10**8)
        bag.write(seen.arrived_ns, camera_messages(seen, HERE, "camera", messages))
    bag.flush()
    if ended:
        bag.close()
    patient = {"id": "P1", "side": "left"}
    store.write_json(folder / "recording.json", {"patient": patient, "corrected": True})
    said = "\n".join(describe(folder if ended else folder / "seen.mcap"))
    assert "a recording of 1.0 s" in said
    assert "/camera/depth/image_rect: 11 frames, 10.0 a second" in said
    assert "patient P1, side left" in said
    assert "its depths were corrected" in said
