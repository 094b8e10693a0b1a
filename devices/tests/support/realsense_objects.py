"""The RealSense SDK's software device: frames go in by hand and come out as from a camera."""

from __future__ import annotations

import threading
import time

import numpy as np

import needs
from clock import PATIENCE_S

rs = needs.module("pyrealsense2", "make debian")  # without libusb it cannot be loaded

WIDTH, HEIGHT, UNIT_M = 848, 480, 0.0001


def raw_depth(number: int) -> np.ndarray:
    """A frame (480, 848) of uint16 that no other number has; pixel (0, 0) has no return."""
    noise = np.random.default_rng(number).integers(0, 50, (HEIGHT, WIDTH))
    raw = (1200 + number + noise).astype(np.uint16)
    raw[0, 0] = 0
    return raw


class Camera:
    """A software device with a depth stream of 848 x 480; options as a D405's."""

    def __init__(
        self,
        unit_m: float = UNIT_M,
        global_time: bool = True,
        distortion: float = 0.0,
        pictures: tuple[str, ...] = (),  # color, infrared
    ) -> None:
        self.device = rs.software_device()
        self.device.register_info(rs.camera_info.serial_number, "8128")
        self._sensor = self.device.add_sensor("Depth")
        stream = rs.video_stream()
        stream.type, stream.fmt, stream.bpp = rs.stream.depth, rs.format.z16, 2
        stream.width, stream.height, stream.fps, stream.uid = WIDTH, HEIGHT, 30, 1
        stream.intrinsics = _intrinsics(distortion)
        self._profile = self._sensor.add_video_stream(stream).as_video_stream_profile()
        self._wanted = pictures
        self._pictures = {name: self._picture_profile(name) for name in pictures}
        self._sensor.add_read_only_option(rs.option.depth_units, unit_m)
        self._unit_m = unit_m
        if global_time:
            span = rs.option_range()
            span.min, span.max, span.step, span.default = 0, 1, 1, 1
            self._sensor.add_option(rs.option.global_time_enabled, span, True)

    def _picture_profile(self, name: str) -> rs.video_stream_profile:
        stream, colour = rs.video_stream(), name == "color"
        stream.type, stream.bpp = getattr(rs.stream, name), 3 if colour else 1
        stream.fmt = rs.format.rgb8 if colour else rs.format.y8
        stream.width, stream.height, stream.fps = WIDTH, HEIGHT, 30
        stream.index, stream.uid = (0, 2) if colour else (1, 3)
        # A colour image with a lens of its own is not the depth image's.
        stream.intrinsics = _intrinsics(0.1 if colour and "infrared" in self._wanted else 0.0)
        return self._sensor.add_video_stream(stream).as_video_stream_profile()

    def show_picture(self, name: str, pixels: np.ndarray, number: int, stamp_ms: float) -> None:
        frame = rs.software_video_frame()
        frame.pixels = pixels
        frame.bpp = pixels.size // (WIDTH * HEIGHT)
        frame.stride, frame.timestamp = WIDTH * frame.bpp, stamp_ms
        frame.domain = rs.timestamp_domain.global_time
        frame.frame_number, frame.profile = number, self._pictures[name]
        self._sensor.on_video_frame(frame)

    def show(
        self, number: int, stamp_ms: float | None = None, hardware_clock: bool = False
    ) -> None:
        """One frame, by default of this moment."""
        domain = rs.timestamp_domain
        frame = rs.software_video_frame()
        frame.pixels = raw_depth(number)
        frame.stride, frame.bpp, frame.depth_units = WIDTH * 2, 2, self._unit_m
        frame.timestamp = time.time() * 1e3 if stamp_ms is None else stamp_ms
        frame.domain = domain.hardware_clock if hardware_clock else domain.global_time
        frame.frame_number, frame.profile = number, self._profile
        self._sensor.on_video_frame(frame)


class Streaming:
    """Shows frames from a thread of its own until left."""

    def __init__(self, camera: Camera, period_s: float = 0.02) -> None:
        self._camera, self._period_s = camera, period_s
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)

    def _run(self) -> None:
        number = 0
        while not self._stop.wait(self._period_s):
            self._camera.show(number)
            number += 1

    def __enter__(self) -> Streaming:
        self._thread.start()
        return self

    def __exit__(self, *_: object) -> None:
        self._stop.set()
        self._thread.join(5)


def record(path: str, frames: int) -> None:
    """A recording of frames 0, 1, 2, ... whose stamps are 20 ms apart."""
    camera = Camera()
    recorder = rs.recorder(path, camera.device)
    sensor = recorder.query_sensors()[0]
    came = threading.Semaphore(0)
    sensor.open(sensor.get_stream_profiles()[0])
    sensor.start(lambda _: came.release())
    begin_ms = time.time() * 1e3
    for number in range(frames):
        camera.show(number, begin_ms + 20 * number)
        assert came.acquire(timeout=PATIENCE_S)
        time.sleep(0.02)  # a recording's pace is that of its making
    sensor.stop()
    sensor.close()
    recorder.pause()


def _intrinsics(distortion: float) -> rs.intrinsics:
    lens = rs.intrinsics()
    lens.width, lens.height = WIDTH, HEIGHT
    lens.fx, lens.fy, lens.ppx, lens.ppy = 446.25, 447.5, 423.75, 238.5
    lens.model, lens.coeffs = rs.distortion.brown_conrady, [distortion, 0, 0, 0, 0]
    return lens
