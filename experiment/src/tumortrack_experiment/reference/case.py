"""The case that a kit was made of."""

from __future__ import annotations

from pathlib import Path

from tumortrack.core.errors import InputError
from tumortrack.core.store import MANIFEST, sha256_of
from tumortrack.imaging.case import Case, load_case
from tumortrack_experiment.kit_file import Kit


def case_of_kit(folder: Path, kit: Kit) -> Case:
    """The case in a folder. Raises InputError: none, or not the one that the kit was made of."""
    case = load_case(folder)
    if sha256_of(folder / MANIFEST) != kit.case_sha256:
        raise InputError(
            f"{folder} is not the case that this kit was made of, so its tumors lie elsewhere. "
            "Give the case that `tumortrack phantom-kit` was given."
        )
    return case
