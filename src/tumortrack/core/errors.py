"""The one error tree. A message says what was wrong, what is allowed and what to do."""

from __future__ import annotations

from tumortrack.core.causes import Likely


class TumortrackError(Exception):
    """Base of every error raised on purpose: the command line prints its text as one line and exits
    with ``exit_code``. Any other exception is a defect of ours and keeps its traceback."""

    exit_code = 1


class InputError(TumortrackError):
    """What the user gave cannot be used: a file, a number, a combination of options."""

    exit_code = 2


class ArtifactError(InputError):
    """A case, model or run folder is missing, damaged, or of another kind or schema."""


class PackageError(InputError):
    """An installed package that is asked for is broken."""


class NoEstimate(TumortrackError):
    """The input is well formed but allows no answer (too few points, no organ). ``causes``:
    the likeliest first, where they were looked for."""

    exit_code = 3

    def __init__(self, text: str, causes: tuple[Likely, ...] = ()) -> None:
        super().__init__(text)
        self.causes = causes


class NotThisOrgan(NoEstimate):
    """The points cannot be the model's organ, in mm in the camera's frame."""


class NoPlan(TumortrackError):
    """What was located cannot be cut out as requested, and why."""

    exit_code = 3


class Aborted(TumortrackError):
    """Arms were stopped for good before they had finished, and why."""

    exit_code = 3


class StorageError(TumortrackError):
    """The disk refused a write; what was there before is still whole."""

    exit_code = 2
