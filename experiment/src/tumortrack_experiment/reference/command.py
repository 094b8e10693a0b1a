"""`reference`."""

from __future__ import annotations

from dataclasses import dataclass

from tumortrack.core.errors import InputError
from tumortrack_experiment.reference.options import ReferenceOptions


@dataclass(frozen=True, kw_only=True)
class Reference(ReferenceOptions):
    """Make a scene of what a camera saw of a phantom's state, with a second CT of that state as
    its truth, laid on each other by the base's beads: what `evaluate` and `margins` read."""

    def run(self) -> None:
        if self.targets is not None and self.target_mm is None:
            raise InputError("--targets needs --target-mm, the diameter of these beads.")

        from tumortrack_experiment.reference.build import write_reference

        write_reference(self)
