"""The viewer's panel: status as HTML (how good the estimate is, how old), slice, buttons,
switches."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from html import escape
from typing import TYPE_CHECKING, Literal, get_args

import numpy as np
from jaxtyping import UInt8

from tumortrack.core import colours
from tumortrack.core.colours import Colour, css, part_colour
from tumortrack.live.values import TrackingResult, Workcell
from tumortrack.live.viewer.look import View
from tumortrack.live.viewer.scene import DisplayOptions
from tumortrack.live.viewer.slices import ORIENTATIONS

if TYPE_CHECKING:
    from viser import ClientHandle, GuiEvent, ViserServer

State = Literal["waiting", "good", "poor", "none", "stale"]

_WIDTH = 360  # pixels; the banner leaves this much room
_ABORT, _ABORTED = "Stop the arms for good", "The arms were stopped for good"
_CLICK, _CANCEL = "Click the organ", "Now click on the organ (again: cancel)"
SILENCE_S = 2.0  # without a word from the server the page itself says so

_COLOURS: dict[State, Colour] = {
    "waiting": colours.STALE,
    "good": colours.GOOD,
    "poor": colours.POOR,
    "none": colours.NONE,
    "stale": colours.STALE,
}
_HEADING: dict[State, str] = {"waiting": "WAITING", "none": "NO ESTIMATE", "stale": "STALE"}

# The page's own watch: every message replaces this element and so restarts its clock. When
# none comes (the program was killed, the network is gone) it shows itself, by the browser alone;
# as a popover it lies above all, where the panel has been dimmed too.
_WATCH = f"""
<style>
@keyframes tumortrack-silence {{ to {{ visibility: visible; }} }}
.tumortrack-silence {{ visibility: hidden; animation: tumortrack-silence 1ms {SILENCE_S}s forwards;
  position: fixed; inset: 0; width: 100vw; height: 100vh; box-sizing: border-box; border: 0;
  margin: 0; z-index: 9999; pointer-events: none; background: {css(colours.STALE)}99;
  backdrop-filter: grayscale(1); display: flex; align-items: center; justify-content: center; }}
.tumortrack-silence div {{ background: {css(colours.STALE)}; color: white; padding: 24px 36px;
  border-radius: 10px; font: 800 44px/1.25 system-ui, sans-serif; text-align: center; }}
.tumortrack-silence small {{ display: block; font-size: 19px; font-weight: 400; }}
</style>
<div class="tumortrack-silence" onanimationend="this.popover = 'manual'; this.showPopover()">
<div>STALE<small>tumortrack has been silent for {SILENCE_S:g} s; what you see is old</small></div>
</div>
"""


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
        return self.state in _HEADING and (cell is None or bool(cell.halted))

    @property
    def _cell(self) -> Workcell | None:
        """What arms do, as far as it is still true."""
        if self.result is None or self.state in ("waiting", "stale"):
            return None
        return self.result.workcell

    def flag(self) -> str:
        """How good, in one line; over the page a banner with the reason, and the page's watch."""
        text = {"good": "GOOD", "poor": "POOR"}.get(self.state) or _HEADING[self.state]
        return (
            f"<i hidden>{self.counter}</i>{_WATCH}{self._banner()}"
            f"{_box(text, _COLOURS[self.state])}{self._arms() if self.arms else ''}"
        )

    def _arms(self) -> str:
        """What they do: in the panel, and over the scene; where they stand still, why."""
        cell = self._cell
        if cell is None:
            return _box("ARMS: nothing is known of them", colours.STALE)
        colour = colours.NONE if cell.halted else colours.ARMS
        text = f"ARMS: {escape(cell.state)}"
        why = f"<div style='font-weight:400'>{escape(cell.halted)}</div>" if cell.halted else ""
        over = (
            "<div style='position:fixed;bottom:18px;left:18px;right:378px;z-index:9998;"
            "pointer-events:none;display:flex;justify-content:center'>"
            f"<div style='background:{css(colour)};color:white;padding:8px 20px;border-radius:10px;"
            f"text-align:center;font:700 20px/1.25 system-ui,sans-serif'>{escape(cell.state)}"
            f"{': HALTED' if cell.halted else ''}{why}</div></div>"
        )
        return over + _box(f"{text}{', HALTED' if cell.halted else ''}", colour)

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
            "<div style='margin:4px 14px 10px;font-size:13px;font-variant-numeric:tabular-nums'>"
            f"{parts}<div style='display:flex;justify-content:space-between;margin-top:6px'>"
            f"<span>latency <b>{latency}</b></span><span>last frame <b>{self.age_s:.1f} s</b> ago"
            f"</span><span>no. {result.sequence}</span></div>"
            "<div style='opacity:0.65;font-size:12px;min-height:36px'>"
            f"{times and 'stages, ms: '}{times}</div></div>"
        )

    def _reason(self) -> str:
        if self.state == "waiting":
            return "no frame has come yet"
        if self.state == "stale":
            return f"nothing has come for {self.age_s:.1f} s; the last estimate is hidden"
        assert self.result is not None
        return self.result.reason if self.state == "none" else self.result.warning

    def _banner(self) -> str:
        """Over the scene: big where there is nothing to see."""
        if self.state == "good":
            return ""
        size = 44 if self.alarming else 20
        why = f"<div style='font-size:19px;font-weight:400'>{escape(self._reason())}</div>"
        return (
            "<div style='position:fixed;top:18px;left:18px;right:378px;z-index:9998;"
            "pointer-events:none;display:flex;justify-content:center'>"
            f"<div style='background:{css(_COLOURS[self.state])};color:white;padding:10px 26px;"
            f"border-radius:10px;text-align:center;font:800 {size}px/1.2 system-ui,sans-serif'>"
            f"{_HEADING.get(self.state, 'POOR ESTIMATE')}{why}</div></div>"
        )


def _box(text: str, colour: Colour) -> str:
    """A line of the panel."""
    return (
        f"<div style='background:{css(colour)};color:white;padding:8px 12px;margin:8px 12px;"
        f"border-radius:6px;font-size:15px;font-weight:700'>{text}</div>"
    )


def backdrop(state: State, alarming: bool) -> UInt8[np.ndarray, "h w 3"]:
    """What lies behind the scene: dark; where it is ``alarming``, a warning colour and the word, so
    that it is read with the panel closed too."""
    from PIL import Image, ImageDraw

    if not alarming:
        return np.full((4, 4, 3), colours.BACKGROUND, np.uint8)
    dark = colours.BACKGROUND_NONE if state == "none" else colours.BACKGROUND_STALE
    image = Image.new("RGB", (960, 800), dark)
    brighter = tuple(min(255, 2 * channel + 30) for channel in dark)
    draw = ImageDraw.Draw(image)
    draw.text((480, 730), _HEADING[state], fill=brighter, font_size=84, anchor="mm")
    return np.asarray(image)


def _parts(parts: Mapping[str, dict]) -> str:
    """A row per part: colour, name, probability as a bar and number, volume, deviation."""
    rows = []
    for name, part in parts.items():
        swatch = css(part_colour(part["label"]))
        probability = part.get("probability")
        if not part.get("found") or probability is None:
            rest = "<td colspan=3 style='opacity:0.7'>not found</td>"
        else:
            deviation = part.get("center_std_mm")
            bar = (
                "<div style='background:#8884;border-radius:3px;width:70px'><div style='height:8px;"
                f"border-radius:3px;background:{swatch};width:{100 * probability:.0f}%'></div>"
                "</div>"
            )
            rest = (
                f"<td>{bar}</td><td style='text-align:right'>{probability:.2f}</td>"
                f"<td style='text-align:right'>{part['volume_ml']:.1f} ml</td>"
                f"<td style='text-align:right'>"
                f"{'' if deviation is None else f'± {deviation:.1f} mm'}</td>"
            )
        rows.append(
            f"<tr><td><span style='display:inline-block;width:11px;height:11px;border-radius:3px;"
            f"background:{swatch};margin-right:6px'></span>{escape(name.replace('_', ' '))}</td>"
            f"{rest}</tr>"
        )
    return f"<table style='width:100%;border-spacing:2px 3px'>{''.join(rows)}</table>"


@dataclass(frozen=True)
class Actions:
    """What the panel's elements do; called from viser's threads."""

    changed: Callable[[], None]
    pick: Callable[[], None]
    forget: Callable[[], None]
    look: Callable[[ClientHandle, View], None]
    abort: Callable[[], None]


class Panel:
    """The elements, shared by all clients. ``slices``: with the CT; ``arms``: with what they do."""

    def __init__(
        self,
        server: ViserServer,
        parts: tuple[str, ...],
        actions: Actions,
        slices: bool = False,
        arms: bool = False,
    ) -> None:
        gui = server.gui
        gui.configure_theme(dark_mode=True, show_logo=False, show_share_button=False)
        gui.main_panel.dock_right()
        gui.main_panel.set_width(_WIDTH)
        self._flag = gui.add_html("")  # of one height: what is to be clicked must not jump
        self._pick = gui.add_button(
            _CLICK, hint="Of several things before the camera, choose the one that is the organ"
        )
        self._forget = gui.add_button("Choose again", visible=False)
        if arms:
            self._abort = gui.add_button(
                _ABORT, color="red", hint="The arms stop, and move no more in this run"
            )
            self._abort.on_click(lambda _: actions.abort())
            views = gui.add_button_group("Look at", get_args(View))

            @views.on_click
            def _(event: GuiEvent) -> None:
                if event.client is not None:  # nobody's click otherwise: set by the program
                    actions.look(event.client, event.target.value)

        self._numbers = gui.add_html("")
        self._slice = None
        if slices:
            with gui.add_folder("CT at the present position"):
                self._slice = gui.add_image(np.zeros((8, 8, 3), np.uint8), format="jpeg")
                self._slice.visible = False
                self._through = gui.add_dropdown("Through", parts[1:] or parts)
                self._plane = gui.add_dropdown("Plane", tuple(ORIENTATIONS))
                self._in_scene = gui.add_checkbox("In the scene", False)
        with gui.add_folder("Show"):
            self._kidney = gui.add_slider("Kidney", 0.0, 1.0, 0.05, DisplayOptions.kidney)
            self._margin = gui.add_checkbox("Margins", DisplayOptions.margin)
            self._observed = gui.add_checkbox("Observed points", DisplayOptions.observed)
            self._points = gui.add_dropdown("Labelled points", ("none", "tumors", "all"))
            self._colour = gui.add_dropdown("Coloured by", ("label", "probability"))
            self._helpers = gui.add_checkbox("Axes, region", DisplayOptions.helpers)
        self._connect(actions, slices)

    def _connect(self, actions: Actions, slices: bool) -> None:
        switches = [self._margin, self._observed, self._helpers]
        choices = [self._points, self._colour]
        if slices:
            switches.append(self._in_scene)
            choices += [self._through, self._plane]
        self._kidney.on_update(lambda _: actions.changed())
        for switch in switches:
            switch.on_update(lambda _: actions.changed())
        for choice in choices:
            choice.on_update(lambda _: actions.changed())
        self._pick.on_click(lambda _: actions.pick())
        self._forget.on_click(lambda _: actions.forget())

    @property
    def options(self) -> DisplayOptions:
        return DisplayOptions(
            observed=self._observed.value,
            kidney=self._kidney.value,
            margin=self._margin.value,
            points=self._points.value,
            by_probability=self._colour.value == "probability",
            slice_plane=self._slice is not None and self._in_scene.value,
            helpers=self._helpers.value,
        )

    @property
    def slice_through(self) -> tuple[str, str]:
        """The part and the orientation that the user chose."""
        return self._through.value, self._plane.value

    def say(self, status: StatusPanel) -> None:
        # Both before either: an error leaves the page as it was.
        flag, numbers = status.flag(), status.numbers()
        self._flag.content, self._numbers.content = flag, numbers

    def picking(self, asked: bool, chosen: bool) -> None:
        """``asked``: the next click counts; ``chosen``: one did."""
        self._pick.label = _CANCEL if asked else _CLICK
        self._forget.visible = chosen

    def aborted(self) -> None:
        """The arms move no more."""
        self._abort.label, self._abort.disabled = _ABORTED, True

    def put_slice(self, picture: UInt8[np.ndarray, "h w 3"] | None) -> None:
        if self._slice is not None:
            if picture is not None:
                self._slice.image = picture
            self._slice.visible = picture is not None
