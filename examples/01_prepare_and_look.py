"""From a CT to a case: scan the built-in phantom, segment it, look at the result.

Run: python examples/01_prepare_and_look.py [FOLDER]     (default: runs/examples)
With a CT of your own, leave out the first step and give its path to ``prepare``.
"""

import sys
from pathlib import Path

from tumortrack.core.store import new_folder
from tumortrack.imaging.case import save_case
from tumortrack.imaging.prepare import PrepareOptions, prepare
from tumortrack.phantom.dicom import write_dicom_series
from tumortrack.phantom.digital import PhantomParameters, phantom_labels
from tumortrack.phantom.scanner import ScannerParameters, scan
from tumortrack.report.pictures import qc_picture


def main(out: Path) -> None:
    ct_folder, case_folder = out / "ct_dicom", out / "case"
    if not ct_folder.exists():
        labels = phantom_labels(PhantomParameters())
        ct = scan(labels, ScannerParameters(spacing_mm=(1.2, 1.2, 1.5)), seed=1)
        write_dicom_series(ct, ct_folder)

    # A phantom lies with its front to the camera; say --up for another direction.
    case = prepare(ct_folder, PrepareOptions(up="anterior"))
    for note in case.report["notes"]:
        print("note:", note)
    for name, part in zip(case.anatomy.names, case.anatomy.parts, strict=True):
        print(f"{name}: {part.volume_mm3 / 1000:.1f} ml, {len(part.faces)} triangles")

    # The folder appears whole or not at all.
    with new_folder(case_folder, overwrite=True) as aside:
        qc_picture(case.labels, case.ct, case.anatomy, aside / "qc.png")
        save_case(case, aside)
    print(f"look at {case_folder / 'qc.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"))
