"""The command that makes a folder of another schema again: with its own inputs, as far as its
manifest names them, else with their kinds in capitals."""

from __future__ import annotations

import shlex
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

# By kind: what comes before and after the folder.
_COMMANDS = {
    "plan": ("plan RUN", "--overwrite"),
    "run": ("locate CASE CLOUD --out", "--overwrite"),
    "kit": ("phantom-kit CASE", "--overwrite"),
    "twin": ("twin CASE", ""),
    "camera": ("calibrate camera PICTURES", "--overwrite"),
    "hand-eye calibration": ("calibrate hand-eye PICTURES", "--lens LENS --overwrite"),
    "registration": ("calibrate register KIT", "--overwrite"),
}
_REPEATED = ("organ", "tumor", "structure")  # options of `prepare` that are given once a value


def remaking(folder: Path, manifest: Mapping[str, Any], parent: Mapping[str, Any]) -> str:
    """The command, or empty for a kind that no command makes. ``parent``: the manifest of the
    folder that holds this one; empty: there is none."""
    kind = manifest.get("kind")
    if kind == "model" and parent.get("kind") == "case":  # it is made with its case
        folder, manifest, kind = folder.parent, parent, "case"
    if kind == "case":
        source = _word(_at(manifest, "report", "source") or "INPUT").split(", ")
        options = _at(manifest, "report", "options")
        words = ["prepare", *source, "--out", str(folder), "--overwrite", *_options(options)]
    elif kind == "model":  # a training is never overwritten
        words = ["train", "CASE", f"{folder}_new", *_poses(manifest)]
    elif kind in _COMMANDS:
        before, after = _COMMANDS[kind]
        words = [*before.split(), str(folder), *after.split(), *_states(manifest)]
    else:
        return ""
    return f"tumortrack {shlex.join(words)}"


def _at(content: object, *keys: str) -> Any:
    """An entry of JSON; None: it is not there."""
    for key in keys:
        content = content.get(key) if isinstance(content, Mapping) else None
    return content


def _word(value: object) -> str:
    """On one line, whatever a manifest says."""
    return "".join(filter(str.isprintable, str(value)))


def _options(options: object) -> Iterator[str]:
    """Of `prepare`, all that were not empty."""
    if not isinstance(options, Mapping):
        return
    for name, value in options.items():
        if value is None or value is False or value in ("", []):
            continue
        flag, values = _word(f"--{name.replace('_', '-')}"), value
        if not isinstance(value, list):
            values = [] if value is True else [value]
        words = [f"{each:g}" if isinstance(each, float) else _word(each) for each in values]
        if name in _REPEATED:
            yield from (word for each in words for word in (flag, each))
        else:
            yield from (flag, *words)


def _poses(manifest: Mapping[str, Any]) -> Iterator[str]:
    if (rotations := _at(manifest, "config", "scene", "pose", "rotations")) is not None:
        yield from ("--rotations", _word(rotations))
    if _at(manifest, "config", "network") is not None:
        yield from ("--preset", "PRESET")


def _states(manifest: Mapping[str, Any]) -> Iterator[str]:
    """Of a kit."""
    if isinstance(states := _at(manifest, "config", "base", "states"), list):
        yield from ("--states", *map(_word, states))
