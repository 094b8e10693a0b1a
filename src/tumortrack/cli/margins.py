"""`margins`: how far a tumor may be from where a model says that it is."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import Device, keep_loaded, model_folder, progress_bar, say
from tumortrack.core import store
from tumortrack.core.config import check_seed
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    from tumortrack.models.margins import ModelMargins
    from tumortrack.report.calibration import Listed
    from tumortrack.report.calibration_table import Row


@dataclass(frozen=True, kw_only=True)
class Margins:
    """Calibrate a model: the margin that its tumors lie in, in 95 of 100 cases like the scenes.

    Attributes:
        model: a case, or a folder that `train` wrote; the margins are kept in it.
        scenes: folders of scene folders whose truth is known.
        confidence: the shares of cases in which the margins are to hold.
        widest: answers that miss by more mm than this are to be kept out.
        out: file for what was found scene by scene; what is in it already is not located again
            (default: MODEL/margins.jsonl).
        seed: of the scene that stands for each state, and of what it is used for.
        device: auto takes CUDA if there is a GPU.
    """

    model: Positional[Path]
    scenes: Positional[tuple[Path, ...]] = ()
    confidence: tuple[float, ...] = (0.9, 0.95)
    widest: float = 8.0
    out: Path | None = None
    seed: int = 0
    device: Device = "auto"

    def run(self) -> None:
        from tumortrack.models.folder import read_model_manifest
        from tumortrack.models.margins import keep_margins

        if not self.confidence or not all(0.5 <= one <= 0.99 for one in self.confidence):
            raise InputError("--confidence: give shares from 0.5 to 0.99, as 0.9 0.95.")
        if not 0.5 <= self.widest <= 20:
            raise InputError(f"--widest {self.widest:g} is not allowed; choose 0.5 to 20 mm.")
        check_seed(self.seed)
        if not self.scenes:
            raise InputError("give folders of scenes: tumortrack margins MODEL SCENES.")
        folder = model_folder(self.model)
        read_model_manifest(folder)
        margins = self._calibrated(folder)
        path = keep_margins(folder, margins)
        for line in described(margins):
            say(line)
        say(f"written to {path}; `locate`, `track` and `plan` state them from now on.")

    def _calibrated(self, folder: Path) -> ModelMargins:
        from tumortrack.report import calibration, calibration_table

        listed = calibration.list_states(self.scenes, self.seed)
        highest = max(self.confidence)
        if len(listed) < (needed := calibration.least_states(highest)):
            raise InputError(
                f"{len(listed)} scenes given, a state each; about {needed} are needed for margins "
                f"that hold in {100 * highest:g} % of cases. Give more, or a lower --confidence."
            )
        digest = store.sha256_of(folder / store.MANIFEST)
        table = self.out or folder / "margins.jsonl"
        head = calibration_table.head_of(digest, self.seed)
        with calibration_table.open_table(table, head) as (known, add):
            rows = self._located(folder, listed, known, add)
        of = store.sha256_of(table)
        return calibration.margins_of(rows, of, self.confidence, self.widest, self.seed)

    def _located(
        self, folder: Path, listed: list[Listed], known: list[Row], add: Callable[[Row], None]
    ) -> list[Row]:
        """A row for every state; those that are known are not located again."""
        states = {str(one.folder.resolve()): one for one in listed}
        done = {row.scene: row for row in known}
        for scene, one in states.items():
            if scene in done and done[scene].sha256 != store.sha256_of(one.folder):
                raise InputError(
                    f"{one.folder} was changed since it was located. Remove the table, or give "
                    "another --out."
                )
        left = [one for scene, one in states.items() if scene not in done]
        if not left:
            return [done[scene] for scene in states]
        with progress_bar("locating", len(left)) as advance:
            from tumortrack.cli.evaluate import check_case
            from tumortrack.report.calibration import row_of
            from tumortrack.simulate.scene_folder import read_scene
            from tumortrack.tracking.model_files import load_model
            from tumortrack.tracking.tracker import Tracker

            keep_loaded()
            model = load_model(folder, self.device, with_margins=False)
            check_case(model, [one.folder for one in left])
            tracker = Tracker(model)
            for one in left:
                row = row_of(tracker, read_scene(one.folder), one, self.seed)
                add(row)
                done[row.scene] = row
                advance()
        return [done[scene] for scene in states]


def described(margins: ModelMargins) -> list[str]:
    """Lines for the screen: radii, what they rest on, and where there is no answer."""
    lines = []
    for shells in margins.shells:
        for kind, radius in shells.radii.items():
            size = f"{radius.constant_mm:.1f} mm"
            if radius.used == "scaled":
                size = f"{radius.offset_mm:g} mm + largest deviation"
                if radius.bend_mm:
                    size += f" + {radius.bend_mm:g} mm x root of rarity"
                size = f"{radius.scaled:.2f} x ({size})"
            lines.append(f"{100 * shells.confidence:g} % margin of {_WHAT[kind]}: {size}")
    lines += [
        f"{', '.join(group.label)} (family, visible share, organ): {group.states} states, "
        f"{group.good} good, {group.accepted} with an answer: {group.tested} to test limits, "
        f"{group.calibrated} to find margins"
        for group in margins.groups
    ]
    lines += [f"{small} has too few of them: {large} counts instead" for small, large in
              margins.joined.items()]  # fmt: skip
    limits = ", ".join(f"{name} {limit:.3g}" for name, limit in margins.limits.items())
    return [
        *lines,
        f"no answer where one of these is exceeded: {limits}",
        f"of all states {100 * margins.accepted:.0f} % have an answer, "
        f"{100 * margins.missed:.1f} % one that is outside the widest margin; of the worst group's "
        f"answers these are no more than {100 * margins.risk_bound:.1f} %, with 95 % confidence",
    ]


_WHAT = {"tumor": "a tumor's surface", "organ": "the organ's surface", "map": "mapped points"}
