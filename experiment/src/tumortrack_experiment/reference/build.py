"""What `reference` does."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.cli.console import say, say_notes
from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import transform_points
from tumortrack.core.mesh_query import contains
from tumortrack.io.case import Case
from tumortrack.io.points import read_points
from tumortrack.io.scene_folder import Scene, Targets
from tumortrack.io.volume import read_volume
from tumortrack_experiment.kit_file import Kit, case_of_kit, kit_path, read_kit
from tumortrack_experiment.record.read import Moment, Recorded
from tumortrack_experiment.reference import scenes
from tumortrack_experiment.reference.command import Reference
from tumortrack_experiment.reference.deformed import parts_in, segment_deformed
from tumortrack_experiment.register.beads import CT, NamedBeads, name_beads, register
from tumortrack_experiment.register.build import say_registration
from tumortrack_experiment.register.frames import (
    beads_in_view,
    distance_mm,
    moments_of,
    one_of,
    states_in,
    still_beads,
)
from tumortrack_experiment.register.in_ct import find_balls, middles_mm

_MOVED_MM = 1.5  # beads' noise in two states is half of it


def write_reference(given: Reference) -> None:
    """Raises InputError: CT, recording, kit and case do not belong together, or cannot be read."""
    kit = read_kit(given.kit)
    case = case_of_kit(given.case, kit)
    states = states_in(given.recording, kit)
    state = one_of(states, given.state, given.recording)
    store.check_place(folder := given.scenes / state, "scene", None)
    volume = read_volume(given.ct, given.series)
    parts = parts_in(kit, given.kit, state)
    moments = moments_of(states[state], state)
    frame, in_view = still_beads(kit, moments, state)
    moved_mm = {} if given.moves else _moved(kit, states, state, (moments[0], in_view))
    balls = find_balls(volume, kit.bead_diameter_mm)
    in_ct = name_beads(kit, middles_mm(balls), CT)
    one = register(kit, in_ct, in_view)
    inner = find_balls(volume, given.target_mm) if given.target_mm is not None else []
    windows, others = (given.organ_hu, given.tumor_hu), (parts, [*balls, *inner])
    in_ct2, report = segment_deformed(volume, in_ct.device_from_base, kit, case, others, windows)
    say_notes(report["notes"])
    moved = (p.with_vertices(transform_points(one.to_from, p.vertices_mm)) for p in in_ct2.parts)
    anatomy = in_ct2.with_parts(moved)
    beads = in_view.points_mm[in_view.found], kit.bead_diameter_mm
    known = scenes.kit_pixels(frame, in_view.device_from_base, [*parts.values()], beads)
    cloud = scenes.organ_cloud(frame, known)
    middles = {
        name: part.vertices_mm.mean(0)[None]
        for name, part in zip(in_ct2.names, in_ct2.parts, strict=True)
    }
    inputs = {"ct": given.ct, "recording": given.recording, "kit": kit_path(given.kit)}
    meta: dict[str, Any] = {
        "state": state,
        "depth": f"median of the first {len(moments)} frames",
        "case_sha256": kit.case_sha256,
        "inputs": {name: store.sha256_of(path) for name, path in inputs.items()},
        "moved_mm": moved_mm,
        "registration": one.report(middles),
        "surface": scenes.check_surface(frame, known, anatomy.organ, cloud),
        "deformed": report,
    }
    targets = None
    if given.target_mm is not None:
        found = middles_mm(inner)
        found = transform_points(one.to_from, found[contains(in_ct2.organ, found)])
        camera_from_rest = one.to_from @ in_ct.device_from_base @ np.array(kit.base_from_ct)
        targets = _targets(given, case, found, camera_from_rest)
    given.scenes.mkdir(parents=True, exist_ok=True)
    Scene(cloud, anatomy, frame, meta, targets).write(folder)
    say_registration("camera_from_ct", one, meta["registration"])
    say(
        f"depths seen lie {meta['surface']['median_mm']:+.2f} mm from the CT's surface in the "
        f"middle, 95 % within {meta['surface']['p95_mm']:.2f} mm"
    )
    say(f"written to {folder}; give {given.scenes} to `evaluate`.")


def _moved(
    kit: Kit, states: dict[str, Recorded | Path], state: str, here: tuple[Moment, NamedBeads]
) -> dict[str, float]:
    """By other state: how far the base lies from where it is in this one. Raises InputError:
    farther than the beads' noise explains."""

    def place(moment: Moment, beads: NamedBeads) -> np.ndarray:
        fixed_from_camera = moment.fixed_from_camera
        pose = np.eye(4) if fixed_from_camera is None else fixed_from_camera
        return np.asarray(pose @ beads.device_from_base)

    moved = {}
    for other in (name for name in states if name != state):
        there = moments_of(states[other], other, 1)[0]
        try:
            beads = beads_in_view(kit, there.depth)
        except InputError as error:
            say_notes([f"{other}: where the base was is unknown: {error}"])
            continue
        moved[other] = distance_mm(kit, place(*here), place(there, beads))
        if moved[other] > _MOVED_MM:
            raise InputError(
                f"camera or base moved by {moved[other]:.1f} mm between {state} and {other} (at "
                f"most {_MOVED_MM:g} mm is noise). Record again; if they are meant to move, say "
                "--moves: each state is registered by itself."
            )
    return moved


def _targets(
    given: Reference, case: Case, found_mm: np.ndarray, camera_from_rest: np.ndarray
) -> Targets:
    """Beads in the organ, of both CTs. Nothing else in it is known to be the same point."""
    assert given.target_mm is not None
    if given.targets is not None:
        rest_ct = read_points(given.targets).points_ct
    elif case.ct is not None:
        rest_ct = middles_mm(find_balls(case.ct, given.target_mm))
        rest_ct = rest_ct[contains(case.anatomy.organ, rest_ct)]
    else:
        raise InputError("the case has no CT: give the beads' places in it with --targets.")
    expected = transform_points(camera_from_rest, rest_ct)
    targets, note = scenes.match_targets(rest_ct, found_mm, expected, case)
    say_notes([note])
    return targets
