"""A RealSense depth camera, or its recording.

Camera, recording and the SDK's software device all have a depth sensor that calls back with frames,
so one class serves them. The SDK's own frame queue is not used: from Python it holds the GIL while
it waits for room, and a recording that is read frame by frame deadlocks.
"""

from __future__ import annotations

import contextlib
import threading
import time
from collections.abc import Iterator
from pathlib import Path
from types import ModuleType
from typing import Any, ClassVar

import numpy as np

from tumortrack.core.camera import plausible
from tumortrack.core.errors import InputError
from tumortrack.core.packages import to_install
from tumortrack.core.types import DepthFrame, Intrinsics
from tumortrack.core.units import depths_mm
from tumortrack.live.values import Observation, SourceConfig, SourceEnded, SourceLost

_RECORDINGS = (".db3", ".bag")
_LAST_S = 0.2  # after a recording's end, for its last frame
_TOGETHER_MS = 5.0  # depth image and picture of one exposure
_MOST_UNTIMED = 150  # frames before the camera's clock is synchronised with this machine's


@contextlib.contextmanager
def _while_connected() -> Iterator[None]:
    """Any call of the SDK fails while a camera is plugged in or out."""
    try:
        yield
    except RuntimeError as error:
        raise SourceLost(f"the RealSense does not answer: {error}. Replug it.") from error


class RealSenseSourceConfig(SourceConfig, frozen=True, kw_only=True, tag="realsense"):
    """The first RealSense, the one with a serial number, or a recording (.db3, .bag).

    Attributes:
        device: empty, a serial number or a recording's path.
        width, height, fps: of a camera's depth stream; a recording has its own.
        global_time: stamps of a camera by this machine's clock, else by its own.
        realtime: a recording at its own speed, else every frame on demand.
        picture: also the picture in the depth image's pixels: in colour if the depth sensor has
            that, else the left infrared image.
    """

    target: ClassVar[str] = "device"

    device: str = ""
    width: int = 848
    height: int = 480
    fps: int = 30
    global_time: bool = True
    realtime: bool = True
    picture: bool = False

    def open(self) -> RealSenseSource:
        rs, path = _sdk(), Path(self.device)
        if path.suffix not in _RECORDINGS:
            with _while_connected():
                return RealSenseSource(self._connected(rs), self)
        if not path.is_file():
            raise InputError(f"no recording {path}.")
        try:
            device = rs.context().load_device(str(path))
            device.set_real_time(self.realtime)
        except RuntimeError as error:
            raise InputError(f"{path} is no recording of a RealSense: {error}.") from error
        return RealSenseSource(device, self)

    def _connected(self, rs: ModuleType) -> Any:
        serial = rs.camera_info.serial_number
        devices = {device.get_info(serial): device for device in rs.context().query_devices()}
        if not devices:
            raise SourceLost("no RealSense is connected. Plug one in, at a USB 3 port.")
        if self.device and self.device not in devices:
            serials = ", ".join(sorted(devices))
            raise SourceLost(f"no RealSense {self.device!r} is connected; there is {serials}.")
        return devices[self.device or next(iter(devices))]


class RealSenseSource:
    """Depth frames of an SDK device: camera, playback or software device."""

    def __init__(self, device: Any, config: RealSenseSourceConfig) -> None:
        self._rs = rs = _sdk()
        self.dropped = 0
        self._device = device
        self._playback = device.as_playback() if device.is_playback() else None
        self.on_demand = self._playback is not None
        self.lossless = self.on_demand and not config.realtime
        self._room = threading.Condition()
        # The SDK's depth image (True) and picture (False) of one moment, and their arrival.
        self._newest: tuple[dict[bool, Any], int] | None = None
        self._wanted, self._pair = {True, not config.picture}, dict[bool, Any]()
        self._closed = False
        self._untimed = 0
        self._sensor, profile = _depth_stream(rs, device, None if self._playback else config)
        given = profile.get_intrinsics()
        if any(given.coeffs):
            raise InputError(f"the RealSense's depth is distorted ({given.model}). Calibrate it.")
        lens = given.fx, given.fy, given.ppx, given.ppy
        self._intrinsics = plausible(Intrinsics(given.width, given.height, *lens), "the RealSense")
        self._unit_mm = float(f"{self._sensor.get_option(rs.option.depth_units) * 1000:.6g}")
        option = rs.option.global_time_enabled
        if self._playback is None and self._sensor.supports(option):
            self._sensor.set_option(option, int(config.global_time))
        synchronised = self._sensor.supports(option) and self._sensor.get_option(option)
        self.host_clock = self._playback is None and bool(synchronised)
        pictures = [_picture_stream(rs, self._sensor, profile)] if config.picture else []
        self._sensor.open([profile, *pictures])
        self._sensor.start(self._take)

    @_while_connected()
    def read(self, timeout_s: float) -> Observation | None:
        newest = self._next(timeout_s)
        stopped = self._rs.playback_status.stopped
        if newest is None and self._playback and self._playback.current_status() == stopped:
            newest = self._next(_LAST_S)
            if newest is None:
                raise SourceEnded("the recording is over.")
        if newest is None:
            if not self._device.is_connected():
                raise SourceLost("the RealSense is unplugged.")
            return None
        pair, arrived_ns = newest
        frame = pair[True]
        hardware_clock = self._rs.timestamp_domain.hardware_clock
        if self.host_clock and frame.get_frame_timestamp_domain() == hardware_clock:
            # A camera's first frames come before its clock is synchronised.
            self.dropped += 1
            self._untimed += 1
            if self._untimed > _MOST_UNTIMED:
                raise InputError("the RealSense gives no global time. Give global_time=false.")
            return None
        raw = np.asarray(frame.get_data())
        depth_mm = depths_mm(raw, self._unit_mm)
        depth = DepthFrame(depth_mm, self._intrinsics, round(frame.get_timestamp() * 1e6))
        picture = np.array(pair[False].get_data()) if False in pair else None
        return Observation(depth, arrived_ns, picture=picture)

    def close(self) -> None:
        with self._room:
            closed, self._closed, self._newest = self._closed, True, None
            self._room.notify_all()
        with contextlib.suppress(RuntimeError):  # an unplugged camera can't be stopped
            if not closed:
                self._sensor.stop()
                self._sensor.close()

    def _take(self, frame: Any) -> None:
        """Called by the SDK's thread."""
        arrived_ns = time.time_ns()
        is_depth = frame.is_depth_frame()
        if is_depth not in self._wanted:
            return
        with self._room:
            self._pair[is_depth] = frame
            times_ms = [image.get_timestamp() for image in self._pair.values()]
            if self._pair.keys() != self._wanted or np.ptp(times_ms) > _TOGETHER_MS:
                return
            pair, self._pair = self._pair, {}
            if self.lossless:
                self._room.wait_for(lambda: self._newest is None or self._closed)
            if self._closed:
                return
            self.dropped += self._newest is not None
            self._newest = (pair, arrived_ns)
            self._room.notify_all()

    def _next(self, timeout_s: float) -> tuple[dict[bool, Any], int] | None:
        with self._room:
            self._room.wait_for(lambda: self._newest is not None or self._closed, timeout_s)
            if self._closed:
                raise SourceLost("the RealSense is closed; open it again.")
            newest, self._newest = self._newest, None
            self._room.notify_all()
        return newest


def _sdk() -> ModuleType:
    try:
        import pyrealsense2
    except ImportError as error:
        raise InputError(
            f"a RealSense needs pyrealsense2: {to_install('tumortrack-devices[realsense]')}, and "
            f"Debian's libusb-1.0-0 ({error})."
        ) from error
    return pyrealsense2


def _depth_stream(
    rs: ModuleType, device: Any, wanted: RealSenseSourceConfig | None
) -> tuple[Any, Any]:
    """The sensor and profile of the depth stream: the only one, or as ``wanted``."""
    streams = [
        (sensor, profile.as_video_stream_profile())
        for sensor in device.query_sensors()
        for profile in sensor.get_stream_profiles()
        if profile.stream_type() == rs.stream.depth and profile.format() == rs.format.z16
    ]
    if not streams:
        raise InputError("the RealSense has no depth stream; choose another camera or recording.")
    if wanted is None:
        return streams[0]
    size = (wanted.width, wanted.height, wanted.fps)
    modes = {(p.width(), p.height(), p.fps()): (s, p) for s, p in streams}
    if size not in modes:
        listed = ", ".join(f"{w}x{h}@{fps}" for w, h, fps in sorted(modes))
        raise InputError(f"the RealSense has no {size[0]}x{size[1]}@{size[2]}. Allowed: {listed}.")
    return modes[size]


def _picture_stream(rs: ModuleType, sensor: Any, depth: Any) -> Any:
    """The profile of a picture in the depth image's pixels."""
    profiles = [profile.as_video_stream_profile() for profile in sensor.get_stream_profiles()]
    for kind in ((rs.stream.color, rs.format.rgb8), (rs.stream.infrared, rs.format.y8)):
        for p in profiles:
            if (p.stream_type(), p.format()) == kind and _lens_of(p) == _lens_of(depth):
                return p
    raise InputError("the RealSense has no picture in the depth image's pixels; leave it out.")


def _lens_of(profile: Any) -> tuple[Any, ...]:
    """What two streams with the same pixels and moments have in common."""
    lens = profile.get_intrinsics()
    size = lens.width, lens.height, profile.fps(), max(profile.stream_index(), 1)
    return *size, lens.fx, lens.fy, lens.ppx, lens.ppy, *lens.coeffs
