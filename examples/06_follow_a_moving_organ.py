"""A live loop from Python: a case in motion, followed, and a sink of one's own that hears of it.

Run after 01 to 03: python examples/06_follow_a_moving_organ.py [FOLDER] [MODEL] [FRAMES]
From the command line: tumortrack track MODEL virtual:CASE viewer
"""

import sys
from pathlib import Path

import numpy as np

from tumortrack.live.loop import Loop, LoopConfig, summary
from tumortrack.live.sink_worker import SinkWorker
from tumortrack.live.source_worker import SourceWorker
from tumortrack.live.sources.virtual import VirtualSourceConfig
from tumortrack.live.values import PublishedFrame, SinkContext, TrackingResult
from tumortrack.sense.cloud import CloudConfig
from tumortrack.sense.region import RegionConfig
from tumortrack.tracking.tracker import Tracker
from tumortrack.training.model import load_model


class Teller:
    """A sink is any object with ``publish`` and ``close``: this one says where tumor 1 is."""

    def publish(self, update: TrackingResult) -> None:
        placed = update.transformed
        if placed is None:
            print(f"no estimate: {update.reason}")  # never the last answer again
            return
        middle = placed.meshes["tumor_1"].box_mm.mean(0)
        off_mm = np.nan
        if update.observation is not None and update.observation.truth is not None:
            off_mm = np.linalg.norm(middle - update.observation.truth.tumors[0].box_mm.mean(0))
        print(
            f"frame {update.sequence} ({update.quality}): tumor 1 at {middle.round(1)} mm, off by "
            f"{off_mm:.1f} mm; {update.latency_ms:.0f} ms after the frame"
        )

    def close(self) -> None:
        print("that was all")


def main(out: Path, model_folder: Path, frames: int) -> None:
    tracker = Tracker(load_model(model_folder))
    setting = SinkContext(tracker.model.parts, PublishedFrame(), tracker.anatomy_ct)
    # Everything that the camera sees goes in; the organ is found in it. Depths in mm.
    region = RegionConfig(crop=CloudConfig(near_mm=75, far_mm=340))
    loop = Loop(tracker, setting, LoopConfig(region=region))
    loop.warm()
    sink_worker = SinkWorker("teller", Teller(), waiting=1)  # a slow sink gets the newest update
    source_worker = SourceWorker(VirtualSourceConfig(case=out / "case", fps=10).open)

    def enough(update: TrackingResult) -> None:
        if loop.statistics.counts["good"] + loop.statistics.counts["poor"] >= frames:
            loop.stop()

    loop.run(source_worker, [sink_worker], enough)
    source_worker.close()
    sink_worker.close()
    told = summary(loop, source_worker, [sink_worker])
    print(f"latency p50 {told['latency_ms']['p50']} ms, {told['dropped']} frames dropped")


if __name__ == "__main__":
    given = sys.argv[1:]
    folder = Path(given[0]) if given else Path("runs/examples")
    main(
        folder,
        Path(given[1]) if len(given) > 1 else folder / "model_60",
        int(given[2]) if len(given) > 2 else 30,
    )
