"""What the arms do, as sinks and screens show it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from jaxtyping import Float64

from tumortrack.core.colours import CUT, NOW, TO_CUT
from tumortrack.live.values import ControlState, Polyline
from tumortrack_resection.halt import Halt
from tumortrack_resection.values import Cut

# From an arm's name (cutter, holder) and its six joints to the tip of its tool, published frame
TipOf = Callable[[str, Float64[np.ndarray, " 6"]], Float64[np.ndarray, " 3"]]


@dataclass(frozen=True, eq=False)
class Workcell(ControlState):
    """``state``: of the procedure: approach, grasp, hold, sweep 1, ... ``halt``: why the arms have
    stopped early; None: they have not. ``left_mm``: what the present errors leave of the
    instrument's distance to the tumor that is the least safe; None: unknown. ``cutting``: the
    instrument is on a cut; ``all_cut``: none is left."""

    halt: Halt | None = None
    left_mm: float | None = None
    cutting: bool = False
    all_cut: bool = False


@runtime_checkable
class Arms(Protocol):
    """A controller of arms. ``tip_mm``: None: nothing says where their tools are."""

    tip_mm: TipOf | None


def cut_lines(cuts: Sequence[Cut], sweep: int) -> tuple[Polyline, ...]:
    """In the colours of what is cut, is being cut, in this sweep, and is to be cut."""
    colours = [CUT if c.sweep < sweep else NOW if c.sweep == sweep else TO_CUT for c in cuts]
    pairs = enumerate(zip(cuts, colours, strict=True), start=1)
    return tuple(Polyline(f"cut/{n}", cut.path_mm, colour, 0.8) for n, (cut, colour) in pairs)


def stage_words(state: str, real: bool) -> str:
    """A stage for the screen. ``real``: there are sinks of real arms, which may not be home yet."""
    return state.replace("home", "the way back", 1) if real else state
