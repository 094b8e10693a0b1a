"""Segmentations whose labels have names: which are the organ and the tumors, and the label map."""

from __future__ import annotations

import re
from collections.abc import Sequence
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.types import ORGAN
from tumortrack.imaging.grid import RawVolume, Segment
from tumortrack.imaging.options import PrepareOptions, StructureSources, parse_structures

_TUMOR = re.compile("tumou?r|neoplasm|lesion|cancer|carcinoma|metasta|mass")
_ALSO = {"left", "right", "l", "r", "organ", "whole", "parenchyma", "mask", "seg", "label"}


def is_tumor(name: str) -> bool:
    return bool(_TUMOR.search(name.lower()))


def is_organ(name: str, organ: str) -> bool:
    """Whether a label's name says ``organ`` and, but for the side, nothing else."""
    words = set(filter(None, re.split(r"[^a-z]+", name.lower())))
    wanted = set(organ.split("_"))
    said = wanted if wanted <= words else {"organ"} & words
    return bool(said) and words - said <= _ALSO and not is_tumor(name)


class Parts(NamedTuple):
    """What is what in a label map: numbers of the organ (several count as its first), of tumors
    (None: all from 2 up) and of structures, which may be meshes too; ``names`` of all labels, none
    where they have none; a ``note`` on what was taken."""

    organ: tuple[int, ...]
    tumors: tuple[int, ...] | None
    structures: StructureSources
    names: dict[int, str]
    note: str = ""


def parts_of(raw: RawVolume, options: PrepareOptions, where: str) -> Parts:
    """As stated, or else by names; without either 1 is the organ and every other label a tumor.
    Raises InputError: labels have names, and none is the organ's."""
    names = {segment.number: segment.name for segment in raw.segments}
    sources = parse_structures(options.structure, options.name)
    numbers = {name: number for number, name in names.items()}
    structures = {name: numbers.get(str(source), source) for name, source in sources.items()}
    organ = options.organs or tuple(n for n in names if is_organ(names[n], options.name))
    tumors = options.tumors
    if not names:
        stated = tumors if tumors is not None or options.organs in ((), (ORGAN,)) else ()
        note = "tumors by their numbers alone: every label from 2 up" if stated is None else ""
        return Parts(organ or (ORGAN,), stated, structures, {}, note)
    listing = ", ".join(f"{n} {name}" for n, name in names.items())
    if not organ:
        raise InputError(
            f"{where} holds {listing}: none is a {options.kind.words} by name. Say which is: "
            "--organ NUMBER, or --name of another organ."
        )
    if tumors is None:
        tumors = tuple(n for n in names if is_tumor(names[n]) and n not in organ)
    taken = [" and ".join(names.get(n, f"{n}") for n in of) or "none" for of in (organ, tumors)]
    note = f"organ: {taken[0]}; tumors: {taken[1]}; of {listing}"
    return Parts(organ, tumors, structures, names, note)


def painted(
    segments: Sequence[Segment], organ: tuple[int, ...] = (), others: tuple[int, ...] = ()
) -> UInt8[np.ndarray, "i j k"]:
    """One map of segments that may overlap: ``others`` in their order over the ``organ`` (all of it
    with its first number) over the rest, tumors first."""
    used = [*organ, *others]

    def rank(segment: Segment) -> tuple[int, bool]:
        number, name = segment.number, segment.name
        return used.index(number) if number in used else -1, not is_tumor(name)

    out = np.zeros((), np.uint8)
    for segment in sorted(segments, key=rank):
        mask = segment.mask()
        out = out if out.ndim else np.zeros(mask.shape, np.uint8)
        mask = mask if segment.number in used else mask & (out == 0)
        out[mask] = organ[0] if segment.number in organ else segment.number
    return out
