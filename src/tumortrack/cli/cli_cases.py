"""The command line of cases and scenes: see ``cli.main``."""

from __future__ import annotations

from pathlib import Path
from typing import Literal

from tyro.conf import Positional


def prepare(
    input: Positional[Path],
    case: Positional[Path],
    /,
    *,
    kidney_hu: tuple[float, float] = (-300.0, 300.0),
    tumor_hu: tuple[float, float] = (300.0, 1000.0),
    labels: bool = False,
    side: Literal["left", "right"] | None = None,
    organ: int = 1,
    tumor: int | None = None,
    up: str = "anterior",
    series: str | None = None,
    unit: Literal["mm", "m"] | None = None,
    min_tumor_ml: float = 0.2,
    overwrite: bool = False,
) -> None:
    """Make a case from a CT, a label map or a folder of meshes.

    Args:
        input: DICOM folder, CT volume or label map (.nii, .nii.gz, .nrrd), or folder of meshes.
        case: folder to write.
        kidney_hu: HU window of the kidney in a CT: low (inclusive) and high.
        tumor_hu: HU window of the tumors in a CT.
        labels: INPUT is a label map (recognised by itself where that is plain).
        side: the patient's kidney to take; default: the one with the largest tumor.
        organ: label number of the kidney.
        tumor: label number of the tumors; default: every label from 2 up. 0: none.
        up: patient direction that faces the camera: anterior, left, ... or "x,y,z" in LPS.
        series: which DICOM series, if the folder holds several (UID or number in the list).
        unit: of mesh files.
        min_tumor_ml: smaller tumors are reported and dropped.
        overwrite: replace CASE if it exists.
    """
    from tumortrack.cli import commands
    from tumortrack.imaging.prepare import PrepareOptions

    options = PrepareOptions(
        kidney_hu=kidney_hu,
        tumor_hu=tumor_hu,
        labels=labels,
        side=side,
        organ=organ,
        tumor=tumor,
        up=up,
        series=series,
        unit=unit,
        min_tumor_ml=min_tumor_ml,
    )
    commands.prepare(input, case, options, overwrite)


def export(
    case: Positional[Path],
    out: Positional[Path],
    /,
    *,
    dicom: Path | None = None,
    series: str | None = None,
) -> None:
    """Write a case's segmentation for 3D Slicer and, with its CT, as DICOM.

    Args:
        case: folder that `prepare` wrote.
        out: folder to write: case.seg.nrrd and, with --dicom, segmentation.dcm.
        dicom: folder of the CT's slices that the case's voxels come from.
        series: which of its series, if the folder holds several (UID or number in the list).
    """
    from tumortrack.cli.export import export as run

    run(case, out, dicom, series)


def simulate(
    case: Positional[Path],
    dataset: Positional[Path],
    /,
    *,
    scenes: int = 20,
    seed: int = 0,
    configuration: tuple[Literal[1, 2, 3, 4, 5, 6], ...] = (3,),
    falloff: Literal["sigma", "variance"] = "sigma",
    rotations: Literal["limited", "full"] = "limited",
    squeeze: bool = False,
    noise: bool = True,
    elastic: bool = False,
) -> None:
    """Write deformed scenes of a case with their truth: what `evaluate` reads.

    Args:
        case: folder that `prepare` wrote.
        dataset: folder to write.
        scenes: how many.
        seed: of the scenes; they are never those that training sees.
        configuration: of the paper's deformation table; several are mixed.
        falloff: how the table's third number is read (docs/method.md).
        rotations: poses, as in `train`.
        squeeze: also squeeze and bend the organ as a whole.
        noise: with the depth sensor's noise.
        elastic: deform the organ as an elastic body in its bed does (plates, instruments, pulls,
            weight, swelling), instead of by the paper's table.
    """
    from tumortrack.cli import commands

    commands.simulate(
        case,
        dataset,
        commands.SimulateOptions(
            scenes, seed, configuration, falloff, rotations, squeeze, noise, elastic
        ),
    )
