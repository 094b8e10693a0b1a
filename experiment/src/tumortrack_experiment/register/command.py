"""`calibrate register`: one frame to another by the beads of a kit's base."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

from tyro.conf import Positional

from tumortrack.cli.console import say, say_notes
from tumortrack.core import store
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from tumortrack_experiment.kit_file import Kit
    from tumortrack_experiment.record.read import Moment
    from tumortrack_experiment.register.beads import NamedBeads, Registration

_ORGAN_MM = (0.0, 0.0, 25.0)  # without a case: half an organ's height above the plate


@dataclass(frozen=True, kw_only=True)
class CalibrateRegister:
    """CT to camera, camera to robot, or CT to robot, by the beads of a kit's base; two or all
    three.

    Attributes:
        kit: folder that `phantom-kit` wrote.
        out: folder to write: report.json; of camera and robot also calibration.json, for
            `track --frame`, `plan` and `resect`.
        ct: DICOM folder or volume of the phantom on its base.
        series: which DICOM series, if the folder holds several.
        view: depth image (.png) of the base, a folder of them, or a recording (with --state).
        intrinsics: of a depth image; default: intrinsics.json beside it.
        state: of a recording.
        robot_points: .csv with x,y,z of the places that the robot pointed at, in its base frame,
            and bead (their names), if they are known.
        unit: of these places.
        pointed_at: where the tip touched each bead.
        case: folder that `prepare` wrote: errors are stated at its tumors, else at the organ.
        frame_id: the robot's frame.
        camera_frame_id: what the source's messages call the camera's frame.
        overwrite: replace OUT if it exists.
    """

    kit: Positional[Path]
    out: Positional[Path]
    ct: Path | None = None
    series: str | None = None
    view: Path | None = None
    intrinsics: Path | None = None
    state: str | None = None
    robot_points: Path | None = None
    unit: Literal["mm", "m"] = "mm"
    pointed_at: Literal["top", "middle"] = "top"
    case: Path | None = None
    frame_id: str = "base_link"
    camera_frame_id: str = ""
    overwrite: bool = False

    def run(self) -> None:
        from tumortrack.core.geometry import transform_points
        from tumortrack_experiment.kit_file import read_kit
        from tumortrack_experiment.register.beads import register

        store.check_place(self.out, "registration", self.overwrite)
        if sum(path is not None for path in (self.ct, self.view, self.robot_points)) < 2:
            raise InputError("give at least two of --ct, --view and --robot-points.")
        kit = read_kit(self.kit)
        found = self._found(kit)
        targets = self._targets(kit)
        said: dict[str, Any] = {"inputs": self._inputs(), "transforms": {}}
        calibration = None
        for first, second in (("ct", "camera"), ("camera", "robot"), ("ct", "robot")):
            if first in found and second in found:
                one = register(kit, found[first], found[second])
                at_first = found[first].device_from_base
                there = {name: transform_points(at_first, at) for name, at in targets.items()}
                name = f"{second}_from_{first}"
                said["transforms"][name] = one.report(there)
                _say(name, one, said["transforms"][name]["tre_mm"])
                if (first, second) == ("camera", "robot"):
                    calibration = self._calibration(one, there)
        with store.new_folder(self.out, self.overwrite) as aside:
            store.write_json(aside / "report.json", said)
            if calibration is not None:
                store.write_json(aside / "calibration.json", calibration)
            store.seal(aside, "registration", {"report": "report.json"}, "several")
        say(f"written to {self.out}.")

    def _inputs(self) -> dict[str, str]:
        given = {"kit": self.kit, "ct": self.ct, "view": self.view, "robot": self.robot_points}
        return {name: store.sha256_of(path) for name, path in given.items() if path is not None}

    def _found(self, kit: Kit) -> dict[str, NamedBeads]:
        """The kit's beads by what found them, in its frame."""
        found = {}
        if self.robot_points is not None:
            found["robot"] = self._pointed(kit, self.robot_points)
        if self.view is not None:
            from tumortrack_experiment.register.frames import still_beads

            moments = self._moments(self.view)
            found["camera"] = still_beads(kit, moments, self.state or str(self.view))[1]
        if self.ct is not None:
            from tumortrack.imaging.volume import read_volume
            from tumortrack_experiment.register.in_ct import beads_in_ct

            found["ct"] = beads_in_ct(kit, read_volume(self.ct, self.series))
        return found

    def _moments(self, view: Path) -> list[Moment]:
        from tumortrack.sense.files import read_depth_png
        from tumortrack_experiment.record.read import Moment
        from tumortrack_experiment.register.frames import moments_of, states_in

        if view.suffix.lower() == ".png":
            beside = self.intrinsics or view.parent / "intrinsics.json"
            return [Moment(read_depth_png(view, beside))]
        if self.intrinsics is not None:
            raise InputError(f"--intrinsics is for a depth image (.png); {view} has its own.")
        if self.state is None:
            return moments_of(view, "")
        states = states_in(view)
        if self.state not in states:
            raise InputError(f"{view} has no state {self.state!r}; it has {', '.join(states)}.")
        return moments_of(states[self.state], self.state)

    def _pointed(self, kit: Kit, path: Path) -> NamedBeads:
        from tumortrack.tracking.points import read_points
        from tumortrack_experiment.register.beads import ROBOT, name_beads

        table = read_points(path)
        points_mm = table.points_ct * (1000.0 if self.unit == "m" else 1.0)
        above_mm = kit.bead_diameter_mm / 2 if self.pointed_at == "top" else 0.0
        found = name_beads(kit, points_mm, ROBOT, above_mm)
        if "bead" in table.columns:
            column = table.columns.index("bead")
            places = points_mm - above_mm * found.device_from_base[:3, 2]
            for row, at in zip(table.rows, places, strict=True):
                nearest = int(((found.places_mm(kit) - at) ** 2).sum(1).argmin())
                if row[column] != (name := kit.beads[nearest].name):
                    raise InputError(
                        f"{path}: the place named {row[column]!r} is that of bead {name}, by its "
                        "distances from the others. Correct the names, or leave out that column."
                    )
        return found

    def _targets(self, kit: Kit) -> dict[str, np.ndarray]:
        """Where errors are stated, base frame."""
        import numpy as np

        if self.case is None:
            return {"organ": np.array([_ORGAN_MM])}
        from tumortrack.core.geometry import transform_points
        from tumortrack_experiment.reference.case import case_of_kit

        anatomy = case_of_kit(self.case, kit).anatomy
        parts = list(zip(anatomy.names, anatomy.parts, strict=True))
        return {
            name: transform_points(np.array(kit.base_from_ct), part.vertices_mm.mean(0)[None])
            for name, part in parts[1:] or parts
        }

    def _calibration(self, one: Registration, targets: dict[str, np.ndarray]) -> dict[str, Any]:
        import numpy as np

        from tumortrack.core.config import to_builtins
        from tumortrack.live.calibration_file import CalibrationFile

        bound_mm = one.bound_mm(np.concatenate(list(targets.values())))
        file = CalibrationFile(
            frame_id=self.frame_id,
            unit="mm",
            robot_from_camera=tuple(map(tuple, one.to_from.tolist())),
            camera_frame_id=self.camera_frame_id,
            error_mm=bound_mm,
        )
        say(f"calibration: within {bound_mm:.2f} mm at the organ, with 95 % confidence")
        return {name: value for name, value in to_builtins(file).items() if value is not None}


def _say(name: str, one: Registration, tre_mm: dict[str, float]) -> None:
    say_notes(one.notes)
    errors = ", ".join(f"{at} {error:.2f}" for at, error in tre_mm.items())
    say(
        f"{name}: {len(one.beads)} beads, FRE {one.fre_mm:.2f} mm, largest leave-one-out "
        f"{one.without_mm.max():.2f} mm; expected TRE, mm: {errors}"
    )
