"""From a CT to a case: scan the built-in phantom, segment it, look at the result.

Run: python examples/01_prepare_and_look.py [FOLDER]     (default: runs/examples)
With a CT of your own, leave out the first step and give its path to ``prepare``.
"""

import sys
from pathlib import Path

import tumortrack as tt


def main(out: Path) -> None:
    ct_folder = tt.scan_phantom(out / "ct_dicom")

    # A phantom lies with its front to the camera; say ``up`` for another direction. The folder
    # appears whole or not at all. As the last step the case gets the model that locates it.
    case = tt.prepare(ct_folder, out / "case", up="anterior", overwrite=True)
    for note in case.report["notes"]:
        print("note:", note)
    for name, part in zip(case.anatomy.names, case.anatomy.parts, strict=True):
        print(f"{name}: {part.volume_mm3 / 1000:.1f} ml, {len(part.faces)} triangles")
    print(f"look at {out / 'case' / 'qc.png'}")


if __name__ == "__main__":
    main(Path(sys.argv[1] if len(sys.argv) > 1 else "runs/examples"))
