"""Model folders: what all methods write and read."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import ArtifactError
from tumortrack.core.estimate import FAR_MM
from tumortrack.core.organ import Organ, organ_in
from tumortrack.core.patient import Patient, patient_in

if TYPE_CHECKING:
    from tumortrack.registration.base_model import Model

KIND = "model"
SHAPE = "shape.safetensors"
_MOST_FAR = 0.1  # share of the scenes of the check; beyond, what is seen does not say how it lies


def is_finished(folder: Path) -> bool:
    """Whether the folder holds a finished model (rather than a training under way)."""
    return (folder / store.MANIFEST).is_file()


def is_model_of(folder: Path, case: Path) -> bool:
    """Whether the folder holds a finished model of the case in another folder."""
    if not is_finished(folder):
        return False
    about = store.read_json(folder / store.MANIFEST).get("provenance")
    digest = store.sha256_of(case / store.MANIFEST)
    return isinstance(about, dict) and about.get("case_sha256") == digest


def check_trainable(folder: Path) -> None:
    """InputError where what lies in a folder is neither a training nor a model."""
    if folder.is_dir() and not any(folder.iterdir()):
        return
    if not (folder / "training").is_dir() and not is_finished(folder):
        store.check_place(folder, "", None)


def read_model_manifest(folder: Path) -> dict[str, Any]:
    """The manifest of a finished model; ArtifactError for no model, a training that has not ended,
    another schema, a file missing or changed."""
    if not is_finished(folder) and (folder / "training").is_dir():
        raise ArtifactError(
            f"{folder} holds a training that has not ended. Run the same `tumortrack train` "
            "command again to go on with it."
        )
    return store.read_manifest(folder, KIND)


def read_tensors(
    path: Path, load: Callable[[bytes], dict[str, Any]], largest: float = 1e6
) -> dict[str, Any]:
    """The tensors of a safetensors file, as ``load`` makes them; ArtifactError where it is damaged
    or holds a number that is not finite or beyond ``largest``, as no training gives them."""
    from safetensors import SafetensorError

    try:
        tensors = load(path.read_bytes())
    except (OSError, SafetensorError) as error:
        raise ArtifactError(f"{path} cannot be read: {error}.") from error
    for name, tensor in tensors.items():
        if 0 not in tensor.shape and not -largest <= tensor.min() <= tensor.max() <= largest:
            raise ArtifactError(f"{path}: {name} holds numbers that are no trained model's.")
    return tensors


def save_model(model: Model, folder: Path) -> None:
    """Write a model into an existing folder, the manifest last."""
    for name, data in model.files().items():
        store.write_atomically(folder / name, data)
    content = {
        "parts": list(model.parts),
        **model.entries(),
        "in_distribution": to_builtins(model.in_distribution),
        "provenance": model.provenance,
        "config": to_builtins(model.config),
    }
    store.seal(folder, KIND, content, frame="camera")


def patient_of(manifest: dict[str, Any], folder: Path) -> Patient:
    """Whose organ a model was trained for; InputError where its manifest says nonsense."""
    return patient_in(manifest.get("provenance", {}).get("patient"), str(folder))


def organ_of(manifest: dict[str, Any], folder: Path) -> Organ:
    """Which organ a model was trained for; InputError where its manifest says nonsense."""
    return organ_in(manifest.get("provenance", {}).get("organ"), str(folder))


def reliability_warning(provenance: dict[str, Any]) -> str:
    """Why no estimate of a model should be relied on, by what training knows of it, and what to do;
    empty: no reason is known."""
    far, half_turn_mm = provenance.get("validation_far"), provenance.get("half_turn_mm")
    if isinstance(far, float) and far > _MOST_FAR:
        return (
            f"{100 * far:.0f} % of the simulated scenes on which this model was checked were over "
            f"{FAR_MM:g} mm off: this organ's surface does not tell how it lies"
        )
    if isinstance(half_turn_mm, float):
        return (
            f"the organ looks much the same after half a turn (surfaces {half_turn_mm:.1f} mm "
            "apart), and this method can't try both ways; use the case itself, without a network"
        )
    return ""


def training_words(provenance: dict[str, Any]) -> str:
    """How far off a model is on scenes with a known truth, and how long it was trained."""
    if "validation_tre_mm" in provenance:
        return (
            f"on simulated scenes points inside are {provenance['validation_tre_mm']:.1f} mm off "
            f"(median), {provenance['validation_far']:.0%} of scenes over {FAR_MM:g} mm"
        )
    steps, seconds = provenance["steps"], provenance.get("training_s")  # a fleet's have none
    words = f"{steps} step{'s' * (steps != 1)}"
    words += "" if seconds is None else f" in {seconds:.0f} s"
    return f"{words}; validation mIoU {provenance['validation_miou']:.3f}"


def has_shape(manifest: dict[str, Any]) -> bool:
    """Whether the model knows the organ's shape, and so which point of the CT lies where."""
    return SHAPE in manifest["files"]
