"""`calibrate board`, `calibrate camera` and `calibrate hand-eye`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack_experiment.calibrate.board import Board, Corners
    from tumortrack_experiment.calibrate.depth import PlaneErrors
    from tumortrack_experiment.calibrate.lens import Lens
    from tumortrack_experiment.calibrate.pictures import Shot


@dataclass(frozen=True, kw_only=True)
class WithBoard:
    """What says which board it is.

    Attributes:
        squares: of the board, across and down.
        square_mm: their size as it was printed: measure the board's whole length.
        overwrite: replace OUT if it exists.
    """

    squares: tuple[int, int] = (15, 21)
    square_mm: float = 12.0
    overwrite: bool = False

    @property
    def board(self) -> Board:
        from tumortrack_experiment.calibrate.board import Board

        columns, rows = self.squares
        return Board(columns=columns, rows=rows, square_mm=self.square_mm)

    def shown_in(self, folder: Path) -> tuple[list[Shot], dict[int, Corners]]:
        """The pictures, and by their numbers the board's corners where it shows."""
        from tumortrack_experiment.calibrate.board import find_boards
        from tumortrack_experiment.calibrate.pictures import read_shots

        shots = read_shots(folder)
        found = find_boards([shot.grey for shot in shots], self.board)
        seen = {n: corners for n, corners in enumerate(found) if corners is not None}
        say(f"the board is in {len(seen)} of {len(shots)} pictures.")
        return shots, seen


@dataclass(frozen=True, kw_only=True)
class CalibrateBoard(WithBoard):
    """Draw the board to print.

    Attributes:
        out: .pdf, .svg or .png.
    """

    out: Positional[Path]

    def run(self) -> None:
        from tumortrack_experiment.calibrate.board import draw_board

        if not (self.out.is_file() and self.overwrite):
            store.check_place(self.out, "board", self.overwrite)
        draw_board(self.board, self.out)
        say(f"written to {self.out}; print it at 100 %, and measure its rulers.")


@dataclass(frozen=True, kw_only=True)
class CalibrateCamera(WithBoard):
    """Intrinsics, lens distortion and depth errors, from pictures of the board.

    Attributes:
        pictures: what `record` wrote, each state a pose of the board; or a folder of pictures
            (.png, .jpg), or of folders with colour.png or infrared.png, depth.png and
            intrinsics.json. Of the lens that depth belongs to: a D405's left infrared, or colour
            in the depth image's pixels.
        out: folder to write: intrinsics.json, lens.json, report.json, camera.png.
    """

    pictures: Positional[Path]
    out: Positional[Path]

    def run(self) -> None:
        store.check_place(self.out, "camera", self.overwrite)
        shots, seen = self.shown_in(self.pictures)

        import numpy as np

        from tumortrack.core.config import to_builtins
        from tumortrack.io.depth_files import intrinsics_json
        from tumortrack_experiment.calibrate.depth import correction, depth_report
        from tumortrack_experiment.calibrate.lens import fit_lens, lens_of, rays_apart
        from tumortrack_experiment.calibrate.report import camera_words, draw_camera

        height, width = shots[0].grey.shape
        fit = fit_lens(seen, [shot.name for shot in shots], (width, height))
        lens, warnings = to_builtins(fit.lens), fit.warnings
        said = {"squares": self.squares, "square_mm": self.square_mm, "lens": lens, **fit.said}
        said["depth"], pinhole = None, intrinsics_json(fit.pinhole.camera)
        del pinhole["depth_unit_mm"]  # the depth images' own file says it
        if planes := _planes(shots, seen, fit.lens):
            device = next(shot.depth.intrinsics for shot in shots if shot.depth)
            off_mm = 150 * rays_apart(lens_of(device), fit.lens)
            rms_mm = float(np.sqrt(np.mean(off_mm**2)))
            said["device_off_mm"] = {"rms": rms_mm, "largest": float(off_mm.max())}
            said["depth"], more = depth_report(planes, fit.lens)
            warnings += more
            pinhole |= correction(said["depth"])
        else:
            warnings.append("no depth images of the board: how far depth is off is unknown")
        with store.new_folder(self.out, self.overwrite) as aside:
            store.write_json(aside / "intrinsics.json", pinhole)
            store.write_json(aside / "lens.json", lens)
            store.write_json(aside / "report.json", {**said, "warnings": warnings})
            draw_camera(aside / "camera.png", [seen[n] for n in fit.used], said)
            store.seal(aside, "camera", {"report": "report.json"}, "camera")
        for line in [*camera_words(said), *(f"warning: {one}" for one in warnings)]:
            say(f"{line}.")
        say(f"written to {self.out}; `track`, `locate`: --intrinsics {self.out}/intrinsics.json.")


@dataclass(frozen=True, kw_only=True)
class CalibrateHandEye(WithBoard):
    """Where a camera is on a robot's tool, or before its base, with a bound of the error.

    Attributes:
        pictures: as for `calibrate camera`: 20 or more, the wrist turned by 20 degrees or more
            about two axes, each from where the camera will work.
        out: folder to write: calibration.json for `track --frame` and `plan --frame`, report.json.
        lens: lens.json of these pictures' camera, that `calibrate camera` wrote, or intrinsics.
        poses: the tool's in the robot's base: a table as for `track --moving file:` (.csv; pictures
            then need stamps), or JSON with base_from_tool (4 x 4 rows for each picture), unit (mm
            or m) and frame_id. Without: those of the recording.
        eye_to_hand: the camera stands still, and the board is on the tool.
        distance: of the organ from the camera, mm, where the error is stated.
        camera_frame_id: what the source's messages call the camera's frame.
    """

    pictures: Positional[Path]
    out: Positional[Path]
    lens: Path
    poses: Path | None = None
    eye_to_hand: bool = False
    distance: float = 150.0
    camera_frame_id: str = ""

    def run(self) -> None:
        store.check_place(self.out, "hand-eye calibration", self.overwrite)
        if not 30 <= self.distance <= 3000:
            raise InputError(f"--distance {self.distance:g} is not allowed; choose 30 to 3000 mm.")

        import numpy as np

        from tumortrack_experiment.calibrate.depth import same_pose
        from tumortrack_experiment.calibrate.hand_eye import HandEyeData, described, solve
        from tumortrack_experiment.calibrate.lens import read_lens
        from tumortrack_experiment.calibrate.pictures import with_poses

        lens = read_lens(self.lens)
        shots, seen = self.shown_in(self.pictures)
        if shots[0].grey.shape != (lens.height, lens.width):
            raise InputError(
                f"{self.lens} is of {lens.width} x {lens.height}; the pictures have another size."
            )
        frame_id, shots = with_poses(shots, self.poses or self.pictures)
        once: list[int] = []  # a pose seen twice would vouch for itself
        for n in seen:
            if not once or not same_pose(seen[once[-1]], seen[n]):
                once.append(n)
        poses = np.array([shots[n].base_from_tool for n in once])
        if self.eye_to_hand:
            poses = np.linalg.inv(poses)
        places = np.array([lens.place(seen[n])[0] for n in once])
        data = HandEyeData(poses, places, self.eye_to_hand)
        names = [shots[n].name for n in once]
        found, said, warnings = solve(data, names, self.distance, lens.focal_std)
        way = "robot_from_camera" if self.eye_to_hand else "tool_from_camera"
        content = {
            "frame_id": frame_id,
            "unit": "mm",
            way: found.tolist(),
            "camera_frame_id": self.camera_frame_id,
            "error_mm": said["error_mm"],
            "error_deg": said["error_deg"],
        }
        with store.new_folder(self.out, self.overwrite) as aside:
            store.write_json(aside / "calibration.json", content)
            store.write_json(aside / "report.json", {**said, "warnings": warnings})
            store.seal(aside, "hand-eye calibration", {"report": "report.json"}, frame_id)
        for line in [*described(said), *(f"warning: {one}" for one in warnings)]:
            say(f"{line}.")
        moving = "" if self.eye_to_hand else "--moving ... "
        say(f"written to {self.out}; {moving}--frame {self.out}/calibration.json.")


def _planes(shots: list[Shot], seen: dict[int, Corners], lens: Lens) -> list[PlaneErrors]:
    """Of the depth images that show the board."""
    from tumortrack_experiment.calibrate.depth import plane_errors, same_pose

    found, pose, before = [], 0, None
    for n, corners in seen.items():
        pose += before is None or not same_pose(before, corners)
        before = corners
        if (frame := shots[n].depth) is not None:
            found.append(plane_errors(frame, lens, corners, pose))
    return [one for one in found if one is not None]
