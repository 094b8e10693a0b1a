"""Molds of shapes whose answer is known."""

import numpy as np
import pytest
from manifold3d import Manifold

from refused import refused
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points, triangles_of
from tumortrack.core.mesh_query import contains
from tumortrack.core.render import Visibility
from tumortrack.core.solids import mesh_of, solid_of
from tumortrack.core.types import Anatomy
from tumortrack.report.metrics import distance_to_surface
from tumortrack_experiment.kit.casting import cut_halves, lay_out, rod
from tumortrack_experiment.kit.mold import MoldConfig, organ_mold, tumor_molds
from tumortrack_experiment.kit.mold_checks import demould
from tumortrack_experiment.kit.parting import undercut
from tumortrack_experiment.kit.pins import firmness
from tumortrack_experiment.kit.split import fits, laid_mesh, split_to_bed
from tumortrack_experiment.kit.values import PrintedPart

UP = np.array([0.0, 0.0, 1.0])


def ball(radius, *center):
    return Manifold.sphere(radius, 32).translate(center or (0.0, 0.0, 0.0))


@pytest.fixture(scope="module")
def cast():
    """A ball with a tumor inside and one that pokes out."""
    tumors = ball(4.0, 5.0, 3.0, 2.0), ball(4.0, -8.0, 0.0, 7.0)
    organ = ball(13.0) + tumors[1]
    anatomy = Anatomy(tuple(mesh_of(solid) for solid in (organ, *tumors)))
    return anatomy, organ_mold(anatomy, MoldConfig())


def test_a_ball_parts_along_a_great_circle_without_undercut():
    layout = lay_out(mesh_of(ball(12.0)), (), 4.0, 8.0)
    loop = layout.parting_mm
    assert np.abs(np.linalg.norm(loop, axis=1) - 12.0).max() < 0.2
    assert np.abs(loop[:, 2]).max() < 0.1
    assert not undercut(layout.mesh, UP, Visibility(layout.mesh)).any()
    halves, organ = cut_halves(layout, 1.5, 1.5, 0.25, []), solid_of(layout.mesh, "ball")
    # Flat faces on 32 sides lie 0.06 mm within the ball.
    assert demould(halves.upper, organ, layout.mesh, UP) < 0.15
    assert demould(halves.lower, organ, layout.mesh, -UP) < 0.15
    assert demould(halves.upper, organ, layout.mesh, UP[[2, 1, 0]]) > 2  # not sideways
    # They fit, come apart, and fill the block but for the cast and the holes.
    assert (halves.upper ^ halves.lower).volume() < 0.05
    assert (halves.upper.translate([0, 0, 2]) ^ halves.lower).volume() < 0.05
    filled = halves.upper + halves.lower + organ + halves.channels
    pegs = halves.lower ^ halves.channels
    assert pegs.volume() > halves.keys * 80
    assert (halves.block - filled).volume() < 0.5
    assert layout.sprue_mm[2] > 10.5
    assert not len(layout.vents_mm)


def test_a_groove_is_undercut_by_its_own_area_and_as_deep_as_it_is():
    drum = Manifold.cylinder(50.0, 20.0, 20.0, 200)
    ring = (drum - Manifold.cylinder(50.0, 17.0, 17.0, 200)).trim_by_plane([0, 0, 1], 20.0)
    ring = ring.trim_by_plane([0, 0, -1], -26.0)
    mesh = mesh_of(drum - ring)
    area = np.linalg.norm(triangles_of(mesh.vertices_mm, mesh.faces)[1], axis=1) / 2
    hidden = undercut(mesh, UP, Visibility(mesh))
    assert area[hidden].sum() == pytest.approx(np.pi * (2 * (20**2 - 17**2) + 2 * 17 * 6), rel=0.01)
    fine = mesh_of((drum - ring).refine_to_length(2.0))
    assert demould(ring, drum - ring, fine, UP) == pytest.approx(3.0, abs=0.05)
    # Sideways each half of the ring comes off freely.
    half = ring.trim_by_plane([1, 0, 0], 0.0)
    assert demould(half, drum - ring, fine, UP[[2, 1, 0]]) < 0.1


def test_a_pocket_beside_the_sprue_gets_a_vent_and_a_dent_none():
    hills = ball(10.0, -14.0, 0.0, 0.0) + ball(8.0, 14.0, 0.0, 0.0)
    hills += Manifold.cylinder(28.0, 5.0, 5.0, 48).rotate([0, 90, 0]).translate([-14.0, 0, 0])
    layout = lay_out(mesh_of(hills), (), 4.0, 4.0)
    assert len(layout.vents_mm) == 1
    assert layout.sprue_mm[2] > 8.0
    assert abs(layout.sprue_mm[0] - layout.vents_mm[0, 0]) > 20


def test_the_organ_s_mold_casts_the_organ(cast):
    anatomy, mold = cast
    checks = dict(mold.checks)
    assert mold.cast_ml == pytest.approx(anatomy.organ.volume_mm3 / 1000, rel=1e-4)
    assert abs(checks["cast_error_percent"]) < 0.01
    assert checks["halves_overlap_mm3"] < 0.1
    assert distance_to_surface(mold.parting_ct, anatomy.organ).max() < 1.0
    assert mold.undercut_depth_mm < 1.5
    for part in mold.parts:
        numbers = dict(part.checks)
        assert numbers["open_edges"] == 0
        assert numbers["fits_bed"]
        assert 4.9 < numbers["least_wall_mm"] < 8
        low, high = laid_mesh(part).box_mm
        assert low[2] == pytest.approx(0.0, abs=1e-6)
        assert high[2] > 12
    highest = (anatomy.organ.vertices_mm @ mold.pull_ct).max()
    assert mold.sprue_ct @ mold.pull_ct > highest - 4.0
    assert anatomy.tumors[1].box_mm.mean(0) @ mold.pull_ct < 5  # the tumors lie low


def test_a_tumor_that_takes_up_all_leaves_no_place_for_the_sprue():
    with refused(InputError, "8 mm"):
        lay_out(mesh_of(ball(13.0)), (mesh_of(ball(12.0)),), 4.0, 8.0)


def test_pins_hold_each_tumor_and_reach_it_through_both_molds(cast):
    anatomy, mold = cast
    (its_mold,) = tumor_molds(Anatomy(anatomy.parts[:2]), MoldConfig(), mold.pins)
    for pin, same in zip(its_mold.pins, mold.pins[:3], strict=True):
        np.testing.assert_allclose([pin.tip_mm, pin.way], [same.tip_mm, same.way], atol=1e-6)
        assert pin.depth_mm > 5.0 + np.linalg.norm(pin.tip_mm - pin.entry_mm)
        ways = [rod(pin.tip_mm, pin.mouth_mm + 10 * pin.way, radius) for radius in (0.75, 1.0)]
        halves = sum((solid_of(part.mesh, part.name) for part in its_mold.parts), Manifold())
        assert (ways[0] ^ halves).volume() < 0.01
        around = (ways[1] ^ halves).to_mesh64().vert_properties[:, :3]
        assert ((around - pin.tip_mm) @ pin.way).max() == pytest.approx(pin.depth_mm, abs=2.0)
    for number, tumor in enumerate(anatomy.tumors, 1):
        pins = [pin for pin in mold.pins if pin.tumor == number]
        assert contains(tumor, np.array([pin.tip_mm for pin in pins])).all()
        entries = np.array([pin.entry_mm for pin in pins])
        assert distance_to_surface(entries, tumor).max() < 0.6
        assert firmness(np.array([pin.way for pin in pins])) > 0.7
        other = solid_of(anatomy.tumors[2 - number], "the other")
        for pin in pins:
            steel = rod(pin.tip_mm, pin.mouth_mm + 10 * pin.way, pin.diameter_mm / 2)
            assert (steel ^ other).volume() == 0
            for part in mold.parts:
                assert (steel ^ solid_of(part.mesh, part.name)).volume() < 0.01
    assert firmness(np.array([UP, UP, -UP])) == pytest.approx(0)
    assert firmness(np.eye(3)) == pytest.approx(1)


def test_a_part_too_large_for_the_bed_comes_in_pieces_that_fit_together():
    lying = np.eye(4)
    lying[:2, :2] = [[0, -1], [1, 0]]
    part = PrintedPart("bar", "", mesh_of(Manifold.cube([20.0, 130.0, 30.0])), "base", lying)
    assert split_to_bed(part, (40.0, 135.0, 40.0)) == (part,)
    pieces = split_to_bed(part, (60.0, 50.0, 40.0))
    assert len(pieces) == 3
    assert all(fits(piece, (60.0, 50.0, 40.0)) for piece in pieces)
    solids = [solid_of(piece.mesh, piece.name) for piece in pieces]
    overlap = sum((a ^ b).volume() for n, a in enumerate(solids) for b in solids[n + 1 :])
    assert overlap < 1e-6
    whole = sum(solids[1:], solids[0])
    assert 0 < 20 * 130 * 30 - whole.volume() < 120  # the play round pegs
    shifted = solids[0].translate([1, 0, 0]) ^ sum(solids[2:], solids[1])
    assert shifted.volume() > 5  # pegs hold it
    moved = [transform_points(p.print_from_frame, p.mesh.vertices_mm) for p in pieces]
    assert max(abs(points[:, 2].min()) for points in moved) < 1e-6
    with refused(InputError, 20.0):
        split_to_bed(part, (20.0, 50.0, 40.0))
