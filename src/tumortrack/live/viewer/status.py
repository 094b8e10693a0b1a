"""What the page says in words: how good the estimate is, and how old; as HTML."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from html import escape
from typing import Literal

import numpy as np
from jaxtyping import UInt8

from tumortrack.core import colours
from tumortrack.core.colours import Colour, css, part_colour
from tumortrack.live.values import TrackingResult, Workcell

State = Literal["waiting", "good", "poor", "none", "stale"]

SILENCE_S = 2.0  # without a word from the server the page itself says so

_COLOURS: dict[State, Colour] = {
    "waiting": colours.STALE,
    "good": colours.GOOD,
    "poor": colours.POOR,
    "none": colours.NONE,
    "stale": colours.STALE,
}
_HEADING: dict[State, str] = {"waiting": "WAITING", "none": "NO ESTIMATE", "stale": "STALE"}

# The page's own watch: every message replaces this element and so starts its clock anew. When
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
    """What is to be said now. ``update``: the last; ``age_s``: since its frame; ``beat`` differs
    from message to message; ``arms``: there may be some."""

    state: State
    update: TrackingResult | None
    age_s: float
    beat: int
    arms: bool = False

    @property
    def loud(self) -> bool:
        """There is nothing that may be looked at. Arms that go on without an estimate are meant
        to, as of a plan that is only shown: they would be halted."""
        cell = self._cell
        return self.state in _HEADING and (cell is None or bool(cell.halted))

    @property
    def _cell(self) -> Workcell | None:
        """What arms do, as far as it is still true."""
        if self.update is None or self.state in ("waiting", "stale"):
            return None
        return self.update.workcell

    def flag(self) -> str:
        """How good, in one line; over the page a banner with the reason, and the page's watch."""
        text = {"good": "GOOD", "poor": "POOR"}.get(self.state) or _HEADING[self.state]
        return (
            f"<i hidden>{self.beat}</i>{_WATCH}{self._banner()}"
            f"{_box(text, _COLOURS[self.state])}{self._arms() if self.arms else ''}"
        )

    def _arms(self) -> str:
        """What they do: in the panel, and over the scene; where they stand still, why."""
        cell = self._cell
        if cell is None:
            return _box("ARMS: nothing is known of them", colours.STALE)
        colour = colours.NONE if cell.halted else colours.ARMS
        said = f"ARMS: {escape(cell.state)}"
        why = f"<div style='font-weight:400'>{escape(cell.halted)}</div>" if cell.halted else ""
        over = (
            "<div style='position:fixed;bottom:18px;left:18px;right:378px;z-index:9998;"
            "pointer-events:none;display:flex;justify-content:center'>"
            f"<div style='background:{css(colour)};color:white;padding:8px 20px;border-radius:10px;"
            f"text-align:center;font:700 20px/1.25 system-ui,sans-serif'>{escape(cell.state)}"
            f"{': HALTED' if cell.halted else ''}{why}</div></div>"
        )
        return over + _box(f"{said}{', HALTED' if cell.halted else ''}", colour)

    def numbers(self) -> str:
        """Probabilities, age, latency and the stages' times."""
        update = self.update
        if update is None:
            return ""
        latency = "–" if update.latency_ms is None else f"{update.latency_ms:.0f} ms"
        parts = ""
        if update.estimate is not None and self.state in ("good", "poor"):
            report = update.estimate.report
            parts = _parts(report.get("parts", {}))
            lag_ms = report.get("smoothing", {}).get("lag_ms", 0.0)
            latency += f" + {lag_ms:.0f} smoothing" if lag_ms >= 0.5 else ""
        stages = {k: v for k, v in update.seconds.items() if "." not in k}  # "a.b" is a part of a
        times = " · ".join(f"{escape(k)} {1000 * v:.1f}" for k, v in stages.items())
        return (
            "<div style='margin:4px 14px 10px;font-size:13px;font-variant-numeric:tabular-nums'>"
            f"{parts}<div style='display:flex;justify-content:space-between;margin-top:6px'>"
            f"<span>latency <b>{latency}</b></span><span>last frame <b>{self.age_s:.1f} s</b> ago"
            f"</span><span>no. {update.sequence}</span></div>"
            "<div style='opacity:0.65;font-size:12px;min-height:36px'>"
            f"{times and 'stages, ms: '}{times}</div></div>"
        )

    def _reason(self) -> str:
        if self.state == "waiting":
            return "no frame has come yet"
        if self.state == "stale":
            return f"nothing has come for {self.age_s:.1f} s; the last estimate is hidden"
        assert self.update is not None
        return self.update.reason if self.state == "none" else self.update.warning

    def _banner(self) -> str:
        """Over the scene: big where there is nothing to see."""
        if self.state == "good":
            return ""
        size = 44 if self.loud else 20
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


def backdrop(state: State, loud: bool) -> UInt8[np.ndarray, "h w 3"]:
    """What lies behind the scene: dark; where it is ``loud``, a warning colour and the word, so
    that it is read with the panel closed too."""
    from PIL import Image, ImageDraw

    if not loud:
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
