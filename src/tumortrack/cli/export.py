"""`tumortrack export`: a case for other programs."""

from __future__ import annotations

from pathlib import Path

from tumortrack.cli.console import say
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.imaging.case import load_case
from tumortrack.imaging.segmentation import SIDES, segments, write_dicom_seg, write_seg_nrrd


def export(case_folder: Path, out: Path, dicom: Path | None, series: str | None) -> None:
    """Write OUT/case.seg.nrrd and, on the CT in ``dicom``, OUT/segmentation.dcm; all or nothing.

    Raises:
        InputError: OUT exists; ``series`` without ``dicom``; see ``write_dicom_seg``.
        ArtifactError: no case.
        StorageError: the disk refused.
    """
    if series is not None and dicom is None:
        raise InputError("--series says which series of --dicom; give that folder too.")
    case = load_case(case_folder)
    options = case.report.get("options", {})
    side = options.get("side")
    parts = segments(case.anatomy.names, side if side in SIDES else None)
    labels = case.labels
    notes: tuple[str, ...] = ()
    with store.new_folder(out) as aside:
        write_seg_nrrd(aside / "case.seg.nrrd", labels.labels, labels.lps_from_index, parts)
        if dicom is not None:
            wanted = series or options.get("series")
            notes = write_dicom_seg(aside / "segmentation.dcm", labels, parts, dicom, wanted)
    for note in notes:
        say(f"note: {note}")
    say(f"written to {out}: {', '.join(sorted(p.name for p in out.iterdir()))}.")
