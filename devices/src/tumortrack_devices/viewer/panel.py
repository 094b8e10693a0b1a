"""The viewer's panel: status as HTML, slice, buttons, switches."""

from __future__ import annotations

from html import escape
from importlib.resources import files
from string import Template
from typing import TYPE_CHECKING, Any, Literal, NamedTuple, get_args

import numpy as np
from jaxtyping import UInt8

from tumortrack.core import colours
from tumortrack.core.colours import Colour, css, part_colour
from tumortrack.core.estimate import NO_CHECK_FAILED, UNVERIFIED
from tumortrack.core.patient import NOBODY
from tumortrack.core.report import FitReport
from tumortrack.live.values import Controls, ControlState, TrackingResult
from tumortrack.report.slices import ORIENTATIONS
from tumortrack_devices.viewer.look import View
from tumortrack_devices.viewer.scene import DisplayOptions

if TYPE_CHECKING:
    from viser import ViserServer

State = Literal["waiting", "good", "poor", "none", "stale", "playback"]

_WIDTH = 360  # pixels, which overlays of the scene leave free
ABORT, ABORTED = "Stop the arms for good", "The arms were stopped for good"
CLICKS = {True: "Point at the organ", False: "Point beside it"}
CANCEL = {
    True: "Now click on the organ (again: cancel)",
    False: "Now click beside it (again: cancel)",
}
_CLICK_HINTS = {
    True: "Choose the thing that is the organ; a picture teaches its colour",
    False: "Teach the colour of fat, a hand, a drape",
}
SILENCE_S = 2  # without a message from the server, after which the page itself says so

# Shape and colour of each state, over the scene and in the panel.
_SIGNS: dict[State, tuple[str, Colour]] = {
    "waiting": ("○", colours.STALE),
    "good": ("●", colours.GOOD),  # a tick would promise too much
    "poor": ("▲", colours.POOR),
    "none": ("✕", colours.NONE),
    "stale": ("◆", colours.STALE),
    "playback": ("►", colours.CONTROL),
}
_EMPTY: tuple[State, ...] = ("waiting", "none", "stale")

# Styles and places of the status. Surfaces reach the screen one frame after their message, so the
# status waits as long (status.html).
_PAGE = Template(files(__package__).joinpath("status.html").read_text("utf-8")).substitute(
    stale=css(colours.STALE), silence_s=SILENCE_S, right=_WIDTH + 18
)
# The page's own watch: every message replaces this element and so restarts its animation. When
# none comes (the program was killed, the network is down) the browser shows it, as a popover over
# everything.
_SILENCE = (
    '<div class="tumortrack-silence" onanimationend="this.popover = \'manual\'; '
    f'this.showPopover()"><div>◆ STALE<small>tumortrack has been silent for {SILENCE_S} s, or its '
    "panel was closed; what is said here is old</small></div></div>"
)


class StatusPanel(NamedTuple):
    """The status of the shown result. ``age_s``: since its frame; ``counter``: of messages;
    ``arms``: there may be some; ``parts``: the model's, the organ first."""

    state: State
    result: TrackingResult | None
    age_s: float
    counter: int
    arms: bool = False
    parts: tuple[str, ...] = ()

    def stage(self) -> str:
        """Everything, in one piece that the page shows at once: in the panel (``flag``,
        ``numbers``) and over the scene (``over``)."""
        parts = {"flag": self.flag(), "numbers": self.numbers(), "over": self._over_scene()}
        inside = "".join(f'<div class="{name}">{html}</div>' for name, html in parts.items())
        return f'<div class="tumortrack-stage" hidden data-n="{self.counter}">{inside}</div>'

    def flag(self) -> str:
        """Quality and frame number; the arms' state, or why they are halted."""
        shape, colour = _SIGNS[self.state]
        quality = _box(f"{shape} {self.state.upper()}", colour, self._number)
        if not self.arms:
            return quality
        if (control := self._control) is None:
            return quality + _box("ARMS: nothing is known of them", colours.STALE)
        text, colour = _arms_sign(control)
        return quality + _box(f"ARMS: {text}", colour, control.stopped or control.note)

    def _over_scene(self) -> str:
        """A banner with the reason, and one of the arms; the watch. Without an estimate the whole
        page is in its colour, unless arms go on: they are meant to, as in a playback."""
        shape, colour = _SIGNS[self.state]
        control, size, tint = self._control, "quiet" if self.state == "good" else "plain", ""
        if self.state in _EMPTY and (control is None or control.stopped):
            style, size = f"background:{css(colour)}48;color:{css(colour)}", "loud"
            tint = f"<div class='tumortrack-tint' style='{style}'></div>"
        why = f"{self._number}: {self._reason()}".removeprefix(": ")
        banner = tint + _over("top", size, colour, f"{shape} {self.state.upper()}", why)
        if self.arms and control is not None:
            text, colour = _arms_sign(control)
            banner += _over("bottom", "plain", colour, text, control.stopped)
        return banner + _SILENCE

    @property
    def _control(self) -> ControlState | None:
        """What the arms do, if that is current."""
        if self.result is None or self.state in ("waiting", "stale"):
            return None
        return self.result.control

    @property
    def _number(self) -> str:
        return "" if self.result is None else f"frame no. {self.result.sequence}"

    def _reason(self) -> str:
        if self.state == "waiting":
            return "no frame has come yet"
        if self.state == "stale":
            return f"nothing has come for {self.age_s:.1f} s; the last estimate is hidden"
        if self.state == "playback":
            return "not a live estimate: a stored plan is shown, nothing is tracked"
        assert self.result is not None
        if self.state == "good":
            return f"{NO_CHECK_FAILED}; {UNVERIFIED}"
        return f"no estimate: {self.result.reason}" if self.state == "none" else self.result.warning

    def numbers(self) -> str:
        """Each part's volume and bound; latency and age."""
        result = self.result
        if result is None:
            return ""
        latency = "–" if result.latency_ms is None else f"{result.latency_ms:.0f} ms"
        report = FitReport()
        if result.estimate is not None and self.state in ("good", "poor"):
            report = result.estimate.report
            lag_ms = 0.0 if report.smoothing is None else report.smoothing.lag_ms
            latency += f" + {lag_ms:.0f} smoothing" if lag_ms >= 0.5 else ""
        parts = "" if self.state == "playback" else self._parts(report)
        return (
            f"<div class='tumortrack-numbers'>{parts}"
            f"<div class='tumortrack-row'><span>latency <b>{latency}</b></span>"
            f"<span>last frame <b>{self.age_s:.1f} s</b> ago</span></div>"
            f"<div class='tumortrack-beside'>{escape(result.extra_status)}</div></div>"
        )

    def _parts(self, report: FitReport) -> str:
        """A row for each part, with and without an estimate: nothing below must jump. After a
        failed check the bound is not valid, and left out."""
        bounds = self.result.bounds if self.result and self.state == "good" else {}
        heads = ["", "volume", "off by at most (95 %)"]
        rows = []
        for label, name in enumerate(self.parts, start=1):
            part = report.parts.get(name)
            volume_ml = part.volume_ml if part else None
            bound = bounds.get(name)
            cells = [
                f"<i style='background:{css(part_colour(label))}'></i>"
                + escape(name.replace("_", " "))
                + (" (not found)" if part is not None and not part.found else ""),
                "–" if volume_ml is None else f"{volume_ml:.1f} ml",
                "–" if bound is None else f"{bound.error_bound95_mm:.1f} mm",
            ]
            rows.append(f"<tr><td>{'</td><td>'.join(cells)}</td></tr>")
        return f"<table><tr><th>{'</th><th>'.join(heads)}</th></tr>{''.join(rows)}</table>"


def _arms_sign(control: ControlState) -> tuple[str, Colour]:
    if control.stopped:
        return f"{control.state}: HALTED", colours.NONE
    return control.state, colours.CONTROL


def _over(edge: str, size: str, colour: Colour, text: str, why: str) -> str:
    return (
        f"<div class='tumortrack-over tumortrack-{size}' style='{edge}:18px'>"
        f"<div style='background:{css(colour)}'>{escape(text)}<small>{escape(why)}</small></div>"
        "</div>"
    )


def _box(text: str, colour: Colour, why: str = "") -> str:
    return (
        f"<div class='tumortrack-box' style='background:{css(colour)}'>{escape(text)}"
        f"<small>{escape(why)}</small></div>"
    )


class Panel:
    """The elements, shared by all clients; the sink sets their callbacks. The result comes first,
    then what shows it, then what changes it. ``slices``: of what; empty: there are none; ``arms``:
    there may be some; ``patient``: in words; ``tools``: names of what touches."""

    def __init__(
        self,
        server: ViserServer,
        parts: tuple[str, ...],
        slices: str = "",
        arms: bool = False,
        patient: str = str(NOBODY),
        tools: tuple[str, ...] = (),
    ) -> None:
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_WIDTH)
        self.patient = gui.add_html(
            f"<div class='tumortrack-row tumortrack-whose'><b>{escape(patient)}</b>"
            "<label><input type='checkbox' id='tumortrack-more'> more</label></div>"
        )
        gui.add_html(_PAGE)  # of constant height: buttons must not jump
        self.stage = gui.add_html("")
        if arms:
            self.abort = gui.add_button(
                ABORT, color="red", hint="The arms stop, and move no more in this run"
            )
        gui.add_html('<div id="tumortrack-numbers"></div>')
        if arms:
            self.views = gui.add_button_group("Look at", get_args(View))
        # By its button's label, which status.html looks for when such a key is pressed.
        keys = [f" (key {n})" if n < 10 else "" for n in range(1, len(tools) + 1)]
        self.tools = {tool + key: tool for tool, key in zip(tools, keys, strict=True)}
        if tools:
            self.touches = gui.add_button_group(
                "It touches",
                tuple(self.tools),
                hint="This tool's tip touches now; or holds, or lets go",
            )
        self.slice = None
        default = DisplayOptions()
        shown: dict[str, Any] = {}  # by the option's name
        label = parts[0].replace("_", " ").capitalize()
        if slices:
            with gui.add_folder(f"{slices} at the present position"):
                self.slice = gui.add_image(np.zeros((8, 8, 3), np.uint8), format="jpeg")
                self.slice.visible = False
                self.through = gui.add_dropdown("Through", parts[1:] or parts)
                self.plane = gui.add_dropdown("Plane", tuple(ORIENTATIONS))
                shown["slice_plane"] = gui.add_checkbox("In the scene", default.slice_plane)
        with gui.add_folder("Is something else tracked?"):
            self.clicks = {
                organ: gui.add_button(CLICKS[organ], color="gray", hint=_CLICK_HINTS[organ])
                for organ in (True, False)
            }
            self.colour = gui.add_html("")
            self.forget = gui.add_button("Forget", color="gray", visible=False)
            self.cut = gui.add_button(
                "It is being cut",
                color="gray",
                hint="With no tool that says where: until one does, no answer is good",
            )
            self.acknowledge = gui.add_button(
                "That was wrong",
                color="gray",
                visible=False,
                hint="What contradicts the answer counts no more; or, it was not cut",
            )
        with gui.add_folder("Show"):
            shown |= {
                "organ": gui.add_slider(label, 0.0, 1.0, 0.05, default.organ),
                "margin": gui.add_checkbox("Where the tumors may be (95 %)", default.margin),
                "structures": gui.add_checkbox("Structures", default.structures),
                "evidence": gui.add_checkbox(
                    "Evidence, next touches",
                    default.evidence,
                    hint="White: what is known beside the camera; red diamonds: what contradicts "
                    "the rest; blue: what to touch next, and by how much the deviation of the "
                    "tumor's middle along its least sure axis would fall",
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

    def say_clicks(self, asked: bool | None, controls: Controls) -> None:
        """``asked``: for a click on the organ (True), beside it (False), or for none."""
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
