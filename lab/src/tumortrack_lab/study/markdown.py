"""Markdown tables, and blocks of a document that are replaced while the rest stays as written."""

from __future__ import annotations

from collections.abc import Iterable, Sequence

from tumortrack.core.errors import InputError


def table(head: Sequence[str], rows: Iterable[Sequence[str]], left: int = 1) -> str:
    """A markdown table; the first ``left`` columns are left-aligned, numbers right-aligned."""
    marks = ["---" if n < left else "---:" for n in range(len(head))]
    lines = [_line(head), _line(marks)]
    for row in rows:
        if len(row) != len(head):
            raise ValueError(f"a row of {len(row)} cells under a head of {len(head)}: {row}")
        lines.append(_line(row))
    return "\n".join(lines)


def _line(cells: Sequence[str]) -> str:
    return "| " + " | ".join(cell.replace("|", "\\|") for cell in cells) + " |"


def opening(name: str) -> str:
    return f"<!-- results:{name} -->"


def closing(name: str) -> str:
    return f"<!-- /results:{name} -->"


def fill(document: str, blocks: dict[str, str]) -> str:
    """The document with the text between each block's markers replaced.

    Doing it twice changes nothing more. Blocks that are not given stay as they are.

    Raises:
        InputError: a marker is missing, double or out of order.
    """
    for name, text in blocks.items():
        if document.count(opening(name)) != 1 or document.count(closing(name)) != 1:
            raise InputError(
                f"the document needs the markers {opening(name)} and {closing(name)} exactly once "
                f"each; put them where the {name} results belong."
            )
        before, _, rest = document.partition(opening(name))
        if closing(name) not in rest:
            raise InputError(f"{closing(name)} stands before {opening(name)}; put it after.")
        after = rest.partition(closing(name))[2]
        document = f"{before}{opening(name)}\n{text.strip()}\n{closing(name)}{after}"
    return document
