"""The study of noise: images err as their conditions say, and nothing is measured twice."""

from __future__ import annotations

import noise
import numpy as np
import pandas as pd
import pytest
from noise import Condition, disturbed, placed

from stress_objects import ANATOMY
from tumortrack.core.camera import d405, deproject
from tumortrack.core.errors import InputError
from tumortrack.core.types import DepthFrame, SensorCloud

FLAT = DepthFrame(np.full((480, 848), 300.0, np.float32), d405())


def seen(text: str, frame: DepthFrame = FLAT, seed: int = 1) -> DepthFrame | SensorCloud:
    return disturbed(frame, Condition.read(text), seed)


def test_the_organ_lies_in_the_middle_as_far_off_as_the_condition_says():
    there, frame = placed(ANATOMY, 300.0)
    assert np.nanmedian(frame.depth_mm) == pytest.approx(300, abs=0.5)
    assert there.organ.box_mm.mean(0)[:2] == pytest.approx([0, 0], abs=1e-6)
    apart = there.tumors[0].vertices_mm - ANATOMY.tumors[0].vertices_mm
    assert np.ptp(apart, axis=0) == pytest.approx([0, 0, 0], abs=1e-9)


@pytest.mark.parametrize(
    ("text", "step_px", "alike"),
    [("white:2", 1, 0), ("correlated:2:8", 8, np.exp(-1)), ("correlated:2:3", 3, np.exp(-1))],
)
def test_depths_err_by_as_much_as_stated_and_neighbours_alike_by_1_e_at_the_length(
    text, step_px, alike
):
    off = seen(text).depth_mm - FLAT.depth_mm
    assert off.std() == pytest.approx(2, rel=0.03)
    beside = np.corrcoef(off[:, step_px:].ravel(), off[:, :-step_px].ravel())[0, 1]
    assert beside == pytest.approx(alike, abs=0.04)


def test_a_camera_errs_by_its_noise_at_the_distance():
    condition = Condition.read("d405-measured@300")
    off = seen("d405-measured@300").depth_mm - FLAT.depth_mm
    assert np.nanstd(off) == pytest.approx(condition.noise_mm, rel=0.1)
    assert Condition.read("d405-measured@600").noise_mm == pytest.approx(4 * condition.noise_mm)
    assert seen("zed:0@300").depth_mm == pytest.approx(FLAT.depth_mm, abs=1e-3)
    times, once = (Condition.read(text).noise_mm for text in ("zed:3@300", "zed@300"))
    assert times == pytest.approx(3 * once)
    assert np.array_equal(seen("white:1").depth_mm, seen("white:1").depth_mm)
    assert not np.array_equal(seen("white:1").depth_mm, seen("white:1", seed=2).depth_mm)


def test_a_bias_is_to_either_side_and_unstated_and_cameras_state_theirs():
    for number, off_mm in ((0, -4.0), (1, 4.0)):
        biased = seen("depth:4", seed=number)
        np.testing.assert_allclose(biased.depth_mm - FLAT.depth_mm, off_mm, atol=1e-3)
        assert biased.intrinsics.depth_error is None
    np.testing.assert_allclose(seen("scale:3").depth_mm, 1.03 * FLAT.depth_mm, rtol=1e-5)
    right, raw = seen("d435@300"), seen("uncalibrated-d435@300")
    assert right.intrinsics.depth_error == (0.0, 0.0)
    assert raw.intrinsics.depth_error == (5.0, 0.02)
    assert abs(np.nanmedian(raw.depth_mm - right.depth_mm)) > 0.3


def test_clouds_have_noise_strays_or_a_lump_as_asked():
    _, frame = placed(ANATOMY, 150.0)
    low, high = deproject(frame).min(0), deproject(frame).max(0)
    plain, outliers, fat = (
        seen(text, frame).points_mm for text in ("cloud:0", "outliers:40", "fat:15")
    )
    outside = ((outliers < low - 1e-3) | (outliers > high + 1e-3)).any(1).mean()
    assert len(plain) == len(outliers) == 3000
    assert outside == pytest.approx(0.4 * (1 - 1 / 1.5**3), abs=0.03)
    assert len(fat) == 3450
    assert np.array_equal(fat[:3000], plain)
    lump = fat[3000:]
    assert np.linalg.norm(lump - plain[:, None], axis=2).min(0).max() < 14 + 1e-3
    assert (seen("cloud:2", frame).points_mm - plain).std() == pytest.approx(2, rel=0.05)


@pytest.mark.parametrize("text", ["whit:1", "white:x", "white:-1", "white:1:2:3@x", "d405"])
def test_what_is_no_condition_is_refused(text):
    with pytest.raises(InputError):
        Condition.read(text)


def test_each_condition_is_measured_once_and_is_a_line_of_the_table(ready_case, tmp_path):
    (kidney := tmp_path / "rows" / "7").mkdir(parents=True)
    (kidney / "case").symlink_to(ready_case)  # instead of a random one
    page = tmp_path / "page.md"
    page.write_text("<!-- results:noise -->\n<!-- /results:noise -->\n")
    options = noise.Options(
        tmp_path / "rows",
        kidneys=1,
        first=7,
        conditions=("white:0", "outliers:20"),
        count=2,
        document=page,
    )
    noise.main(options)
    files = sorted(path.name for path in (kidney / "noise").iterdir())
    assert files == ["outliers-20.json", "white-0.json"]
    table = pd.read_csv(tmp_path / "data" / "noise.csv", comment="#")
    assert table.scenes.tolist() == [2, 2]
    assert table["no answer"].tolist() == [0, 0]
    assert (table["worst tumor off mm: median"] < 2).all()
    assert (table["worst tumor off mm: median"] <= table["95 %"]).all()
    assert (tmp_path / "images" / "noise.png").read_bytes().startswith(b"\x89PNG")

    written = [path.stat().st_mtime_ns for path in (kidney / "noise").iterdir()]
    noise.main(options)
    assert written == [path.stat().st_mtime_ns for path in (kidney / "noise").iterdir()]
    assert pd.read_csv(tmp_path / "data" / "noise.csv", comment="#").equals(table)
