"""What a camera's calibration says: lines for the screen, and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.report.drawing import new_figure, save
from tumortrack_experiment.calibrate.board import Corners


def camera_words(said: dict[str, Any]) -> list[str]:
    """Lines of a report."""
    lens, model, held_out_px = said["lens"], said["model"], said["held_out_rms_px"]
    lines = [
        ", ".join(f"{name} {lens[name]:.2f} +- {std:.2f}" for name, std in said["std_px"].items())
        + f" px; distortion: {model}",
        f"corners {said['reprojection_rms_px']:.2f} px off, in held-out pictures "
        f"{held_out_px[model]:.2f}; without distortion {held_out_px['none']:.2f}",
    ]
    if (depth := said["depth"]) is None:
        return lines
    off_mm = said["device_off_mm"]
    lines.append(
        f"the device's own intrinsics put points at 150 mm {off_mm['rms']:.2f} mm beside these "
        f"(root mean square; largest {off_mm['largest']:.2f})"
    )
    lines.append("depth, mm: from - to, images, error, between poses, flatness, noise")
    for row in depth["by_distance"]:
        names = "error_mm", "between_poses_mm", "flatness_mm", "noise_mm"
        numbers = ["     -" if row[n] is None else f"{row[n]:6.2f}" for n in names]
        range_mm = f"{row['from_mm']:3.0f} - {row['to_mm']:3.0f}"
        lines.append(f"  {range_mm} {row['images']:4d} {' '.join(numbers)}")
    if "scale" in depth:
        where = "inside" if depth["inside_training"] else "OUTSIDE"
        lines.append(
            f"depth: {100 * depth['scale']:+.2f} +- {100 * depth['scale_std']:.2f} % and "
            f"{depth['offset_mm']:+.2f} +- {depth['offset_std_mm']:.2f} mm; {where} what models "
            "are trained for"
        )
    corrected = f", {depth['left_mm']:.2f} once corrected" if depth["corrected"] else ""
    return [*lines, f"95 % of poses are off by up to {depth['error_mm']:.2f} mm{corrected}"]


def draw_camera(path: Path, seen: list[Corners], said: dict[str, Any]) -> None:
    """Where corners were, and depth errors by distance and over the image."""
    figure = new_figure(13, 4, left=0.05, right=0.97, bottom=0.14, top=0.88)
    first, middle, last = figure.subplots(1, 3)
    first.plot(*np.concatenate([one.pixels for one in seen]).T, ",", color="black")
    size = said["lens"]["width"], said["lens"]["height"]
    first.set(title="corners seen", xlim=(0, size[0]), ylim=(size[1], 0), aspect="equal")
    if (depth := said["depth"]) is None:
        middle.axis("off")
        last.axis("off")
    else:
        rows = depth["by_distance"]
        at_mm = [(row["from_mm"] + row["to_mm"]) / 2 for row in rows]
        for name in ("error", "flatness", "noise"):
            values = np.array([row[f"{name}_mm"] for row in rows], float)
            middle.plot(at_mm, values, "o-", label=name)
        middle.axhline(0, color="0.7", linewidth=0.5)
        middle.set(title="depth errors, mm", xlabel="distance, mm")
        middle.legend(frameon=False)
        fields = np.array(depth["fields_at_150_mm"], float)
        widest = float(np.abs(fields[np.isfinite(fields)]).max(initial=0.1))
        shown = last.imshow(fields, cmap="coolwarm", vmin=-widest, vmax=widest)
        last.set(title="depth error at 150 mm, mm", xticks=[], yticks=[])
        figure.colorbar(shown, ax=last, shrink=0.7)
    save(figure, path)
