"""`reference`: scenes whose truth is a second CT."""

from __future__ import annotations

from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

from tyro.conf import Positional

from tumortrack.cli.console import say, say_notes
from tumortrack.core import store
from tumortrack.core.errors import InputError

if TYPE_CHECKING:
    import numpy as np

    from tumortrack.core.types import DepthFrame, Mesh, Volume
    from tumortrack.imaging.case import Case
    from tumortrack.simulate.scene_folder import Scene, Targets
    from tumortrack_experiment.kit_file import Kit
    from tumortrack_experiment.record.read import Moment, Recorded
    from tumortrack_experiment.register.beads import NamedBeads, Registration

_MOVED_MM = 1.5  # beads' noise in two states is half of it


@dataclass(frozen=True, kw_only=True)
class Reference:
    """Make a scene of what a camera saw of a phantom's state, with a second CT of that state as
    its truth, laid on each other by the base's beads: what `evaluate` and `margins` read.

    Attributes:
        ct: DICOM folder or volume of the phantom on its base, in that state.
        recording: folder that `tumortrack record` wrote, or with a folder of depth images a state.
        scenes: folder to write the scene into, as SCENES/STATE.
        kit: folder that `phantom-kit` wrote.
        case: folder that `prepare` wrote, of which the kit was made.
        state: which of the recording's; may be left out if it has one.
        series: which DICOM series, if the folder holds several.
        kidney_hu: HU window of the organ: low (inclusive; half way from air, as its surface then
            lies where it is) and high.
        tumor_hu: HU window of the tumors.
        targets: .csv with ct_x,ct_y,ct_z: beads cast into the organ, as in the case's CT. By
            default those that its CT shows.
        target_mm: their diameter; without it there are none.
        moves: camera or base are moved between states; each state is registered by itself.
    """

    ct: Positional[Path]
    recording: Positional[Path]
    scenes: Positional[Path]
    kit: Path
    case: Path
    state: str | None = None
    series: str | None = None
    kidney_hu: tuple[float, float] = (-480.0, 300.0)
    tumor_hu: tuple[float, float] = (300.0, 1000.0)
    targets: Path | None = None
    target_mm: float | None = None
    moves: bool = False

    def run(self) -> None:
        from tumortrack.imaging.volume import read_volume
        from tumortrack_experiment.kit_file import read_kit
        from tumortrack_experiment.reference.case import case_of_kit
        from tumortrack_experiment.reference.deformed import parts_in
        from tumortrack_experiment.register.frames import moments_of, states_in, still_beads

        kit = read_kit(self.kit)
        case = case_of_kit(self.case, kit)
        states = states_in(self.recording)
        state = self._state(list(states))
        if (folder := self.scenes / state).exists():
            raise InputError(f"{folder} exists already. Choose another SCENES folder.")
        parts = parts_in(kit, self.kit, state)
        moments = moments_of(states[state], state)
        seen = still_beads(kit, moments, state)
        moved_mm = {} if self.moves else self._moved(kit, states, state, moments, seen[1])
        scene = self._scene(kit, case, parts, seen, read_volume(self.ct, self.series))
        about = {
            "state": state,
            "depth": f"median of {len(moments)} frames, from the first"
            if moments[1:]
            else "1 frame",
            "moved_mm": moved_mm,
            "case_sha256": kit.case_sha256,
            "inputs": self._inputs(),
        }
        self.scenes.mkdir(parents=True, exist_ok=True)
        replace(scene, meta={**about, **scene.meta}).write(folder)
        said = scene.meta["registration"]
        errors = ", ".join(f"{name} {error:.2f}" for name, error in said["tre_mm"].items())
        say(f"registration: {len(said['beads'])} beads, FRE {said['fre_mm']:.2f} mm; expected TRE, "
            f"mm: {errors}")  # fmt: skip
        surface = scene.meta["surface"]
        say(
            f"depths seen lie {surface['median_mm']:+.2f} mm from the CT's surface in the middle, "
            f"95 % within {surface['p95_mm']:.2f} mm"
        )
        say(f"written to {folder}; give {self.scenes} to `evaluate`.")

    def _state(self, states: list[str]) -> str:
        if self.state is None and len(states) == 1:
            return states[0]
        if self.state not in states:
            raise InputError(
                f"{self.recording} has no state {self.state or 'of its own choice'}; choose with "
                f"--state: {', '.join(states)}."
            )
        return self.state

    def _inputs(self) -> dict[str, str]:
        from tumortrack_experiment.kit_file import KIT_FILE

        kit = self.kit / KIT_FILE if self.kit.is_dir() else self.kit
        given = {"ct": self.ct, "recording": self.recording, "kit": kit, "targets": self.targets}
        return {name: store.sha256_of(path) for name, path in given.items() if path is not None}

    def _moved(
        self,
        kit: Kit,
        states: dict[str, Recorded | Path],
        state: str,
        moments: list[Moment],
        here: NamedBeads,
    ) -> dict[str, float]:
        """By other state: how far the base lies from where it is in this one. Raises InputError:
        farther than the beads' noise explains."""
        from tumortrack_experiment.register.frames import apart_mm, beads_in_view, moments_of

        moved = {}
        for other in (name for name in states if name != state):
            there = moments_of(states[other], other)[:1]
            try:
                beads = beads_in_view(kit, there[0].depth)
            except InputError as error:
                say_notes([f"{other}: where the base was is unknown: {error}"])
                continue
            first, second = (
                found.device_from_base
                if moment.fixed_from_camera is None
                else moment.fixed_from_camera @ found.device_from_base
                for moment, found in ((moments[0], here), (there[0], beads))
            )
            moved[other] = apart_mm(kit, first, second)
            if moved[other] > _MOVED_MM:
                raise InputError(
                    f"camera or base moved by {moved[other]:.1f} mm between {state} and {other} "
                    f"(at most {_MOVED_MM:g} mm is noise). Record again; if they are meant to "
                    "move, say --moves: each state is registered by itself."
                )
        return moved

    def _scene(
        self,
        kit: Kit,
        case: Case,
        parts: list[Mesh],
        seen: tuple[DepthFrame, NamedBeads],
        volume: Volume,
    ) -> Scene:
        from tumortrack.core.geometry import transform_points
        from tumortrack.core.types import Anatomy
        from tumortrack.simulate.scene_folder import Scene
        from tumortrack_experiment.reference import scenes
        from tumortrack_experiment.reference.deformed import segment_deformed
        from tumortrack_experiment.register.beads import CT, name_beads, register
        from tumortrack_experiment.register.in_ct import find_balls, middles_mm

        frame, in_view = seen
        balls = find_balls(volume, kit.bead_diameter_mm)
        in_ct = name_beads(kit, middles_mm(balls), CT)
        one = register(kit, in_ct, in_view)
        say_notes(one.notes)
        inner = find_balls(volume, self.target_mm) if self.target_mm is not None else []
        windows = self.kidney_hu, self.tumor_hu
        deformed = segment_deformed(
            volume, in_ct.device_from_base, kit, case, (parts, [*balls, *inner]), windows
        )
        say_notes(deformed.report["notes"])
        names, meshes = deformed.anatomy.names, deformed.anatomy.parts
        moved = (part.moved(transform_points(one.to_from, part.vertices_mm)) for part in meshes)
        anatomy = Anatomy(tuple(moved))
        beads = in_view.points_mm[in_view.found], kit.bead_diameter_mm
        others = scenes.kit_pixels(frame, in_view.device_from_base, parts, beads)
        cloud = scenes.organ_cloud(frame, others)
        registration = one.report(
            {name: part.vertices_mm.mean(0)[None] for name, part in zip(names, meshes, strict=True)}
        )
        meta = {
            "registration": registration,
            "surface": scenes.check_surface(frame, others, anatomy.organ, cloud),
            "deformed": deformed.report,
        }
        targets = self._targets(kit, case, in_ct, one, middles_mm(inner), deformed.anatomy.organ)
        return Scene(cloud, anatomy, frame, meta, targets)

    def _targets(
        self,
        kit: Kit,
        case: Case,
        in_ct: NamedBeads,
        one: Registration,
        found_ct2: np.ndarray,
        organ: Mesh,
    ) -> Targets | None:
        """Beads in the organ, of both CTs. Nothing else in it is known to be the same point."""
        import numpy as np

        from tumortrack.core.geometry import transform_points
        from tumortrack.simulate.occupancy import contains
        from tumortrack.tracking.points import read_points
        from tumortrack_experiment.reference.scenes import match_targets
        from tumortrack_experiment.register.in_ct import find_balls, middles_mm

        if self.target_mm is None:
            if self.targets is not None:
                raise InputError("--targets needs --target-mm, the diameter of these beads.")
            return None
        if self.targets is not None:
            rest_ct = read_points(self.targets).points_ct
        elif case.ct is not None:
            rest_ct = middles_mm(find_balls(case.ct, self.target_mm))
            rest_ct = rest_ct[contains(case.anatomy.organ, rest_ct)]
        else:
            raise InputError("the case has no CT: give the beads' places in it with --targets.")
        found_ct2 = found_ct2[contains(organ, found_ct2)]
        camera_from_rest = one.to_from @ in_ct.device_from_base @ np.array(kit.base_from_ct)
        targets, notes = match_targets(
            rest_ct,
            transform_points(one.to_from, found_ct2),
            transform_points(camera_from_rest, rest_ct),
            case,
        )
        say_notes(notes)
        return targets
