"""The how-to pages' commands, each page's run in the order in which a reader would type them.

A fenced block marked `bash` is run as it stands; one with a title is not, and the title tells the
reader why (a camera, a browser, minutes).
"""

import contextlib
import re
import shlex
import shutil
from pathlib import Path

import numpy as np
import pytest

from stories import cloud_by_rays, looking_down
from tumortrack.cli.main import run
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import contains
from tumortrack.io.case import Case, load_case
from tumortrack.io.ply import write_cloud_ply

PAGES = sorted((Path(__file__).parents[2] / "docs" / "how-to").glob("*.md"))
LEFT = {  # what a page's commands leave behind, besides what they print
    "camera": ("RUN/metadata.yaml", "again.json", "PACKED/metadata.yaml"),
    "cut": ("RUN/report.json", "RUN/tumor_1.ply"),
    "ct": ("CASE/qc.png", "RUN/tumor_2.ply", "RUN_WITH_POINTS/points.csv"),
    "dvrk": ("frames.png",),
    "evaluate": ("REPORT/index.html",),
    "evidence": ("RUN/report.json", "TOUCHED/tumor_1.ply"),
    "frames": ("frames.png",),
    "organ": ("LIVER/liver.ply",),
    "plan": ("PLAN/plan.png",),
    "poor-answer": ("RUN/index.html",),
    "ros2": ("report.json",),
    "simulators": ("BODY/body.usda", "BODY/body.json"),
    "slicer": ("FOR_SLICER/case.seg.nrrd", "RUN/labels.seg.nrrd"),
}


def commands(page: Path) -> list[list[str]]:
    blocks = re.findall(r"^```bash\n(.*?)^```$", page.read_text("utf-8"), re.M | re.S)
    return [shlex.split(line, comments=True) for block in blocks for line in block.splitlines()]


def write_touches(path: Path, case: Case) -> None:
    """On all sides of the organ, in the camera's frame."""
    organ = case.anatomy.organ
    faces = organ.faces[:: len(organ.faces) // 48]
    places_mm = transform_points(looking_down(case), organ.vertices_mm[faces].mean(1))
    rows = [
        f"{n},camera,touch,{x:.2f},{y:.2f},{z:.2f},1.0,probe"
        for n, (x, y, z) in enumerate(places_mm)
    ]
    path.write_text("\n".join(["piece,frame,kind,x_mm,y_mm,z_mm,std_mm,tool", *rows]))


def write_cut(path: Path, case: Case) -> None:
    """Half way round a tumor, of the CT."""
    tumor, organ = case.anatomy.tumors[0].vertices_mm[::8], case.anatomy.organ
    places_ct = tumor.mean(0) + 1.3 * (tumor - tumor.mean(0))
    places_ct = places_ct[contains(organ, places_ct) & (places_ct[:, 0] > tumor[:, 0].mean())]
    rows = [f"1,ct,cut,{x:.2f},{y:.2f},{z:.2f},1.5" for x, y, z in places_ct]
    path.write_text("\n".join(["piece,frame,kind,x_mm,y_mm,z_mm,kerf_mm", *rows]))


@pytest.fixture
def desk(tmp_path, page, phantom_case, elastic_model):
    """A reader's folder: a label map, a case and its model, a cloud, points of the CT."""
    shutil.copy(phantom_case / "labels.nii.gz", tmp_path)
    shutil.copytree(elastic_model, tmp_path / "MODEL")
    case = load_case(phantom_case)
    cloud = cloud_by_rays(case, looking_down(case)).astype(np.float32)
    write_cloud_ply(tmp_path / "cloud.ply", cloud)
    if (example := PAGES[0].parents[2] / "examples" / page.stem).is_dir():
        shutil.copytree(example, tmp_path, dirs_exist_ok=True)
    else:
        write_touches(tmp_path / "touches.csv", case)
        write_cut(tmp_path / "cut.csv", case)
    points = case.anatomy.tumors[0].vertices_mm[:3]
    np.savetxt(tmp_path / "points.csv", points, delimiter=",", header="x,y,z", comments="")
    return tmp_path


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_a_page_does_what_it_says(page, desk, ready_case, capsys, monkeypatch):
    monkeypatch.setenv("ROS_LOCALHOST_ONLY", "1")
    if page.stem != "ct":  # whose reader makes the case
        shutil.copytree(ready_case, desk / "CASE")
    found = commands(page)
    assert found
    with contextlib.chdir(desk):
        for program, *arguments in found:
            assert program == "tumortrack"
            poor = (0, 4) if arguments[0] in ("locate", "frames") else (0,)
            assert run(arguments) in poor, (arguments, capsys.readouterr().err)
    for left in LEFT[page.stem]:
        assert (desk / left).stat().st_size > 0
