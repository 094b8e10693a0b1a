"""All errors. A message says what was wrong, what is allowed and what to do."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

from tumortrack.core.renamed import attributes_of
from tumortrack.core.wording import for_caller

if TYPE_CHECKING:
    from tumortrack.core.report import Finding, Likely
else:
    __getattr__ = attributes_of(__name__)

# Of `locate`, by its verdict; each of them with a folder written.
EXIT_STATUSES = {"good": 0, "poor": 4, "none": 3}


class TumortrackError(Exception):
    """Base of errors raised on purpose: the command line prints the message on one line and exits
    with ``exit_code``. Any other exception is a bug and keeps its traceback. The message names
    options as the command line does there, and elsewhere as keywords."""

    exit_code = 1

    def __str__(self) -> str:
        return for_caller(Exception.__str__(self))


class InputError(TumortrackError):
    """Unusable input: a file, a number, a combination of options."""

    exit_code = 2


class UnknownPart(InputError, KeyError):
    """A name that no part of an estimate has."""


@contextmanager
def readable(file: object, fault: str = "cannot be read") -> Iterator[None]:
    """Libraries raise anything on a damaged ``file``: in this context it becomes an InputError."""
    try:
        yield
    except TumortrackError:
        raise
    except Exception as error:
        reason = (str(error).strip().splitlines() or [type(error).__name__])[-1]
        raise InputError(f"{file} {fault}: {reason.strip().rstrip('.')}.") from error


class ArtifactError(InputError):
    """A case, model or run folder is missing, damaged, or of another kind or schema."""


class PackageError(InputError):
    """A requested package is installed but broken."""


class NoEstimate(TumortrackError):
    """The input is well formed but allows no answer (too few points, no organ).

    ``finding``: the reason by its kind; None where none was given. ``causes``: the most likely
    first, where they were looked for. ``advice``: what they mean and what to do, in words."""

    exit_code = EXIT_STATUSES["none"]

    def __init__(
        self, reason: str | Finding, causes: tuple[Likely, ...] = (), advice: str = ""
    ) -> None:
        self.finding = None if isinstance(reason, str) else reason
        super().__init__((reason if isinstance(reason, str) else reason.message) + advice)
        self.causes = causes


class NotThisOrgan(NoEstimate):
    """The points, in mm in the camera frame, cannot be the model's organ."""


class NoPlan(TumortrackError):
    """What was located cannot be cut out as requested."""

    exit_code = 3


class StorageError(TumortrackError):
    """The disk refused a write; what was there before is intact."""

    exit_code = 2
