"""A plot of errors in sequences, and a film of one organ under a press: truth and estimate."""

from __future__ import annotations

import io
from pathlib import Path

import numpy as np
import pandas as pd
from matplotlib.axes import Axes
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from PIL import Image

from tumortrack.core.errors import NoEstimate
from tumortrack.core.store import write_atomically
from tumortrack.core.types import Mesh
from tumortrack.report import drawing
from tumortrack.report.drawing import ESTIMATED, TRUE
from tumortrack.report.renderer import Frame, ParallelView
from tumortrack.sense.camera import deproject
from tumortrack_lab.study.tumor_sites import tumor_sites_of
from tumortrack_lab.world.films import Film
from tumortrack_lab.world.following import Locate, Moment

_PHASES = ("at rest", "loaded", "held", "released", "at rest")
_STYLES: dict[str, tuple[str, str, float]] = {
    "first-look": ("each frame a first look", "C0", 3.5), "track": ("followed", "C1", 1.5),
    "several-looks": ("three cameras, each frame a first look", "C2", 1.5),
}  # fmt: skip
_BEND = Patch(color="0.88", label="largest bend")
_EVERY, _FRAME_MS, _COLOURS = 2, 200, 64
_NEAR_MM, _BORDER_MM = 1.5, 8.0  # of the section: points that are drawn; round the organ


def draw(rows: pd.DataFrame, path: Path) -> None:
    """Error of centres against time under a press, phases made equally long: medians over organs of
    medians over sequences that all methods saw; and how far the organs are bent."""
    rows = rows[(rows["kind"] == "press") & rows["method"].isin(list(_STYLES))]
    methods = rows.groupby(["organ", "sequence"])["method"].transform("nunique")
    rows = rows[methods == methods.max()].assign(step=np.floor(rows["phase"] * 4) / 4 + 0.125)
    figure, top = drawing.new_figure(9.4, 4.0), 0.0
    for number, (site, mine) in enumerate(rows.groupby("site")):
        axes = figure.add_axes((0.065 + 0.475 * number, 0.1, 0.405, 0.68))
        for method, its in mine.groupby("method"):
            middle, (_, color, width) = _middle(its, "center_mm"), _STYLES[str(method)]
            axes.plot(middle.index, middle, color=color, linewidth=width)
            top = max(top, 1.1 * float(middle.max()))
        bend = _middle(mine, "bend_mm")
        side = axes.twinx()
        side.fill_between(bend.index, bend, color=_BEND.get_facecolor())
        side.set(ylim=(0, None), zorder=-1)
        side.set_ylabel("largest bend, mm" if number else "", color="0.45")
        side.tick_params(colors="0.45")
        axes.patch.set_visible(False)
        axes.set_xticks(np.arange(len(_PHASES)) + 0.5, _PHASES)
        axes.set_title(f"{site} tumors, organs: {mine['organ'].nunique()}", fontsize=10)
        axes.set(xlim=(0, len(_PHASES)), ylabel="" if number else "error of the centre, mm")
    for axes in figure.axes[::2]:
        axes.set_ylim(0, top)
    styles = [style for method, style in _STYLES.items() if (rows["method"] == method).any()]
    lines = [Line2D([], [], color=color, linewidth=w, label=label) for label, color, w in styles]
    drawing.show_legend(figure, [*lines, _BEND], 4, (0.985, 1.0))
    drawing.save(figure, path)


def _middle(rows: pd.DataFrame, key: str) -> pd.Series:
    each = rows.groupby(["organ", "sequence", "step"])[key].median()
    return each.groupby(["organ", "step"]).median().groupby("step").median()


def show(locate: Locate, film: Film, path: Path) -> None:
    """An animated GIF: a section along the organ through its best covered tumor, seen from the side
    as the bench stands; and that tumor's error so far."""
    sites, axes = tumor_sites_of(film.rest), np.array(film.meta["first_from_bench"])[:3, :3].T
    tumor = 1 + int(np.argmax([site.cover_mm for site in sites.values()]))
    view = ParallelView("side", tuple(axes[0].tolist()), tuple((-axes[2]).tolist()))
    truths = [film.truth(n).parts for n in range(len(film.stamps_ns))]
    flat = view.project(np.concatenate([parts[0].vertices_mm for parts in truths]))
    low, high = flat.min(0) - _BORDER_MM, flat.max(0) + _BORDER_MM
    errors: list[float] = []
    pictures = []
    for n, truth in enumerate(truths):
        estimated: tuple[Mesh, ...] = ()
        try:
            motion = locate(Moment(film.looks(n), film.first_from_camera())).motion
            if motion is not None:
                estimated = tuple(p.moved(motion.carry(p.vertices_mm)) for p in film.rest.parts)
        except NoEstimate:
            pass
        middles = [parts[tumor].vertices_mm.mean(0) for parts in (truth, estimated) if parts]
        errors.append(float(np.linalg.norm(middles[0] - middles[-1])) if estimated else np.nan)
        if n % _EVERY == 0:
            figure = drawing.new_figure(7.2, 3.0)
            left = figure.add_axes((0.01, 0.03, 0.56, 0.84))
            _section(left, view, middles[0], ((truth, TRUE), (estimated, ESTIMATED)))
            points = view.project(deproject(film.looks(n)[0]).astype(float) - middles[0])
            near = points[np.abs(points[:, 2]) < _NEAR_MM] + view.project(middles[0][None])
            left.plot(near[:, 0], near[:, 1], ".", color="0.6", markersize=2, zorder=0)
            drawing.finish_view(left, Frame(low[0], high[0], low[1], high[1]))
            _curve(figure.add_axes((0.65, 0.16, 0.33, 0.71)), film, errors)
            lines = [Line2D([], [], color=TRUE, label="truth")]
            lines.append(Line2D([], [], color=ESTIMATED, label="estimate, its tumor's error"))
            drawing.show_legend(figure, [*lines, _BEND], 3, (0.99, 1.0))
            buffer = io.BytesIO()
            figure.savefig(buffer, format="png")
            pictures.append(Image.open(buffer).convert("RGB"))
    palette, plain = pictures[0].quantize(_COLOURS), Image.Dither.NONE
    first, *others = (picture.quantize(palette=palette, dither=plain) for picture in pictures)
    buffer, lasts = io.BytesIO(), [_FRAME_MS] * len(others) + [5 * _FRAME_MS]
    first.save(buffer, "GIF", save_all=True, append_images=others, duration=lasts, loop=0)
    write_atomically(path, buffer.getvalue())


def _section(
    axes: Axes, view: ParallelView, middle_mm: np.ndarray,
    shown: tuple[tuple[tuple[Mesh, ...], tuple[float, float, float]], ...],
) -> None:  # fmt: skip
    for parts, color in shown:
        for n, part in enumerate(parts):
            lines = drawing.section(part, view, middle_mm)
            drawing.draw_lines(axes, lines, color=color, linewidth=2.0 if n else 1.2)


def _curve(axes: Axes, film: Film, errors: list[float]) -> None:
    axes.fill_between(film.seconds, film.bend_mm, color=_BEND.get_facecolor())
    axes.plot(film.seconds[: len(errors)], errors, color=ESTIMATED)
    axes.set(xlim=(0, film.seconds[-1]), ylim=(0, 1.05 * film.bend_mm.max()))
    axes.set(xlabel="s", ylabel="mm")
