"""Numbers of many cells in one: over scenes by the protocol's rule, over seeds as mean and spread.

Over scenes: medians, a part that was not found counting as infinitely far (``protocol.RULE``).
Over seeds: mean and standard deviation (n - 1); where a seed has no finite number, how many have.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass

import numpy as np

NOT_FOUND = "not found"
Value = Callable[[dict], float | None]


def part_value(part: str, key: str) -> Value:
    """Reads a part's metric from a cell; infinite (None) where the part was not found."""

    def value(cell: dict) -> float | None:
        metrics = cell["parts"][part]
        return metrics.get(key) if metrics["found"] or key == "iou" else None

    return value


def pick(cells: Iterable[dict], **wanted: object) -> list[dict]:
    """The cells whose specification, or method's name, has these values."""

    def fits(cell: dict) -> bool:
        spec = {**cell["spec"], "method": cell["spec"]["method"]["name"]}
        return all(spec[key] == value for key, value in wanted.items())

    return [cell for cell in cells if fits(cell)]


def names(cells: Iterable[dict], key: str) -> list[str]:
    """Distinct values of one field of the specification, in the order of their appearance."""
    seen: dict[str, None] = {}
    for cell in cells:
        spec = cell["spec"]
        seen[spec["method"]["name"] if key == "method" else spec[key]] = None
    return list(seen)


@dataclass(frozen=True)
class Figure:
    """A number of a table: one value a seed; None where it is infinite (not found)."""

    values: tuple[float | None, ...]

    @property
    def finite(self) -> list[float]:
        return [value for value in self.values if value is not None]

    @property
    def mean(self) -> float | None:
        """None unless every seed has a number."""
        return float(np.mean(self.finite)) if len(self.finite) == len(self.values) > 0 else None

    @property
    def spread(self) -> float | None:
        """Standard deviation over seeds (n - 1); None for one seed."""
        if self.mean is None or len(self.values) < 2:
            return None
        return float(np.std(self.finite, ddof=1))

    def text(self, digits: int = 1) -> str:
        """``4.2 ± 0.3``; ``4.2`` for one seed; ``5.0 (2 of 3)``: the median by the rule, where a
        seed has none; ``not found``."""
        if not self.values:
            return "–"
        if self.mean is not None:
            spread = "" if self.spread is None else f" ± {self.spread:.{digits}f}"
            return f"{self.mean:.{digits}f}{spread}"
        middle = median(self.values)
        if middle is None:
            return NOT_FOUND
        return f"{middle:.{digits}f} ({len(self.finite)} of {len(self.values)})"


def figure(cells: Iterable[dict], value: Value) -> Figure:
    """Median over scenes for each seed, then the seeds' figure."""
    seeds: dict[int, list[float | None]] = {}
    for cell in cells:
        seeds.setdefault(cell["spec"]["method"].get("seed", 0), []).append(value(cell))
    return Figure(tuple(median(values) for _, values in sorted(seeds.items())))


def median(values: Iterable[float | None]) -> float | None:
    """The median with None as infinite; None where it is infinite."""
    ordered = np.sort([np.inf if value is None else value for value in values])
    low, high = ordered[(len(ordered) - 1) // 2], ordered[len(ordered) // 2]
    return float((low + high) / 2) if np.isfinite(high) else None
