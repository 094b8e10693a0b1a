"""Segmentations whose labels have names: which are the organ and the tumors, and the label map."""

from __future__ import annotations

import re
from collections.abc import Iterable, Sequence
from pathlib import Path
from typing import NamedTuple

import numpy as np
from jaxtyping import UInt8

from tumortrack.core.errors import InputError
from tumortrack.core.grid import Segment
from tumortrack.core.organ import KNOWN
from tumortrack.core.patient import UNKNOWN, Side

_TUMOR = re.compile(
    r"(tumou?r|lesion|cancer|mass|nodule|rcc|aml|gtv|\w*(carcinoma|adenoma|oncocytoma|angiomyolipoma|"
    r"lipoma))s?|neoplas\w+|metasta\w+"
)
_NO_TUMOR = {"non", "not", "without", "free", "peri", "bed", "rim", "margin", "effect"}
_SIDES: dict[str, Side] = {"left": "left", "l": "left", "right": "right", "r": "right"}
_ALSO = {*_SIDES, "organ", "whole", "parenchyma", "mask", "seg", "segment", "segmentation", "label"}
_ALSO |= {"case", "patient", "copy", "final", "manual", "volume", "model"}
_LOST = 0.4  # of a segment, below others: what only overlaps their border has less


def words_of(name: str) -> set[str]:
    """The words of a name such as kidney_left_2 or TumorLeft, in lower case."""
    apart = re.sub(r"(?<=[a-z])(?=[A-Z])", " ", name)
    return set(filter(None, re.split(r"[^a-z]+", apart.lower())))


def is_tumor(name: str) -> bool:
    words = words_of(name)
    return any(map(_TUMOR.fullmatch, words)) and not words & _NO_TUMOR


def is_organ(name: str, organ: str) -> bool:
    """Whether a label's name says ``organ`` and, but for the side, nothing else."""
    wanted = set(organ.split("_"))
    words = {word.removesuffix("s") if word[:-1] in wanted else word for word in words_of(name)}
    said = wanted if wanted <= words else {"organ"} & words
    return bool(said) and words - said <= _ALSO and not is_tumor(name)


def other_organ(name: str, organ: str) -> str:
    """Which organ a file's name says, where it says another one alone; else empty."""
    words = words_of(name)
    others = sorted(KNOWN & words)
    return others[0] if len(others) == 1 and not set(organ.split("_")) & words else ""


def check_side(names: Iterable[str], side: Side) -> None:
    """Raises InputError: the organ's names say the other side than was stated."""
    for name in names:
        said = {_SIDES[word] for word in words_of(name) if word in _SIDES}
        if side != UNKNOWN and said and side not in said:
            raise InputError(f"--side says {side}, and {name!r} another one. Correct one of them.")


StructureSources = dict[str, int | Path]  # a label, or a mesh, by name


class Parts(NamedTuple):
    """What is what in a label map: numbers of the organ (several count as its first), of tumors
    (None: all from 2 up) and of structures, which may be meshes too; ``names`` of all labels, none
    where they have none; a ``note`` on what was taken."""

    organ: tuple[int, ...]
    tumors: tuple[int, ...] | None
    structures: StructureSources
    names: dict[int, str]
    stated: bool  # the tumors, by options
    note: str = ""


def painted(
    shape: tuple[int, ...],
    segments: Sequence[Segment],
    organ: tuple[int, ...] = (),
    others: tuple[int, ...] = (),
) -> tuple[UInt8[np.ndarray, "i j k"], list[int]]:
    """One map of segments that may overlap: the ``organ``, all of it with its first number; over it
    ``others`` in their order; below both what else there is, tumors first. And what else there is
    that lies mostly below them, where it is lost."""
    used = [*organ, *others]
    above = [segment for segment in segments if segment.number in used]
    below = [segment for segment in segments if segment.number not in used]
    out = np.zeros(shape, np.uint8)
    for segment in sorted(above, key=lambda s: used.index(s.number)):
        out[segment.mask()] = organ[0] if segment.number in organ else segment.number
    free, lost = out == 0, list[int]()
    for segment in sorted(below, key=lambda s: not is_tumor(s.name)):
        mask = segment.mask()
        size = int(np.count_nonzero(mask))
        if size - int(np.count_nonzero(mask & free)) > _LOST * size:
            lost.append(segment.number)
        out[mask & (out == 0)] = segment.number
    return out, lost
