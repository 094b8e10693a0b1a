"""ROS parameters and the command line of ``tumortrack track`` that they stand for; without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, NamedTuple


class Option(NamedTuple):
    """A parameter's default, and what it means. Empty text: it is left out. ``limits``: of each of
    its numbers; of texts what is allowed."""

    default: Any
    description: str
    limits: tuple[Any, ...] = ()


REQUIRED = ("model", "source")
# What a run is about: only while the node is not active. The others restart tracking.
FIXED = {"executable", *REQUIRED, "sinks", "tool", "patient", "side", "device", "report"}
OPTIONS = {
    "executable": Option("tumortrack", "the command, with its folder if it is not on the PATH"),
    "model": Option("", "a case, or the folder of a model"),
    "source": Option("", "where frames come from, such as ros2:/camera/depth/image_rect_raw"),
    "sinks": Option(["ros2:/tumortrack"], "where results go; also moveit, viewer"),
    "tool": Option([""], "NAME=KIND:..., tools that touch or hold the organ"),
    "frame": Option("", "JSON file that says where the camera is"),
    "moving": Option("", "where a camera that moves is, such as ros2:base_link (tf)"),
    "patient": Option("", "whose organ it is; a model of another patient is refused"),
    "side": Option("", "left or right; as patient", ("", "left", "right")),
    "range": Option("", "depth range of the organ, mm: two numbers", (0.0, 1e4)),
    "box": Option("", "box of the organ, camera frame, mm: six numbers", (-1e4, 1e4)),
    "whole": Option(False, "what is in range and box is the organ alone"),
    "smoothing": Option(0.0, "time constant of a mean over past estimates, s", (0.0, 60.0)),
    "rescan": Option(1.0, "search as in a first frame every so many s", (0.01, 3600.0)),
    "stale": Option(0.5, "older frames are refused, s", (0.01, 60.0)),
    "give_up": Option(60.0, "end after so many s without a frame", (0.01, 1e6)),
    "seconds": Option(0.0, "end so many s after the first frame; 0: never", (0.0, 1e9)),
    "device": Option("auto", "auto, cpu or cuda", ("auto", "cpu", "cuda")),
    "report": Option("", "file for latencies, counts and reasons; NAME-2 of a restart"),
}
_LISTS = {"range": 2, "box": 6}  # so many numbers in one text


def _new(report: str) -> str:
    """A file that is not there yet: no run replaces another's."""
    path, number = Path(report), 1
    while report and path.exists():
        number += 1
        path = Path(report).with_stem(f"{Path(report).stem}-{number}")
    return str(path) if report else ""


def command(values: Mapping[str, Any]) -> list[str]:
    """The program and its arguments. ``values``: of parameters by name; others keep their default.
    Raises ValueError: one is lacking, or not allowed."""
    known = {name: values.get(name, option.default) for name, option in OPTIONS.items()}
    if lacking := [name for name in REQUIRED if not known[name]]:
        about = OPTIONS[lacking[0]].description
        raise ValueError(f"the parameter {lacking[0]} is not set: {about}")
    for name, value in known.items():
        check(name, value)
    arguments = [known.pop("executable"), "track", *(known.pop(name) for name in REQUIRED)]
    arguments += known.pop("sinks")
    arguments += [f"--tool={tool}" for tool in known.pop("tool") if tool]
    known["report"] = _new(known["report"])
    for name, value in known.items():
        if value is False or value == "":
            continue
        texts = [] if value is True else str(value).split() if name in _LISTS else [str(value)]
        arguments += [f"--{name.replace('_', '-')}", *texts]
    return arguments


def check(name: str, value: Any) -> None:
    """Raises ValueError: a parameter's value is not allowed."""
    limits, texts = OPTIONS[name].limits, str(value).split()
    if not limits or value == "":
        return
    if isinstance(limits[0], str):
        allowed = value in limits
    else:
        try:
            allowed = len(texts) == _LISTS.get(name, 1)
            allowed = allowed and all(limits[0] <= float(text) <= limits[1] for text in texts)
        except ValueError:
            allowed = False
    if not allowed:
        raise ValueError(f"{name} is {value!r}; allowed: {limits}, {OPTIONS[name].description}")
