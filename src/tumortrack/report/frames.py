"""What is known of frames, in words and as a picture."""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from tumortrack.core.frames import FrameGraph, OpenCycle, Steps, composed
from tumortrack.core.geometry import unit

_CAMERA = re.compile("camera|optical", re.IGNORECASE)
_STILL = re.compile("base|world|robot|room|tracker", re.IGNORECASE)  # best linked with a camera
_AXES, _WRONG = ("#c0392b", "#27903c", "#2c5fb3"), "#d62828"  # x, y, z; what does not close
# Seen from 35 degrees beside and 20 above, where z is up; and turned to that, where y is down
_FLAT = np.array([[0.82, 0.57, 0.0], [-0.19, 0.28, 0.94]])
_UP_FROM_CAMERA = np.array([[1, 0, 0], [0, 0, 1], [0, -1, 0]])
_SIDE_IN, _ROOM = 5.5, np.array([-0.8, 0.8])  # of a panel, and what it shows: times its frames
_AXIS, _LINE = 0.09, 0.07  # an axis's length and a label's height, as shares of that
_MOST, _LONGEST = 40, 40  # lines below the picture; letters of a name in it


def chain_lines(graph: FrameGraph) -> Iterator[str]:
    """Where each frame is, and by which links."""
    for steps in filter(None, graph.ways.values()):
        far_mm = np.linalg.norm(composed(steps)[:3, 3])
        by = ", ".join(dict.fromkeys(link.source for link, _ in steps))
        yield f"{_chain(steps)}: {far_mm:.1f} mm away, by {by}."


def missing_lines(graph: FrameGraph) -> Iterator[str]:
    """What would connect each further group with the first."""
    for group in graph.groups[1:]:
        stillest = next(filter(_STILL.search, group), group[0])
        yield (
            f"missing: {graph.groups[0][0]}_from_{stillest} (a calibration, or three touches or a "
            f"board in both); so {', '.join(group)} {'is' if len(group) == 1 else 'are'} not "
            f"connected with {', '.join(graph.groups[0])}."
        )


def open_line(cycle: OpenCycle) -> str:
    """Which links disagree by how much, and what would make them agree."""
    names = ", ".join(dict.fromkeys(link.name for link, _ in cycle.steps))
    cures = f"; it closes if {', or if '.join(cycle.cures)}" if cycle.cures else ""
    return (
        f"{_chain(cycle.steps)} is open by {cycle.off_mm:.1f} mm at the organ and "
        f"{cycle.off_deg:.1f} degrees (allowed: {cycle.allowed_mm:.1f} mm), by {names}{cures}."
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
    flat = _FLAT @ _UP_FROM_CAMERA if _CAMERA.search(group[0]) else _FLAT
    poses = {frame: composed(graph.ways[frame]) for frame in group}
    places = {frame: flat @ pose[:3, 3] for frame, pose in poses.items()}
    every = np.array([*places.values()])
    reach_mm = max(float(np.ptp(every, axis=0).max()), 100.0)
    middle = (every.min(0) + every.max(0)) / 2
    axes.set(aspect="equal", xticks=[], yticks=[])
    axes.set(xlim=middle[0] + reach_mm * _ROOM, ylim=middle[1] + reach_mm * _ROOM)
    for frame, pose in poses.items():
        for axis, colour in zip(pose[:3, :3].T, _AXES, strict=True):
            tip = places[frame] + flat @ unit(axis) * reach_mm * _AXIS
            axes.plot(*np.transpose([places[frame], tip]), color=colour, lw=2.2)
        for link, _ in graph.ways[frame][:1]:
            axes.plot(*np.transpose([places[link.a], places[link.b]]), color="0.6", lw=1, zorder=1)
    style: dict[str, Any] = {"textcoords": "data", "va": "center", "parse_math": False}
    for cycle in cycles:
        link = cycle.steps[0][0]
        if link.a in places:
            ends = np.array([places[link.a], places[link.b]])
            axes.plot(*ends.T, color=_WRONG, lw=1.3, ls="--", zorder=1)
            off = f"  {cycle.off_mm:.1f} mm, {cycle.off_deg:.1f}\N{DEGREE SIGN} off"
            axes.annotate(off, ends.mean(0), fontsize=10, color=_WRONG, **style)
    style["arrowprops"] = {"arrowstyle": "-", "color": "0.6", "lw": 0.7}
    y_mm = -np.inf
    for frame in sorted(places, key=lambda name: places[name][1]):  # each label above the last
        right, place = places[frame][0] <= middle[0], places[frame]
        y_mm = max(place[1] - _LINE * reach_mm, y_mm + _LINE * reach_mm)
        x_mm = place[0] + (1 if right else -1) * _AXIS * reach_mm / 2
        style |= {"xytext": (x_mm, y_mm), "ha": "left" if right else "right"}
        axes.annotate(frame[:_LONGEST], place, fontsize=11, fontweight="bold", **style)
    ruler = f"axes are {reach_mm * _AXIS:.0f} mm long"
    axes.text(0.02, 0.02, ruler, transform=axes.transAxes, fontsize=9, color="0.35")
