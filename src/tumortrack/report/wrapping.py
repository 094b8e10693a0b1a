"""Wrapping of text to a width."""

from __future__ import annotations

from bisect import bisect_right
from collections.abc import Callable


def wrapped(text: str, width: float, length_of: Callable[[str], float]) -> list[str]:
    """The text in lines no longer than ``width`` (in the unit of ``length_of``), broken between
    words, or within a word that is longer."""

    def fitting(pieces: list[str], glue: str) -> int:  # bisected, as measuring takes long
        counts = range(1, len(pieces) + 1)
        return bisect_right(counts, width, key=lambda n: length_of(glue.join(pieces[:n])))

    lines = []
    for paragraph in text.splitlines() or [""]:
        words = paragraph.split() or [""]
        while words:
            if fit := fitting(words, " "):
                lines.append(" ".join(words[:fit]))
                words = words[fit:]
            else:
                fit = max(1, fitting([*words[0]], ""))
                lines.append(words[0][:fit])
                words = [rest for rest in (words[0][fit:],) if rest] + words[1:]
    return lines
