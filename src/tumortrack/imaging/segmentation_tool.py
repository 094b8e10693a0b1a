"""A CT -> a label map by the user's own tool: TotalSegmentator, an nnU-Net model, a MONAI bundle.

The tool runs as a process of its own, by its own command line, and needs weights that lie on this
machine: nothing is fetched from here. Its numbers become ours by their names: 1 the organ, 2 its
tumors. Documents: github.com/wasserth/TotalSegmentator (README, map_to_binary.py), github.com/
MIC-DKFZ/nnUNet (how_to_use_nnunet.md), docs.monai.io (MONAI Bundle specification).
"""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections.abc import Callable
from dataclasses import dataclass, replace
from importlib.metadata import PackageNotFoundError, version
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.types import FIRST_TUMOR, ORGAN, Volume
from tumortrack.imaging.case import Case
from tumortrack.imaging.nifti import write_nifti, write_volume_nifti
from tumortrack.imaging.prepare import (
    OF_LABELS,
    PrepareOptions,
    crop_ct,
    prepare,
    refuse_unused,
    stated_patient,
)
from tumortrack.imaging.volume import read_raw, volume_of

# Datasets of TotalSegmentator's tasks, and the masks of theirs that are tumors, or cut out as such.
_TOTAL = (291, 292, 293, 294, 295, 298)
_LESIONS = {
    "liver_lesions": (591, ("liver_lesions",)),
    "liver_vessels": (8, ("liver_tumor",)),
    "kidney_cysts": (789, ("kidney_cyst_left", "kidney_cyst_right")),
}
_TUMOR = re.compile("tumou?r|neoplasm|lesion|cancer|carcinoma|mass")
_SAME_MM = 0.01  # of the label map's grid
# Where the organ is, and where its tumors are; None: the tool knows none.
Masks = tuple[Bool[np.ndarray, "i j k"], Bool[np.ndarray, "i j k"] | None]


@dataclass(frozen=True)
class Tool:
    """What runs in a folder, from its in/ct_0000.nii.gz to its out/, and what reads that."""

    name: str
    package: str
    weights: tuple[Path, ...]
    commands: tuple[tuple[str, ...], ...]
    masks: Callable[[Path, Volume], Masks]

    @property
    def version(self) -> str:
        try:
            return version(self.package)
        except PackageNotFoundError:  # of another environment
            return "(version unknown)"


def segmented_case(ct: Path, spec: str, options: PrepareOptions, keep: Path) -> Case:
    """A case of a CT that a tool segments; its output goes to this process's. Raises InputError: an
    unknown tool, one that is not installed or lacks its weights, one that fails or finds no such
    organ; and as ``prepare``.

    Args:
        spec: totalsegmentator, totalsegmentator:TASK, nnunet:FOLDER or monai:BUNDLE.
        keep: file for the label map in our numbers; it must not exist.
    """
    refuse_unused("--segment makes the labels", options, *OF_LABELS)
    if keep.exists():
        raise InputError(f"{keep} exists already. Move it away; it is what an earlier run found.")
    tool = _tool(spec, options.name)
    raw = read_raw(ct, options.series)
    volume = volume_of(raw, ct)
    with tempfile.TemporaryDirectory(prefix="tumortrack-") as folder:
        work = Path(folder)
        for name in ("in", "out"):
            (work / name).mkdir()
        write_volume_nifti(work / "in" / "ct_0000.nii.gz", volume.hu, volume.lps_from_index)
        for command in tool.commands:
            _run(command, work)
        organ, tumors = tool.masks(work / "out", volume)
    if not organ.any():
        raise InputError(f"{tool.name} found no {options.name} in {ct}. Look at the CT.")
    labels = np.where(organ, ORGAN, 0).astype(np.uint8)
    if tumors is not None:
        labels[tumors] = FIRST_TUMOR
    keep.parent.mkdir(parents=True, exist_ok=True)
    write_nifti(keep, labels, volume.lps_from_index, lps=True)
    has_tumors = tumors is not None and tumors.any()
    asked = replace(options, labels=True, series=None, organ=1, tumor=2 if has_tumors else 0)
    case = prepare(keep, asked)
    about = {
        "tool": tool.name,
        "version": tool.version,
        "commands": [" ".join(command) for command in tool.commands],
        "weights_sha256": {path.name: store.sha256_of(path) for path in tool.weights},
        "label_map": keep.name,
        "ct": ct.name,
        "ct_sha256": store.sha256_of(ct),
    }
    note = f"segmented by {tool.name} {tool.version}, and by nobody else: check it in qc.png"
    notes = [*raw.notes, *case.report["notes"], note]
    report = case.report | {"kind": "segmented ct", "segmentation": about, "notes": notes}
    patient = stated_patient(ct, raw.patient, options.patient, case.patient.side)
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
    """Its path: beside this Python, or on the PATH."""
    places = os.pathsep.join([str(Path(sys.executable).parent), os.environ.get("PATH", "")])
    found = shutil.which(name, path=places)
    if found is None:
        raise InputError(
            f"{name} is not installed. Install it, which brings its own dependencies: pip install "
            f"{package}. Its weights are apart (docs/segment.md)."
        )
    return found


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
    program = _program("TotalSegmentator", "TotalSegmentator")
    home = Path(os.environ.get("TOTALSEG_HOME_DIR", Path.home() / ".totalsegmentator"))
    folder = Path(os.environ.get("TOTALSEG_WEIGHTS_PATH", home / "nnunet" / "results"))
    number, lesions = _LESIONS.get(task, (0, ()))
    weights = []
    for of, datasets in (("total", _TOTAL), *([(task, (number,))] if task else [])):
        for dataset in datasets:
            found = sorted(folder.glob(f"Dataset{dataset:03d}_*"))
            if not found:
                raise InputError(
                    f"{folder} lacks the weights of TotalSegmentator's task {of} (Dataset"
                    f"{dataset:03d}). Fetch them yourself: totalseg_download_weights -t {of}. "
                    "TotalSegmentator would download them without asking, so it is not started."
                )
            weights += found
    sides = [f"{organ}_left", f"{organ}_right"] if organ in ("kidney", "adrenal_gland") else [organ]
    run = (program, "-i", "in/ct_0000.nii.gz", "-o")
    commands = [(*run, "out/total", "--task", "total", "--roi_subset", *sides)]
    commands += [(*run, "out/lesions", "--task", task)] if task else []

    def masks(out: Path, ct: Volume) -> Masks:
        def union(names: list[Path]) -> np.ndarray:
            return np.any([_voxels(file, ct) > 0 for file in names], axis=0)

        found = union([out / "total" / f"{name}.nii.gz" for name in sides])
        tumors = [out / "lesions" / f"{name}.nii.gz" for name in lesions]
        return found, union(tumors) if tumors else None

    return Tool("TotalSegmentator", "TotalSegmentator", tuple(weights), tuple(commands), masks)


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
    chosen = _chosen(dataset.get("labels", {}), organ, model)
    device = "cuda" if _has_gpu() else "cpu"
    command = (
        *(program, "-i", "in", "-o", "out", "-m", str(model), "-device", device),
        *("-npp", "1", "-nps", "1", "-f", *(fold.name.removeprefix("fold_") for fold in folds)),
    )
    weights = (model / "dataset.json", model / "plans.json", *folds)
    return Tool("nnU-Net", "nnunetv2", weights, (command,), _of_one_map(chosen))


def _has_gpu() -> bool:
    """As PyTorch says, where nnU-Net brought it into this environment; else by the driver."""
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
    meta = _json(bundle / "configs" / "metadata.json", "monai")
    try:
        said = meta["network_data_format"]["outputs"]["pred"]["channel_def"]
        names = {str(name): int(number) for number, name in said.items()}
    except (KeyError, ValueError, AttributeError) as error:
        raise InputError(f"{bundle}: metadata.json does not name its labels ({error}).") from error
    chosen = _chosen(names, organ, bundle)
    config = next((bundle / "configs").glob("inference.*"), bundle / "configs" / "inference.json")
    command = (
        *(sys.executable, "-m", "monai.bundle", "run", "--config_file", str(config)),
        *("--meta_file", str(bundle / "configs" / "metadata.json"), "--bundle_root", str(bundle)),
        *("--datalist", "['in/ct_0000.nii.gz']", "--output_dir", "out"),
    )
    return Tool("MONAI", "monai", (bundle,), (command,), _of_one_map(chosen))


def _json(path: Path, kind: str) -> dict[str, Any]:
    if not path.is_file():
        raise InputError(f"--segment {kind}: there is no {path}. Give a trained model's folder.")
    return store.read_json(path)


def _chosen(labels: dict[str, Any], organ: str, where: Path) -> tuple[list[int], list[int]]:
    """The organ's numbers and the tumors', by the names of labels; a region (nnU-Net) has several
    numbers."""
    try:
        names = {
            re.sub(r"[\s-]+", "_", name.lower()): tuple(numbers)
            if isinstance(numbers, list)
            else (int(numbers),)
            for name, numbers in labels.items()
        }
    except (TypeError, ValueError) as error:
        raise InputError(f"{where}: its labels {str(labels)[:200]} have no numbers.") from error
    mine = {organ, f"{organ}_left", f"{organ}_right", f"left_{organ}", f"right_{organ}"}
    tumors = sorted({n for name in names if _TUMOR.search(name) for n in names[name]})
    organs = sorted({n for name in mine & names.keys() for n in names[name]} - set(tumors))
    if not organs:
        raise InputError(f"{where} knows {', '.join(names)}, and no {organ}. Choose it by --name.")
    return organs, tumors


def _of_one_map(chosen: tuple[list[int], list[int]]) -> Callable[[Path, Volume], Masks]:
    def masks(out: Path, ct: Volume) -> Masks:
        files = sorted(out.rglob("*.nii.gz"))
        if len(files) != 1:
            raise InputError(f"the tool wrote {len(files)} label maps, and one was to be expected.")
        voxels, (organs, tumors) = _voxels(files[0], ct), chosen
        return np.isin(voxels, organs), np.isin(voxels, tumors) if tumors else None

    return masks


def _voxels(file: Path, ct: Volume) -> np.ndarray:
    """Of a mask or a label map, which must lie on the CT's voxels."""
    if not file.is_file():
        raise InputError(
            f"the tool ended well and wrote no {file.name}; it may be another version."
        )
    raw = read_raw(file)
    same = raw.array.shape == ct.hu.shape
    if not same or not np.allclose(raw.lps_from_index, ct.lps_from_index, atol=_SAME_MM):
        raise InputError(f"{file.name} has another grid than the CT that the tool was given.")
    return np.rint(raw.array).astype(np.int64)
