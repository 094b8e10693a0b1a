"""RealSense: what the SDK's software device shows comes out bit for bit, live and played back."""

from __future__ import annotations

import sys
import time

import numpy as np
import pytest

from clock import PATIENCE_S, until
from realsense_objects import HEIGHT, WIDTH, Camera, raw_depth, record
from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install
from tumortrack.core.types import Intrinsics
from tumortrack.live.values import SourceEnded, SourceLost
from tumortrack_devices.sources.realsense import RealSenseSource, RealSenseSourceConfig


def test_a_cameras_frame_comes_out_bit_for_bit():
    camera = Camera()
    source = RealSenseSource(camera.device, RealSenseSourceConfig())
    for number in range(3):
        camera.show(number, stamp_ms=1_790_000_000_123.25 + number)
        seen = source.read(PATIENCE_S)
        assert seen is not None
        assert seen.stamp_ns == pytest.approx(1_790_000_000_123_250_000 + number * 1e6, abs=500)
        depth_mm, raw = seen.content.depth_mm, raw_depth(number)
        assert np.isnan(depth_mm[0, 0])
        np.testing.assert_array_equal(np.rint(depth_mm * 10)[raw > 0], raw[raw > 0])
        np.testing.assert_allclose(depth_mm[raw > 0], raw[raw > 0] / 10, rtol=2e-7)
    assert seen.content.intrinsics == Intrinsics(WIDTH, HEIGHT, 446.25, 447.5, 423.75, 238.5)
    assert source.host_clock
    assert not source.lossless
    source.close()


@pytest.mark.parametrize("pictures", [("color",), ("infrared",), ("color", "infrared")])
def test_the_picture_in_the_depth_images_pixels_comes_with_it(pictures: tuple[str, ...]):
    """Of a colour image through another lens nobody knows that: the infrared one is taken."""
    camera = Camera(pictures=pictures)
    source = RealSenseSource(camera.device, RealSenseSourceConfig(picture=True))
    shape = (HEIGHT, WIDTH) if "infrared" in pictures else (HEIGHT, WIDTH, 3)
    for number in range(4):
        stamp_ms = 1_790_000_000_123.0 + 33 * number
        picture = np.random.default_rng(number).integers(0, 256, shape).astype(np.uint8)
        shows = [
            lambda n=number, t=stamp_ms: camera.show(n, t),
            lambda n=number, t=stamp_ms, p=picture: camera.show_picture(pictures[-1], p, n, t),
        ]
        for show in shows[:: 1 if number % 2 else -1]:  # in either order
            assert source.read(0.01) is None
            show()
        seen = source.read(PATIENCE_S)
        np.testing.assert_array_equal(seen.picture, picture)
        assert seen.stamp_ns == pytest.approx(stamp_ms * 1e6, abs=500)
        assert np.nanmax(np.rint(seen.content.depth_mm * 10) - raw_depth(number)) == 0
    source.close()
    with pytest.raises(InputError):
        RealSenseSource(Camera().device, RealSenseSourceConfig(picture=True))


@pytest.mark.parametrize("unit_m", [0.001, 0.0001, 0.00025])
def test_the_devices_own_unit_counts(unit_m: float):
    camera = Camera(unit_m=unit_m)
    source = RealSenseSource(camera.device, RealSenseSourceConfig())
    camera.show(5)
    seen = source.read(PATIENCE_S)
    source.close()
    np.testing.assert_allclose(
        seen.content.depth_mm[1:], raw_depth(5)[1:] * (unit_m * 1000), rtol=1e-6
    )


def test_every_recorded_frame_comes_back_bit_for_bit(tmp_path):
    record(str(tmp_path / "some.db3"), frames=5)
    source = RealSenseSourceConfig(device=str(tmp_path / "some.db3"), realtime=False).open()
    assert source.lossless
    assert not source.host_clock
    stamps = []
    for number in range(5):
        seen = source.read(PATIENCE_S)
        stamps.append(seen.stamp_ns)
        raw = raw_depth(number)
        np.testing.assert_array_equal(np.rint(seen.content.depth_mm * 10)[raw > 0], raw[raw > 0])
        time.sleep(0.02)  # slow readers lose nothing
    with pytest.raises(SourceEnded):
        until(lambda: source.read(0.1))
    np.testing.assert_allclose(np.diff(stamps), 20e6, atol=1000)
    assert seen.content.intrinsics == Intrinsics(WIDTH, HEIGHT, 446.25, 447.5, 423.75, 238.5)
    assert source.dropped == 0
    source.close()


def test_the_newest_frame_wins_and_others_are_counted():
    camera = Camera()
    source = RealSenseSource(camera.device, RealSenseSourceConfig())
    for number in range(4):
        camera.show(number, stamp_ms=1000.0 + number)
    until(lambda: source.dropped == 3)
    assert source.read(PATIENCE_S).stamp_ns == 1_003_000_000
    assert source.read(0.01) is None
    source.close()


def test_a_clock_of_its_own_is_not_taken_for_this_machines():
    own = RealSenseSource(Camera(global_time=False).device, RealSenseSourceConfig())
    assert not own.host_clock
    own.close()
    asked = RealSenseSource(Camera().device, RealSenseSourceConfig(global_time=False))
    assert not asked.host_clock
    asked.close()


def test_frames_before_the_clocks_are_tied_are_left_out():
    camera = Camera()
    source = RealSenseSource(camera.device, RealSenseSourceConfig())
    camera.show(0, stamp_ms=17.0, hardware_clock=True)
    assert source.read(0.5) is None
    assert source.dropped == 1
    camera.show(1)
    assert source.read(PATIENCE_S) is not None
    for number in range(149):
        camera.show(number, hardware_clock=True)
        assert source.read(0.5) is None
    camera.show(149, hardware_clock=True)
    with refused(InputError, "global_time=false"):
        source.read(0.5)
    source.close()


class _Unplugged:
    """A device that is gone: it does as the real one, but says that it isn't connected."""

    def __init__(self, device: object) -> None:
        self._device = device

    def __getattr__(self, name: str) -> object:
        return getattr(self._device, name)

    def is_connected(self) -> bool:
        return False


def test_an_unplugged_camera_is_lost():
    camera = Camera()
    source = RealSenseSource(_Unplugged(camera.device), RealSenseSourceConfig())
    camera.show(0)
    assert source.read(PATIENCE_S) is not None  # what came before counts
    with pytest.raises(SourceLost):
        source.read(0.05)
    source.close()


def test_what_a_camera_cannot_do_is_said():
    with pytest.raises(InputError):
        RealSenseSource(Camera(distortion=0.1).device, RealSenseSourceConfig())
    with refused(InputError, "848x480@30"):
        RealSenseSource(Camera().device, RealSenseSourceConfig(width=640))


def test_what_is_not_there_is_said(tmp_path, monkeypatch):
    with refused(InputError, "none.db3"):
        RealSenseSourceConfig(device=str(tmp_path / "none.db3")).open()
    (tmp_path / "torn.db3").write_bytes(b"x" * 5000)
    with refused(InputError, "torn.db3"):
        RealSenseSourceConfig(device=str(tmp_path / "torn.db3")).open()
    with pytest.raises(SourceLost):
        RealSenseSourceConfig(device="000000000000").open()  # no camera has it
    monkeypatch.setitem(sys.modules, "pyrealsense2", None)
    with refused(InputError, to_install("tumortrack-devices[realsense]")):
        RealSenseSourceConfig().open()
