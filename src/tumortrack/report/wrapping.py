"""Wrapping of text to a width."""

from __future__ import annotations

from collections.abc import Callable


def wrapped(text: str, width: float, length_of: Callable[[str], float]) -> list[str]:
    """The text in lines no longer than ``width`` (in the unit of ``length_of``), broken between
    words, or within a word that is longer."""
    lines = []
    for paragraph in text.splitlines() or [""]:
        line = ""
        for word in paragraph.split():
            if line and length_of(f"{line} {word}") > width:
                lines.append(line)
                line = ""
            line = f"{line} {word}" if line else word
            while len(line) > 1 and length_of(line) > width:
                fits = (n for n in range(len(line) - 1, 1, -1) if length_of(line[:n]) <= width)
                fit = next(fits, 1)
                lines.append(line[:fit])
                line = line[fit:]
        lines.append(line)
    return lines
