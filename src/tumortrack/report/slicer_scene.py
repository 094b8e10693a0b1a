"""Scenes for 3D Slicer (.mrb): a zip of a scene in MRML, Slicer's XML, and the files it shows.

Follows the source code of Slicer (``ReadXMLAttributes`` of the nodes in Libs/MRML/Core) and of
SlicerOpenIGTLink (vtkMRMLIGTLConnectorNode.cxx).
"""

from __future__ import annotations

import csv
import io
import json
import zipfile
from collections.abc import Iterable
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import msgspec
import numpy as np

from tumortrack.core import store
from tumortrack.core.assessment import Assessment, centre_label
from tumortrack.core.colours import Colour, part_colour, structure_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS
from tumortrack.core.patient import Patient
from tumortrack.core.report import FitReport
from tumortrack.core.types import FIRST_TUMOR, ORGAN
from tumortrack.io.case import Case, load_case
from tumortrack.io.mesh_files import write_mesh
from tumortrack.io.run_folder import CENTRES, CT, MARGIN, read_report
from tumortrack.io.segmentation_files import segments, write_dicom_seg, write_seg_nrrd
from tumortrack.tracking.options import ExportOptions

_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/"
    "Schema/markups-schema-v1.0.3.json#"
)
_ORGAN_OPACITY, _SHELL_OPACITY = 0.4, 0.25
_File = tuple[str, str, bytes]  # kind of its storage node, name, content


def export(given: Path, out: Path, options: ExportOptions) -> tuple[str, ...]:
    """Write a case, or a located organ, as a scene with its files; notes. See ``api.export``."""
    if options.dicom is None and (options.series, options.patient) != (None, None):
        raise InputError("--series and --patient are those of --dicom; give that folder too.")
    if options.located is not None and options.live is not None:
        raise InputError("--located shows what is done, --live what comes: give one of them.")
    manifest = given / store.MANIFEST
    is_run = manifest.is_file() and store.read_json(manifest).get("kind") == "run"
    if is_run and (options.located, options.live, options.dicom) != (None, None, None):
        raise InputError(
            f"{given} was located. --located, --live and --dicom are for a case: "
            "tumortrack export CASE OUT --located RUN."
        )
    scene = Scene()
    notes: tuple[str, ...] = ()
    with store.new_folder(out) as aside:
        if is_run:
            scene.add_run(given, read_report(given))
        else:
            notes = _export_case(load_case(given), given, aside, scene, options)
        scene.write(aside / "scene.mrb")
    return notes


def _export_case(
    case: Case, folder: Path, aside: Path, scene: Scene, options: ExportOptions
) -> tuple[str, ...]:
    """Adds the case to the scene and writes what else was asked for; notes."""
    labels, patient = case.labels, case.patient
    parts = segments(case.anatomy.names, patient.side, case.anatomy.organ_kind)
    file = aside / "case.seg.nrrd"
    write_seg_nrrd(file, labels.labels, labels.lps_from_index, parts)
    for name, mesh in case.anatomy.structures.items():
        write_mesh(aside / f"{name}.ply", mesh)
    moved = (options.located, options.live) != (None, None)
    scene.add_case(folder, case, file.read_bytes(), moved)
    if options.located is not None:
        report = report_with_motion(options.located, case, folder)
        scene.add_ct_transform(report["motion"]["camera_from_ct"])
        scene.add_run(options.located, report)
    if options.live is not None:
        host, _, port = options.live.rpartition(":")
        if not host or not port.isdecimal():
            raise InputError(f"--live {options.live!r} must be HOST:PORT, as localhost:18944.")
        scene.add_ct_transform(None)
        scene.add_live(case.anatomy.names, host, int(port))
    if options.dicom is None:
        return ()
    series = options.series or case.report.get("options", {}).get("series")
    shown = Patient(patient.id if options.patient is None else options.patient, patient.side)
    file = aside / "segmentation.dcm"
    return write_dicom_seg(file, labels, parts, options.dicom, series, shown)


def report_with_motion(run: Path, case: Case, folder: Path) -> dict[str, Any]:
    """report.json of a run. Raises InputError: of another case's model, or without a motion."""
    report = read_report(run)
    if report.get("model", {}).get("case_sha256") != case.sha256:
        raise InputError(f"{run} was not located with a model of {folder}: give its case.")
    if "motion" not in report:
        raise InputError(
            f"{run} does not know where the CT is now: a model of the preset elastic does. "
            "Export it alone: tumortrack export RUN OUT."
        )
    return report


class Scene:
    """Collects nodes and their files. Content in the camera frame is shown as if it were LPS."""

    def __init__(self) -> None:
        self._root = ElementTree.Element("MRML", version="Slicer4.4.0", userTags="")
        self._files: dict[str, bytes] = {}

    def write(self, path: Path) -> None:
        """Write PATH.mrb. Raises StorageError: the disk refused."""
        buffer = io.BytesIO()
        with zipfile.ZipFile(buffer, "w", zipfile.ZIP_DEFLATED) as archive:
            scene = ElementTree.tostring(self._root, "utf-8", xml_declaration=True)
            archive.writestr(f"{path.stem}/{path.stem}.mrml", scene)
            for name, content in self._files.items():
                archive.writestr(f"{path.stem}/Data/{name}", content)
        store.write_atomically(path, buffer.getvalue())

    def add_case(self, folder: Path, case: Case, segmentation: bytes, moved: bool) -> None:
        """CT and segmentation. ``moved``: under the transform ``ct``, which the caller adds; if
        not, with surfaces and the tumors' centres."""
        parent = CT if moved else ""
        if case.ct is not None:
            file = ("VolumeArchetypeStorage", "ct.nii.gz", (folder / "ct.nii.gz").read_bytes())
            grey = {"colorNodeID": "vtkMRMLColorTableNodeGrey", "autoWindowLevel": "1"}
            self._add("Volume", "CT", grey, file, parent)
        file = ("SegmentationStorage", "case.seg.nrrd", segmentation)
        self._add("Segmentation", "CT segmentation", {}, file, parent)
        if not moved:
            for label, name in enumerate(case.anatomy.names, ORGAN):
                self._add_model(name, label, (folder / f"{name}.ply").read_bytes())
            self._add_structures(folder, case.anatomy.structures)
            tumors = zip(case.anatomy.names[1:], case.anatomy.tumors, strict=True)
            centres = [(name, mesh.box_mm.mean(0).tolist()) for name, mesh in tumors]
            self._add_points(CENTRES, centres)

    def add_run(self, folder: Path, stored: dict[str, Any]) -> None:
        """The result of `locate`: segmentation, surfaces, shells, tumor centres labelled with how
        far off they are at most, and mapped points; camera frame. ``stored``: its report.json."""
        report = msgspec.convert(stored, FitReport)
        assessment = msgspec.convert(stored["assessment"], Assessment)
        voxels = (folder / "labels.seg.nrrd").read_bytes()
        self._add("Segmentation", "located", {}, ("SegmentationStorage", "labels.seg.nrrd", voxels))
        centres = []
        for name, part in report.parts.items():
            for shown in (name, name + MARGIN):
                if (file := folder / f"{shown}.ply").exists():
                    self._add_model(shown, part.label, file.read_bytes())
            if part.center_mm is not None and part.label >= FIRST_TUMOR:
                words = centre_label(name, assessment.bounds, assessment.quality == "poor")
                centres.append((words, list(part.center_mm)))
        self._add_structures(folder, report.structures)
        self._add_points(CENTRES, centres)
        if (table := folder / "points.csv").exists():
            rows = list(csv.DictReader(io.StringIO(table.read_text())))
            names = [row.get("label") or row.get("name") or str(n) for n, row in enumerate(rows, 1)]
            places = [[float(row[f"camera_{axis}"]) for axis in "xyz"] for row in rows]
            self._add_points("mapped_points", list(zip(names, places, strict=True)))

    def add_ct_transform(self, camera_from_ct: list[list[float]] | None) -> None:
        """The transform ``ct``, which moves its children to the organ; None: the identity."""
        matrix = np.eye(4) if camera_from_ct is None else np.array(camera_from_ct)
        matrix = RAS_FROM_LPS @ matrix @ RAS_FROM_LPS
        numbers = " ".join(f"{number:.9g}" for number in matrix.ravel())
        self._node("LinearTransform", CT, id=f"{CT}Transform", matrixTransformToParent=numbers)

    def add_live(self, names: Iterable[str], host: str, port: int) -> None:
        """A connection to the sink `openigtlink`, which starts when the scene is opened (with
        SlicerOpenIGTLink), and empty models with the display properties of its surfaces."""
        for label, name in enumerate(names, ORGAN):
            for shown in (name,) if label == ORGAN else (name, name + MARGIN):
                self._add_model(shown, label)
        client = {"connectorType": "CLIENT", "serverHostname": host, "serverPort": str(port)}
        # Slicer starts connectors that are persistent and not off (1: waits for the server).
        active = {"persistent": "1", "state": "1", "checkCRC": "1"}
        self._node("IGTLConnector", "tumortrack", **client, **active)

    def _add_structures(self, folder: Path, names: Iterable[str]) -> None:
        for number, name in enumerate(names):
            content = (folder / f"{name}.ply").read_bytes()
            self._add_model(name, FIRST_TUMOR, content, structure_colour(number))

    def _add_model(
        self, name: str, label: int, content: bytes | None = None, colour: Colour | None = None
    ) -> None:
        shell = name.endswith(MARGIN)
        opacity = _SHELL_OPACITY if shell else _ORGAN_OPACITY if label == ORGAN else 1.0
        display = {
            "color": " ".join(f"{channel / 255:.4g}" for channel in colour or part_colour(label)),
            "opacity": f"{opacity:g}",
            "visibility2D": "true",
            "backfaceCulling": "false",
            "scalarVisibility": "false",
        }
        file = None if content is None else ("ModelStorage", f"{name}.ply", content)
        self._add("Model", name, display, file)

    def _add_points(self, name: str, points: list[tuple[str, list[float]]]) -> None:
        if not points:
            return
        control = [
            {"id": str(n), "label": label, "position": place, "positionStatus": "defined"}
            for n, (label, place) in enumerate(points, 1)
        ]
        markup = {"type": "Fiducial", "coordinateSystem": "LPS", "coordinateUnits": "mm"}
        content = {"@schema": _SCHEMA, "markups": [markup | {"controlPoints": control}]}
        file = ("MarkupsJsonStorage", f"{name}.mrk.json", json.dumps(content, indent=1).encode())
        self._add("MarkupsFiducial", name, {}, file)

    def _add(
        self, kind: str, name: str, display: dict[str, str], file: _File | None, parent: str = ""
    ) -> None:
        """A node with its display, the file it is read from and its parent transform."""
        references = {"display": self._node(f"{kind}Display", f"{name} display", **display)}
        if file is not None:
            storage, file_name, content = file
            self._files[file_name] = content
            attributes = {"fileName": f"Data/{file_name}"}
            if kind in ("Model", "MarkupsFiducial"):
                attributes["coordinateSystem"] = "LPS"
            references["storage"] = self._node(storage, f"{name} storage", **attributes)
        if parent:
            references["transform"] = f"{parent}Transform"
        listed = "".join(f"{role}:{node};" for role, node in references.items())
        self._node(kind, name, references=listed)

    def _node(self, kind: str, name: str, **attributes: str) -> str:
        """Add a node; returns its id."""
        attributes = {"id": f"vtkMRML{kind}Node{len(self._root) + 1}", "name": name} | attributes
        ElementTree.SubElement(self._root, kind, attributes)
        return attributes["id"]
