"""`generic-margins`: what `margins` found with many organs -> the calibration that is shipped."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from pathlib import Path

from msgspec.structs import replace
from tyro.conf import Positional

from tumortrack.cli.console import say
from tumortrack.cli.margins import described
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.models.folder import read_model_manifest
from tumortrack.models.margins import GENERIC, METHOD, judged_by, write_sealed
from tumortrack.report.calibration import CONFIDENCES, WIDEST_MM, margins_of
from tumortrack.report.calibration_table import Row, read_table


@dataclass(frozen=True, kw_only=True)
class GenericMargins:
    """Join tables of `margins`, an organ each, into the calibration for models without their own.

    Attributes:
        tables: files that `margins` wrote, beside the models (MODEL/margins.jsonl).
        confidence: the shares of cases in which the margins are to hold.
        widest: answers that miss by more mm than this are to be kept out.
        out: file to write.
        seed: of what each state is used for.
    """

    tables: Positional[tuple[Path, ...]]
    confidence: tuple[float, ...] = CONFIDENCES
    widest: float = WIDEST_MM
    out: Path = GENERIC
    seed: int = 0

    def run(self) -> None:
        rows: list[Row] = []
        worst: dict[str, float] = {}
        for table in self.tables:
            head, some = read_table(table)
            if head.get("method") != METHOD:
                raise InputError(f"{table} was made with another version of the method.")
            manifest = read_model_manifest(table.parent)
            if head.get("model_sha256") != store.sha256_of(table.parent / store.MANIFEST):
                raise InputError(f"{table} does not lie beside the model that it was made with.")
            for name, figure in judged_by(manifest).items():
                worst[name] = max(figure, worst.get(name, figure))
            rows += [replace(row, label=(*row.label[:2], table.parent.name)) for row in some]
        digests = "".join(store.sha256_of(table) for table in self.tables)
        of = hashlib.sha256(digests.encode()).hexdigest()
        margins = margins_of(rows, of, self.confidence, self.widest, self.seed)
        write_sealed(self.out, replace(margins, models=worst))
        for line in described(margins):
            say(line)
        say(f"written to {self.out}.")
