"""A case's organ for simulators: tetrahedra with stiffness, surfaces, and where all that is now."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float64
from safetensors.numpy import load

import tumortrack
from tumortrack.core import store
from tumortrack.core.colours import name_colour, structure_colour
from tumortrack.core.errors import InputError
from tumortrack.core.evidence import Cut
from tumortrack.core.mesh_query import contains
from tumortrack.core.types import ORGAN, Anatomy
from tumortrack.io.body_files import Cells, write_usd, write_vtk
from tumortrack.io.case import Case, load_case
from tumortrack.io.model_folder import is_finished, read_tensors
from tumortrack.io.run_folder import MOTION
from tumortrack.organ.body import BodyConfig
from tumortrack.organ.finite import CONTRAST
from tumortrack.organ.loads import DENSITY, TISSUE_KPA
from tumortrack.organ.tets import TetMesh, lattice, tet_volumes
from tumortrack.registration.model import RegistrationModel
from tumortrack.registration.motion import ElasticMotion
from tumortrack.report.slicer_scene import report_with_motion
from tumortrack.tracking.model_files import load_model
from tumortrack.tracking.options import ExportOptions

# What the elastic body is made with, in the middle of its range; no organ was measured.
YOUNG_KPA, POISSON = float(np.sqrt(np.prod(TISSUE_KPA))), BodyConfig().poisson
_MODES = 10  # 93 % of the variance of a kidney that is seen from one side
# Barycentric places in a tetrahedron that stand for a tenth of it each.
_PLACES = np.array([sixths for sixths in product(range(1, 4), repeat=4) if sum(sixths) == 6]) / 6


def export_body(given: Path, out: Path, options: ExportOptions) -> tuple[str, ...]:
    """Write a case's body into a new folder; notes. See ``api.export``."""
    if (options.live, options.dicom, options.series, options.patient) != (None,) * 4:
        raise InputError(
            f"--format {options.format} takes --located alone; --live, --dicom, --series and "
            "--patient are for a scene of 3D Slicer: leave --format out."
        )
    case, notes = load_case(given), tuple[str, ...]()
    anatomy, organ = case.anatomy, case.anatomy.organ
    surfaces = {**dict(zip(anatomy.names, anatomy.parts, strict=True)), **anatomy.structures}
    tets = lattice(organ, float(np.cbrt(organ.volume_mm3 / BodyConfig().cells)))
    body = rest = Cells(tets.nodes_mm, tets.tets, _of_cells(tumor_shares(anatomy, tets)))
    about: dict[str, Any] = {
        "tumortrack": tumortrack.__version__,
        "units": "mm",
        "frame": "lps",
        "verdict": "none",
        "reason": "not located: as in the CT",
        "case_sha256": case.sha256,
        "presumed": {
            "young_modulus_kpa": YOUNG_KPA,
            "times_in_tumors": CONTRAST,
            "poisson_ratio": POISSON,
            "density_kg_per_m3": 1e9 * DENSITY,
        },
        "parts": {name: n for n, name in enumerate(anatomy.names, ORGAN)},
    }
    if options.located is not None:
        report, motion = _located(options.located, case, given)
        body, about["modes"] = _moved(rest, tets, motion)
        about |= {"frame": report["frame"], **report["quality"]}
        for name, mesh in surfaces.items():
            surfaces[name] = mesh.with_vertices(motion.forward(mesh.vertices_mm))
        if inverted := int((tet_volumes(body.nodes_mm, tets.tets) <= 0).sum()):
            notes = (f"{inverted} tetrahedra are inside out as located: start from the rest state",)
    words = (f"{key} {about[key]}" for key in ("units", "frame", "verdict", "reason") if about[key])
    title = f"tumortrack {tumortrack.__version__}: {', '.join(words)}"
    with store.new_folder(out) as aside:
        store.write_json(aside / "body.json", about)
        if options.format == "vtk":
            write_vtk(aside / "body.tets.vtk", title, body)
            write_vtk(aside / "rest.tets.vtk", f"at rest, mm, frame lps; {title}", rest)
            for name, mesh in surfaces.items():
                write_vtk(aside / f"{name}.vtk", title, Cells(mesh.vertices_mm, mesh.faces))
        else:
            other = {name: structure_colour(n) for n, name in enumerate(anatomy.structures)}
            shown = {n: (mesh, other.get(n) or name_colour(n)) for n, mesh in surfaces.items()}
            tissue = {"youngsModulus": 1000 * YOUNG_KPA, "poissonsRatio": POISSON}
            tissue["density"] = 1e9 * DENSITY
            write_usd(aside / "body.usda", title, body, tets.nodes_mm, tissue, shown)
    return notes


def tumor_shares(anatomy: Anatomy, tets: TetMesh) -> Float64[np.ndarray, "k t"]:
    """How much of each tetrahedron lies in each tumor, in tenths."""
    places_mm = np.einsum("sc,tcx->tsx", _PLACES, tets.nodes_mm[tets.tets]).reshape(-1, 3)
    inside = np.array([contains(tumor, places_mm) for tumor in anatomy.tumors], float)
    return inside.reshape(-1, len(tets.tets), len(_PLACES)).mean(2)


def _of_cells(shares: Float64[np.ndarray, "k t"]) -> dict[str, np.ndarray]:
    """A tetrahedron belongs to the tumor that has half of it or more; it is as stiff as what it
    holds, as a cell of the elastic body is."""
    every = np.concatenate([np.full((1, shares.shape[1]), 0.5 - 1e-9), shares])
    return {
        "part": (ORGAN + every.argmax(0)).astype(np.int32),
        "young_modulus_kpa": YOUNG_KPA * (1 + (CONTRAST - 1) * np.minimum(shares.sum(0), 1)),
        "poisson_ratio": np.full(shares.shape[1], POISSON),
    }


def _located(run: Path, case: Case, folder: Path) -> tuple[dict[str, Any], ElasticMotion]:
    """A run's report and motion. Raises InputError: of another case or model, or with no motion."""
    report, kept = report_with_motion(run, case, folder), folder / case.MODEL
    if not is_finished(kept) or report["model_sha256"] != store.sha256_of(kept / store.MANIFEST):
        raise InputError(
            f"{run} was located with another model than {kept}. Locate with the case: "
            f"tumortrack locate {folder} CLOUD --out RUN."
        )
    if not (run / MOTION).is_file():
        raise InputError(f"{run} lacks {MOTION}, which older versions did not write: locate again.")
    model, arrays = load_model(kept), read_tensors(run / MOTION, load)
    assert isinstance(model, RegistrationModel)  # others' reports have no motion
    if "cut_ct" in arrays:
        cut, kerf_mm = np.atleast_2d(arrays["cut_ct"]), float(arrays["kerf_mm"])
        model = model.with_cut([Cut(points_ct=tuple(map(tuple, cut.tolist())), kerf_mm=kerf_mm)])
    return report, ElasticMotion.from_arrays(model.shape.compliant, arrays)


def _moved(rest: Cells, tets: TetMesh, motion: ElasticMotion) -> tuple[Cells, list[dict[str, Any]]]:
    """The body where it was located, with what the leading modes of the covariance do to its nodes;
    and their names, root mean squares over the volume, and shares of the variance."""
    weights = tets.lump(tets.volumes_mm3 / tets.volumes_mm3.sum())
    modes = np.moveaxis(motion.spread_modes(tets.nodes_mm, weights), 2, 0)
    squares = np.einsum("n,knx->k", weights, modes**2)
    named = {f"mode_{k}_mm": mode for k, mode in enumerate(modes[:_MODES], 1)}
    about = [
        {"name": name, "rms_mm": square**0.5, "share": square / squares.sum()}
        for name, square in zip(named, squares[:_MODES].tolist(), strict=True)
    ]
    return replace(rest, nodes_mm=motion.forward(tets.nodes_mm), of_nodes=named), about
