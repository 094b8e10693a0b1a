"""Conformal quantiles, and rules of acceptance that are tested before they are used.

Sources: Vovk et al., Algorithmic Learning in a Random World, 2005 (quantile); Clopper and Pearson,
Biometrika 26:404, 1934 (bound); Angelopoulos et al., Learn then Test, arXiv 2110.01052 (rules).
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from jaxtyping import Float, Int64
from scipy.special import betaincinv

ERROR = 0.05  # chance that a rule passes its test although its risk is too large
_ROUNDING = 1e-9  # (n + 1) * 0.9 may be a little more than the whole number that it is

Label = tuple[str, ...]


def least_scores(confidence: float) -> int:
    """How many scores a quantile needs; with fewer it is infinite."""
    return math.ceil(confidence / (1 - confidence) - _ROUNDING)


def conformal_quantile(scores: Float[np.ndarray, " n"], confidence: float) -> float:
    """The ceil((n + 1) confidence)-th smallest score: a further one, exchangeable with them, is no
    larger with at least this confidence. Infinite where there are too few."""
    rank = math.ceil((len(scores) + 1) * confidence - _ROUNDING)
    return float(np.sort(scores)[rank - 1]) if rank <= len(scores) else math.inf


def risk_bound(misses: int, cases: int, error: float = ERROR) -> float:
    """Clopper and Pearson's upper bound of the share of misses; too low with chance ``error``."""
    return 1.0 if misses >= cases else float(betaincinv(misses + 1, cases - misses, 1 - error))


def least_tested(risk: float, error: float = ERROR, misses: int = 0) -> int:
    """How many cases with so many misses show that the risk is no larger."""
    cases = misses + 1
    while risk_bound(misses, cases, error) > risk:
        cases += 1
    return cases


def loosest_rule(
    rules: Sequence[Sequence[tuple[int, int]]], risk: float, error: float = ERROR
) -> int | None:
    """The number of the last rule before the first that does not hold its risk in every group; None
    if the first rule fails. ``rules``: (misses, accepted cases) of each group, rule by rule, in an
    order fixed beforehand, the strictest first. Each is tested with the whole ``error``: as testing
    ends with the first failure, this bounds the chance that the rule returned has a larger risk in
    any group (fixed-sequence testing)."""
    for number, groups in enumerate(rules):
        if not all(risk_bound(misses, cases, error) <= risk for misses, cases in groups):
            return number - 1 if number else None
    return len(rules) - 1


def groups_of(labels: Sequence[Label], least: int) -> dict[Label, Int64[np.ndarray, " m"]]:
    """The members of each group, by their numbers. A group with fewer than ``least`` members is
    replaced by the larger one whose label lacks the last word; in the end by that of all, whose
    label is empty, however few they are."""
    groups: dict[Label, Int64[np.ndarray, " m"]] = {}
    for label in sorted(set(labels)) or [()]:
        while True:
            members = [n for n, other in enumerate(labels) if other[: len(label)] == label]
            if len(members) >= least or not label:
                break
            label = label[:-1]
        groups[label] = np.array(members, np.int64)
    return groups
