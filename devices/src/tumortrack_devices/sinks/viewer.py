"""A web page that shows each estimate: ``viewer:8080?case=CASE_FOLDER``.

The page says how good the estimate is, how old, or why there is none; without one, or after a
second of silence, nothing of an older one stays visible.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar

import numpy as np
from jaxtyping import UInt8

from tumortrack.core import colours
from tumortrack.core.errors import InputError
from tumortrack.core.estimate import Motion
from tumortrack.core.geometry import transform_points
from tumortrack.core.packages import to_install
from tumortrack.core.types import Mesh
from tumortrack.io.case import load_case
from tumortrack.live.values import SinkConfig, SinkContext, TrackingResult
from tumortrack.report.slices import CarriedCt, SlicePlane, outlined, plane_through
from tumortrack_devices.display import seen_points
from tumortrack_devices.viewer.look import point_under
from tumortrack_devices.viewer.panel import ABORTED, Panel, State, StatusPanel
from tumortrack_devices.viewer.scene import ViewerScene

if TYPE_CHECKING:
    from viser import GuiEvent, SceneClickEvent

_STALE_S = 1.0
_TICK_S = 0.2  # how often the age is updated and the slice renewed
_SLICE_PIXELS = 320
_COARSER = 2  # the CT is sampled coarser: a pixel in the panel is less than a voxel
# For viser's thread to pause, else changes may arrive in pieces: on a busy machine, or in a full
# garbage collection, it may not run for a second.
_PARKED_S = 5.0
_CONTRADICTED = "evidence", "disputed", "cut_unknown"  # what a user may say was wrong
_SAME_ORGAN_MM = 3.0  # a case's surface may differ from the model's by so much


class ViewerSinkConfig(SinkConfig, frozen=True, kw_only=True, tag="viewer"):
    """A page at ``http://127.0.0.1:port``, for this machine alone.

    Attributes:
        port: 0: any free one.
        case: folder of the patient's case, of whose CT (or labels) slices are shown.
        margin_mm: a fixed distance of the shell around each tumor; 0: no shell; default: how far
            off the tumor is at most (95 %).
        hz: limit for clouds and surfaces.
    """

    target: ClassVar[str] = "port"

    port: int = 8080
    case: str = ""
    margin_mm: float | None = None
    hz: float = 15.0

    def __post_init__(self) -> None:
        self.check_ranges("viewer:", "0", port=65535)
        if self.margin_mm is not None:
            self.check_ranges("viewer:", "0 (no shell)", margin_mm=50)
        if not 0 < self.hz <= 60:
            raise InputError(f"viewer: hz={self.hz:g}; allowed are more than 0 and up to 60.")
        if self.case and not Path(self.case).is_dir():
            raise InputError(f"viewer: case={self.case} is not a folder that `prepare` wrote.")

    def open(self, context: SinkContext) -> ViewerSink:
        return ViewerSink(self, context)


class ViewerSink:
    """``port``, ``url``: of the page; ``server``: viser's; ``panel``: its elements."""

    def __init__(self, config: ViewerSinkConfig, context: SinkContext) -> None:
        self._ct = _load_ct(config.case, context) if config.case else None
        self._config, self._context = config, context
        try:
            from tumortrack_devices.viewer.server import HOST, LocalServer
        except ImportError as error:
            needed = to_install("tumortrack-devices")
            raise InputError(f"the viewer needs viser: {needed}.") from error
        self.server = LocalServer(config.port)
        self.port: int = self.server.get_port()
        self.url = f"http://{HOST}:{self.port}"
        self.notes = (f"open {self.url}",)
        self._lock = threading.RLock()  # for every change of the page
        self._result: TrackingResult | None = None  # the latest
        self._drawn: TrackingResult | None = None  # the whole page shows this one
        # The same and its margins, if its estimate is visible.
        self._shown: tuple[TrackingResult, dict[str, Mesh]] | None = None
        self._came_s = self._drawn_s = -np.inf
        self._hidden_count = 0  # a slice computed before the last hiding is invalid
        self._counter = 0
        self._fault: BaseException | None = None  # for the next publish to raise
        self._asked: bool | None = None  # for a click on the organ (True) or beside it
        self._state: State = "waiting"
        self.server.scene.set_background_image(np.full((4, 4, 3), colours.BACKGROUND, np.uint8))
        self._scene = ViewerScene(self.server, context, config.margin_mm)
        slices = "" if self._ct is None else self._ct.name
        options = slices, context.controller is not None, str(context.patient), context.tools
        self.panel = Panel(self.server, context.parts, *options)
        self._connect()
        self._say("waiting")
        self._closing = threading.Event()
        self._watch = threading.Thread(target=self._keep_watch, name="viewer", daemon=True)
        self._watch.start()

    def _connect(self) -> None:
        """Callbacks of the panel's elements; viser calls them from its own threads."""
        panel = self.panel

        def changed(_: object) -> None:
            with self._page():
                self._scene.change(panel.options)

        for switch in panel.switches:
            switch.on_update(changed)
        panel.clicks[True].on_click(lambda _: self._ask(True))
        panel.clicks[False].on_click(lambda _: self._ask(False))
        panel.forget.on_click(lambda _: self._forget())
        panel.acknowledge.on_click(lambda _: self._context.controls.acknowledged.set())
        panel.cut.on_click(lambda _: self._context.controls.cut.set())
        if self._context.tools:

            @panel.touches.on_click
            async def _(event: GuiEvent[Any]) -> None:  # at once: the next press changes the value
                tool = panel.tools.get(event.target.value)
                if tool and event.client is not None:  # else set by the program
                    self._context.controls.touched.append(tool)

        if self._context.controller is not None:
            panel.abort.on_click(lambda _: self._abort())

            @panel.views.on_click
            def _(event: GuiEvent[Any]) -> None:
                if event.client is not None:  # else set by the program
                    self._scene.look.turn(event.client, event.target.value)

    def publish(self, result: TrackingResult) -> None:
        """Show all of it at once, at most ``hz`` times a second; a change of the quality, and arms
        that halt or go on, without delay."""
        if self._closing.is_set():
            return
        now = time.monotonic()
        with self._page():
            self._result, self._came_s = result, now
            self._scene.extra_status.update(result)
            changed = self._drawn is None or _kind(self._drawn) != _kind(result)
            if changed or self._state == "stale" or now - self._drawn_s >= 1 / self._config.hz:
                self._drawn_s = now
                self._draw(result)
        fault, self._fault = self._fault, None
        if fault is not None:
            raise fault

    def close(self) -> None:
        if not self._closing.is_set():
            self._closing.set()
            self._watch.join(5)
            self.server.stop()

    @contextmanager
    def _page(self) -> Iterator[None]:
        """Changes inside arrive at clients together. viser's thread is paused: its own ``atomic``
        cuts what it is sending where the next change begins."""
        parked, go_on = threading.Event(), threading.Event()

        def park() -> None:
            parked.set()
            go_on.wait()

        with self._lock:
            with suppress(RuntimeError):  # it has ended
                self.server.get_event_loop().call_soon_threadsafe(park)
                parked.wait(_PARKED_S)
            try:
                yield
            finally:
                go_on.set()

    def _draw(self, result: TrackingResult) -> None:
        self._drawn = result
        state: State = "playback" if result.playback else result.quality
        if state != "good":  # a page gets 128 messages at once: a warning comes with the first
            self._say(state)
        try:
            self._scene.show_control(result.control)
        except Exception as error:
            self._scene.show_control(None)
            self._fault = error  # raised when the estimate has been shown
        try:
            self._scene.observe(result)
            if result.estimate is None:
                self._hide()
                self._scene.apply()
            else:
                self._scene.show(result)
                self._shown = result, self._scene.margins
            if state == "good":
                self._say(state)
        except Exception as error:
            self._hide()
            reason = f"this estimate cannot be shown ({error!r})"
            self._drawn = replace(result, estimate=None, quality="none", reason=reason)
            self._say("none")
            raise

    def _hide(self) -> None:
        self._shown = None
        self._hidden_count += 1
        self._scene.hide()
        self.panel.put_slice(None)

    def _say(self, state: State) -> None:
        self._state = state
        self._counter += 1
        result, age_s = self._drawn, 0.0
        if result is not None:
            since_s = self._came_s if state == "stale" else self._drawn_s
            age_s = time.monotonic() - since_s + (result.latency_ms or 0.0) / 1000
        arms = self._context.controller is not None
        about = age_s, self._counter, arms, self._context.parts
        self.panel.stage.content = StatusPanel(state, result, *about).stage()
        finding = None if result is None else result.finding
        contradicted = finding is not None and finding.kind in _CONTRADICTED
        if self.panel.acknowledge.visible is not contradicted:
            self.panel.acknowledge.visible = contradicted

    def _keep_watch(self) -> None:
        """Update the age, hide what is too old, renew the slice."""
        while not self._closing.wait(_TICK_S):
            try:
                with self._page():
                    stale = self._result and time.monotonic() - self._came_s > _STALE_S
                    if stale and self._shown is not None:
                        self._hide()
                    if stale:
                        self._scene.show_control(None)
                    self._say("stale" if stale else self._state)
                self._renew_slice()
            except Exception as error:  # the thread must go on
                self._fault = error

    def _renew_slice(self) -> None:
        if self._ct is None:
            return
        with self._lock:
            shown, hidden_count = self._shown, self._hidden_count
            part, orientation = self.panel.through.value, self.panel.plane.value
        if shown is None or (estimate := shown[0].estimate) is None:
            return
        result, margins = shown
        plane = plane_through(estimate.meshes, part, orientation)
        motion, picture = estimate.motion, None
        if plane is not None and motion is not None:
            outlines = self._outlines(result, margins)
            number = f"frame no. {result.sequence}"
            picture = slice_picture(self._ct, motion, plane, outlines, _SLICE_PIXELS, number)
        with self._page():
            if hidden_count == self._hidden_count:
                self.panel.put_slice(picture)
                if picture is not None and plane is not None:
                    pose = result.published_frame.published_from_camera
                    self._scene.put_slice(picture, plane, pose)

    def _outlines(
        self, result: TrackingResult, margins: dict[str, Mesh]
    ) -> Iterator[tuple[Mesh, colours.Colour, int]]:
        assert result.estimate is not None
        camera_from_published = np.linalg.inv(result.published_frame.published_from_camera)
        for label, name in enumerate(self._context.parts, start=1):
            colour = colours.part_colour(label)
            if (mesh := result.estimate.meshes.get(name)) is not None:
                yield mesh, colour, 2 if label > 1 else 1
            if (margin := margins.get(name)) is not None:
                vertices_mm = transform_points(camera_from_published, margin.vertices_mm)
                yield margin.with_vertices(vertices_mm), colour, 1
        for number, mesh in enumerate(result.estimate.structures.values()):
            yield mesh, colours.structure_colour(number), 1

    def _ask(self, organ: bool) -> None:
        """The next click in the scene is on the organ, or beside it; asked twice: cancelled."""
        with self._lock:
            if self._asked is not None:
                self.server.scene.remove_click_callback(self._clicked)
            self._asked = None if self._asked is organ else organ
            if self._asked is not None:
                self.server.scene.on_click()(self._clicked)
            self._scene.look_at_colours(self._asked is not None)
            self.panel.say_clicks(self._asked, self._context.controls)

    def _clicked(self, event: SceneClickEvent) -> None:
        with self._lock:
            if self._asked is None:
                return
            try:
                self._take_click(event, self._asked)
            finally:  # the buttons change last: whoever waits for them finds the click taken
                self._ask(self._asked)

    def _take_click(self, event: SceneClickEvent, organ: bool) -> None:
        result = self._result
        if result is None or (seen := result.observation) is None:
            event.client.add_notification("Nothing is seen at present", "Click again later.")
            return
        pose, points_mm = result.published_frame.published_from_camera, seen_points(seen)
        ray = np.array(event.ray_origin), np.array(event.ray_direction)
        place_mm = point_under(transform_points(pose, points_mm.astype(float)), *ray)
        if place_mm is None:
            event.client.add_notification("No observed point there", "Click on the points.")
            return
        controls = self._context.controls
        try:
            place_in_camera = transform_points(np.linalg.inv(pose), place_mm[None])[0]
            controls.click(seen, place_in_camera, organ)
        except InputError as error:
            if not organ or seen.picture is not None:
                event.client.add_notification("No colour was learned from this click", str(error))
        if organ:
            controls.picked_mm = place_mm
            self._scene.mark(place_mm)

    def _forget(self) -> None:
        with self._lock:
            self._context.controls.forget()
            self._scene.mark(None)
            self.panel.say_clicks(self._asked, self._context.controls)

    def _abort(self) -> None:
        with self._lock:
            self._context.controls.aborted.set()
            self.panel.abort.label, self.panel.abort.disabled = ABORTED, True


def _kind(result: TrackingResult) -> tuple[str, str, bool]:
    """What a page must show without delay."""
    control = result.control
    if control is None:
        return result.quality, "", True
    return result.quality, control.state, bool(control.stopped)


def _load_ct(case: str, context: SinkContext) -> CarriedCt:
    """Raises InputError if the model has no motion or the case is another patient's, ArtifactError
    if it is none."""
    loaded = load_case(Path(case))
    if context.anatomy_ct is None:
        raise InputError(
            "viewer: case= shows the CT at the present position, which this model cannot: its "
            "estimates have no motion. Leave it out, or give the case itself in MODEL's place."
        )
    if context.patient.differs(loaded.patient):
        raise InputError(
            f"viewer: {case} is of {loaded.patient}, the model of {context.patient}. Give the case "
            "that the model is of."
        )
    apart = np.abs(loaded.anatomy.organ.box_mm - context.anatomy_ct.organ.box_mm).max()
    if apart > _SAME_ORGAN_MM:
        raise InputError(
            f"viewer: {case} is not the case that the model is of: the organs' boxes in the CT "
            f"differ by {apart:.1f} mm. Give that case."
        )
    return CarriedCt(loaded)


def slice_picture(
    ct: CarriedCt,
    motion: Motion,
    plane: SlicePlane,
    outlines: Iterable[tuple[Mesh, colours.Colour, int]],
    pixels: int,
    note: str = "",
) -> UInt8[np.ndarray, "h w 3"] | None:
    """The CT in a plane before the camera, with the rest as in ``outlined``. None if ``motion`` has
    no inverse."""
    sampled = pixels // _COARSER
    points_ct = motion.inverse(plane.points(sampled))
    if points_ct is None:
        return None
    picture = ct.picture(points_ct).reshape(sampled, sampled, 3)
    return outlined(picture, plane, outlines, pixels, note)
