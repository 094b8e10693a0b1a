"""What was judged in sequences, as a plot; and a film of one organ under a press, truth against
estimate."""

from __future__ import annotations

import io
from pathlib import Path
from typing import NamedTuple

import numpy as np
import pandas as pd
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image

from tumortrack.core.errors import NoEstimate
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Anatomy
from tumortrack.report import drawing
from tumortrack.report.drawing import ESTIMATED, TRUE
from tumortrack.report.renderer import Frame, ParallelView
from tumortrack.sense.camera import deproject
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.world.films import Film
from tumortrack_lab.world.following import Locate, Moment

_PHASES = ("at rest", "loaded", "held", "released", "at rest")
_WORDS = {
    "first-look": ("each frame a first look", "C0"), "track": ("followed", "C1"),
    "several-looks": ("three cameras, each frame a first look", "C2"),
}  # fmt: skip
_BEND = "0.88"
_EVERY, _FRAME_MS, _LAST_MS, _COLOURS = 2, 200, 1500, 64
_SIDES = ("endophytic", "exophytic")
_NEAR_MM, _BORDER_MM = 1.5, 8.0  # of the section: points that are drawn; round the organ


class _Section(NamedTuple):
    tumor: int
    view: ParallelView
    shown: Frame


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Error of centres against time under a press, phases made equally long: medians over organs of
    medians over sequences; and how far the organs are bent."""
    rows = rows[(rows["kind"] == "press") & rows["method"].isin(list(_WORDS))]
    rows = rows.assign(step=np.floor(rows["phase"] * 4) / 4 + 0.125)
    figure = drawing.new_figure(9.4, 4.0)
    left = None
    for number, site in enumerate(_SIDES):
        mine = rows[rows["site"] == site]
        left = axes = figure.add_axes((0.065 + 0.475 * number, 0.1, 0.405, 0.68), sharey=left)
        for method, (_, color) in _WORDS.items():
            middle = _middle(mine[mine["method"] == method], "center_mm")
            axes.plot(middle.index, middle, color=color, linewidth=1.8)
        bend = _middle(mine, "bend_mm")
        side = axes.twinx()
        side.fill_between(bend.index, bend, color=_BEND)
        side.set(ylim=(0, None), zorder=-1)
        side.set_ylabel("largest bend, mm" if number else "", color="0.45")
        side.tick_params(colors="0.45")
        axes.patch.set_visible(False)
        axes.set_xticks(np.arange(len(_PHASES)) + 0.5, _PHASES)
        organs = mine["organ"].nunique()
        axes.set_title(f"{site} tumors, {organs} organ{'s' * (organs != 1)}", fontsize=10)
        axes.set(ylim=(0, None), xlim=(0, len(_PHASES)))
    assert left is not None
    figure.axes[0].set_ylabel("error of the centre, mm (median)")
    shown = [words for method, words in _WORDS.items() if (rows["method"] == method).any()]
    handles = [Line2D([], [], color=color, linewidth=1.8, label=label) for label, color in shown]
    handles.append(Patch(color=_BEND, label="largest bend (right axis)"))
    drawing.show_legend(figure, handles, 4, (0.985, 1.0))
    drawing.save(figure, path)


def _middle(rows: pd.DataFrame, key: str) -> pd.Series:
    each = rows.groupby(["organ", "sequence", "step"])[key].median()
    return each.groupby(["organ", "step"]).median().groupby("step").median()


def show(locate: Locate, film: Film, path: Path) -> None:
    """An animated GIF: a section along the organ through its best covered tumor, seen from the side
    as the bench stands; and that tumor's error so far."""
    sites, axes = tumor_sites_of(film.rest), np.array(film.meta["first_from_bench"])[:3, :3].T
    number = int(np.argmax([site.cover_mm for site in sites.values()]))
    view = ParallelView("side", tuple(axes[0].tolist()), tuple((-axes[2]).tolist()))
    truths = [film.truth(n) for n in range(len(film.stamps_ns))]
    flat = view.project(np.concatenate([one.organ.vertices_mm for one in truths]))
    low, high = flat.min(0) - _BORDER_MM, flat.max(0) + _BORDER_MM
    section = _Section(number, view, Frame(low[0], high[0], low[1], high[1]))
    errors: list[float] = []
    pictures = []
    for n, truth in enumerate(truths):
        try:
            motion = locate(Moment(film.looks(n), film.first_from_camera())).motion
        except NoEstimate:
            motion = None
        found = None
        if motion is not None:
            parts = (part.moved(motion.carry(part.vertices_mm)) for part in film.rest.parts)
            found = Anatomy(tuple(parts))
        there = [one and one.tumors[number].vertices_mm.mean(0) for one in (truth, found)]
        errors.append(np.linalg.norm(there[1] - there[0]) if found else np.nan)
        if n % _EVERY == 0:
            pictures.append(_picture(film, truth, found, section, errors))
    sheet = Image.fromarray(np.concatenate([np.asarray(one)[::2, ::2] for one in pictures[::4]]))
    palette = sheet.quantize(_COLOURS, Image.Quantize.MEDIANCUT, dither=Image.Dither.NONE)
    first, *others = (one.quantize(palette=palette, dither=Image.Dither.NONE) for one in pictures)
    lasts, buffer = [_FRAME_MS] * len(others) + [_LAST_MS], io.BytesIO()
    first.save(
        buffer, "GIF", save_all=True, append_images=others, duration=lasts, loop=0, optimize=True
    )
    write_atomically(path, buffer.getvalue())


def _picture(
    film: Film, truth: Anatomy, found: Anatomy | None, section: _Section, errors: list[float]
) -> Image.Image:
    (tumor, view, shown), n = section, len(errors) - 1
    middle_mm = truth.tumors[tumor].vertices_mm.mean(0)
    figure = drawing.new_figure(7.2, 3.0)
    axes = figure.add_axes((0.01, 0.03, 0.56, 0.84))
    points = deproject(film.looks(n)[0]).astype(float)
    flat, depth = view.project(points), view.project(middle_mm[None])[0, 2]
    near = flat[np.abs(flat[:, 2] - depth) < _NEAR_MM]
    axes.plot(near[:, 0], near[:, 1], ".", color="0.6", markersize=2)
    for anatomy, color in ((truth, TRUE), (found, ESTIMATED)):
        for part in anatomy.parts if anatomy else ():
            width = 1.2 if part is anatomy.organ else 2.0
            lines = drawing.section(part, view, middle_mm)
            drawing.draw_lines(axes, lines, colors=[color], linewidths=width)
    drawing.finish_view(axes, shown)
    curve = figure.add_axes((0.65, 0.16, 0.33, 0.71))
    seconds = film.seconds
    curve.fill_between(seconds, film.bend_mm, color=_BEND)
    curve.plot(seconds[: len(errors)], errors, color=ESTIMATED)
    curve.set(xlim=(0, seconds[-1]), ylim=(0, 1.05 * film.bend_mm.max()), xlabel="s", ylabel="mm")
    handles = [Line2D([], [], color=TRUE, label="truth")]
    handles.append(Line2D([], [], color=ESTIMATED, label="estimate, tumor's error"))
    handles.append(Line2D([], [], color="0.6", marker=".", linestyle="", label="measured"))
    handles.append(Patch(color=_BEND, label="largest bend"))
    drawing.show_legend(figure, handles, 4, (0.99, 1.0), fontsize=8.5)
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png")
    return Image.open(buffer).convert("RGB")
