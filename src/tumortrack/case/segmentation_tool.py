"""Segment a CT with the user's own tool: TotalSegmentator, an nnU-Net model, a MONAI bundle.

The tool runs in its own process by its own command line, with weights that are on this machine;
nothing is downloaded. Its labels are mapped by name: 1 the organ, 2 its tumors.
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable, Iterable
from dataclasses import replace
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np
from jaxtyping import Bool

from tumortrack.case.options import PrepareOptions
from tumortrack.case.prepare import OF_LABELS, crop_ct, patient_of, prepare, refuse_unused
from tumortrack.core import store
from tumortrack.core.errors import InputError, readable
from tumortrack.core.grid import RawVolume
from tumortrack.core.types import FIRST_TUMOR, ORGAN
from tumortrack.io.case import Case
from tumortrack.io.nifti import write_nifti, write_volume_nifti
from tumortrack.io.segments import is_tumor
from tumortrack.io.volume import read_raw, same_grid, volume_of

# Datasets of TotalSegmentator's tasks, and the masks in them that count as tumors.
_TOTAL = (291, 292, 293, 294, 295, 298)
_LESIONS = {
    "liver_lesions": (591, ("liver_lesions",)),
    "liver_vessels": (8, ("liver_tumor",)),
    "kidney_cysts": (789, ("kidney_cyst_left", "kidney_cyst_right")),
}
# Masks of the organ and of its tumors; None: the tool knows no tumors.
Masks = tuple[Bool[np.ndarray, "i j k"], Bool[np.ndarray, "i j k"] | None]


class Tool(NamedTuple):
    """``commands`` are run in a folder and turn in/ct_0000.nii.gz into files in out/, from which
    ``masks`` reads."""

    name: str
    package: str
    weights: list[Path]
    commands: list[tuple[str, ...]]
    masks: Callable[[Path, RawVolume], Masks]


def segmented_case(ct: Path, spec: str, options: PrepareOptions, keep: Path) -> Case:
    """A case from a CT that a tool segments (``spec``: of ``prepare --segment``); its output is
    shown. ``keep``: a new file for the label map. Raises InputError: a tool that is unknown, not
    installed, lacks its weights, fails or finds no such organ; and as ``prepare``."""
    refuse_unused("--segment makes the labels", options, *OF_LABELS)
    if keep.exists():
        raise InputError(f"{keep} exists already. Move it away; it is what an earlier run found.")
    tool = _tool(spec, options.name)
    raw = read_raw(ct, options.series)
    volume = volume_of(raw, ct)
    with tempfile.TemporaryDirectory(prefix="tumortrack-") as folder:
        work = Path(folder)
        (work / "in").mkdir()
        (work / "out").mkdir()
        write_volume_nifti(work / "in" / "ct_0000.nii.gz", volume.hu, volume.lps_from_index)
        for command in tool.commands:
            _run(command, work)
        organ, tumors = tool.masks(work / "out", raw)
    if not organ.any():
        raise InputError(f"{tool.name} found no {options.name} in {ct}. Look at the CT.")
    labels = np.where(organ, ORGAN, 0).astype(np.uint8)
    if tumors is not None:
        labels[tumors] = FIRST_TUMOR
    keep.parent.mkdir(parents=True, exist_ok=True)
    write_nifti(keep, labels, volume.lps_from_index, lps=True)
    tumor = FIRST_TUMOR if tumors is not None and tumors.any() else 0
    case = prepare(keep, replace(options, labels=True, series=None, organ=ORGAN, tumor=tumor))
    try:
        of_tool = version(tool.package)
    except PackageNotFoundError:  # in another environment
        of_tool = "(version unknown)"
    segmentation = {
        "tool": tool.name,
        "version": of_tool,
        "commands": [" ".join(command) for command in tool.commands],
        "weights_sha256": {path.name: store.sha256_of(path) for path in tool.weights},
        "label_map": keep.name,
        "ct": ct.name,
        "ct_sha256": store.sha256_of(ct),
    }
    note = f"segmented by {tool.name} {of_tool}, and by nobody else: check it in qc.png"
    notes = [*raw.notes, *case.report["notes"], note]
    report = case.report | {"kind": "segmented ct", "segmentation": segmentation, "notes": notes}
    patient = patient_of(ct, raw.patient, options.patient, case.patient.side)
    return replace(case, ct=crop_ct(volume, case.labels), report=report, patient=patient)


def _tool(spec: str, organ: str) -> Tool:
    kind, _, target = spec.partition(":")
    if kind == "totalsegmentator":
        return _totalsegmentator(target, organ)
    if kind in ("nnunet", "monai") and target:
        return (_nnunet if kind == "nnunet" else _monai)(Path(target).absolute(), organ)
    raise InputError(
        f"--segment {spec!r} is not known: totalsegmentator, totalsegmentator:TASK "
        f"({', '.join(_LESIONS)}), nnunet:FOLDER or monai:BUNDLE."
    )


def _program(name: str, package: str) -> str:
    """The path of a program next to this Python or on the PATH."""
    folders = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    if path := shutil.which(name, path=folders):
        return path
    raise InputError(
        f"{name} is not installed. Install it, which brings its own dependencies: pip install "
        f"{package}. Its weights are apart (docs/segment.md)."
    )


def _run(command: tuple[str, ...], work: Path) -> None:
    try:
        code = subprocess.run(command, cwd=work, check=False).returncode
    except OSError as error:
        raise InputError(f"{command[0]} cannot be started: {error.strerror}.") from error
    if code:
        raise InputError(
            f"{' '.join(command)} ended with code {code}; what it printed above says why."
        )


def _totalsegmentator(task: str, organ: str) -> Tool:
    if task and task not in _LESIONS:
        raise InputError(f"--segment totalsegmentator:{task}: tasks are {', '.join(_LESIONS)}.")
    run = (_program("TotalSegmentator", "TotalSegmentator"), "-i", "in/ct_0000.nii.gz", "-o")
    home = Path(os.environ.get("TOTALSEG_HOME_DIR", Path.home() / ".totalsegmentator"))
    folder = Path(os.environ.get("TOTALSEG_WEIGHTS_PATH", home / "nnunet" / "results"))
    number, lesions = _LESIONS.get(task, (0, ()))
    weights = []
    for dataset in (*_TOTAL, number) if task else _TOTAL:
        if not (paths := sorted(folder.glob(f"Dataset{dataset:03d}_*"))):
            of = "total" if dataset in _TOTAL else task
            raise InputError(
                f"{folder} lacks the weights of TotalSegmentator's task {of} (Dataset"
                f"{dataset:03d}). Fetch them yourself: totalseg_download_weights -t {of}. "
                "TotalSegmentator would download them without asking, so it is not started."
            )
        weights += paths
    sides = [f"{organ}_left", f"{organ}_right"] if organ in ("kidney", "adrenal_gland") else [organ]
    commands = [(*run, "out/total", "--task", "total", "--roi_subset", *sides)]
    commands += [(*run, "out/lesions", "--task", task)] if task else []

    def masks(out: Path, ct: RawVolume) -> Masks:
        def union(folder: Path, names: Iterable[str]) -> np.ndarray:
            return np.any([_voxels(folder / f"{name}.nii.gz", ct) > 0 for name in names], axis=0)

        return union(out / "total", sides), union(out / "lesions", lesions) if lesions else None

    return Tool("TotalSegmentator", "TotalSegmentator", weights, commands, masks)


def _nnunet(model: Path, organ: str) -> Tool:
    program = _program("nnUNetv2_predict_from_modelfolder", "nnunetv2")
    dataset = _json(model / "dataset.json", "nnunet")
    folds = sorted(file.parent for file in model.glob("fold_*/checkpoint_final.pth"))
    if not folds or not (model / "plans.json").is_file():
        raise InputError(
            f"{model} lacks plans.json or fold_N/checkpoint_final.pth. Give the folder that "
            "nnU-Net's training wrote: Dataset.../TRAINER__PLANS__CONFIGURATION."
        )
    channels, ending = dataset.get("channel_names", {}), dataset.get("file_ending")
    if len(channels) != 1 or ending != ".nii.gz":
        raise InputError(f"{model} takes {channels} as {ending}; what we have is one CT, .nii.gz.")
    numbers = _numbers(dataset.get("labels", {}), organ, model)
    device = "cuda" if _has_gpu() else "cpu"
    command = (
        *(program, "-i", "in", "-o", "out", "-m", str(model), "-device", device),
        *("-npp", "1", "-nps", "1", "-f", *(fold.name.removeprefix("fold_") for fold in folds)),
    )
    weights = [model / "dataset.json", model / "plans.json", *folds]
    return Tool("nnU-Net", "nnunetv2", weights, [command], _from_label_map(*numbers))


def _has_gpu() -> bool:
    """Asks PyTorch if it is in this environment (nnU-Net brings it), else the driver."""
    if find_spec("torch") is None:
        return shutil.which("nvidia-smi") is not None
    import torch

    return torch.cuda.is_available()


def _monai(bundle: Path, organ: str) -> Tool:
    if find_spec("monai") is None:
        raise InputError("MONAI is not installed. Install it: pip install 'monai[fire,ignite]'.")
    if not (bundle / "models").is_dir():
        raise InputError(
            f"{bundle} is no MONAI bundle with weights: it lacks models/. Fetch one yourself: "
            "python -m monai.bundle download NAME."
        )
    configs = bundle / "configs"
    meta = _json(configs / "metadata.json", "monai")
    with readable(configs / "metadata.json", "does not name its labels"):
        channels = meta["network_data_format"]["outputs"]["pred"]["channel_def"]
        names = {str(name): int(number) for number, name in channels.items()}
    numbers = _numbers(names, organ, bundle)
    config = next(configs.glob("inference.*"), configs / "inference.json")
    command = (
        *(sys.executable, "-m", "monai.bundle", "run", "--config_file", str(config)),
        *("--meta_file", str(configs / "metadata.json"), "--bundle_root", str(bundle)),
        *("--datalist", "['in/ct_0000.nii.gz']", "--output_dir", "out"),
    )
    return Tool("MONAI", "monai", [bundle], [command], _from_label_map(*numbers))


def _json(path: Path, kind: str) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"--segment {kind}: there is no {path}. Give a trained model's folder.")
    return store.read_json(path)


def _numbers(labels: dict[str, Any], organ: str, where: Path) -> tuple[list[int], list[int]]:
    """Label numbers of the organ and of tumors, by name; an nnU-Net region has several."""
    numbers: dict[str, set[int]] = {}
    with readable(where, "has labels without numbers"):
        for name, value in labels.items():
            values = value if isinstance(value, list) else [int(value)]
            numbers[re.sub(r"[\s-]+", "_", name.lower())] = set(values)
    names = {organ, f"{organ}_left", f"{organ}_right", f"left_{organ}", f"right_{organ}"}
    tumors = {n for name in numbers if is_tumor(name) for n in numbers[name]}
    organs = {n for name in names & numbers.keys() for n in numbers[name]} - tumors
    if not organs:
        raise InputError(
            f"{where} knows {', '.join(numbers)}, and no {organ}. Choose it by --name."
        )
    return sorted(organs), sorted(tumors)


def _from_label_map(organs: list[int], tumors: list[int]) -> Callable[[Path, RawVolume], Masks]:
    def masks(out: Path, ct: RawVolume) -> Masks:
        files = sorted(out.rglob("*.nii.gz"))
        if len(files) != 1:
            raise InputError(f"the tool wrote {len(files)} label maps, and one was to be expected.")
        voxels = _voxels(files[0], ct)
        return np.isin(voxels, organs), np.isin(voxels, tumors) if tumors else None

    return masks


def _voxels(file: Path, ct: RawVolume) -> np.ndarray:
    """Voxels of a mask or label map on the CT's grid."""
    if not file.is_file():
        raise InputError(f"the tool wrote no {file.name}; it may be another version.")
    raw = read_raw(file)
    if not same_grid(raw, ct):
        raise InputError(f"{file.name} has another grid than the CT that the tool was given.")
    return np.rint(raw.array).astype(np.int64)
