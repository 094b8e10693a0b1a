"""The viewer's panel: status, slice, buttons and switches."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from typing import TYPE_CHECKING, get_args

import numpy as np
from jaxtyping import UInt8

from tumortrack.live.viewer.look import View
from tumortrack.live.viewer.scene import DisplayOptions
from tumortrack.live.viewer.slices import ORIENTATIONS
from tumortrack.live.viewer.status import StatusPanel

if TYPE_CHECKING:
    from viser import ClientHandle, GuiEvent, ViserServer

_WIDTH = 360  # pixels; the banner leaves this much room
_ABORT, _ABORTED = "Stop the arms for good", "The arms were stopped for good"
_CLICK, _CANCEL = "Click the organ", "Now click on the organ (again: cancel)"


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
        # Both before either: what cannot be said leaves the page as it was.
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
