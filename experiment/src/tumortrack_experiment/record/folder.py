"""A recording as it grows: an MCAP for each finished state, and one of all in the end.

An MCAP without its end has no index, and behind its end nothing can follow. So a state becomes a
file of its own, which appears when it is whole (``01_rest.mcap``); after the last one all are
copied into ``recording.mcap``, and taken away. Whatever ends this, finished states stay.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import shutil
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import tumortrack
from tumortrack.core.errors import InputError
from tumortrack.core.geometry import IDENTITY, Affine
from tumortrack.core.store import read_json, write_json, writing
from tumortrack.live.values import Observation
from tumortrack_devices.recording.mcap import STRING, McapBag, camera_messages
from tumortrack_devices.ros.messages import Messages, Outgoing
from tumortrack_experiment.record.attachments import attach
from tumortrack_experiment.record.read import IMAGE, STATE, TF, WHOLE, messages_in

ABOUT, _ASIDE, _KIND = "recording.json", ".part", "experiment"
_NAME = re.compile(r"[A-Za-z0-9][A-Za-z0-9_.-]{0,39}")
_AGAIN = "What is finished stays. Free some space, and give the same command again."


class RecordingFolder:
    """A new one, or one that was begun with the same checklist, frame and files.

    Args:
        states: the checklist.
        frame_id: of the poses that ``add`` is given.
        files: attachments by name.

    Raises InputError: something else lies there, it was begun otherwise, or a state cannot be
    called so.
    """

    def __init__(
        self, path: Path, states: tuple[str, ...], frame_id: str, files: Mapping[str, bytes]
    ) -> None:
        if wrong := [name for name in states if not _NAME.fullmatch(name)]:
            raise InputError(
                f"a state cannot be called {wrong[0]!r}: allowed are up to 40 letters, digits, "
                "dots, dashes and underscores."
            )
        if not states or len(set(states)) < len(states):
            raise InputError("the checklist needs one state at least, and each once.")
        self.path, self._files, self._messages = path, files, Messages()
        hashes = {name: hashlib.sha256(data).hexdigest() for name, data in files.items()}
        same = {"kind": _KIND, "states": list(states), "frame_id": frame_id, "files": hashes}
        self.about: dict[str, Any] = same | {"tumortrack": tumortrack.__version__, "done": {}}
        if (path / ABOUT).is_file():
            self.about |= read_json(path / ABOUT)
            for key, new in same.items():
                if (old := self.about.get(key)) != new:
                    raise InputError(
                        f"{path} was begun with other {key}: {json.dumps(old)}; now they are "
                        f"{json.dumps(new)}. Give the same to go on with it, or another folder."
                    )
        elif path.exists() and (not path.is_dir() or any(path.iterdir())):
            raise InputError(f"{path} exists already, and is no recording. Choose another folder.")
        with writing(path):
            path.mkdir(parents=True, exist_ok=True)
        self._note()

    def to_record(self, only: tuple[str, ...] = ()) -> list[str]:
        """The states that are missing; or those that are asked for. Raises InputError: there is no
        such state in the checklist, or all are in one MCAP already."""
        states, done = self.about["states"], self.about["done"]
        if strange := [name for name in only if name not in states]:
            raise InputError(f"the checklist has no state {strange[0]!r}, but {', '.join(states)}.")
        if only and (self.path / WHOLE).is_file():
            raise InputError(f"{self.path} is finished. Choose another folder.")
        return [state for state in states if (state in only if only else state not in done)]

    def begin(self, state: str) -> None:
        """Record this state, from its beginning."""
        self.drop()
        self._bag = McapBag(self.path / _ASIDE, self._messages, _AGAIN)
        self._state, self._begins = state, True

    def add(self, seen: Observation, fixed_from_camera: Affine | None) -> None:
        """What was seen next. Raises StorageError: the disk refuses."""
        where = IDENTITY if fixed_from_camera is None else fixed_from_camera
        out = camera_messages(seen, where, self.about["frame_id"], self._messages)
        if fixed_from_camera is None:
            out = [one for one in out if one.suffix != TF]
        if self._begins:
            named = self._messages.make(STRING, data=self._state)
            out, self._begins = [Outgoing(STATE, STRING, named), *out], False
        self._bag.write(seen.arrived_ns, sorted(out, key=lambda one: one.suffix == IMAGE))

    def keep(self, said: dict[str, Any], **facts: Any) -> None:
        """What was added since ``begin`` is the state. ``said``: of it; ``facts``: of all."""
        self._bag.close()
        with writing(self.path):
            file = self.path / _ASIDE / f"{_ASIDE}.mcap"
            attach(file, self._files)
            os.replace(file, self._part(self._state))
        self.about["done"][self._state] = said
        self.about |= facts
        self._note()
        self.drop()

    def finish(self) -> Path:
        """All states in one MCAP, as a rosbag2 folder."""
        parts = [self._part(state) for state in self.about["states"]]
        if not (self.path / WHOLE).is_file():
            self.drop()
            inside = self.path / _ASIDE / Path(WHOLE).stem
            bag, end_ns = McapBag(inside, self._messages, _AGAIN), 0
            for part in parts:
                begin_ns = next(messages_in(part))[1]
                shift_ns = max(end_ns + 1 - begin_ns, 0)  # the clock may have been set back
                for topic, at_ns, message in messages_in(part):
                    end_ns = at_ns + shift_ns
                    bag.write(end_ns, [Outgoing(topic, message.__msgtype__, message)])
            bag.close()
            with writing(self.path):
                about = (self.path / ABOUT).read_bytes()
                attach(inside / WHOLE, {**self._files, ABOUT: about})
                for name in (WHOLE, "metadata.yaml"):
                    os.replace(inside / name, self.path / name)
        for part in parts:
            part.unlink(missing_ok=True)
        self.drop()
        return self.path / WHOLE

    def _part(self, state: str) -> Path:
        return self.path / f"{self.about['states'].index(state) + 1:02d}_{state}.mcap"

    def _note(self) -> None:
        write_json(self.path / ABOUT, self.about)

    def drop(self) -> None:
        """Take away a state that was begun, and not kept."""
        shutil.rmtree(self.path / _ASIDE, ignore_errors=True)
