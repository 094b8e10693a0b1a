"""The viewer's panel: status as HTML (how good the estimate is, how old), slice, buttons,
switches."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Any, Literal, get_args

import numpy as np
from jaxtyping import UInt8

from tumortrack.core import colours
from tumortrack.core.colours import Colour, css, part_colour
from tumortrack.core.patient import NOBODY
from tumortrack.live.values import TrackingResult, Workcell
from tumortrack.live.viewer.look import View
from tumortrack.live.viewer.scene import DisplayOptions
from tumortrack.live.viewer.slices import ORIENTATIONS

if TYPE_CHECKING:
    from viser import ViserServer

State = Literal["waiting", "good", "poor", "none", "stale"]

_WIDTH = 360  # pixels; what lies over the scene leaves this much room
ABORT, ABORTED = "Stop the arms for good", "The arms were stopped for good"
CLICK, CANCEL = "Click the organ", "Now click on the organ (again: cancel)"
SILENCE_S = 2  # without a word from the server the page itself says so

# In the panel, over the scene, in colour.
_HEADINGS: dict[State, tuple[str, str, Colour]] = {
    "waiting": ("WAITING", "WAITING", colours.STALE),
    "good": ("GOOD", "", colours.GOOD),
    "poor": ("POOR", "POOR ESTIMATE", colours.POOR),
    "none": ("NO ESTIMATE", "NO ESTIMATE", colours.NONE),
    "stale": ("STALE", "STALE", colours.STALE),
}
_EMPTY: tuple[State, ...] = ("waiting", "none", "stale")

# The styles, and the page's own watch: every message replaces this element and so restarts its
# clock. When none comes (the program was killed, the network is gone) it shows itself, by the
# browser alone; as a popover it lies above all, where the panel has been dimmed too.
_PAGE = Template(files(__package__).joinpath("status.html").read_text("utf-8")).substitute(
    stale=css(colours.STALE), silence_s=SILENCE_S, right=_WIDTH + 18
)


@dataclass(frozen=True, eq=False)
class StatusPanel:
    """What the panel says now. ``result``: the last; ``age_s``: since its frame; ``counter``:
    another with each message; ``arms``: there may be some."""

    state: State
    result: TrackingResult | None
    age_s: float
    counter: int
    arms: bool = False

    @property
    def alarming(self) -> bool:
        """There is nothing that may be looked at. Arms that go on without an estimate are meant
        to, as of a plan that is only shown: they would be halted."""
        cell = self._cell
        return self.state in _EMPTY and (cell is None or bool(cell.halted))

    @property
    def _cell(self) -> Workcell | None:
        """What arms do, as far as it is still true."""
        if self.result is None or self.state in ("waiting", "stale"):
            return None
        return self.result.workcell

    def flag(self) -> str:
        """How good, in one line; over the page a banner with the reason, and the page's watch."""
        text, heading, colour = _HEADINGS[self.state]
        size = 44 if self.alarming else 20  # big where there is nothing to see
        banner = heading and _over("top", size, colour, heading, self._reason())
        arms = self._arms() if self.arms else ""
        return f"<i hidden>{self.counter}</i>{_PAGE}{banner}{_box(text, colour)}{arms}"

    def _arms(self) -> str:
        """What they do: in the panel, and over the scene; where they stand still, why."""
        cell = self._cell
        if cell is None:
            return _box("ARMS: nothing is known of them", colours.STALE)
        colour = colours.NONE if cell.halted else colours.ARMS
        text = f"{cell.state}: HALTED" if cell.halted else cell.state
        left = "" if cell.left_mm is None else f"{cell.left_mm:.1f} mm of the margin are left"
        box = _box(f"ARMS: {text}", colour, cell.halted or left)
        return _over("bottom", 20, colour, text, cell.halted) + box

    def _reason(self) -> str:
        if self.state == "waiting":
            return "no frame has come yet"
        if self.state == "stale":
            return f"nothing has come for {self.age_s:.1f} s; the last estimate is hidden"
        assert self.result is not None
        return self.result.reason if self.state == "none" else self.result.warning

    def numbers(self) -> str:
        """Probabilities, age, latency and the stages' times."""
        result = self.result
        if result is None:
            return ""
        latency = "–" if result.latency_ms is None else f"{result.latency_ms:.0f} ms"
        parts = ""
        if result.estimate is not None and self.state in ("good", "poor"):
            report = result.estimate.report
            parts = _parts(report.get("parts", {}))
            lag_ms = report.get("smoothing", {}).get("lag_ms", 0.0)
            latency += f" + {lag_ms:.0f} smoothing" if lag_ms >= 0.5 else ""
        stages = {k: v for k, v in result.seconds.items() if "." not in k}  # "a.b" is a part of a
        times = " · ".join(f"{escape(k)} {1000 * v:.1f}" for k, v in stages.items())
        return (
            f"<div class='tumortrack-numbers'>{parts}"
            "<div style='display:flex;justify-content:space-between;margin-top:6px'>"
            f"<span>latency <b>{latency}</b></span><span>last frame <b>{self.age_s:.1f} s</b> ago"
            f"</span><span>no. {result.sequence}</span></div>"
            "<div style='opacity:0.65;font-size:12px;min-height:36px'>"
            f"{times and 'stages, ms: '}{times}</div></div>"
        )

    def backdrop(self) -> UInt8[np.ndarray, "h w 3"]:
        """What lies behind the scene: dark; where it is alarming, a warning colour and the word, so
        that it is read with the panel closed too."""
        from PIL import Image, ImageDraw

        if not self.alarming:
            return np.full((4, 4, 3), colours.BACKGROUND, np.uint8)
        dark = colours.BACKGROUND_NONE if self.state == "none" else colours.BACKGROUND_STALE
        image = Image.new("RGB", (960, 800), dark)
        fill = tuple(min(255, 2 * channel + 30) for channel in dark)
        heading = _HEADINGS[self.state][1]
        ImageDraw.Draw(image).text((480, 730), heading, fill=fill, font_size=84, anchor="mm")
        return np.asarray(image)


def _over(edge: str, size: int, colour: Colour, text: str, why: str) -> str:
    """A box over the scene."""
    return (
        f"<div class='tumortrack-over' style='{edge}:18px'><div style='background:{css(colour)};"
        f"font-size:{size}px'>{escape(text)}<small>{escape(why)}</small></div></div>"
    )


def _box(text: str, colour: Colour, why: str = "") -> str:
    """A line of the panel."""
    return (
        f"<div class='tumortrack-box' style='background:{css(colour)}'>{escape(text)}"
        f"<small>{escape(why)}</small></div>"
    )


def _parts(parts: Mapping[str, dict[str, Any]]) -> str:
    """A row per part: colour, name, probability as a bar and number, volume, deviation."""
    rows = []
    for name, part in parts.items():
        swatch = f"background:{css(part_colour(part['label']))}"
        probability = part.get("probability")
        if not part.get("found") or probability is None:
            rest = "<td colspan=4 style='opacity:0.7'>not found</td>"
        else:
            deviation = part.get("center_std_mm")
            bar = f"<div style='{swatch};width:{100 * probability:.0f}%'></div>"
            rest = (
                f"<td><div class='tumortrack-bar'>{bar}</div></td><td>{probability:.2f}</td>"
                f"<td>{part['volume_ml']:.1f} ml</td>"
                f"<td>{'' if deviation is None else f'± {deviation:.1f} mm'}</td>"
            )
        label = escape(name.replace("_", " "))
        rows.append(f"<tr><td><i style='{swatch}'></i>{label}</td>{rest}</tr>")
    return f"<table>{''.join(rows)}</table>"


class Panel:
    """The elements, shared by all clients; whoever made it says what they do. ``slices``: with the
    CT; ``arms``: with what they do; ``whose``: organ it is, in words."""

    def __init__(
        self,
        server: ViserServer,
        parts: tuple[str, ...],
        slices: bool = False,
        arms: bool = False,
        whose: str = str(NOBODY),
    ) -> None:
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_WIDTH)
        self.whose = gui.add_html(f"<div style='padding:4px 12px'><b>{escape(whose)}</b></div>")
        self.flag = gui.add_html("")  # of one height: what is to be clicked must not jump
        self.pick = gui.add_button(
            CLICK, hint="Of several things before the camera, choose the one that is the organ"
        )
        self.forget = gui.add_button("Choose again", visible=False)
        if arms:
            self.abort = gui.add_button(
                ABORT, color="red", hint="The arms stop, and move no more in this run"
            )
            self.views = gui.add_button_group("Look at", get_args(View))
        self._numbers = gui.add_html("")
        self.slice = None
        default = DisplayOptions()
        shown: dict[str, Any] = {}  # by the option's name
        if slices:
            with gui.add_folder("CT at the present position"):
                self.slice = gui.add_image(np.zeros((8, 8, 3), np.uint8), format="jpeg")
                self.slice.visible = False
                self.through = gui.add_dropdown("Through", parts[1:] or parts)
                self.plane = gui.add_dropdown("Plane", tuple(ORIENTATIONS))
                shown["slice_plane"] = gui.add_checkbox("In the scene", default.slice_plane)
        with gui.add_folder("Show"):
            shown |= {
                "kidney": gui.add_slider("Kidney", 0.0, 1.0, 0.05, default.kidney),
                "margin": gui.add_checkbox("Margins", default.margin),
                "observed": gui.add_checkbox("Observed points", default.observed),
                "points": gui.add_dropdown("Labelled points", ("none", "tumors", "all")),
                "coloured_by": gui.add_dropdown("Coloured by", ("label", "probability")),
                "helpers": gui.add_checkbox("Axes, region", default.helpers),
            }
        self._shown = shown
        self.switches = [*shown.values(), *((self.through, self.plane) if slices else ())]

    @property
    def options(self) -> DisplayOptions:
        return DisplayOptions(**{name: element.value for name, element in self._shown.items()})

    def say(self, status: StatusPanel) -> None:
        # Both before either: an error leaves the page as it was.
        flag, numbers = status.flag(), status.numbers()
        self.flag.content, self._numbers.content = flag, numbers

    def put_slice(self, picture: UInt8[np.ndarray, "h w 3"] | None) -> None:
        if self.slice is not None:
            if picture is not None:
                self.slice.image = picture
            self.slice.visible = picture is not None
