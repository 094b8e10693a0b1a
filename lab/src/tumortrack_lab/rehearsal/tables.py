"""A rehearsal's tables and picture for a document."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
from matplotlib.image import imread

from tumortrack.imaging.volume import read_volume
from tumortrack.report.drawing import new_figure, save
from tumortrack.simulate.scene_folder import read_scene
from tumortrack_lab.rehearsal.run import STATES, Rehearsal, errors_mm

_SHOWN = "D2"


def evaluation_rows(reports: dict[str, dict[str, Any]]) -> pd.DataFrame:
    """Each state's tumors: errors of estimates against the second CT and against the truth."""
    by_ct, by_truth = (errors_mm(reports[name]) for name in ("scenes", "true-scenes"))
    verdicts = {
        scene["name"]: scene.get("quality", "none") for scene in reports["scenes"]["scenes"]
    }
    rows = (
        {"state": state, "verdict": verdicts[state], "tumor": name, "by second CT mm": off,
         "by truth mm": true, "apart mm": off - true}
        for state in STATES
        for (name, off), true in zip(by_ct[state].items(), by_truth[state].values(), strict=True)
    )  # fmt: skip
    return pd.DataFrame(rows)


def picture(rehearsal: Rehearsal, path: Path) -> None:
    """One state: the depth image, the second CT across base and organ, and the estimate
    over the second CT's surfaces."""
    out = rehearsal.out
    figure = new_figure(15, 4.2, wspace=0.04)
    depth, ct, estimate = figure.subplots(1, 3, width_ratios=(1.5, 1.1, 1.3))
    frame = read_scene(out / "scenes" / _SHOWN).depth
    assert frame is not None
    depth.imshow(frame.depth_mm, cmap="viridis_r")
    depth.set_title(f"{_SHOWN}: the depth image that is recorded")
    volume = read_volume(out / "ct" / _SHOWN)
    tumors = np.where((volume.hu > 450) & (volume.hu < 900))
    cut = volume.hu[:, :, int(np.median(tumors[2]))]
    ct.imshow(cut.T, cmap="gray", vmin=-900, vmax=1200)
    ct.set_title("the second CT")
    picture = imread(out / "scenes-report" / "scenes" / f"{_SHOWN}.png")
    height, width = picture.shape[:2]
    estimate.imshow(picture[height // 11 : height // 2, : width // 2])
    estimate.set_title("estimate, and the second CT's surfaces")
    for axes in (depth, ct, estimate):
        axes.set_axis_off()
    save(figure, path)
