"""Mishaps on the bench, and whether the commands notice them: each is acted out, and the commands'
words are kept."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import NamedTuple

import numpy as np

from tumortrack.cli.console import say
from tumortrack.core.errors import TumortrackError
from tumortrack.core.types import Anatomy
from tumortrack_lab.rehearsal.bench import Setup, set_up
from tumortrack_lab.rehearsal.hands import looking_down
from tumortrack_lab.rehearsal.run import Rehearsal

_STATE = "D1"
_GONE = (np.nan, np.nan, np.nan)
_OTHER_ORGAN = 0.93  # as large along each axis: four fifths of the volume
_AS_ORGAN_HU = 60.0
_CAMERA_MM = 6.0


class Mishap(NamedTuple):
    """``noticed``: refused, or named by the expected word; ``said``: the line that names it."""

    what: str
    noticed: bool
    refused: bool
    said: str


class Mishaps:
    """Of a rehearsal that has run; temporary files go to ``out``/mishaps."""

    def __init__(self, rehearsal: Rehearsal) -> None:
        self._of, self._out = rehearsal, rehearsal.out / "mishaps"

    def run(self) -> list[Mishap]:
        shutil.rmtree(self._out, ignore_errors=True)
        self._out.mkdir()
        names = [bead.name for bead in self._of.kit.beads]
        acts: dict[str, tuple[Callable[[], str], str]] = {
            "a bead is missing in the CT": (
                lambda: self._beads({names[1]: _GONE}), f"bead {names[1]} ",
            ),
            "a bead lies 4 mm beside its dimple in the CT": (
                lambda: self._beads({names[2]: (4.0, 0.0, 0.0)}), f"bead {names[2]} ",
            ),
            "three beads are left in the CT": (
                lambda: self._beads(dict.fromkeys(names[3:], _GONE)), "",
            ),
            "the CT is another phantom's": (lambda: self._ct(self._smaller()), ""),
            "the CT has no organ, and base and press as bright as one": (
                lambda: self._ct(self._without_organ(), _AS_ORGAN_HU), "",
            ),
            "the CT is of D3, the recording of D1": (
                lambda: self._compare(self._of.out / "ct" / "D3"), "",
            ),
            "the camera was moved by 6 mm between states": (self._camera_moved, ""),
        }  # fmt: skip
        mishaps = []
        for what, (act, word) in acts.items():
            refused = False
            try:
                words = act()
                words = next((line for line in words.splitlines() if word and word in line), "")
            except TumortrackError as error:
                refused, words = True, str(error)
            mishaps.append(Mishap(what, refused or bool(words), refused, words))
            say(f"{what}: {'refused' if refused else 'named' if words else 'NOT NOTICED'}: {words}")
        return mishaps

    def _beads(self, moved_mm: dict[str, tuple[float, float, float]]) -> str:
        of = self._of
        kit = of.out / "kit"
        return self._ct(set_up(of.kit, kit, of.states[_STATE], _STATE, moved_mm))

    def _smaller(self) -> Setup:
        setup = self._of.setup(_STATE)
        organ = setup.anatomy.organ.vertices_mm
        foot = np.array([*organ.mean(0)[:2], organ[:, 2].min()])
        parts = (
            part.moved((part.vertices_mm - foot) * _OTHER_ORGAN + foot)
            for part in setup.anatomy.parts
        )
        return replace(setup, anatomy=Anatomy(tuple(parts)))

    def _without_organ(self) -> Setup:
        setup = self._of.setup(_STATE)
        (organ, *_) = setup.anatomy.parts
        away = organ.moved(organ.vertices_mm * 0.05 + [0, 0, 40.0])  # a crumb of it
        return replace(setup, anatomy=Anatomy((away,)))

    def _ct(self, setup: Setup, printed_hu: float | None = None) -> str:
        ct = self._out / "ct"
        shutil.rmtree(ct, ignore_errors=True)
        more = () if printed_hu is None else (printed_hu,)
        self._of.hands.scanned(setup, ct, 30, *more)
        return self._compare(ct)

    def _compare(self, ct: Path, recording: Path | None = None) -> str:
        scenes = self._out / "scenes"
        shutil.rmtree(scenes, ignore_errors=True)
        recording = recording or self._of.out / "recording"
        return self._of.compare(ct, recording, scenes, _STATE)

    def _camera_moved(self) -> str:
        hands = self._of.hands
        moved = looking_down(hands.camera_from_base[2, 3] + _CAMERA_MM, (8.0, -5.0))
        recording = self._out / "recording"
        states = {"rest": hands, _STATE: replace(hands, camera_from_base=moved)}
        output = self._of.record_into(recording, states)
        warned = [line.strip() for line in output.splitlines() if "moved" in line]
        say("; ".join(warned))
        return self._compare(self._of.out / "ct" / _STATE, recording)
