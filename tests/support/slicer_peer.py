"""3D Slicer's core in a process of its own (`clients.py`).

slicer_peer.py read SCENE...     a line of JSON for each scene (.mrb): what Slicer made of it
slicer_peer.py write FOLDER      points, a segmentation and surfaces, as Slicer writes them
"""

from __future__ import annotations

import json
import sys
import tempfile
from pathlib import Path
from typing import Any

import numpy as np
import slicer
from vtkmodules.util.numpy_support import vtk_to_numpy
from vtkmodules.vtkCommonCore import reference
from vtkmodules.vtkCommonMath import vtkMatrix4x4
from vtkmodules.vtkFiltersSources import vtkSphereSource

LOGICS = (
    slicer.vtkSlicerSegmentationsModuleLogic,
    slicer.vtkSlicerMarkupsModuleLogic.vtkSlicerMarkupsLogic,
    slicer.vtkSlicerModelsModuleLogic.vtkSlicerModelsLogic,
    slicer.vtkSlicerVolumesModuleLogic.vtkSlicerVolumesLogic,
)


class Slicer:
    """What Slicer starts with: a scene, and the modules that know its nodes."""

    def __init__(self, folder: str) -> None:
        self.scene, self._app = slicer.vtkMRMLScene(), slicer.vtkSlicerApplicationLogic()
        self._app.SetMRMLScene(self.scene)
        self._app.SetTemporaryPath(folder)
        self._cache, self._files = slicer.vtkCacheManager(), slicer.vtkDataIOManager()
        self._cache.SetRemoteCacheDirectory(f"{folder}/cache")
        self._files.SetCacheManager(self._cache)
        self.scene.SetCacheManager(self._cache)
        self.scene.SetDataIOManager(self._files)
        self._logics = [logic() for logic in LOGICS]
        for logic in self._logics:
            logic.SetMRMLApplicationLogic(self._app)
            logic.SetMRMLScene(self.scene)

    def opened(self, path: str) -> dict[str, Any]:
        said = slicer.vtkMRMLMessageCollection()
        good = self.scene.ReadFromMRB(path, True, said)
        nodes = [self.scene.GetNthNode(n) for n in range(self.scene.GetNumberOfNodes())]
        kinds = "vtkMRMLDisplayableNode", "vtkMRMLTransformNode"
        shown = [node for node in nodes if node.IsA(kinds[0]) or node.IsA(kinds[1])]
        found = {node.GetName(): about(node) for node in shown if not node.GetHideFromEditors()}
        return {"good": bool(good), "said": said.GetAllMessagesAsString(), "nodes": found}


def about(node: Any) -> dict[str, Any]:
    """Class, world coordinates (RAS, mm) and look of a node."""
    parent = node.GetParentTransformNode()
    found = {"kind": node.GetClassName(), "under": parent.GetName() if parent else ""}
    if node.IsA("vtkMRMLTransformNode"):
        matrix = vtkMatrix4x4()
        node.GetMatrixTransformToWorld(matrix)
        found["world_from_node"] = [[matrix.GetElement(i, j) for j in range(4)] for i in range(4)]
        return found
    node.GetRASBounds(box := [0.0] * 6)
    display = node.GetDisplayNode()
    found |= {"box": box, "seen": bool(display and display.GetVisibility())}
    if node.IsA("vtkMRMLModelNode"):
        found |= {"colour": display.GetColor(), "opacity": display.GetOpacity()}
        mesh = node.GetPolyData()
        found["points"] = vtk_to_numpy(mesh.GetPoints().GetData()).tolist() if mesh else []
    if node.IsA("vtkMRMLScalarVolumeNode"):
        node.GetIJKToRASMatrix(matrix := vtkMatrix4x4())
        found["brightest"] = voxels_of(node.GetImageData(), matrix, None)[1]
    if node.IsA("vtkMRMLMarkupsNode"):
        numbers = range(node.GetNumberOfControlPoints())
        found["places"] = {
            node.GetNthControlPointLabel(n): list(node.GetNthControlPointPositionWorld(n))
            for n in numbers
        }
    if node.IsA("vtkMRMLSegmentationNode"):
        names = node.GetSegmentation().GetSegmentIDs()
        found["segments"] = {name: segment_of(node, name) for name in names}
    return found


def segment_of(node: Any, name: str) -> dict[str, Any]:
    """``middle``: of its voxels, in the node's own RAS; empty where it has none."""
    segment, entry, matrix = node.GetSegmentation().GetSegment(name), reference(""), vtkMatrix4x4()
    segment.GetTag("TerminologyEntry", entry)
    term = slicer.vtkSlicerTerminologyEntry()
    slicer.vtkSlicerTerminologiesModuleLogic().DeserializeTerminologyEntry(str(entry), term)
    coded = [term.GetTypeObject(), term.GetTypeModifierObject()]
    coded += [term.GetRegionObject(), term.GetRegionModifierObject()]
    image = segment.GetRepresentation("Binary labelmap")
    image.GetImageToWorldMatrix(matrix)
    count, middle = voxels_of(image, matrix, segment.GetLabelValue())
    return {
        "colour": segment.GetColor(),
        "meaning": [one.GetCodeMeaning() or "" for one in coded],
        "volume_mm3": float(np.prod(image.GetSpacing())) * count,
        "middle": middle,
    }


def voxels_of(image: Any, matrix: Any, value: float | None) -> tuple[int, list[float]]:
    """How many have this value (None: the largest), and their middle by the matrix."""
    extent, values = image.GetExtent(), vtk_to_numpy(image.GetPointData().GetScalars())
    values = values.reshape([1 + extent[n + 1] - extent[n] for n in (4, 2, 0)])
    places = np.argwhere(values == (values.max() if value is None else value))[:, ::-1]
    if not len(places):
        return 0, []
    return len(places), list(matrix.MultiplyPoint([*(places.mean(0) + extent[::2]), 1])[:3])


MIDDLE, TUMOR = (10.0, 20.0, 30.0), (24.0, 20.0, 30.0)  # RAS, mm
GRID = "1.5;0;0;-40; 0;1.5;0;-30; 0;0;1.5;-20; 0;0;0;1; 0;66;0;66;0;66;"


def write(scene: Any, folder: Path) -> None:
    """An organ of 20 mm and its tumor of 6 mm, and points in their middles, in both systems."""
    kidney, tumor = ball(20.0, MIDDLE), ball(6.0, TUMOR)
    markups = scene.AddNewNodeByClass("vtkMRMLMarkupsFiducialNode", "F")
    for label, place in (("hilum, left", MIDDLE), ("F-2", TUMOR)):
        markups.AddControlPoint(place, label)
    for axes in ("LPS", "RAS"):
        (folder / axes).mkdir()
        for name, surface in (("kidney.ply", kidney), ("tumor_1.stl", tumor)):
            model = scene.AddNewNodeByClass("vtkMRMLModelNode", name)
            model.SetAndObservePolyData(surface)
            saved(model, "vtkMRMLModelStorageNode", folder / axes / name, axes)
        for kind, suffix in (("Json", "mrk.json"), ("Fiducial", "fcsv")):
            saved(markups, f"vtkMRMLMarkups{kind}StorageNode", folder / f"{axes}.{suffix}", axes)
    segmentation = scene.AddNewNodeByClass("vtkMRMLSegmentationNode", "S")
    segmentation.GetSegmentation().SetConversionParameter("Reference image geometry", GRID)
    for name, surface in (("Kidney", kidney), ("Tumor", tumor)):
        segmentation.AddSegmentFromClosedSurfaceRepresentation(surface, name)
    segmentation.CreateBinaryLabelmapRepresentation()
    segmentation.SetSourceRepresentationToBinaryLabelmap()
    saved(segmentation, "vtkMRMLSegmentationStorageNode", folder / "S.seg.nrrd")
    names = segmentation.GetSegmentation().GetSegmentIDs()
    print(json.dumps([segment_of(segmentation, name) for name in names]), flush=True)


def ball(radius_mm: float, middle: tuple[float, float, float]) -> Any:
    source = vtkSphereSource()
    source.SetRadius(radius_mm)
    source.SetCenter(middle)
    source.SetThetaResolution(64)
    source.SetPhiResolution(64)
    source.Update()
    return source.GetOutput()


def saved(node: Any, kind: str, path: Path, axes: str = "") -> None:
    storage = node.GetScene().AddNewNodeByClass(kind)
    if axes:
        storage.SetCoordinateSystem(getattr(storage, f"CoordinateSystem{axes}"))
    storage.SetFileName(str(path))
    if not storage.WriteData(node):
        raise OSError(path)


if __name__ == "__main__":
    with tempfile.TemporaryDirectory() as folder:
        started = Slicer(folder)
        if sys.argv[1] == "read":
            for path in sys.argv[2:]:
                print(json.dumps(started.opened(path)), flush=True)
        else:
            write(started.scene, Path(sys.argv[2]))
