"""Scenes of 3D Slicer (.mrb): a zip of a scene in MRML, Slicer's XML, and of the files it shows.

Written after the source code of Slicer (what ``ReadXMLAttributes`` of the nodes in Libs/MRML/Core
takes) and of SlicerOpenIGTLink (vtkMRMLIGTLConnectorNode.cxx).
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
from tumortrack.core.colours import Colour, part_colour, structure_colour
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import RAS_FROM_LPS
from tumortrack.core.mesh_files import write_mesh
from tumortrack.core.patient import Patient
from tumortrack.core.report import FitReport
from tumortrack.core.types import FIRST_TUMOR, ORGAN
from tumortrack.imaging.case import Case, load_case
from tumortrack.imaging.segmentation_files import segments, write_dicom_seg, write_seg_nrrd
from tumortrack.tracking.files import MARGIN, read_report
from tumortrack.tracking.margins import stated_radius
from tumortrack.tracking.options import ExportOptions

_SCHEMA = (
    "https://raw.githubusercontent.com/slicer/slicer/master/Modules/Loadable/Markups/Resources/"
    "Schema/markups-schema-v1.0.3.json#"
)
CENTRES, CT = "tumors", "ct"  # what the sink `openigtlink` calls the centres and the organ's pose
_ORGAN_OPACITY, _SHELL_OPACITY = 0.4, 0.25
_File = tuple[str, str, bytes]  # kind of node that reads it, name, content


def centre_label(report: FitReport, name: str, poor: bool) -> str:
    """A tumor's label: its name and, as far as known, how certain its centre is."""
    radius, std_mm = stated_radius(report.margin, name), report.parts[name].center_std_mm
    words = [f"{name} POOR" if poor else name]
    words += [] if std_mm is None else [f"std {std_mm:.1f} mm"]
    return ", ".join([*words, radius.words if radius else "no margin stated"])


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
    parts = segments(case.anatomy.names, patient.side, case.anatomy.kind)
    file = aside / "case.seg.nrrd"
    write_seg_nrrd(file, labels.labels, labels.lps_from_index, parts)
    for name, mesh in case.anatomy.structures.items():
        write_mesh(aside / f"{name}.ply", mesh)
    moved = (options.located, options.live) != (None, None)
    scene.add_case(folder, case, file.read_bytes(), moved)
    if options.located is not None:
        report = _report_with_motion(options.located, case, folder)
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


def _report_with_motion(run: Path, case: Case, folder: Path) -> dict[str, Any]:
    """report.json of a run. Raises InputError: it was located with another case's model, or without
    a motion."""
    report = read_report(run)
    if report.get("model", {}).get("case_sha256") != case.sha256:
        raise InputError(f"{run} was not located with a model of {folder}: give its case.")
    if "motion" not in report:
        raise InputError(
            f"{run} does not know where the CT is now: a model of the preset clinic does. "
            "Export it alone: tumortrack export RUN OUT."
        )
    return report


class Scene:
    """Collects nodes and their files. Those of the camera's frame are shown as if it were LPS."""

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
        """Its CT and segmentation; ``moved``: by the transform ``ct``, which is to be added too;
        else with its surfaces and the tumors' centres."""
        under = CT if moved else ""
        if case.ct is not None:
            file = ("VolumeArchetypeStorage", "ct.nii.gz", (folder / "ct.nii.gz").read_bytes())
            grey = {"colorNodeID": "vtkMRMLColorTableNodeGrey", "autoWindowLevel": "1"}
            self._add("Volume", "CT", grey, file, under)
        file = ("SegmentationStorage", "case.seg.nrrd", segmentation)
        self._add("Segmentation", "CT segmentation", {}, file, under)
        if not moved:
            for label, name in enumerate(case.anatomy.names, ORGAN):
                self._add_model(name, label, (folder / f"{name}.ply").read_bytes())
            self._add_structures(folder, case.anatomy.structures)
            named = zip(case.anatomy.names[1:], case.anatomy.tumors, strict=True)
            middles = [(name, mesh.box_mm.mean(0).tolist()) for name, mesh in named]
            self._add_points(CENTRES, middles)

    def add_run(self, folder: Path, stored: dict[str, Any]) -> None:
        """What `locate` found: segmentation, surfaces, margins, the tumors' centres labelled with
        how sure they are, and mapped points; camera frame. ``stored``: its report.json."""
        report, poor = msgspec.convert(stored, FitReport), stored["quality"]["verdict"] != "good"
        voxels = (folder / "labels.seg.nrrd").read_bytes()
        self._add("Segmentation", "located", {}, ("SegmentationStorage", "labels.seg.nrrd", voxels))
        centres = []
        for name, part in report.parts.items():
            for shown in (name, name + MARGIN):
                if (file := folder / f"{shown}.ply").exists():
                    self._add_model(shown, part.label, file.read_bytes())
            if part.center_mm is not None and part.label >= FIRST_TUMOR:
                centres.append((centre_label(report, name, poor), list(part.center_mm)))
        self._add_structures(folder, report.structures)
        self._add_points(CENTRES, centres)
        if (table := folder / "points.csv").exists():
            rows = list(csv.DictReader(io.StringIO(table.read_text())))
            names = [row.get("label") or row.get("name") or str(n) for n, row in enumerate(rows, 1)]
            places = [[float(row[f"camera_{axis}"]) for axis in "xyz"] for row in rows]
            self._add_points("mapped_points", list(zip(names, places, strict=True)))

    def add_ct_transform(self, camera_from_ct: list[list[float]] | None) -> None:
        """The transform ``ct``: what is under it lies where the organ is; None: as in the CT."""
        matrix = np.eye(4) if camera_from_ct is None else np.array(camera_from_ct)
        matrix = RAS_FROM_LPS @ matrix @ RAS_FROM_LPS
        numbers = " ".join(f"{number:.9g}" for number in matrix.ravel())
        self._node("LinearTransform", CT, id=f"{CT}Transform", matrixTransformToParent=numbers)

    def add_live(self, names: Iterable[str], host: str, port: int) -> None:
        """A connection to the sink `openigtlink`, which starts when the scene is open (with
        SlicerOpenIGTLink), and models that wait for its surfaces, with their look."""
        for label, name in enumerate(names, ORGAN):
            for shown in (name,) if label == ORGAN else (name, name + MARGIN):
                self._add_model(shown, label)
        client = {"connectorType": "CLIENT", "serverHostname": host, "serverPort": str(port)}
        # What is persistent and not off (1: waits for the server) is started by Slicer.
        going = {"persistent": "1", "state": "1", "checkCRC": "1"}
        self._node("IGTLConnector", "tumortrack", **client, **going)

    def _add_structures(self, folder: Path, names: Iterable[str]) -> None:
        for number, name in enumerate(names):
            content = (folder / f"{name}.ply").read_bytes()
            self._add_model(name, FIRST_TUMOR, content, structure_colour(number))

    def _add_model(
        self, name: str, label: int, content: bytes | None = None, colour: Colour | None = None
    ) -> None:
        shell = name.endswith(MARGIN)
        opacity = _SHELL_OPACITY if shell else _ORGAN_OPACITY if label == ORGAN else 1.0
        look = {
            "color": " ".join(f"{channel / 255:.4g}" for channel in colour or part_colour(label)),
            "opacity": f"{opacity:g}",
            "visibility2D": "true",
            "backfaceCulling": "false",
            "activeScalarName": "std_mm",
            "scalarVisibility": "false",
        }
        file = None if content is None else ("ModelStorage", f"{name}.ply", content)
        self._add("Model", name, look, file)

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
        self, kind: str, name: str, look: dict[str, str], file: _File | None, under: str = ""
    ) -> None:
        """A node with its display, the file that it's read from and the transform it lies under."""
        references = {"display": self._node(f"{kind}Display", f"{name} display", **look)}
        if file is not None:
            storage, file_name, content = file
            self._files[file_name] = content
            place = {"fileName": f"Data/{file_name}"}
            if kind in ("Model", "MarkupsFiducial"):
                place["coordinateSystem"] = "LPS"
            references["storage"] = self._node(storage, f"{name} storage", **place)
        if under:
            references["transform"] = f"{under}Transform"
        text = "".join(f"{role}:{node};" for role, node in references.items())
        self._node(kind, name, references=text)

    def _node(self, kind: str, name: str, **attributes: str) -> str:
        """Its id."""
        known = {"id": f"vtkMRML{kind}Node{len(self._root) + 1}", "name": name} | attributes
        ElementTree.SubElement(self._root, kind, known)
        return known["id"]
