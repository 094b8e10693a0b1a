"""`tumortrack margins`: by what a model's error bounds are to be multiplied."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import Device, keep_loaded, model_folder, progress_bar, say
from tumortrack.core import store
from tumortrack.core.config import check_seed
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack_benchmarks.margins import Row


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Calibrate a model's error bounds: find by what they are to be multiplied so that they hold in
    95 of 100 cases like the scenes. Every answer of the model is given with it from then on.

    Attributes:
        model: a case, or its model's folder; the factor is kept in it.
        scenes: folders of scene folders whose truth is known.
        out: file for what was found scene by scene; what is in it already is not located again
            (default: MODEL/margins.jsonl).
        seed: of the scene that stands for each state.
        device: auto takes CUDA if there is a GPU.
    """

    model: Positional[Path]
    scenes: Positional[tuple[Path, ...]] = ()
    out: Path | None = None
    seed: int = 0
    device: Device = "auto"

    def run(self) -> None:
        """Raises InputError: scenes that can't be used, or too few of them."""
        from tumortrack.assessment.bound_factor import NAME, write_factor
        from tumortrack.io.model_folder import read_model_manifest
        from tumortrack_benchmarks.margins import LEAST, found_factor, list_states

        check_seed(self.seed)
        if not self.scenes:
            raise InputError("give folders of scenes: tumortrack margins MODEL SCENES.")
        folder = model_folder(self.model)
        read_model_manifest(folder)
        states = list_states(self.scenes, self.seed)
        if len(states) < LEAST:
            raise InputError(
                f"{len(states)} scenes given, a state each; {LEAST} good answers are needed. Give "
                "more scenes."
            )
        digest = store.sha256_of(folder / store.MANIFEST)
        table = self.out or folder / "margins.jsonl"
        rows = located(folder, states, table, self.seed, self.device)
        found = found_factor(rows, digest, store.sha256_of(table), self.seed)
        write_factor(folder / NAME, found)
        say(f"{found.message}; written to {folder / NAME}, all answers are given so from now on.")


def located(
    folder: Path, states: list[Path], table: Path, seed: int, device: Device = "auto"
) -> list[Row]:
    """The rows of every state, located with the model of this folder; those in the table are not
    located again. Raises InputError: a scene was changed since then."""
    from tumortrack.io.scene_folder import read_scene
    from tumortrack.report.protocol import check_case
    from tumortrack.tracking.model_files import load_model
    from tumortrack.tracking.tracker import Tracker
    from tumortrack_benchmarks.margins import Locating, head_of, open_table

    scenes = {str(state.resolve()): state for state in states}
    with open_table(table, head_of(store.sha256_of(folder / store.MANIFEST), seed)) as (known, add):
        done = {row.scene: row for row in known}
        for scene, state in scenes.items():
            if scene in done and done[scene].sha256 != store.sha256_of(state):
                raise InputError(
                    f"{state} was changed since it was located. Remove the table, or give another "
                    "--out."
                )
        if left := [state for scene, state in scenes.items() if scene not in done]:
            with progress_bar("locating", len(left)) as advance:
                keep_loaded()
                model = load_model(folder, device)
                check_case(model, left)
                locating = Locating(Tracker(model), seed)
                for state in left:
                    row = locating.row(read_scene(state), state)
                    add(row)
                    done[row.scene] = row
                    advance()
    return [done[scene] for scene in scenes]
