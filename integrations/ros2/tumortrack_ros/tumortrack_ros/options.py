"""ROS parameters and the command line of ``tumortrack track`` that they stand for; without ROS."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NamedTuple


class Option(NamedTuple):
    """A parameter's default, and what it means. Empty text: it is left out."""

    default: Any
    description: str


REQUIRED = ("model", "source")
OPTIONS = {
    "executable": Option("tumortrack", "the command, with its folder if it is not on the PATH"),
    "model": Option("", "a case, or the folder of a model"),
    "source": Option("", "where frames come from, such as ros2:/camera/depth/image_rect_raw"),
    "sinks": Option(["ros2:/tumortrack"], "where results go; also moveit, viewer"),
    "frame": Option("", "JSON file that says where the camera is"),
    "moving": Option("", "where a camera that moves is, such as ros2:base_link (tf)"),
    "patient": Option("", "whose organ it is; a model of another patient is refused"),
    "side": Option("", "left or right; as patient"),
    "range": Option("", "depth range of the organ, mm: two numbers"),
    "box": Option("", "box of the organ, camera frame, mm: six numbers"),
    "whole": Option(False, "what is in range and box is the organ alone"),
    "smoothing": Option(0.0, "time constant of a mean over past estimates, s"),
    "rescan": Option(1.0, "search as in a first frame every so many s"),
    "stale": Option(0.5, "older frames are refused, s"),
    "give_up": Option(60.0, "end after so many s without a frame"),
    "seconds": Option(0.0, "end so many s after the first frame; 0: never"),
    "device": Option("auto", "auto, cpu or cuda"),
    "report": Option("", "file for latencies, counts and reasons"),
}
_LISTS = ("range", "box")  # several numbers in one text


def command(values: Mapping[str, Any]) -> list[str]:
    """The program and its arguments. ``values``: of parameters by name; others keep their default.
    Raises ValueError: one is lacking."""
    known = {name: values.get(name, option.default) for name, option in OPTIONS.items()}
    if lacking := [name for name in REQUIRED if not known[name]]:
        about = OPTIONS[lacking[0]].description
        raise ValueError(f"the parameter {lacking[0]} is not set: {about}")
    arguments = [known.pop("executable"), "track", *(known.pop(name) for name in REQUIRED)]
    arguments += known.pop("sinks")
    for name, value in known.items():
        if value is False or value == "":
            continue
        texts = [] if value is True else str(value).split() if name in _LISTS else [str(value)]
        arguments += [f"--{name.replace('_', '-')}", *texts]
    return arguments
