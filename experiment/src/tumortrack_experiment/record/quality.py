"""How good what a depth camera sees is, in numbers and in words."""

from __future__ import annotations

from collections import deque

import numpy as np

from tumortrack.core.config import Config
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame
from tumortrack.live.values import Observation

_PIXELS = 20_000  # that are looked at, evenly spread
_WINDOW = 16  # frames: half a second at 30 Hz
# A matcher that errs by 0.08 px, as RealSense's engineers advise, is 0.22 mm off at 150 mm
# (``simulation.noise``). Three times that is a reflecting, smooth or badly lit surface.
_REFERENCE_MM, _NOISE_MM = 150.0, 0.66
_MOVED_MM = 1.0  # and more than noise would: a hand, an organ that still sinks
_LEAST_MOVING = 0.005  # of all pixels; noise alone shifts less than one in a thousand
_LEAST_SEEN, _MOST_HOLES, _MOST_NEAR = 0.4, 0.3, 0.02
_WHITE, _MOST_WHITE, _LIT = 250, 0.05, (40.0, 215.0)  # of 255; what a picture's mean may be


class DepthQuality(Config, frozen=True, kw_only=True):
    """Of some frames. Shares of all pixels: ``seen`` in range, ``holes`` without any return,
    ``near`` nearer than the range, ``moving`` shifted by over 1 mm within half a second or since
    the beginning. ``depth_mm``: 5th, 50th and 95th percentile. ``noise_mm``: standard deviation
    from frame to frame, of the median pixel; None of too few frames. ``light``: a picture's mean
    (0..255), and its share that is white."""

    frames: int
    fps: float
    dropped: int
    seen: float
    holes: float
    near: float
    depth_mm: tuple[float, float, float]
    noise_mm: float | None
    moving: float
    light: tuple[float, float] | None

    def line(self) -> str:
        """In one line."""
        low, middle, high = self.depth_mm
        noise = "?" if self.noise_mm is None else f"{self.noise_mm:.2f} mm"
        still = "still" if self.moving <= _LEAST_MOVING else f"{self.moving:.1%} moving"
        light = f"light {self.light[0]:.0f} of 255, " if self.light else ""
        return (
            f"depth {self.seen:.0%} in range, {self.holes:.0%} holes, at {middle:.0f} mm "
            f"({low:.0f} to {high:.0f}), noise {noise}, {still}, {light}{self.fps:.0f} fps, "
            f"{self.dropped} dropped"
        )

    def warnings(self, range_mm: tuple[float, float]) -> list[str]:
        """What is bad about it, and what to do."""
        noise_mm, middle_mm, (near_mm, far_mm) = self.noise_mm or 0.0, self.depth_mm[1], range_mm
        most_mm = _NOISE_MM * max(middle_mm / _REFERENCE_MM, 1.0) ** 2
        mean, white = self.light or (_LIT[0], 0.0)
        found = (
            (self.near > _MOST_NEAR, f"{self.near:.0%} is nearer than {near_mm:g} mm: move away"),
            (middle_mm > far_mm, f"half is farther than {far_mm:g} mm: move nearer"),
            (self.seen < _LEAST_SEEN, f"only {self.seen:.0%} is in range: aim at the organ"),
            (self.holes > _MOST_HOLES, f"{self.holes:.0%} has no depth: matt surfaces, more light"),
            (noise_mm > most_mm, f"noise is over {most_mm:.2f} mm: matt surfaces, more light"),
            (self.moving > _LEAST_MOVING, f"{self.moving:.1%} moved: wait until all is still"),
            (white > _MOST_WHITE, f"{white:.0%} of the picture is white: less light"),
            (not _LIT[0] <= mean <= _LIT[1], f"the picture's mean is {mean:.0f} of 255"),
        )
        return [text for bad, text in found if bad]


class DepthMeter:
    """Looks at frame after frame, of one size."""

    def __init__(self, range_mm: tuple[float, float]) -> None:
        self._range_mm, self.frames = range_mm, 0
        self._window: deque[tuple[int, np.ndarray]] = deque(maxlen=_WINDOW)  # stamps and depths
        self._light: tuple[float, float] | None = None
        self._first_mm: np.ndarray | None = None  # the first window's median
        self._changes: list[tuple[float, float]] = []  # at the end of each window

    def add(self, seen: Observation) -> None:
        """A depth image, and its picture. Raises InputError: it is of another size than before."""
        assert isinstance(seen.content, DepthFrame)
        depth_mm = seen.content.depth_mm
        step = max(1, int(np.sqrt(depth_mm.size / _PIXELS)))
        some_mm = depth_mm[::step, ::step].ravel()
        if self._window and len(self._window[0][1]) != len(some_mm):
            raise InputError("the depth images changed their size; give the same command again.")
        self._window.append((seen.stamp_ns, some_mm))
        if seen.picture is not None:
            some = seen.picture[::step, ::step]
            self._light = float(some.mean()), float(np.mean(some >= _WHITE))
        self.frames += 1
        if self.frames % _WINDOW == 0:
            self._changes += self._change()
            if self._first_mm is None:
                self._first_mm = np.median([depths_mm for _, depths_mm in self._window], axis=0)

    def quality(self, dropped: int, whole: bool = False) -> DepthQuality:
        """How the last half second was; one frame at least was added. ``whole``: with the median
        noise, and the most that moved, since the beginning."""
        (first_ns, _), (last_ns, last_mm) = self._window[0], self._window[-1]
        near_mm, far_mm = self._range_mm
        there_mm, every = last_mm[np.isfinite(last_mm)], len(last_mm)
        inside = int(np.count_nonzero((there_mm >= near_mm) & (there_mm <= far_mm)))
        low, middle, high = np.percentile(there_mm, [5, 50, 95]) if len(there_mm) else (0, 0, 0)
        changes = [*(self._changes if whole else ()), *self._change()]
        return DepthQuality(
            frames=self.frames,
            fps=(len(self._window) - 1) * 1e9 / max(last_ns - first_ns, 1),
            dropped=dropped,
            seen=inside / every,
            holes=1 - len(there_mm) / every,
            near=int(np.count_nonzero(there_mm < near_mm)) / every,
            depth_mm=(float(low), float(middle), float(high)),
            noise_mm=float(np.median([noise_mm for noise_mm, _ in changes])) if changes else None,
            moving=max((moving for _, moving in changes), default=0.0),
            light=self._light,
        )

    def _change(self) -> list[tuple[float, float]]:
        """Noise (mm), and the share of pixels that moved; nothing of too few frames."""
        depths_mm = np.array([depths_mm for _, depths_mm in self._window])
        steady = np.isfinite(depths_mm).all(0)
        if len(depths_mm) < _WINDOW // 2 or not steady.any():
            return []
        variance = np.mean(np.diff(depths_mm[:, steady], axis=0) ** 2, axis=0) / 2
        first, last = np.array_split(depths_mm[:, steady], 2)
        end_mm, before_mm = np.median(last, axis=0), [np.median(first, axis=0)]
        if self._first_mm is not None:
            before_mm.append(self._first_mm[steady])
        # Of 8 frames' medians: 4 standard deviations of a difference are 2.5 of a frame.
        least_mm = _MOVED_MM + 2.5 * np.sqrt(variance)
        moved = [int(np.count_nonzero(np.abs(end_mm - one) > least_mm)) for one in before_mm]
        return [(float(np.sqrt(np.median(variance))), max(moved) / depths_mm.shape[1])]
