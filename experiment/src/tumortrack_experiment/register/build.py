"""What `calibrate register` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.cli.console import say, say_notes
from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import Points, transform_points
from tumortrack.io.depth_files import read_depth_png
from tumortrack.io.points import read_points
from tumortrack.io.volume import read_volume
from tumortrack.live.calibration_file import CalibrationFile
from tumortrack_experiment.kit_file import Kit, case_of_kit, kit_path, read_kit
from tumortrack_experiment.record.read import Moment
from tumortrack_experiment.register.beads import (
    CT,
    ROBOT,
    NamedBeads,
    Registration,
    name_beads,
    register,
)
from tumortrack_experiment.register.command import CalibrateRegister
from tumortrack_experiment.register.frames import moments_in, still_beads
from tumortrack_experiment.register.in_ct import find_balls, middles_mm

_ORGAN_MM = [[0.0, 0.0, 25.0]]  # without a case: half an organ's height above the plate


def write_registration(given: CalibrateRegister) -> None:
    """Raises InputError: see what finds and registers beads."""
    kit = read_kit(given.kit)
    base_mm = targets_mm(given.case, kit)
    found, inputs = {}, {"kit": kit_path(given.kit)}
    if given.robot_points is not None:
        inputs["robot"] = given.robot_points
        found["robot"] = _pointed(kit, given.robot_points, given)
    if given.view is not None:
        inputs["camera"] = given.view
        moments = _moments(given.view, given, kit)
        found["camera"] = still_beads(kit, moments, given.state or str(given.view))[1]
    if given.ct is not None:
        inputs["ct"] = given.ct
        balls = find_balls(read_volume(given.ct, given.series), kit.bead_diameter_mm)
        found["ct"] = name_beads(kit, middles_mm(balls), CT)
    said: dict[str, Any] = {"inputs": {k: store.sha256_of(v) for k, v in inputs.items()}}
    said["transforms"], calibration = {}, None
    for first, second in (("ct", "camera"), ("camera", "robot"), ("ct", "robot")):
        if first not in found or second not in found:
            continue
        one = register(kit, found[first], found[second])
        pose = found[first].device_from_base
        at = {name: transform_points(pose, points) for name, points in base_mm.items()}
        report = said["transforms"][f"{second}_from_{first}"] = one.report(at)
        say_registration(f"{second}_from_{first}", one, report)
        if first == "camera":
            calibration = _calibration(given, one, np.concatenate(list(at.values())))
    with store.new_folder(given.out, given.overwrite) as aside:
        store.write_json(aside / "report.json", said)
        if calibration is not None:
            store.write_json(aside / "calibration.json", calibration)
        store.seal(aside, "registration", {"report": "report.json"}, "several")
    say(f"written to {given.out}.")


def say_registration(name: str, one: Registration, report: dict[str, Any]) -> None:
    say_notes(one.notes)
    errors = ", ".join(f"{at} {error:.2f}" for at, error in report["tre_mm"].items())
    say(
        f"{name}: {len(one.beads)} beads, FRE {one.fre_mm:.2f} mm, largest leave-one-out "
        f"{one.without_mm.max():.2f} mm; expected TRE, mm: {errors}"
    )


def targets_mm(case: Path | None, kit: Kit) -> dict[str, Points]:
    """The tumors' middles at rest by name, or the organ's; base frame."""
    if case is None:
        return {"organ": np.array(_ORGAN_MM)}
    anatomy = case_of_kit(case, kit).anatomy
    parts = list(zip(anatomy.names, anatomy.parts, strict=True))
    return {
        name: transform_points(np.array(kit.base_from_ct), part.vertices_mm.mean(0)[None])
        for name, part in parts[1:] or parts
    }


def _moments(view: Path, given: CalibrateRegister, kit: Kit) -> list[Moment]:
    if view.suffix.lower() == ".png":
        beside = given.intrinsics or view.parent / "intrinsics.json"
        return [Moment(read_depth_png(view, beside))]
    if given.intrinsics is not None:
        raise InputError(f"--intrinsics is for a depth image (.png); {view} has its own.")
    return moments_in(view, given.state, kit)


def _pointed(kit: Kit, path: Path, given: CalibrateRegister) -> NamedBeads:
    """Raises InputError: as ``name_beads``, or a place is not that of the bead it is named for."""
    table = read_points(path)
    points_mm = table.points_ct * (1000.0 if given.unit == "m" else 1.0)
    above_mm = kit.bead_diameter_mm / 2 if given.pointed_at == "top" else 0.0
    found = name_beads(kit, points_mm, ROBOT, above_mm)
    if "bead" in table.columns:
        column = table.columns.index("bead")
        drawn = transform_points(found.device_from_base, kit.beads_mm + [0, 0, above_mm])
        for row, at in zip(table.rows, points_mm, strict=True):
            name = kit.beads[int(((drawn - at) ** 2).sum(1).argmin())].name
            if row[column] != name:
                raise InputError(
                    f"{path}: the place named {row[column]!r} is that of bead {name}, by its "
                    "distances from the others. Correct the names, or leave out that column."
                )
    return found


def _calibration(given: CalibrateRegister, one: Registration, at_mm: Points) -> dict[str, Any]:
    bound_mm = one.bound_mm(at_mm)
    file = CalibrationFile(
        frame_id=given.frame_id,
        unit="mm",
        robot_from_camera=tuple(map(tuple, one.to_from.tolist())),
        camera_frame_id=given.camera_frame_id,
        error_mm=bound_mm,
    )
    say(f"calibration: within {bound_mm:.2f} mm at the organ, with 95 % confidence")
    return {name: value for name, value in to_builtins(file).items() if value is not None}
