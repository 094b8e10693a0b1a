"""A simulated operating room in real time: a case that breathes and is pushed, seen by a D405."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, ClassVar

from tumortrack.core import store
from tumortrack.core.config import check_seed
from tumortrack.core.errors import InputError
from tumortrack.core.patient import Patient, patient_in
from tumortrack.live.values import Observation, SourceConfig, SourceLost
from tumortrack.tracking.options import SimulatedSensor

if TYPE_CHECKING:
    from tumortrack_devices.player import ScenePlayer


class VirtualSourceConfig(SourceConfig, frozen=True, kw_only=True, tag="virtual"):
    """A case folder in motion (``tumortrack_devices.player``).

    Attributes:
        case: the folder that ``prepare`` wrote.
        fps: frames that the machine doesn't manage count as dropped.
        distance_mm: depth of the organ's nearest point, before all motion; default: 118, more for
            an organ larger than a kidney.
        seed: of pose, pushed places, tissue and noise.
        table, drape: around the organ.
        instrument: a shaft that comes and pushes; else nothing pushes.
        sensor, uncalibrated, tissue: of the noise, as in `simulate`; the unit is the seed's.
        pulled: states of the organ under the pull of `resect`'s holder (``make pull``).
    """

    target: ClassVar[str] = "case"

    case: Path
    fps: float = 30.0
    width: int = 424
    height: int = 240
    distance_mm: float | None = None
    seed: int = 0
    table: bool = True
    drape: bool = False
    instrument: bool = True
    breathing: bool = True
    camera_motion: bool = True
    noise: bool = True
    sensor: SimulatedSensor = "d405"
    uncalibrated: bool = False
    tissue: bool = False
    pulled: Path | None = None

    def __post_init__(self) -> None:
        self.check_between("virtual:", fps=(0.1, 1000))
        check_seed(self.seed)

    def patient(self) -> Patient:
        return patient_in(store.read_manifest(self.case, "case").get("patient"), str(self.case))

    def player(self) -> ScenePlayer:
        """The simulated room; building it takes some seconds. Raises ArtifactError if there is no
        case, or no states of it, InputError if case or options make no scene."""
        from tumortrack.io.case import load_case
        from tumortrack.simulation.noise import CLEAN
        from tumortrack.simulation.sensors import simulated
        from tumortrack_devices.player import ScenePlayer, ScenePlayerConfig
        from tumortrack_devices.pulled import PulledStates

        off = [
            *(() if self.breathing else ("breath_mm", "swell")),
            *(() if self.instrument else ("push_mm",)),
            *(() if self.camera_motion else ("sway_mm", "sway_degrees")),
        ]
        copied = ("width", "height", "distance_mm", "table", "drape")
        options = {name: getattr(self, name) for name in copied} | dict.fromkeys(off, 0.0)
        noise = simulated(
            self.sensor, unit=self.seed, uncalibrated=self.uncalibrated, tissue=self.tissue
        )
        config = ScenePlayerConfig(noise=noise if self.noise else CLEAN, **options)
        case, pulled = load_case(self.case), None
        if self.pulled is not None:
            pulled = PulledStates.read(self.pulled)
            if pulled.case_sha256 != store.sha256_of(self.case / store.MANIFEST):
                raise InputError(f"{self.pulled} is of another case than {self.case}.")
        return ScenePlayer(case.anatomy, case.up_lps, config, self.seed, pulled)

    def open(self) -> VirtualSource:
        """Its time begins with the first read. Raises as ``player``."""
        return VirtualSource(self.player(), self.fps)


class VirtualSource:
    """Renders the scene ``fps`` times a second, with its true surfaces. ``pull_mm``: how far a tool
    pulls at the moment; whoever moves one replaces it."""

    host_clock, lossless, on_demand = True, False, True

    def __init__(self, player: ScenePlayer, fps: float) -> None:
        self.player = player
        self.dropped = 0
        self._period_s = 1 / fps
        self._begin: float | None = None  # of scene time, by time.monotonic
        self._next = 0  # number of the frame that is due next
        self._closed = threading.Event()
        self.pull_mm: Callable[[], float] = lambda: 0.0

    def read(self, timeout_s: float) -> Observation | None:
        """The next frame, when it is due. Frames that were not read in time are dropped."""
        if self._begin is None:
            self._begin = time.monotonic()
        wait_s = self._begin + self._next * self._period_s - time.monotonic()
        if self._closed.wait(max(min(wait_s, timeout_s), 0)):
            raise SourceLost("the virtual source is closed; open it again.")
        stamp_ns, t_s = time.time_ns(), time.monotonic() - self._begin
        if t_s < self._next * self._period_s:
            return None
        number = int(t_s / self._period_s)
        self.dropped += max(number - self._next, 0)
        self._next = max(number, self._next) + 1
        return self.at(t_s, stamp_ns)

    def at(self, t_s: float, stamp_ns: int) -> Observation:
        """The scene at a time since its beginning."""
        instant = self.player.state_at(t_s)
        truth = self.player.truth(instant, self.pull_mm())
        frame = self.player.frame(instant, truth, stamp_ns)
        return Observation(frame, arrived_ns=time.time_ns(), truth=truth)

    def close(self) -> None:
        self._closed.set()
