"""`tumortrack margins`: how far tumors may be from their estimates."""

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
    from tumortrack.tracking.margins import ModelMargins
    from tumortrack_lab.margins.calibration import Listed
    from tumortrack_lab.margins.table import Row


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Calibrate a model: the margin that its tumors lie in, in 95 of 100 cases like the scenes.

    Attributes:
        model: a case, or a folder that `train` wrote; the margins are kept in it.
        scenes: folders of scene folders whose truth is known.
        confidence: the shares of cases in which the margins are to hold.
        evidence: what margins are found with, besides those of clouds alone: kinds and least
            numbers of pieces, as touch12, outline1 (of each tumor), held1, landmark2 or
            touch6+outline1. It is drawn for the same scenes, with the errors of tools. Name all
            that the model is to have.
        widest: answers that miss by more mm than this are to be kept out.
        out: file for what was found scene by scene; what is in it already is not located again
            (default: MODEL/margins.jsonl; with evidence its name is added).
        seed: of the scene that stands for each state, and of what it is used for.
        device: auto takes CUDA if there is a GPU.
    """

    model: Positional[Path]
    scenes: Positional[tuple[Path, ...]] = ()
    confidence: tuple[float, ...] = (0.9, 0.95)
    evidence: tuple[str, ...] = ()
    widest: float = 8.0
    out: Path | None = None
    seed: int = 0
    device: Device = "auto"

    def run(self) -> None:
        """Raises InputError: options or scenes that can't be used, too few of them, no limits that
        hold."""
        import msgspec

        from tumortrack.models.folder import read_model_manifest
        from tumortrack.tracking.margins import described, keep_margins
        from tumortrack_lab.margins.calibration import evidence_of, least_states, list_states

        highest = max(self.confidence, default=0.0)
        if not self.confidence or not all(0.5 <= share <= 0.99 for share in self.confidence):
            raise InputError("--confidence: give shares from 0.5 to 0.99, as 0.9 0.95.")
        if not 0.5 <= self.widest <= 20:
            raise InputError(f"--widest {self.widest:g} is not allowed; choose 0.5 to 20 mm.")
        check_seed(self.seed)
        asked = [evidence_of(name) for name in self.evidence]
        if not self.scenes:
            raise InputError("give folders of scenes: tumortrack margins MODEL SCENES.")
        folder = model_folder(self.model)
        read_model_manifest(folder)
        listed = list_states(self.scenes, self.seed)
        if len(listed) < (needed := least_states(highest)):
            raise InputError(
                f"{len(listed)} scenes given, a state each; about {needed} are needed for margins "
                f"that hold in {100 * highest:g} % of cases. Give more, or a lower --confidence."
            )
        margins, *others = [self._calibrated(folder, listed, each) for each in ({}, *asked)]
        margins = msgspec.structs.replace(margins, others=tuple(others))
        path = keep_margins(folder, margins)
        for line in described(margins):
            say(line)
        say(f"written to {path}; `locate`, `track` and `plan` state them from now on.")

    def _calibrated(
        self, folder: Path, listed: list[Listed], evidence: dict[str, int]
    ) -> ModelMargins:
        """With this evidence beside the clouds, by a table of its own."""
        import msgspec

        from tumortrack.tracking.margins import evidence_words
        from tumortrack_lab.margins.calibration import margins_of

        first = self.out or folder / "margins.jsonl"
        table, rows = located(folder, listed, evidence, first, self.seed, self.device)
        digest = store.sha256_of(table)
        try:
            margins = margins_of(rows, digest, self.confidence, self.widest, self.seed)
        except InputError as error:
            words = f"with {evidence_words(evidence)}: " if evidence else ""
            raise InputError(f"{words}{error}") from error
        return msgspec.structs.replace(margins, evidence=evidence)


def located(
    folder: Path,
    listed: list[Listed],
    evidence: dict[str, int],
    first: Path,
    seed: int,
    device: Device = "auto",
) -> tuple[Path, list[Row]]:
    """Every state located with the model of this folder and evidence that is drawn: the table, the
    ``first`` one or with evidence another beside it, and its rows. Known ones are not located
    again. Raises InputError: a scene was changed since then."""
    from tumortrack.report.protocol import check_case
    from tumortrack.simulate.scene_folder import read_scene
    from tumortrack.tracking.margins import evidence_words
    from tumortrack.tracking.model_files import load_model
    from tumortrack.tracking.tracker import Tracker
    from tumortrack_lab.margins.calibration import row_of
    from tumortrack_lab.margins.table import head_of, open_table

    table, head = first, head_of(store.sha256_of(folder / store.MANIFEST), seed)
    if evidence:
        words = evidence_words(evidence)
        table, head = first.with_stem(f"{first.stem}-{words}"), {**head, "evidence": words}
    states = {str(state.folder.resolve()): state for state in listed}
    with open_table(table, head) as (known, add):
        done = {row.scene: row for row in known}
        for scene, state in states.items():
            if scene in done and done[scene].sha256 != store.sha256_of(state.folder):
                raise InputError(
                    f"{state.folder} was changed since it was located. Remove the table, or give "
                    "another --out."
                )
        if left := [state for scene, state in states.items() if scene not in done]:
            with progress_bar("locating", len(left)) as advance:
                keep_loaded()
                model = load_model(folder, device, with_margins=False)
                check_case(model, [state.folder for state in left])
                tracker = Tracker(model)
                for state in left:
                    row = row_of(tracker, read_scene(state.folder), state, seed, evidence)
                    add(row)
                    done[row.scene] = row
                    advance()
    return table, [done[scene] for scene in states]
