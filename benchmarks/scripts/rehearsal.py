"""The experiment of docs/bench.md, rehearsed on a simulated bench.

    make rehearsal ARGS='CASE MODEL OUT'      (five minutes; goes on where it was stopped)

The commands are those of a laboratory, from kit to table; OUT keeps every file. Prints the error
that each states beside its true error. --document writes tables beside it.
"""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
import pandas as pd
import tyro
from rehearsal_bench import (
    BenchErrors,
    Hands,
    Setup,
    hold_board,
    looking_down,
    move_board,
    set_up,
)

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import TumortrackError
from tumortrack.core.geometry import Affine, transform_points
from tumortrack.core.organ import is_tumor
from tumortrack.core.types import Anatomy
from tumortrack.io.case import load_case
from tumortrack.io.scene_folder import read_scene, write_scene_files
from tumortrack.report.metrics import surface_distances
from tumortrack_benchmarks import scripting
from tumortrack_benchmarks.document import table_of
from tumortrack_benchmarks.physics.organ import transformed
from tumortrack_benchmarks.physics.tets import TETS
from tumortrack_benchmarks.physics.twin import Bench, solve
from tumortrack_experiment.calibrate.board import Board
from tumortrack_experiment.kit_file import Kit, read_kit

STATES = {"rest": "D0", "D1": "D1", "D2": "D2", "D3": "D3"}  # the kit's and the twin's
_ABOVE_MM, _TILT_DEG = 185.0, (8.0, -6.0)  # the camera over the base
_SECONDS = 2.0  # of each state
_BOARDS, _POSES = 24, 20


@dataclass(frozen=True)
class Options:
    """Rehearse the experiment with a case and its model."""

    case: tyro.conf.Positional[Path]
    """Folder that `tumortrack prepare` wrote."""
    model: tyro.conf.Positional[Path]
    """Its model, or the case again."""
    out: tyro.conf.Positional[Path]
    """Everything goes here."""
    document: Path | None = None
    """A page beside which the tables go."""


def main(options: Options) -> None:
    """Rehearse, and say what was found."""
    writer = scripting.begun("rehearsal", options.document)
    rehearsal = Rehearsal(options.case, options.model, options.out)
    rows, reports = rehearsal.run()
    frames = {"errors": pd.DataFrame(rows), "states": evaluation_rows(reports)}
    for name, frame in frames.items():
        frames[name] = frame.round(2)
        say(table_of(frames[name]))
    writer.tables({f"rehearsal-{name}": frame for name, frame in frames.items()})


class Row(NamedTuple):
    """An error in the chain, as a command states it and the true one, mm."""

    what: str
    stated_mm: float
    true_mm: float


@dataclass(frozen=True)
class Rehearsal:
    """Of a case and its model, into ``out``; finished steps are not repeated."""

    case: Path
    model: Path
    out: Path

    @cached_property
    def kit(self) -> Kit:
        return read_kit(self.out / "kit")

    @cached_property
    def hands(self) -> Hands:
        camera_from_base = looking_down(_ABOVE_MM, _TILT_DEG)
        return Hands(self.out / "camera", BenchErrors(), camera_from_base)

    @cached_property
    def states(self) -> dict[str, Anatomy]:
        """The organ in each state, CT frame (the press stands on the kit's base)."""
        case = load_case(self.case)
        self.out.mkdir(parents=True, exist_ok=True)
        bench = Bench.from_anatomy(case.anatomy, case.up_lps, self.out / TETS)
        rest, back, states = bench.stage.organ.anatomy, np.linalg.inv(bench.bench_from_ct), {}
        for name, of in STATES.items():
            state = solve(bench, of, say)
            there = rest.with_parts(
                part.with_vertices(state.forward(part.vertices_mm)) for part in rest.parts
            )
            states[name] = transformed(there, back)
        return states

    def setup(self, state: str) -> Setup:
        to_base = np.array(self.kit.base_from_ct)
        return set_up(self.kit, self.out / "kit", self.states[state], to_base, state)

    def run(self) -> tuple[list[Row], dict[str, Any]]:
        """All steps in order: the errors, and `evaluate`'s reports against the second CTs and
        against the truth."""
        self._once("kit", lambda: self._do("phantom-kit", self.case, self.out / "kit"))
        rows = [*self.calibrate_camera(), *self.calibrate_hand_eye()]
        self._once("recording", self.record)
        for state in STATES:
            self._once(f"ct/{state}", partial(self.scan, state))
            self._once(f"scenes/{state}", partial(self.reference, state))
        rows += [row for state in STATES for row in self.registered(state)]
        return rows, self.evaluated()

    def calibrate_camera(self) -> list[Row]:
        """The focal length and the depth, at 150 mm."""
        out, board = self.out / "camera-calibration", Board()
        self._once("held", lambda: hold_board(self.hands, board, self.out / "held", _BOARDS, 1))
        self._once(out.name, lambda: self._do("calibrate", "camera", self.out / "held", out))
        report, lens = (store.read_json(out / name) for name in ("report.json", "lens.json"))
        depth, errors, true = report["depth"], self.hands.errors, self.hands.true
        off_mm = (1 + depth["scale"]) * 150 + depth["offset_mm"]
        off_mm -= errors.depth_scale * 150 + errors.depth_offset_mm
        side_mm = 0.4 * 150  # a point beside the axis, seen by the wrong focal length
        focal = lens["fx"] / true.fx - 1
        return [
            Row("depth of the camera at 150 mm, corrected", depth["left_mm"], abs(off_mm)),
            Row("60 mm beside the axis, by the focal length",
                1.96 * lens["focal_std"] * side_mm, abs(focal) * side_mm),
        ]  # fmt: skip

    def calibrate_hand_eye(self) -> list[Row]:
        """The camera before a robot, at the organ."""
        out, folder = self.out / "hand-eye", self.out / "tool"
        middle = np.array([[0.0, 0.0, 20.0]])  # of the organ, base frame
        point = transform_points(self.hands.camera_from_base, middle)
        distance = f"{point[0, 2]:.0f}"
        if not folder.exists():
            move_board(self.hands, Board(), self.robot_from_camera, folder, _POSES, 2)
        lens = self.out / "camera-calibration" / "lens.json"
        options = ("--lens", lens, "--eye-to-hand", "--distance", distance)
        poses = ("--poses", folder.with_suffix(".json"))
        words = "calibrate", "hand-eye", folder, out, *options, *poses
        self._once(out.name, lambda: self._do(*words))
        true = self.robot_from_camera
        calibrated = np.array(store.read_json(out / "calibration.json")["robot_from_camera"])
        off_mm = transform_points(calibrated, point) - transform_points(true, point)
        stated_mm = store.read_json(out / "report.json")["bound_mm"]
        return [Row("hand-eye, at the organ", stated_mm, float(np.linalg.norm(off_mm)))]

    @cached_property
    def robot_from_camera(self) -> Affine:
        """The robot's base beside the bench."""
        robot_from_base = np.eye(4)
        robot_from_base[:3, 3] = [420.0, -80.0, 15.0]
        return robot_from_base @ np.linalg.inv(self.hands.camera_from_base)

    def record(self) -> None:
        """`record` asks for each state, which is then set up."""
        states = list(STATES)
        self.hands.plug_in()
        self.hands.show(self.setup(states[0]))
        command = self._command(
            "record", f"rehearsal:{self.hands.folder}", self.out / "recording", "--states", *states,
            "--kit", self.out / "kit", "--seconds", _SECONDS, "--countdown", 3, "--yes",
            "--intrinsics", self.out / "camera-calibration" / "intrinsics.json",
        )  # fmt: skip
        with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as process:
            assert process.stdout is not None
            for line in process.stdout:
                say(line.rstrip())
                words = line.split()
                if words[:1] == ["state"]:
                    self.hands.show(self.setup(words[4].rstrip(";")))
        if process.returncode:
            raise TumortrackError(f"record ended with {process.returncode}.")

    def scan(self, state: str) -> None:
        """Scan the phantom in this state."""
        out = self.out / "ct" / state
        out.parent.mkdir(exist_ok=True)
        seed = 10 + list(STATES).index(state)
        scanner_from_base = self.hands.scanned(self.setup(state), out, seed)
        rows = scanner_from_base.tolist()
        store.write_json(self.out / "ct" / f"{state}.json", {"scanner_from_base": rows})

    def reference(self, state: str) -> None:
        self._do(
            "reference", self.out / "ct" / state, self.out / "recording", self.out / "scenes",
            "--kit", self.out / "kit", "--case", self.case, "--state", state,
        )  # fmt: skip

    def truth(self, state: str) -> Anatomy:
        """The true anatomy; camera frame."""
        return transformed(self.setup(state).anatomy, self.hands.camera_from_base)

    def registered(self, state: str) -> list[Row]:
        """Errors of the reference: of the registration alone at each tumor, and with the
        segmentation of the second CT."""
        scene, truth = read_scene(self.out / "scenes" / state), self.truth(state)
        registration = scene.meta["registration"]
        scanner_from_base = np.array(
            store.read_json(self.out / "ct" / f"{state}.json")["scanner_from_base"]
        )
        true = self.hands.camera_from_base @ np.linalg.inv(scanner_from_base)
        camera_from_ct = np.array(registration["rows"])
        rows = []
        names = zip(truth.names[1:], truth.tumors, scene.reference.tumors, strict=True)
        for name, tumor, reference in names:
            middle = tumor.vertices_mm.mean(0, keepdims=True)
            in_ct = transform_points(np.linalg.inv(true), middle)
            off_mm = float(np.linalg.norm(transform_points(camera_from_ct, in_ct) - middle))
            stated_mm = registration["tre_mm"][name]
            rows.append(Row(f"{state}: registration at {name}", stated_mm, off_mm))
            apart = surface_distances(reference, tumor)
            rows.append(Row(f"{state}: surface of {name}, mean", stated_mm, apart.surface_mm))
        return rows

    def evaluated(self) -> dict[str, Any]:
        """`evaluate` against the second CTs, and on the same clouds against the truth."""
        for state in STATES:
            self._once(f"true-scenes/{state}", partial(self._write_truth, state))
        for scenes in ("scenes", "true-scenes"):
            self._do("evaluate", self.model, self.out / scenes, self.out / f"{scenes}-report")
        return {
            scenes: store.read_json(self.out / f"{scenes}-report" / "report.json")
            for scenes in ("scenes", "true-scenes")
        }

    def _write_truth(self, state: str) -> None:
        scene = read_scene(self.out / "scenes" / state)
        with store.new_folder(self.out / "true-scenes" / state) as aside:
            write_scene_files(aside, replace(scene, reference=self.truth(state), targets=None))

    def _once(self, name: str, make: Callable[[], object]) -> None:
        if not (self.out / name).exists():
            make()

    def _command(self, *words: object) -> list[str]:
        return [sys.executable, "-m", "tumortrack", *map(str, words)]

    def _do(self, *words: object) -> str:
        """Run a command; returns its output. Raises TumortrackError: it failed."""
        say("$ tumortrack " + " ".join(map(str, words)))
        done = subprocess.run(self._command(*words), capture_output=True, text=True, check=False)
        say(done.stdout.rstrip())
        if done.returncode:
            raise TumortrackError(done.stderr.strip())
        return done.stdout


def errors_mm(report: dict[str, Any]) -> dict[str, dict[str, float]]:
    """Tumors' errors in an evaluation: scene -> tumor -> mm between the boxes' centres."""
    return {
        scene["name"]: {
            name: part["center_mm"] for name, part in scene["parts"].items() if is_tumor(name)
        }
        for scene in report["scenes"]
    }


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


if __name__ == "__main__":
    scripting.run(main, Options)
