"""What a camera's calibration says: files, lines for the screen, and a picture."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.config import to_builtins
from tumortrack_experiment.calibrate.board import Corners
from tumortrack_experiment.calibrate.lens import Lens, LensFit

_AT_MM = 150.0  # where errors of rays are stated
_GRID = 24, 32
_LEAST_COVERED, _LEAST_TILT = 0.6, 20.0  # share of the image; degrees
_BENT_PX = 0.5  # 0.2 mm at 150 mm before a D405 at 848 x 480


def lens_json(lens: Lens) -> dict[str, Any]:
    return to_builtins(lens)


def pinhole_json(lens: Lens) -> dict[str, Any]:
    """Without distortion, as depth images have none."""
    content = lens_json(lens)
    return {name: content[name] for name in ("width", "height", "fx", "fy", "cx", "cy")}


def lens_report(
    fit: LensFit, seen: dict[int, Corners], names: list[str]
) -> tuple[dict[str, Any], list[str]]:
    """With warnings."""
    lens, warnings = fit.lens, []
    pixels = np.concatenate([seen[n].pixels for n in fit.used])
    low, high = pixels.min(0), pixels.max(0)
    fields = np.floor(pixels / [lens.width / 8, lens.height / 6]).astype(int) @ [1, 8]
    covered = len(np.unique(fields)) / 48
    tilts = [np.degrees(np.arccos(abs(lens.place(seen[n])[0][2, 2]))) for n in fit.used]
    bent_px = bent(lens, fit.pinhole)
    if covered < _LEAST_COVERED:
        warnings.append(
            f"the board's corners cover {100 * covered:.0f} % of the image; take pictures with it "
            "at all sides and in the corners"
        )
    if np.quantile(tilts, 0.75) < _LEAST_TILT:
        warnings.append(
            f"a quarter of the pictures alone is tilted by over {np.quantile(tilts, 0.75):.0f} "
            f"degrees; {_LEAST_TILT:g} to 45 tell the focal length"
        )
    if bent_px > _BENT_PX:
        warnings.append(
            f"these pictures are not rectified (up to {bent_px:.1f} px beside a camera without "
            "distortion): intrinsics.json suits them as well as one can; take the stream that "
            "depth belongs to, a D405's left infrared"
        )
    left_out = [name for n, name in enumerate(names) if n in seen and n not in fit.used]
    warnings += [f"{name} left out: its corners do not fit" for name in left_out]
    said = {
        "pictures": len(names),
        "used": len(fit.used),
        "not_seen": [name for n, name in enumerate(names) if n not in seen],
        "left_out": left_out,
        "lens": lens_json(lens),
        "std_px": dict(zip(("fx", "fy", "cx", "cy"), fit.std_px, strict=True)),
        "model": fit.model,
        "reprojection_rms_px": fit.rms_px,
        "held_out_rms_px": fit.held_out_px,
        "pinhole_off_px": bent_px,
        "covered": covered,
        "corners_px": [low.tolist(), high.tolist()],
        "tilt_degrees": [float(min(tilts)), float(max(tilts))],
    }
    return said, warnings


def _pixels(lens: Lens) -> np.ndarray:
    down, right = (
        np.linspace(0, size - 1, count)
        for size, count in zip((lens.height, lens.width), _GRID, strict=True)
    )
    return np.stack(np.meshgrid(right, down), axis=-1).reshape(-1, 2)


def bent(lens: Lens, pinhole: Lens) -> float:
    """How far apart the two see things at most, px."""
    pixels = _pixels(lens)
    apart = lens.rays(pixels)[:, :2] - pinhole.rays(pixels)[:, :2]
    return float(np.linalg.norm(apart, axis=1).max() * lens.fx)


def beside(device: Lens, lens: Lens) -> dict[str, Any]:
    """The intrinsics that the depth images' files state, and how far beside a point at 150 mm they
    put it."""
    pixels = _pixels(lens)
    off_mm = np.linalg.norm(device.rays(pixels) - lens.rays(pixels), axis=1) * _AT_MM
    return {
        "intrinsics": pinhole_json(device),
        "beside_rms_mm": float(np.sqrt(np.mean(off_mm**2))),
        "beside_largest_mm": float(off_mm.max()),
    }


def camera_words(said: dict[str, Any]) -> list[str]:
    lens, std = said["lens"], said["std_px"]
    lines = [
        ", ".join(f"{name} {lens[name]:.2f} +- {std[name]:.2f}" for name in std)
        + f" px; distortion: {said['model']}",
        f"corners {said['reprojection_rms_px']:.2f} px off, in held-out pictures "
        f"{said['held_out_rms_px'][said['model']]:.2f}; without distortion "
        f"{said['held_out_rms_px']['none']:.2f}",
    ]
    if said["device"]:
        lines.append(
            f"the device's own intrinsics are {said['device']['beside_rms_mm']:.2f} mm beside "
            f"these at {_AT_MM:g} mm (largest: {said['device']['beside_largest_mm']:.2f})"
        )
    if (depth := said["depth"]) is None:
        return lines
    lines.append("depth, mm: from - to, images, error, between poses, flatness, noise")
    for row in depth["by_distance"]:
        names = "error_mm", "between_poses_mm", "flatness_mm", "noise_mm"
        numbers = ["     -" if row[n] is None else f"{row[n]:6.2f}" for n in names]
        lines.append(
            f"  {row['from_mm']:3.0f} - {row['to_mm']:3.0f} {row['images']:4d} {' '.join(numbers)}"
        )
    if "scale" in depth:
        lines.append(
            f"depth: {100 * depth['scale']:+.2f} +- {100 * depth['scale_std']:.2f} % and "
            f"{depth['offset_mm']:+.2f} +- {depth['offset_std_mm']:.2f} mm; "
            f"{'inside' if depth['inside_training'] else 'OUTSIDE'} what models are trained for"
        )
    lines.append(
        f"95 % of poses are off by up to {depth['error_mm']:.2f} mm"
        + (f", {depth['left_mm']:.2f} once corrected" if depth["corrected"] else "")
    )
    return lines


def draw_camera(path: Path, lens: Lens, seen: list[Corners], said: dict[str, Any]) -> None:
    """Where corners were, and depth errors by distance and over the image."""
    from tumortrack.report.drawing import new_figure, save

    depth = said["depth"]
    figure = new_figure(12, 4, left=0.06, bottom=0.14, top=0.88)
    first, middle, last = figure.subplots(1, 3)
    pixels = np.concatenate([one.pixels for one in seen])
    first.plot(*pixels.T, ",", color="black")
    first.set(title="corners seen", xlim=(0, lens.width), ylim=(lens.height, 0), aspect="equal")
    if depth is None:
        middle.set_title("no depth images")
        last.axis("off")
    else:
        rows = depth["by_distance"]
        at_mm = [(row["from_mm"] + row["to_mm"]) / 2 for row in rows]
        for name in ("error", "flatness", "noise"):
            values = [np.nan if (v := row[f"{name}_mm"]) is None else v for row in rows]
            middle.plot(at_mm, values, "o-", label=name)
        middle.axhline(0, color="0.7", linewidth=0.5)
        middle.set(title="depth errors, mm", xlabel="distance, mm")
        middle.legend(frameon=False)
        fields = np.array(depth["shape"]["fields_mm"], float)
        widest = max(float(np.nanmax(np.abs(fields))) if np.isfinite(fields).any() else 0, 0.1)
        shown = last.imshow(fields, cmap="coolwarm", vmin=-widest, vmax=widest)
        last.set(title="depth error over the image at 150 mm, mm", xticks=[], yticks=[])
        figure.colorbar(shown, ax=last, shrink=0.7)
    save(figure, path)
