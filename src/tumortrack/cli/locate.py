"""A model on clouds: `locate`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional, UseAppendAction

from tumortrack.cli.console import (
    console,
    inputs_and_out,
    keep_loaded,
    model_folder,
    options_of,
    say,
    say_json,
    say_notes,
)
from tumortrack.core import store
from tumortrack.core.errors import EXIT_STATUSES, InputError, NoEstimate
from tumortrack.tracking.options import LocateOptions, check_grid

if TYPE_CHECKING:
    from tumortrack.core.estimate import Estimate
    from tumortrack.report.locating import Located


_USAGE = "locate CASE CLOUD [MORE ...] --out OUT"
_MOST_SAID = 12  # pieces of evidence that agree: of more, their number alone


@dataclass(frozen=True, kw_only=True)
class Locate(LocateOptions):
    """Locate organ and tumors in one cloud or depth image, or in several of the organ at rest.

    In a depth image the organ is found among table, drapes, instruments and hands, as `track` does
    it; a cloud is taken for the organ alone, unless --box is given. OUT/index.html shows the
    answer. Exit status: 0 good; 4 poor (all is written); 3 no estimate (OUT says why); 2 an error.

    Attributes:
        model: a case, or a folder that `train` wrote.
        cloud: .ply, .pcd or .npz in the camera frame, or a depth image (with --intrinsics): 16-bit
            PNG or TIFF, or a TIFF of floats; or -: none, but touches or outlines (--evidence).
        more: further views of an organ that does not move in between; they need --poses, and the
            answer is in the first one's frame.
        out: folder to write.
        json: print the report (OUT/report.json); sentences go to standard error.
        overwrite: replace OUT if it exists.
    """

    model: Positional[Path]
    cloud: Positional[Path]
    more: Positional[tuple[Path, ...]] = ()
    out: Path | None = None
    intrinsics: UseAppendAction[tuple[Path, ...]] = ()
    evidence: UseAppendAction[tuple[Path, ...]] = ()
    json: bool = False
    overwrite: bool = False

    def run(self) -> int:
        """The exit status, by the verdict."""
        from tumortrack import api
        from tumortrack.io.run_folder import has_no_estimate
        from tumortrack.report.seen import PAGE

        check_grid(self.grid)
        console.stderr = self.json
        clouds, out = inputs_and_out((self.cloud, *self.more), self.out, _USAGE)
        if self.model.is_file() and (self.cloud / store.MANIFEST).is_file():
            raise InputError(
                f"{self.model} stands where the model belongs, and {self.cloud} where the cloud. "
                f"The order is: tumortrack locate {self.cloud} {self.model} --out {out}"
            )
        overwrite = self.overwrite or has_no_estimate(out)
        store.check_place(out, "run", overwrite)
        model_folder(self.model)
        located = api.locate_files(self.model, clouds, **options_of(self, LocateOptions))
        if located.estimate is not None:
            _say_estimate(located.estimate, located)
        located.save(out, overwrite)  # slow imports come after the verdict
        if located.estimate is not None:
            _say_written(located.estimate, located, out)
        if self.json:
            say_json(located.report)
        keep_loaded()  # a quicker end
        if located.estimate is None:
            raise NoEstimate(
                f"none: {located.reason} What was seen: {out / PAGE}"
            ) from located.error
        return EXIT_STATUSES[located.estimate.quality]


def _say_estimate(estimate: Estimate, located: Located) -> None:
    """The verdict, and where each part is."""
    from tumortrack.core.estimate import verdict_words
    from tumortrack.report.seen import other_lines, part_rows, row_words

    report = estimate.report
    say(verdict_words(estimate.quality, estimate.reason))
    say(str(estimate.patient))
    for row in part_rows(report, estimate.assessment):
        say(row_words(row))
    agree = sum(not each.rejected for each in report.evidence)
    for number, each in enumerate(report.evidence, start=1):
        if each.rejected or agree <= _MOST_SAID:
            say(f"{each.name} {number}: {each.off_mm:.1f} mm off{', left out' * each.rejected}")
    if agree > _MOST_SAID:
        say(f"{agree} pieces of evidence agree with the answer")
    for line in other_lines(estimate):
        say(line)
    for view in located.about["input"]:
        say(view["message"])
    say_notes(located.about["notes"])


def _say_written(estimate: Estimate, located: Located, out: Path) -> None:
    from tumortrack.report.seen import PAGE

    if located.points is not None:
        count, file = len(located.points.points_ct), out / "points.csv"
        say(f"{count} points of the CT: their places are in {file}")
    seconds = estimate.report.timings["total"]
    say(f"written to {out} ({estimate.frame} frame, mm) in {seconds:.2f} s; look at {out / PAGE}.")
