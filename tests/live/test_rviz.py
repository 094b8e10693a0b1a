"""RViz shows what the ROS 1 sink publishes: looked at on a screen of its own."""

from __future__ import annotations

import io
import os
import shutil
import subprocess
import time
from contextlib import ExitStack
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from PIL import Image
from ruamel.yaml import YAML

from clock import until
from live_objects import STAMP_NS, empty_update, small_setting
from ros1_objects import end, eventually, ros1_graph
from ros1_rviz import Screen, rviz
from stories import environment, live_resection, looking_down, write_phantom_case
from tumortrack.core.colours import KIDNEY
from tumortrack.core.estimate import Estimate
from tumortrack.core.geometry import rigid, transform_points
from tumortrack.core.types import OccupancyCloud
from tumortrack.live.sinks.ros import Ros1SinkConfig
from tumortrack.live.values import PublishedFrame, TrackingResult
from workcell_objects import with_arms, workcell

pytestmark = pytest.mark.filterwarnings("ignore:notifyAll:DeprecationWarning")  # rospy's own


def phantom_update(folder: Path) -> TrackingResult:
    """The built-in phantom before the camera, as a perfect tracker would see it."""
    case = write_phantom_case(folder / "case")
    camera_from_ct = looking_down(case)
    meshes = {
        name: part.moved(transform_points(camera_from_ct, part.vertices_mm))
        for name, part in zip(case.anatomy.names, case.anatomy.parts, strict=True)
    }
    rng = np.random.default_rng(0)
    voxels = np.argwhere(case.labels.labels)
    voxels = voxels[rng.choice(len(voxels), 8000)]
    points_ct = transform_points(
        case.labels.lps_from_index, voxels + rng.uniform(-0.5, 0.5, voxels.shape)
    )
    cloud = OccupancyCloud(
        transform_points(camera_from_ct, points_ct),
        case.labels.labels[tuple(voxels.T)],
        np.ones(len(voxels)),
        STAMP_NS,
    )
    estimate = Estimate(cloud, None, meshes, {})
    return TrackingResult(sequence=0, stamp_ns=STAMP_NS, estimate=estimate, quality="good")


def shown(screen: Screen) -> dict[str, int]:
    """How many pixels look like each part, shaded and through one another."""
    pixels = screen.pixels()[80:690, 370:1160]
    red, green, blue = np.moveaxis(pixels, -1, 0)
    bright = red + green + blue > 90
    brown = bright & (red > green + 15) & (abs(green - blue) < 20)
    return {
        "tumor_1": int((bright & (green > red + 15) & (green > blue + 15)).sum()),
        "tumor_2": int((bright & (red > green + 15) & (green > blue + 40)).sum()),
        "kidney": int((brown & (red < 2.5 * green)).sum()),
        "kidney's points": int((abs(pixels - KIDNEY).max(-1) < 30).sum()),
        "warning": int((brown & (red > 3 * green)).sum()),
    }


def all_there(count: dict[str, int]) -> bool:
    tumors = min(count["tumor_1"], count["tumor_2"])
    return tumors > 4000 and count["kidney"] > 15_000 and count["kidney's points"] > 400


@pytest.mark.slow
def test_rviz_shows_the_tumors_through_the_kidney_and_nothing_without_an_estimate(tmp_path):
    """With TUMORTRACK_PICTURES=docs/images it also makes the picture in the documentation."""
    ros1_graph()
    update = phantom_update(tmp_path)
    sink = Ros1SinkConfig().open(small_setting())

    def ask(update: TrackingResult) -> dict[str, int]:
        for _ in range(5):
            sink.publish(update)
            time.sleep(0.05)
        return shown(screen)

    with rviz(tmp_path) as screen:
        eventually(lambda: all_there(ask(update)), "all parts")
        if folder := os.environ.get("TUMORTRACK_PICTURES"):
            shutil.copy(screen.picture(), Path(folder) / "rviz.png")
        assert shown(screen)["warning"] < 50

        def nothing_left() -> bool:
            left = ask(empty_update())
            parts = left["tumor_1"] + left["tumor_2"] + left["kidney's points"]
            # Of the kidney, the text's soft edges.
            return left["warning"] > 500 and parts < 50 and left["kidney"] < 1500

        eventually(nothing_left, "the reason in red, and nothing else")
    sink.close()


def seen_of_the_cell(screen: Screen) -> dict[str, np.ndarray]:
    """Which pixels look like what, shaded."""
    red, green, blue = np.moveaxis(screen.pixels()[80:690, 370:1160], -1, 0)
    bright = red + green + blue > 90
    return {
        "cutter": bright & (red > 1.4 * green) & (green > 2 * blue),
        "holder": bright & (blue > 1.35 * green) & (green > 1.5 * red),
        "table": (red > 55) & (abs(red - green) < 8) & (abs(blue - green) < 8) & (red < 180),
        "cut": bright & (red > 2 * green) & (blue > 1.5 * green),
        "tumor": bright & (red > green + 15) & (green > blue + 40) & (red < 1.35 * green),
        "kidney": bright & (red > 1.3 * green) & (red < 2.5 * green) & (abs(green - blue) < 25),
    }


@pytest.mark.slow
def test_rviz_shows_arms_at_work_and_nothing_of_them_when_nothing_is_known(tmp_path):
    ros1_graph()
    update = phantom_update(tmp_path)
    assert update.estimate is not None
    # The camera looks straight down; the organ lies on the table.
    far_mm = update.estimate.meshes["kidney"].box_mm[1, 2]
    frames = PublishedFrame("table", rigid(np.diag([1.0, -1, -1]), np.array([0.0, 0, far_mm])))
    update = replace(update, published_frame=frames)
    assert update.transformed is not None
    x, y, z = update.transformed.meshes["tumor_2"].box_mm.mean(0)
    sink = Ros1SinkConfig(mesh_hz=0.0).open(replace(with_arms(), published_frame=frames))

    def ask(progress: float | None) -> dict[str, np.ndarray]:
        cell = None if progress is None else workcell(progress, "", (x, y, z), 25.0)
        for _ in range(5):
            sink.publish(replace(update, workcell=cell))
            time.sleep(0.05)
        return seen_of_the_cell(screen)

    least = {"cutter": 5000, "holder": 5000, "table": 50_000, "cut": 40, "tumor": 60, "kidney": 300}

    def all_there() -> bool:
        found = {name: int(pixels.sum()) for name, pixels in ask(0.1).items()}
        return all(found[name] > number for name, number in least.items())

    with rviz(tmp_path, "resection_ros1.rviz") as screen:
        eventually(all_there, "arms, table, cuts, kidney and tumor")
        before = ask(0.1)

        def moved() -> bool:  # the cutter, and the holder not
            later = ask(0.6)
            apart = {name: (before[name] ^ later[name]).sum() for name in ("cutter", "holder")}
            return apart["cutter"] > 800 and apart["holder"] < 300 and bool(later["holder"].any())

        eventually(moved, "the cutter at its next place, and the holder at its own")

        def gone() -> bool:
            left = {name: pixels.sum() for name, pixels in ask(None).items()}
            arms = max(left["cutter"], left["holder"], left["table"])
            return arms < 60 and left["cut"] < 20 and left["tumor"] > 60

        eventually(gone, "the organ alone, without the arms")
    sink.close()


PICTURES, DEMO, PLAN = (
    os.environ.get(f"TUMORTRACK_{name}") for name in ("PICTURES", "DEMO", "PLAN")
)


@pytest.mark.skipif(not (PICTURES and DEMO and PLAN), reason="TUMORTRACK_PLAN and more not set")
def test_picture_of_a_resection_for_the_documentation(tmp_path):
    """TUMORTRACK_PICTURES: where it goes; TUMORTRACK_DEMO: what ``tumortrack demo`` left;
    TUMORTRACK_PLAN: what ``tumortrack plan`` made of its phantom. The command itself, live."""
    ros1_graph()
    demo, plan = (Path(str(one)).resolve() for one in (DEMO, PLAN))
    command = live_resection(demo, plan, "ros1:/tumortrack?mesh_hz=5")
    views = Path(__file__).parents[2] / "docs" / "ros"
    near = tmp_path / "near.rviz"
    near.write_text(_near((views / "resection_ros1.rviz").read_text()))
    with ExitStack() as stack:
        screens = []
        for view in (views / "resection_ros1.rviz", near):
            folder = tmp_path / view.stem
            folder.mkdir()
            screens.append(stack.enter_context(rviz(folder, view)))
        said = stack.enter_context((tmp_path / "said.txt").open("w"))
        process = subprocess.Popen(
            command, env=environment(), cwd=tmp_path, stdout=said, stderr=said
        )
        stack.callback(end, process)
        said_so = tmp_path / "said.txt"
        until(lambda: "sweep 2" in said_so.read_text() or process.poll(), "sweep 2", 200)
        assert process.poll() is None, said_so.read_text()
        time.sleep(3)
        shots = [screen.pixels()[63:690, 364:1164] for screen in screens]
    both = np.hstack([shots[0], np.full((len(shots[0]), 8, 3), 255), shots[1][:, 150:650]])
    Image.fromarray(both.astype(np.uint8)).save(Path(str(PICTURES)) / "rviz_resection.png")


def _near(text: str) -> str:
    """The configuration with its saved view in place of the first."""
    yaml, out = YAML(), io.StringIO()
    content = yaml.load(text)
    views = content["Visualization Manager"]["Views"]
    views["Current"] |= views["Saved"][0]
    yaml.dump(content, out)
    return out.getvalue()
