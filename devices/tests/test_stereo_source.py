"""Pictures of two cameras as a source."""

from __future__ import annotations

import cv2
import msgspec
import numpy as np
import pytest

from clock import PATIENCE_S
from stereo_objects import endoscope
from tumortrack.core.errors import InputError
from tumortrack.live.spec import SOURCES
from tumortrack.live.values import Source, SourceEnded, SourceLost

SMALL = endoscope(320, 240, 260.0)


@pytest.fixture(scope="module")
def folder(tmp_path_factory):
    """Three pairs of a wall with a random texture, 6, 7 and 8 pixels apart, of straight lenses."""
    folder = tmp_path_factory.mktemp("stereo")
    matrix = ((260.0, 0, 160), (0, 260.0, 120), (0, 0, 1))
    straight = msgspec.structs.replace(
        SMALL, K1=matrix, K2=matrix, D1=(0.0,) * 5, D2=(0.0,) * 5,
        R=((1, 0, 0), (0, 1, 0), (0, 0, 1)), T=(-4.0, 0.0, 0.0),
    )  # fmt: skip
    (folder / "stereo.json").write_bytes(msgspec.json.encode(straight))
    fine = np.random.default_rng(0).normal(128, 60, (240, 340, 3))
    wall = np.clip(cv2.GaussianBlur(fine, (0, 0), 1.2) * 2 - 128, 0, 255).astype(np.uint8)
    for n in range(3):
        cv2.imwrite(str(folder / f"left_{n:04d}.png"), wall[:, :320])
        cv2.imwrite(str(folder / f"right_{n:04d}.png"), wall[:, 6 + n : 326 + n])
    return folder


def spec(folder, left="left_%04d.png", right="right_%04d.png", more=""):
    return f"stereo:{folder / left},{folder / right}?calibration={folder / 'stereo.json'}{more}"


def test_every_pair_becomes_a_depth_image_with_the_left_picture(folder):
    source = SOURCES.parse(spec(folder, more="&fps=10&far_mm=1000")).open()
    assert isinstance(source, Source)
    assert source.lossless
    assert not source.host_clock
    for n in range(3):
        seen = source.read(PATIENCE_S)
        assert seen.stamp_ns == n * 100_000_000
        depth_mm = seen.content.depth_mm
        inner = depth_mm[20:-20, 60:-20]
        assert np.isfinite(inner).mean() > 0.9
        assert np.nanmedian(inner) == pytest.approx(260 * 4 / (6 + n), rel=0.01)
        blue_first = cv2.imread(str(folder / f"left_{n:04d}.png"))
        off = np.abs(seen.picture[..., ::-1].astype(int) - blue_first)
        assert np.median(off[20:-20, 20:-20]) <= 2  # red first, in the depth image's pixels
    for _ in range(2):
        with pytest.raises(SourceEnded, match="first 3"):
            source.read(PATIENCE_S)
    source.close()
    source.close()
    with pytest.raises(SourceLost):
        source.read(0)


def test_it_is_closed_while_a_pair_waits(folder):
    source = SOURCES.parse(spec(folder)).open()
    source.close()


@pytest.mark.parametrize(
    ("text", "words"),
    [
        ("stereo:left.avi?calibration=x", "LEFT,RIGHT"),
        ("stereo:0,left.avi?calibration=x", "LEFT,RIGHT"),
        ("stereo:0,1", "lacks its calibration"),
        ("stereo:0,1?calibration=x&near_mm=400&far_mm=50", "less than far_mm"),
        ("stereo:0,1?calibration=x&block_px=8", "odd"),
        ("stereo:0,1?calibration=x&block_px=1", "3 to 21"),
    ],
)
def test_what_can_be_no_pair_is_refused(text, words):
    with pytest.raises(InputError, match=words):
        SOURCES.parse(text)


def test_what_is_not_there_is_said_by_us_alone(folder, capfd):
    with pytest.raises(InputError, match="nowhere"):
        SOURCES.parse(spec(folder, left="nowhere.avi")).open()
    with pytest.raises(SourceLost, match="/dev/video97"):
        SOURCES.parse(f"stereo:97,98?calibration={folder / 'stereo.json'}").open()
    with pytest.raises(InputError, match=r"stereo\.json"):
        SOURCES.parse("stereo:97,98?calibration=/nowhere/stereo.json").open()
    assert capfd.readouterr() == ("", "")
