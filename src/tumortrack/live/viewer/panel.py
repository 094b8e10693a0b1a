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
from tumortrack.core.estimate import NO_CHECK_FAILED, UNVERIFIED
from tumortrack.core.patient import NOBODY
from tumortrack.live.values import Controls, TrackingResult, Workcell
from tumortrack.live.viewer.look import View
from tumortrack.live.viewer.scene import DisplayOptions
from tumortrack.live.viewer.slices import ORIENTATIONS
from tumortrack.models.margins import margin_words, stated_radius

if TYPE_CHECKING:
    from viser import ViserServer

State = Literal["waiting", "good", "poor", "none", "stale"]

_WIDTH = 360  # pixels; what lies over the scene leaves this much room
ABORT, ABORTED = "Stop the arms for good", "The arms were stopped for good"
CLICKS = {True: "This is the organ", False: "This is not the organ"}
CANCEL = {
    True: "Now click on the organ (again: cancel)",
    False: "Now click beside it (again: cancel)",
}
SILENCE_S = 2  # without a word from the server the page itself says so

# What stands in the panel, and unless all is well over the scene too; its colour.
_HEADINGS: dict[State, tuple[str, Colour]] = {
    "waiting": ("WAITING", colours.STALE),
    "good": (NO_CHECK_FAILED.upper(), colours.GOOD),
    "poor": ("POOR ESTIMATE", colours.POOR),
    "none": ("NO ESTIMATE", colours.NONE),
    "stale": ("STALE", colours.STALE),
}
_EMPTY: tuple[State, ...] = ("waiting", "none", "stale")

# Styles, where the status is shown, and how it gets there. Surfaces reach the screen one frame
# after the message that brought them, so what a message says waits as long (status.html).
_PAGE = Template(files(__package__).joinpath("status.html").read_text("utf-8")).substitute(
    stale=css(colours.STALE), silence_s=SILENCE_S, right=_WIDTH + 18
)
# The page's own watch: every message replaces this element and so restarts its clock. When none
# comes (the program was killed, the network is gone) it shows itself, by the browser alone; as a
# popover it lies above all, where the panel has been dimmed too.
_SILENCE = (
    '<div class="tumortrack-silence" onanimationend="this.popover = \'manual\'; '
    f'this.showPopover()"><div>STALE<small>tumortrack has been silent for {SILENCE_S} s, or its '
    "panel was closed; what is said here is old</small></div></div>"
)


@dataclass(frozen=True, eq=False)
class StatusPanel:
    """What is said of the result that is shown. ``age_s``: since its frame; ``counter``: another
    with each message; ``arms``: there may be some."""

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

    def stage(self) -> str:
        """All that is said, in one piece that the page shows at once: in the panel (``flag``,
        ``numbers``) and over everything (``over``)."""
        parts = {"flag": self.flag(), "numbers": self.numbers(), "over": self._over_scene()}
        inside = "".join(f'<div class="{name}">{html}</div>' for name, html in parts.items())
        return f'<div class="tumortrack-stage" hidden data-n="{self.counter}">{inside}</div>'

    def flag(self) -> str:
        """How good, of which frame; what the arms do."""
        text, colour = _HEADINGS[self.state]
        return _box(text, colour, self._number()) + (self._arms()[0] if self.arms else "")

    def _over_scene(self) -> str:
        """A banner with the reason; where it is alarming the whole page in its colour; the page's
        watch."""
        heading, colour = _HEADINGS[self.state]
        tint, size = "", 16 if self.state == "good" else 20
        if self.alarming:
            size = 44  # big where there is nothing to see
            style = f"background:{css(colour)}48;color:{css(colour)}"
            tint = f"<div class='tumortrack-tint' style='{style}'></div>"
        why = f"{self._number()}: {self._reason()}"
        banner = _over("top", size, colour, heading, why.removeprefix(": "))
        return tint + banner + (self._arms()[1] if self.arms else "") + _SILENCE

    def _number(self) -> str:
        return "" if self.result is None else f"frame no. {self.result.sequence}"

    def _arms(self) -> tuple[str, str]:
        """What they do: in the panel, and over the scene; where they stand still, why."""
        cell = self._cell
        if cell is None:
            return _box("ARMS: nothing is known of them", colours.STALE), ""
        colour = colours.NONE if cell.halted else colours.ARMS
        text = f"{cell.state}: HALTED" if cell.halted else cell.state
        left = "" if cell.left_mm is None else f"{cell.left_mm:.1f} mm of the margin are left"
        box = _box(f"ARMS: {text}", colour, cell.halted or left)
        return box, _over("bottom", 20, colour, text, cell.halted)

    def _reason(self) -> str:
        if self.state == "waiting":
            return "no frame has come yet"
        if self.state == "stale":
            return f"nothing has come for {self.age_s:.1f} s; the last estimate is hidden"
        assert self.result is not None
        if self.state == "good":
            return UNVERIFIED
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
            parts = _parts(report)
            lag_ms = report.get("smoothing", {}).get("lag_ms", 0.0)
            latency += f" + {lag_ms:.0f} smoothing" if lag_ms >= 0.5 else ""
        stages = {k: v for k, v in result.seconds.items() if "." not in k}  # "a.b" is a part of a
        times = " · ".join(f"{escape(k)} {1000 * v:.1f}" for k, v in stages.items())
        return (
            f"<div class='tumortrack-numbers'>{parts}"
            "<div style='display:flex;justify-content:space-between;margin-top:6px'>"
            f"<span>latency <b>{latency}</b></span><span>last frame <b>{self.age_s:.1f} s</b> ago"
            "</span></div>"
            f"<div>{escape(result.cameras)}</div>"
            "<div style='opacity:0.65;font-size:12px;min-height:36px'>"
            f"{times and 'stages, ms: '}{times}</div></div>"
        )


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


def _parts(report: Mapping[str, Any]) -> str:
    """A row per part: colour, name, probability as a bar and number, volume, margin; and why there
    is no margin."""
    rows, said = [], report.get("margin", {})
    for name, part in report.get("parts", {}).items():
        swatch = f"background:{css(part_colour(part['label']))}"
        probability = part.get("probability")
        if not part.get("found") or probability is None:
            rest = "<td colspan=4 style='opacity:0.7'>not found</td>"
        else:
            margin = stated_radius(said, name)
            bar = f"<div style='{swatch};width:{100 * probability:.0f}%'></div>"
            rest = (
                f"<td><div class='tumortrack-bar'>{bar}</div></td><td>{probability:.2f}</td>"
                f"<td>{part['volume_ml']:.1f} ml</td>"
                f"<td>{margin.words if margin else ''}</td>"
            )
        label = escape(name.replace("_", " "))
        rows.append(f"<tr><td><i style='{swatch}'></i>{label}</td>{rest}</tr>")
    none = f"<div>{escape(margin_words(said))}</div>" if not said.get("stated") else ""
    return f"<table>{''.join(rows)}</table>{none}"


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
        gui.add_html(_PAGE)  # of one height: what is to be clicked must not jump
        self.stage = gui.add_html("")
        self.clicks = {
            True: gui.add_button(
                CLICKS[True],
                hint="Choose the thing that is the organ; a picture teaches its colour",
            ),
            False: gui.add_button(CLICKS[False], hint="Teach the colour of fat, a hand, a drape"),
        }
        self.colour = gui.add_html("")
        self.forget = gui.add_button("Forget", visible=False)
        if arms:
            self.abort = gui.add_button(
                ABORT, color="red", hint="The arms stop, and move no more in this run"
            )
            self.views = gui.add_button_group("Look at", get_args(View))
        gui.add_html('<div id="tumortrack-numbers"></div>')
        self.slice = None
        default = DisplayOptions()
        shown: dict[str, Any] = {}  # by the option's name
        label = parts[0].replace("_", " ").capitalize()
        if slices:
            with gui.add_folder("CT at the present position"):
                self.slice = gui.add_image(np.zeros((8, 8, 3), np.uint8), format="jpeg")
                self.slice.visible = False
                self.through = gui.add_dropdown("Through", parts[1:] or parts)
                self.plane = gui.add_dropdown("Plane", tuple(ORIENTATIONS))
                shown["slice_plane"] = gui.add_checkbox("In the scene", default.slice_plane)
        with gui.add_folder("Show"):
            shown |= {
                "organ": gui.add_slider(label, 0.0, 1.0, 0.05, default.organ),
                "margin": gui.add_checkbox("Margins", default.margin),
                "structures": gui.add_checkbox("Structures", default.structures),
                "ellipsoids": gui.add_checkbox(
                    "95 % ellipsoids (diagnostic)",
                    default.ellipsoids,
                    hint="95 % ellipsoid of each tumor's centre by the fit's own covariance, 2.80 "
                    "standard deviations: a diagnostic, not the margin",
                ),
                "observed": gui.add_checkbox("Observed points", default.observed),
                "points": gui.add_dropdown("Labelled points", ("none", "tumors", "all")),
                "helpers": gui.add_checkbox("Axes, region", default.helpers),
            }
        self._shown = shown
        self.switches = [*shown.values(), *((self.through, self.plane) if slices else ())]

    @property
    def options(self) -> DisplayOptions:
        return DisplayOptions(**{name: element.value for name, element in self._shown.items()})

    def say(self, status: StatusPanel) -> None:
        self.stage.content = status.stage()

    def say_clicks(self, asked: bool | None, controls: Controls) -> None:
        """``asked``: for a click on the organ, beside it, or for none."""
        for organ, button in self.clicks.items():
            button.label = (CANCEL if organ is asked else CLICKS)[organ]
        self.forget.visible = controls.picked_mm is not None or bool(controls.clicks)
        words = escape(controls.colour)
        self.colour.content = words and f"<div class='tumortrack-numbers'>{words}</div>"

    def put_slice(self, picture: UInt8[np.ndarray, "h w 3"] | None) -> None:
        if self.slice is not None:
            if picture is not None:
                self.slice.image = picture
            self.slice.visible = picture is not None
