"""What is known of frames, in words and as a picture."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.errors import InputError
from tumortrack.core.frames import CAMERA, FrameGraph, Link, OpenCycle, Steps, composed
from tumortrack.core.geometry import Affine, transform_points, unit
from tumortrack.live.frame_files import Fit

# Kinds of frames, the stillest first; what they are best linked with; and what gives that link
_CAMERA = r"camera|optical"
_HAND_EYE = "`tumortrack calibrate hand-eye`"
_GIVES = (
    (r"base|world|robot|tracker", CAMERA, f"{_HAND_EYE}, three touches or a board seen in both"),
    (r"tool|probe|psm|stylus|needle|reference", r"base|world|robot|tracker", "NAME=POSES.csv"),
    (_CAMERA, r"base|world|robot|tracker", _HAND_EYE),
    (r"image", r"probe", "a PLUS configuration with the probe's calibration"),
    (r"^ct$", CAMERA, "the folder of a `tumortrack locate`"),
)
_AXES, _LOST = ("#c0392b", "#27903c", "#2c5fb3"), "#d62828"  # x, y, z; what does not close
_SIDE_IN, _SHARE = 5.5, 0.09  # of a panel; an axis's length, of what it shows
_ROOM = np.array([-0.75, 0.75])  # of what a panel shows
_BESIDE = [(x * r, y * r) for r in (6, 16, 30, 46, 64) for x in (1, -1) for y in (1, -1)]  # points
_MOST, _LONGEST = 40, 40  # lines below the picture; letters of a name in it


def chain_lines(graph: FrameGraph) -> Iterator[str]:
    """Where each frame is, and by which links."""
    for steps in filter(None, graph.ways.values()):
        far_mm = np.linalg.norm(composed(steps)[:3, 3])
        by = ", ".join(dict.fromkeys(link.source for link, _ in steps))
        yield f"{_chain(steps)}: {far_mm:.1f} mm away, by {by}."


def missing_lines(graph: FrameGraph) -> Iterator[str]:
    """What would connect each further group with the first."""

    def kind(frame: str) -> int:
        return next((n for n, one in enumerate(_GIVES) if re.search(one[0], frame.lower())), 0)

    for group in graph.groups[1:]:
        stillest = min(group, key=kind)
        _, with_, gives = _GIVES[kind(stillest)]
        others = [one for one in graph.groups[0] if re.search(with_, one.lower())]
        other = (others or graph.groups[0])[0]
        yield (
            f"missing: {other}_from_{stillest} (given by {gives}); so {', '.join(group)} "
            f"{'is' if len(group) == 1 else 'are'} not connected with {graph.groups[0][0]}."
        )


def fault_lines(links: Sequence[Link]) -> list[str]:
    """What is wrong with their own numbers."""
    return [f"{link.name} {fault}." for link in links for fault in link.faults]


def open_line(cycle: OpenCycle) -> str:
    """Which links disagree by how much, and what would make them agree."""
    names = ", ".join(dict.fromkeys(link.name for link, _ in cycle.steps))
    cures = f"; it closes if {', or if '.join(cycle.cures)}" if cycle.cures else ""
    return (
        f"{_chain(cycle.steps)} is open by {cycle.off_mm:.1f} mm at the organ and "
        f"{cycle.off_deg:.1f} degrees (allowed: {cycle.allowed_mm:.1f} mm), by {names}{cures}."
    )


def fit_line(graph: FrameGraph, fit: Fit) -> str:
    """How far places lie from where the chain, and the best rigid transform, has them."""

    def off(b_from_a: np.ndarray) -> str:
        apart = np.linalg.norm(transform_points(b_from_a, fit.places_a) - fit.places_b, axis=1)
        return f"{apart.mean():.1f} mm off in the mean, {apart.max():.1f} at most"

    link = fit.link
    steps = graph.between(link.a, link.b) or ()
    chain = "" if steps[0][0] is link else f"by {_chain(steps)} {off(composed(steps))}; "
    return f"{link.source}: {chain}by the best {link.b}_from_{link.a} {off(link.b_from_a)}."


def corrected(graph: FrameGraph, fits: Sequence[Fit]) -> dict[str, Any]:
    """A calibration file's content by the first fit; if it is not of the camera, then through what
    links its other frame, such as the CT, with the camera. Raises InputError: there is none."""
    for link in (fit.link for fit in fits[:1]):
        for robot, other in ((link.b, link.a), (link.a, link.b)):
            steps = graph.between(CAMERA, other)
            passed = {end for one, _ in steps or () for end in one[:2]}
            if steps is not None and robot not in {*passed, CAMERA, "ct"}:
                fit = np.linalg.inv(link.b_from_a) if robot == link.a else link.b_from_a
                rows = (fit @ composed(steps)).tolist()
                return {"frame_id": robot, "unit": "mm", "robot_from_camera": rows}
    raise InputError(
        "--correct needs touches or a board, in a robot's frame and in the camera's or the CT's."
    )


def _chain(steps: Steps) -> str:
    last, along = steps[-1]
    names = [link.a if along else link.b for link, along in steps]
    return " > ".join([*names, last.b if along else last.a])


def draw_frames(
    path: Path, graph: FrameGraph, cycles: Sequence[OpenCycle], wrong: Sequence[str]
) -> None:
    """Write a PNG: a panel for each group of connected frames, to scale; what is ``wrong`` above,
    the chains below. Raises StorageError."""
    from tumortrack.report.drawing import add_words, new_figure, save  # matplotlib

    columns = min(len(graph.groups), 3)
    rows = -(-len(graph.groups) // columns)
    figure = new_figure(max(_SIDE_IN * columns, 9), _SIDE_IN * rows, top=0.99, wspace=0.04)
    for number, group in enumerate(graph.groups, start=1):
        _panel(figure.add_subplot(rows, columns, number), graph, group, cycles)
    add_words(figure, "Frames (x red, y green, z blue)", wrong, list(chain_lines(graph))[:_MOST])
    save(figure, path)


def _panel(axes: Any, graph: FrameGraph, group: list[str], cycles: Sequence[OpenCycle]) -> None:
    from matplotlib.transforms import Bbox

    poses = {frame: composed(graph.ways[frame]) for frame in group}
    tree = [steps[0][0] for frame in group if (steps := graph.ways[frame])]
    mine = [cycle for cycle in cycles if cycle.steps[0][0].a in poses]
    ghosts = [poses[(link := cycle.steps[0][0]).b] @ link.b_from_a for cycle in mine]
    still = re.search(_CAMERA, group[0].lower()) is None  # its z is up; a camera's y is down
    right, away, up = (
        np.eye(3)[[0, 1, 2]] if still else np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
    )
    right, away = 0.82 * right + 0.57 * away, 0.82 * away - 0.57 * right  # from 35 degrees aside
    flat = np.array([right, 0.94 * up + 0.34 * away])  # and 20 above

    def at(pose: Affine) -> np.ndarray:
        return flat @ pose[:3, 3]

    places = np.array([at(pose) for pose in (*poses.values(), *ghosts)])
    reach_mm = max(float(np.ptp(places, axis=0).max()), 100.0)
    middle = (places.min(0) + places.max(0)) / 2
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set(xlim=middle[0] + reach_mm * _ROOM, ylim=middle[1] + reach_mm * _ROOM)
    axes.apply_aspect()
    taken: list[Any] = []  # where no text fits
    for pose, alpha in [*((pose, 1.0) for pose in poses.values()), *((p, 0.4) for p in ghosts)]:
        tips = at(pose) + np.array([flat @ unit(one) for one in pose[:3, :3].T]) * reach_mm * _SHARE
        for tip, colour in zip(tips, _AXES, strict=True):
            axes.plot(*np.transpose([at(pose), tip]), color=colour, lw=2.2, alpha=alpha)
        corners = axes.transData.transform([at(pose), *tips])
        taken.append(Bbox([corners.min(0), corners.max(0)]))
    names: dict[tuple[float, ...], str] = {}
    for frame, place in zip(poses, places.tolist(), strict=False):
        near = next((k for k in names if np.allclose(k, place, atol=reach_mm / 100)), tuple(place))
        names[near] = f"{names[near]}, {frame}" if near in names else frame
    for where, name in names.items():
        _write(axes, where, name, taken, fontsize=11, fontweight="bold")
    for link in tree:
        ends = np.array([at(poses[link.a]), at(poses[link.b])])
        axes.plot(*ends.T, color="0.6", lw=1, zorder=1)
        far_mm = np.linalg.norm(poses[link.a][:3, 3] - poses[link.b][:3, 3])
        if np.linalg.norm(ends[0] - ends[1]) > reach_mm * _SHARE:
            _write(axes, ends.mean(0), f"{far_mm:.0f} mm", taken, fontsize=9, color="0.35")
    for cycle, ghost in zip(mine, ghosts, strict=True):
        link = cycle.steps[0][0]
        ends = np.array([at(poses[link.b]), at(ghost), at(poses[link.a])])
        axes.plot(*ends.T, color=_LOST, lw=1.3, ls="--", zorder=1)
        said = f"{link.a}, {cycle.off_mm:.1f} mm, {cycle.off_deg:.1f}\N{DEGREE SIGN} off"
        _write(axes, ends[1], said, taken, fontsize=10, color=_LOST)
    ruler = f"axes are {reach_mm * _SHARE:.0f} mm long"
    axes.text(0.02, 0.02, ruler, transform=axes.transAxes, fontsize=9, color="0.35")


def _write(axes: Any, place: Any, text: str, taken: list[Any], **style: Any) -> None:
    """Beside a place, where nothing is written so far."""
    if len(text) > _LONGEST:
        text = f"{text[:_LONGEST]} ..."
    for n, (right, up) in enumerate(_BESIDE, start=1):
        sides = {"ha": "left" if right > 0 else "right", "va": "bottom" if up > 0 else "top"}
        shift = {"xytext": (right, up), "textcoords": "offset points", "parse_math": False}
        note = axes.annotate(text, place, **shift, **sides, **style)
        box = note.get_window_extent()
        inside = axes.bbox.count_contains(box.corners()) == 4
        if (inside and not box.count_overlaps(taken)) or n == len(_BESIDE):
            taken.append(box)
            return
        note.remove()
