"""Model folders of any method, and the model that every case holds."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING

import msgspec

from tumortrack.assessment.bound_factor import read_factor
from tumortrack.core import store
from tumortrack.core.config import from_builtins, to_builtins
from tumortrack.core.errors import ArtifactError, InputError, PackageError, StorageError
from tumortrack.core.organ import Organ, organ_entry
from tumortrack.core.types import part_names
from tumortrack.io.case import Case, holds_case, load_case
from tumortrack.io.model_folder import (
    KIND,
    has_shape,
    is_finished,
    is_model_of,
    organ_of,
    read_model_manifest,
    save_model,
)
from tumortrack.registration.base_model import Model
from tumortrack.registration.in_distribution import InDistributionRange
from tumortrack.registration.method import method_of_folder
from tumortrack.registration.model import RegistrationModel
from tumortrack.tracking.presets import elastic, seen_by

if TYPE_CHECKING:
    from tumortrack.registration.config import RegistrationConfig

Progress = Callable[[int, int], None]


def load_model(folder: Path, device: str = "auto") -> Model:
    """Read a model folder, or the model of a case folder, which is made if there is none yet.

    Args:
        device: where a network runs.

    Raises:
        ArtifactError: missing, of another schema, damaged or changed; its bound factor is of
            another model or version of the method; CUDA is requested without a GPU.
        PackageError: the method that made it is not installed.
    """
    if holds_case(folder):
        return case_model(load_case(folder))
    manifest = read_model_manifest(folder)
    try:
        known = {
            "parts": _parts(manifest["parts"], organ_of(manifest, folder)),
            "in_distribution": from_builtins(
                manifest["in_distribution"], InDistributionRange, f"{folder}: in_distribution"
            ),
            "provenance": dict(manifest["provenance"]),
            "bound_factor": 1.0 if (found := read_factor(folder)) is None else found.factor,
        }
        model: Model
        if has_shape(manifest):
            model = RegistrationModel.from_folder(folder, manifest, **known)
        else:
            model = method_of_folder(manifest).load(folder, manifest, device, **known)
        model.patient  # noqa: B018 - raises InputError if it is not valid
        return model
    except (ArtifactError, PackageError):
        raise
    except InputError as error:
        raise ArtifactError(
            f"{error} The model was made by another version of tumortrack, or with a package "
            "that is not installed here. Install that package, or make the model again."
        ) from error
    except (KeyError, TypeError, ValueError, RuntimeError, OSError) as error:
        raise ArtifactError(
            f"{folder} is not a whole model of this version: {error}. Make it again."
        ) from error


def case_model(case: Case, progress: Progress | None = None) -> Model:
    """The model in a case's folder; if that has none of this case, a new one, which is saved there.
    ``progress``: of making one.

    Raises:
        StorageError: it cannot be saved.
        InputError: something else in its place would be lost.
        ArtifactError: as ``load_model``.
    """
    if case.folder is None:
        return make_model(case, progress=progress)
    kept = case.folder / case.MODEL
    if is_model_of(kept, case.folder):
        return load_model(kept)
    if not os.access(case.folder, os.W_OK):
        raise StorageError(
            f"{case.folder} holds no model yet, and none can be written there. Copy the case to "
            f"where it can, or make a model elsewhere: tumortrack train {case.folder} MODEL"
        )
    if another := kept.exists():
        store.check_place(kept, KIND, True)
    model = make_model(case, progress=progress)
    try:
        with store.new_folder(kept, overwrite=another or None) as aside:
            save_model(model, aside)
    except InputError:
        if not is_model_of(kept, case.folder):  # another process saved it first
            raise
    return model


def write_model(
    case: Case,
    folder: Path,
    config: RegistrationConfig | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> Model:
    """``make_model`` into a folder of its own; if that holds the same model, it is read. Raises
    InputError: another model, or something else, would be lost."""
    config = config or _config_of(case)
    store.check_place(folder, KIND, True)
    if is_finished(folder):
        manifest = read_model_manifest(folder)
        about = manifest["provenance"].get("case_sha256"), manifest["provenance"].get("seed")
        if about != (case.sha256, seed) or manifest["config"] != to_builtins(config):
            raise InputError(
                f"{folder} holds a model of another case, or with another seed or other options. "
                "Choose another MODEL folder."
            )
        return load_model(folder)
    model = make_model(case, config, seed, progress)
    with store.new_folder(folder, overwrite=True) as aside:
        save_model(model, aside)
    return model


def make_model(
    case: Case,
    config: RegistrationConfig | None = None,
    seed: int = 0,
    progress: Progress | None = None,
) -> RegistrationModel:
    """A model of the default method, by default configured by the case's poses and camera; takes
    some seconds. Raises InputError: ``config`` has deformations that are not elastic."""
    from tumortrack.registration.model import build_model

    config = config or _config_of(case)
    provenance = {
        "case_sha256": case.sha256,
        "patient": to_builtins(case.patient),
        "organ": organ_entry(case.anatomy.organ_kind),
        "warnings": msgspec.to_builtins(case.warnings),
    }
    more = {} if progress is None else {"progress": progress}
    return build_model(case.anatomy, case.up_lps, config, seed, provenance, **more)


def _config_of(case: Case) -> RegistrationConfig:
    return seen_by(elastic(case.anatomy, case.rotations, case.tilt_degrees), case.sensor)


def _parts(stated: list[str], organ: Organ) -> tuple[str, ...]:
    if not stated or tuple(stated) != part_names(len(stated), organ.name):
        raise InputError(f"parts {stated} are not {organ.name}, tumor_1, tumor_2, ...")
    return tuple(stated)
