"""A live loop from Python: a case in motion, followed, and a sink of one's own that hears of it.

Run after 01: python examples/06_follow_a_moving_organ.py [FOLDER] [FRAMES]
From the command line: tumortrack track CASE virtual:CASE viewer
"""

import sys
from pathlib import Path
from typing import Any

import numpy as np

import tumortrack as tt


class PrintingSink:
    """A sink is any object with ``publish`` and ``close``: this one says where tumor 1 is."""

    estimates = 0

    def publish(self, result: Any) -> None:
        placed = result.transformed
        if placed is None:
            print(f"none: {result.reason}")  # never the last answer again
            return
        self.estimates += 1
        middle, off_mm = result.center_mm("tumor_1"), np.nan
        if result.observation is not None and result.observation.truth is not None:
            true_mm = result.observation.truth.tumors[0].box_mm.mean(0)
            off_mm = float(np.linalg.norm(middle - true_mm))
        print(
            f"frame {result.sequence} ({result.quality}): tumor 1 at {middle.round(1)} mm, off by "
            f"{off_mm:.1f} mm; {result.latency_ms:.0f} ms after the frame"
        )

    def close(self) -> None:
        print("that was all")


def main(out: Path, frames: int) -> None:
    tracker, sink = tt.Tracker(tt.load_case(out / "case")), PrintingSink()
    # Everything that the camera sees goes in; the organ is found in it.
    summary = tt.track(
        tracker,
        f"virtual:{out / 'case'}?fps=10",
        [sink],
        until=lambda result: sink.estimates >= frames,
    )
    print(f"latency p50 {summary.latency_ms.p50} ms, {summary.dropped} frames dropped")


if __name__ == "__main__":
    main(
        Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"),
        int(sys.argv[2]) if len(sys.argv) > 2 else 30,
    )
