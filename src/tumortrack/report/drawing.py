"""Figures without a display, with text that is never cut off."""

from __future__ import annotations

import io
import pathlib
from collections.abc import Iterator, Sequence
from typing import Any, cast

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.font_manager import FontProperties
from matplotlib.legend import Legend
from matplotlib.text import Text

from tumortrack.core import colours
from tumortrack.core.store import write_atomically
from tumortrack.report.renderer import rgb
from tumortrack.report.wrapping import wrapped

_WARNING: dict[str, Any] = {
    **{"fontsize": 12, "fontweight": "bold", "color": "white"},
    "bbox": {"facecolor": rgb(colours.NONE), "edgecolor": "none", "boxstyle": "square,pad=0.3"},
}
SIGN = "\N{WARNING SIGN}"
_EDGE_IN = 0.17
CENTRED: dict[str, Any] = {"ha": "center", "va": "center"}


def new_figure(width_in: float, height_in: float, **borders: float) -> Figure:
    """A figure without display or global state; ``borders`` as in ``subplots_adjust``."""
    figure = Figure(figsize=(width_in, height_in), dpi=100, facecolor="white")
    FigureCanvasAgg(figure)
    figure.subplots_adjust(**{"left": 0.02, "right": 0.98, "top": 0.9, "bottom": 0.03} | borders)
    return figure


def add_words(
    figure: Figure,
    title: str,
    warnings: Sequence[str] = (),
    below: Sequence[str] = (),
    handles: Sequence[Any] = (),
) -> None:
    """Add text to a finished figure, which grows by the height it takes: above the axes each
    warning in a red box, then title and legend; below them the lines ``below``. Call it once."""
    texts = [f"{SIGN} WARNING: {text}" for text in warnings]
    over: list[Text | Legend] = [*_paragraphs(figure, texts, _WARNING)]
    over += _paragraphs(figure, [title], {"fontsize": 13, "fontweight": "bold"})
    over += [_legend(figure, handles)] if handles else []
    under: list[Text | Legend] = [*_paragraphs(figure, below, {"fontsize": 10.5})]
    above_in, below_in = (
        sum(_height_in(figure, artist) for artist in artists) + _EDGE_IN * bool(artists)
        for artists in (over, under)
    )
    borders, old_in = figure.subplotpars, figure.get_figheight()
    axes_in = borders.bottom * old_in + below_in, borders.top * old_in + below_in
    new_in = old_in + above_in + below_in
    figure.set_figheight(new_in)
    figure.subplots_adjust(bottom=axes_in[0] / new_in, top=axes_in[1] / new_in)
    for artists, y_in in ((over, new_in - _EDGE_IN), (under, below_in)):
        for artist in artists:
            position = _EDGE_IN / figure.get_figwidth(), y_in / new_in
            if isinstance(artist, Legend):
                artist.set_bbox_to_anchor(position, figure.transFigure)
            else:
                artist.set_position(position)
            y_in -= _height_in(figure, artist)


def _paragraphs(figure: Figure, texts: Sequence[str], style: dict[str, Any]) -> Iterator[Text]:
    """Wrapped to the figure's width."""
    renderer = cast(FigureCanvasAgg, figure.canvas).get_renderer()
    font = FontProperties(size=style["fontsize"], weight=style.get("fontweight"))
    room = (figure.get_figwidth() - 3 * _EDGE_IN) * figure.dpi

    def length_of(text: str) -> float:
        return renderer.get_text_width_height_descent(text, font, False)[0]

    for text in texts:
        lines = wrapped(text, room, length_of)
        style = {"va": "top", "linespacing": 1.25, "parse_math": False, **style}
        yield figure.text(0, 0, "\n".join(lines), **style)


def _legend(figure: Figure, handles: Sequence[Any]) -> Legend:
    """Without a frame, in as few rows as the figure's width allows."""
    style: dict[str, Any] = {"loc": "upper left", "frameon": False, "fontsize": 9.5}
    style |= {"borderpad": 0, "borderaxespad": 0, "columnspacing": 1.4, "handlelength": 1.6}
    for columns in range(len(handles), 0, -1):
        legend = figure.legend(handles=list(handles), ncols=columns, **style)
        width_in = legend.get_window_extent().width / figure.dpi
        if columns == 1 or width_in <= figure.get_figwidth() - 2 * _EDGE_IN:
            break
        legend.remove()
    return legend


def _height_in(figure: Figure, artist: Text | Legend) -> float:
    """With the space under it."""
    boxed = isinstance(artist, Text) and artist.get_bbox_patch() is not None
    return artist.get_window_extent().height / figure.dpi + (0.2 if boxed else 0.1)


def show_legend(
    figure: Figure, handles: list[Any], columns: int, corner: tuple[float, float]
) -> None:
    """A legend without a frame; ``corner`` is its upper right one, as shares of the figure."""
    style: dict[str, Any] = {"loc": "upper right", "frameon": False, "fontsize": 9.5}
    figure.legend(handles=handles, ncols=columns, bbox_to_anchor=corner, **style)


def save(figure: Figure, path: pathlib.Path) -> None:
    """Write the PNG atomically. Raises StorageError: the disk refused."""
    buffer = io.BytesIO()
    figure.savefig(buffer, format="png", pil_kwargs={"compress_level": 3})  # half of 6's time
    write_atomically(path, buffer.getvalue())
