"""The bench that does not exist: what is laid on it is what scanner and camera see."""

from __future__ import annotations

from contextlib import closing

import numpy as np
import pytest
import trimesh
from rehearsal_bench import (
    BEAD_HU,
    PRINTED_HU,
    BenchErrors,
    Hands,
    looking_down,
    scan_bench,
    see_bench,
    set_up,
)

from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.types import Anatomy, Mesh
from tumortrack.simulation.phantom.scanner import ScannerParameters
from tumortrack_benchmarks.rehearsal.camera import BenchSourceConfig
from tumortrack_experiment.kit_file import Bead, Kit, KitPart

ROWS = tuple(map(tuple, np.eye(4).tolist()))
BEADS_MM = ((30.0, 0.0, 8.0), (-30.0, 5.0, 6.0), (3.0, 25.0, 9.0), (-8.0, -24.0, 7.0))


def mesh(solid, at=(0.0, 0.0, 0.0)):
    return Mesh(solid.vertices + np.array(at), solid.faces)


@pytest.fixture(scope="module")
def kit(tmp_path_factory):
    """A plate with four beads, on which two balls of hydrogel lie, one in the other."""
    folder = tmp_path_factory.mktemp("kit")
    plate = trimesh.creation.box((80, 70, 4))
    plate.apply_translation((0, 0, -2))
    plate.export(folder / "base.stl")
    stand = trimesh.creation.box((6, 6, 20))
    stand.export(folder / "stand.stl")
    parts = (
        KitPart(name="base", file="base.stl", purpose="", volume_ml=22.4, base_from_part=ROWS),
        KitPart(
            name="stand", file="stand.stl", purpose="", volume_ml=0.7, base_from_part=ROWS,
            state="D1",
        ),
        KitPart(name="mold", file="missing.stl", purpose="", volume_ml=9.0),
    )  # fmt: skip
    beads = tuple(Bead(name=f"{n}", center_mm=at) for n, at in enumerate(BEADS_MM))
    kit = Kit(
        case_sha256="0", bead_diameter_mm=6.0, beads=beads, base_from_ct=ROWS, organ_ml=14.1,
        tumors_ml=(0.5,), parts=parts,
    )  # fmt: skip
    return kit, folder


@pytest.fixture(scope="module")
def laid(kit):
    """The kit with an organ in a state, whose frame lies 5 mm beside the base's."""
    parts = tuple(
        mesh(trimesh.creation.icosphere(subdivisions=3, radius=radius), (5.0, 0, 15))
        for radius in (15.0, 5.0)
    )
    beside = np.eye(4)
    beside[0, 3] = -5.0
    return lambda name, beads_mm=None: set_up(*kit, Anatomy(parts), beside, name, beads_mm)


def hu_at(volume, points_mm):
    index = np.rint(transform_points(np.linalg.inv(volume.lps_from_index), points_mm)).astype(int)
    return volume.hu[tuple(index.T)]


def test_the_scanner_sees_what_is_set_up(laid):
    setup = laid("rest", {"1": (np.nan, 0, 0), "2": (0.0, 0.0, 5.0)})
    assert len(setup.printed) == 1, "no stand at rest, and no mold on the bench"
    turned = looking_down(50.0, (10.0, 20.0))
    quiet = ScannerParameters(noise_hu=0.0, block_size_mm=(0, 0, 0), spacing_mm=(0.8, 0.8, 0.8))
    volume = scan_bench(setup, turned, quiet, 0)

    def hu(*points):
        return hu_at(volume, transform_points(turned, np.array(points, float)))

    assert hu((0, 0, 15)) == pytest.approx(quiet.tumor_hu, abs=3)
    assert hu((10, 0, 15)) == pytest.approx(quiet.organ_hu, abs=5)
    assert hu((-30, 30, -2)) == pytest.approx(PRINTED_HU, abs=30)
    beads = hu(BEADS_MM[0], np.array(BEADS_MM[2]) + [0, 0, 5], BEADS_MM[3])
    assert beads == pytest.approx([BEAD_HU] * 3, rel=0.1)
    assert hu(BEADS_MM[1]) < 0, "the second bead is missing"


def test_the_camera_sees_the_nearest_of_all_and_errs_as_it_is_told(laid, tmp_path):
    setup = laid("D1")
    assert len(setup.printed) == 2
    hands = Hands(
        tmp_path, BenchErrors(depth_scale=1.01, depth_offset_mm=0.5), looking_down(180, (0, 0))
    )
    camera = hands.true
    middle = round(camera.cy), round(camera.cx)
    frame = see_bench(setup, hands.camera_from_base, camera)
    assert frame.depth_mm[middle] == pytest.approx(150, abs=0.05)  # the organ's top, 30 mm high
    assert np.isfinite(frame.depth_mm).all()  # a table lies under all of it
    hands.plug_in()
    with closing(BenchSourceConfig(folder=tmp_path, fps=1000).open()) as source:
        with pytest.raises(InputError):
            source.read(1.0)
        hands.show(setup)
        seen = source.read(1.0)
    off_mm = seen.content.depth_mm - (1.01 * frame.depth_mm + 0.5)
    assert abs(np.nanmedian(off_mm)) < 0.2
    assert (
        0.1
        < np.nanstd(off_mm[middle[0] - 20 : middle[0] + 20, middle[1] - 20 : middle[1] + 20])
        < 1
    )
    assert seen.content.intrinsics == hands.believed
