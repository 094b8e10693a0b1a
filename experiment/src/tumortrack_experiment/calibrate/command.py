"""`calibrate board`, `calibrate camera` and `calibrate hand-eye`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

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
    """

    squares: tuple[int, int] = (15, 21)
    square_mm: float = 12.0

    @property
    def board(self) -> Board:
        from tumortrack_experiment.calibrate.board import Board

        columns, rows = self.squares
        return Board(columns=columns, rows=rows, square_mm=self.square_mm)


@dataclass(frozen=True, kw_only=True)
class CalibrateBoard(WithBoard):
    """Draw the board to print.

    Attributes:
        out: .pdf, .svg or .png.
    """

    out: Positional[Path]

    def run(self) -> None:
        from tumortrack_experiment.calibrate.board import draw_board

        if self.out.exists():
            raise InputError(f"{self.out} exists already. Choose another file.")
        draw_board(self.board, self.out)
        say(f"written to {self.out}; print it at 100 %, and measure its rulers.")


@dataclass(frozen=True, kw_only=True)
class CalibrateCamera(WithBoard):
    """Intrinsics, lens distortion and depth errors, from pictures of the board.

    Attributes:
        pictures: folder of pictures (.png, .jpg) by the lens that depth belongs to (a D405's left
            infrared, or colour aligned to depth); or of a folder each with colour.png or
            infrared.png, depth.png and intrinsics.json.
        out: folder to write: intrinsics.json, lens.json, report.json, camera.png.
        overwrite: replace OUT if it exists.
    """

    pictures: Positional[Path]
    out: Positional[Path]
    overwrite: bool = False

    def run(self) -> None:
        store.check_place(self.out, "camera", self.overwrite)
        shots, seen = _with_board(self.pictures, self.board)

        from tumortrack_experiment.calibrate import report
        from tumortrack_experiment.calibrate.depth import correction, depth_report
        from tumortrack_experiment.calibrate.lens import LENS_FILE, fit_lens

        height, width = shots[0].grey.shape
        fit = fit_lens(seen, (width, height))
        said, warnings = report.lens_report(fit, seen, [shot.name for shot in shots])
        planes, device = self._planes(shots, seen, fit.lens)
        said["device"] = report.beside(device, fit.lens) if device else None
        if planes:
            said["depth"], more = depth_report(planes, fit.lens)
            warnings += more
        else:
            said["depth"] = None
            warnings.append("no depth images of the board: how far depth is off is unknown")
        said = {"board": self._board(), **said, "warnings": warnings}
        pinhole = report.pinhole_json(fit.pinhole) | correction(said["depth"] or {})
        with store.new_folder(self.out, self.overwrite) as aside:
            store.write_json(aside / "intrinsics.json", pinhole)
            store.write_json(aside / LENS_FILE, report.lens_json(fit.lens))
            store.write_json(aside / "report.json", said)
            report.draw_camera(aside / "camera.png", fit.lens, [seen[n] for n in fit.used], said)
            store.seal(aside, "camera", {"report": "report.json"}, "camera")
        for line in [*report.camera_words(said), *(f"warning: {one}." for one in warnings)]:
            say(line)
        say(f"written to {self.out}; give `track` and `locate` its intrinsics.json (--intrinsics).")

    def _board(self) -> dict[str, Any]:
        return {"squares": list(self.squares), "square_mm": self.square_mm}

    def _planes(
        self, shots: list[Shot], seen: dict[int, Corners], lens: Lens
    ) -> tuple[list[PlaneErrors], Lens | None]:
        """Of the depth images, and the camera that their files state."""
        from tumortrack_experiment.calibrate.depth import plane_errors, same_pose
        from tumortrack_experiment.calibrate.lens import lens_of

        found, device, pose, before = [], None, 0, None
        for n, corners in seen.items():
            if (read := shots[n].depth) is None:
                continue
            frame = read()
            if frame.depth_mm.shape != shots[n].grey.shape:
                raise InputError(
                    f"{shots[n].name}: picture and depth image differ in size; align them, or take "
                    "the infrared picture that the depth is of."
                )
            device = lens_of(frame.intrinsics, [0.0] * 5)
            pose += before is None or not same_pose(before, corners)
            before = corners
            one = plane_errors(frame, lens, corners, lens.place(corners)[0], pose)
            found += [one] if one is not None else []
        return found, device


@dataclass(frozen=True, kw_only=True)
class CalibrateHandEye(WithBoard):
    """Where a camera is on a robot's tool, or before its base, with a bound of the error.

    Attributes:
        pictures: folder of pictures of the board, as for `calibrate camera`: 20 or more, the wrist
            turned by 20 degrees or more about two axes.
        poses: the tool's in the robot's base, for each picture: a table as for `track --moving`
            (.csv), or JSON with base_from_tool (4 x 4 rows each), unit (mm or m) and frame_id.
        out: folder to write: calibration.json for `track --frame` and `plan --frame`, report.json.
        lens: lens.json of these pictures' camera, that `calibrate camera` wrote, or its intrinsics.
        eye_to_hand: the camera stands still, and the board is on the tool.
        distance: of the organ from the camera, mm, where the error is stated.
        camera_frame_id: what the source's messages call the camera's frame.
        overwrite: replace OUT if it exists.
    """

    pictures: Positional[Path]
    poses: Positional[Path]
    out: Positional[Path]
    lens: Path
    eye_to_hand: bool = False
    distance: float = 150.0
    camera_frame_id: str = ""
    overwrite: bool = False

    def run(self) -> None:
        store.check_place(self.out, "hand-eye calibration", self.overwrite)
        if not 30 <= self.distance <= 3000:
            raise InputError(f"--distance {self.distance:g} is not allowed; choose 30 to 3000 mm.")

        import numpy as np

        from tumortrack.core.config import to_builtins
        from tumortrack.live.calibration_file import CalibrationFile
        from tumortrack_experiment.calibrate.hand_eye import solve
        from tumortrack_experiment.calibrate.lens import read_lens
        from tumortrack_experiment.calibrate.pictures import read_robot_poses

        lens = read_lens(self.lens)
        shots, seen = _with_board(self.pictures, self.board)
        if shots[0].grey.shape != (lens.height, lens.width):
            raise InputError(
                f"{self.lens} is of {lens.width} x {lens.height}; the pictures have another size."
            )
        frame_id, base_from_tool = read_robot_poses(self.poses, shots)
        poses = base_from_tool[list(seen)]
        poses = np.linalg.inv(poses) if self.eye_to_hand else poses
        names = [shots[n].name for n in seen]
        found, said, warnings = solve(poses, list(seen.values()), names, lens, self.distance)
        key = "robot_from_camera" if self.eye_to_hand else "tool_from_camera"
        file = CalibrationFile(
            frame_id=frame_id,
            unit="mm",
            camera_frame_id=self.camera_frame_id,
            error_mm=said["error_mm"],
            error_deg=said["error_deg"],
            **{key: tuple(map(tuple, found.tolist()))},
        )
        content = {name: value for name, value in to_builtins(file).items() if value is not None}
        with store.new_folder(self.out, self.overwrite) as aside:
            store.write_json(aside / "calibration.json", content)
            store.write_json(aside / "report.json", {**said, "warnings": warnings})
            store.seal(aside, "hand-eye calibration", {"report": "report.json"}, frame_id)
        for name, one in said["methods"].items():
            say(
                f"{name}: {one['leave_one_out_rms_mm']:.2f} mm off where it was left out (root "
                f"mean square), {one['from_chosen_mm']:.2f} mm from the chosen one"
            )
        say(
            f"{said['method']}, {said['used']} of {len(shots)} pictures: with 95 % confidence "
            f"within {said['error_at_organ_mm']:.2f} mm at {self.distance:g} mm."
        )
        for one in warnings:
            say(f"warning: {one}.")
        how = "--moving with --frame" if key == "tool_from_camera" else "--frame"
        say(f"written to {self.out}; calibration.json is for {how}.")


def _with_board(folder: Path, board: Board) -> tuple[list[Shot], dict[int, Corners]]:
    """The pictures, and by their numbers the board's corners where it shows."""
    from tumortrack_experiment.calibrate.board import find_boards
    from tumortrack_experiment.calibrate.pictures import read_shots

    shots = read_shots(folder)
    found = find_boards([shot.grey for shot in shots], board)
    seen = {n: corners for n, corners in enumerate(found) if corners is not None}
    say(f"the board is in {len(seen)} of {len(shots)} pictures.")
    return shots, seen
