"""Which frames are known, which link is missing, and which disagrees: `frames`."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

from tyro.conf import Positional, UseAppendAction

from tumortrack.cli.console import console, say, say_json, say_notes, warn
from tumortrack.core.errors import InputError
from tumortrack.core.store import check_place


@dataclass(frozen=True, kw_only=True)
class Frames:
    """Say and draw how frames (camera, robot, tracker, CT, tools) hang together.

    Each file adds links. Exit status: 0 all frames are connected and agree; 4 a link is missing,
    doubtful, or disagrees with others; 2 an error.

    Attributes:
        file: calibration files, folders of `locate`, `plan` or `calibrate hand-eye`, poses of
            cameras (JSON), PLUS configurations (.xml) and recordings (.mha, .nrrd), live tf
            (ros2:FRAME); tables of poses (.csv), NAME=TABLE saying of what, or of three or more
            places touched in two frames (columns A_x, A_y, A_z, B_x, B_y, B_z, mm). Two tables of
            the poses of one NAME, a board say, in two frames compare these. Earlier files make the
            chains.
        to: frame in which the others are given.
        same: A=B: two names of one frame.
        distance: of the organ from the camera, mm, where links are compared.
        out: picture to write (.png); nothing is replaced.
        json: print all as JSON.
    """

    file: Positional[tuple[str, ...]]
    to: str = "camera"
    same: UseAppendAction[tuple[str, ...]] = ()
    distance: float = 150.0
    out: Path | None = None
    json: bool = False

    def run(self) -> int:
        """The exit status."""
        from tumortrack.core.frames import CAMERA, FrameGraph, Link, composed
        from tumortrack.core.geometry import IDENTITY
        from tumortrack.live.frame_files import KnownFrames
        from tumortrack.report import frames as report

        self._check()
        console.stderr = self.json
        known = KnownFrames()
        for a, same, b in (one.partition("=") for one in self.same):
            known.links.append(Link(b, a, IDENTITY, f"--same {a}{same}{b}", 0.0))
        for text in self.file:
            known.add(text)
        known.link_tables()
        links = [*known.links, *known.fits]
        there = {CAMERA, *(end for link in links for end in link[:2])}
        if self.to not in there:
            raise InputError(f"--to {self.to} is not among the frames: {', '.join(sorted(there))}.")
        graph = FrameGraph(links, self.to, self.distance)
        cycles = list(graph.open_cycles())
        wrong = [f"{link.name} {fault}." for link in links for fault in link.faults]
        wrong += [*report.missing_lines(graph), *map(report.open_line, cycles)]
        for line in report.chain_lines(graph):
            say(line)
        say_notes(known.notes)
        warn(wrong)
        if not wrong:
            say("all frames are connected, and agree where they can be compared.")
        if self.out is not None:
            report.draw_frames(self.out, graph, cycles, wrong)
            say(f"written to {self.out}.")
        if self.json:
            poses = {frame: composed(steps).tolist() for frame, steps in graph.ways.items()}
            say_json({"wrong": wrong, "groups": graph.groups, "first_from_frame": poses})
        return 4 if wrong else 0

    def _check(self) -> None:
        """Raises InputError: options that do not fit, before anything is read."""
        if not 1 <= self.distance <= 5000:
            raise InputError(f"--distance {self.distance:g} is not allowed; choose 1 to 5000 mm.")
        if not self.file or any(len(list(filter(None, one.split("=")))) != 2 for one in self.same):
            raise InputError(
                "say which: tumortrack frames FILE [FILE ...] [--same A=B] [--to FRAME]"
            )
        if self.out is not None:
            check_place(self.out, "file", None)
            if self.out.suffix.lower() != ".png":
                raise InputError(f"--out {self.out}: pictures are .png.")
