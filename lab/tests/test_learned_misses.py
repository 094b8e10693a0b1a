"""What is learned of tumors' misses holds for scenes that were not learned from."""

from __future__ import annotations

import numpy as np
import pandas as pd
import pytest

from tumortrack_lab.margins.misses import learned, left_out

TRUE = {"center_std": 0.8, "nearest": 0.4, "cost": 0.0}


def rows(seed, count=2000, constant=-1.0):
    rng = np.random.default_rng(seed)
    figures = {name: rng.normal(1.0, 0.7, count) for name in TRUE}
    logs = constant + sum(TRUE[name] * figures[name] for name in TRUE) + rng.normal(0, 0.4, count)
    # One tumor an answer; each scene is judged twice.
    about = {"scene": np.arange(count) // 2, "by": np.tile(["cloud", "image"], count // 2)}
    about |= {"kidney": rng.integers(0, 5, count), "family": rng.choice(["rest", "pull"], count)}
    return pd.DataFrame(
        {**about, "miss_mm": np.exp(logs), "rigid_fit_mm": 2.0, "finding": None, **figures}
    )


def test_weights_and_radius_are_found():
    model = learned(rows(0), {"seed": 3})
    for name, weight in TRUE.items():
        assert model.weights.get(name, 0.0) == pytest.approx(weight, abs=0.05)
    assert model.about == {"seed": 3, "answers": 2000}
    fresh = rows(1)
    radii_mm = [model.radius_mm(known) for known in fresh[list(TRUE)].to_dict("records")]
    assert (fresh.miss_mm <= radii_mm).mean() == pytest.approx(0.95, abs=0.015)


def test_what_makes_an_answer_poor_anyway_does_not_widen_the_radius():
    plain, lost = rows(0), rows(2, 200)
    lost["miss_mm"], lost["finding"] = 80.0, "fit"
    both = pd.concat([plain, lost], ignore_index=True)
    assert learned(both, {}).constant == pytest.approx(learned(plain, {}).constant)


def test_each_part_is_judged_by_what_was_learned_from_the_others():
    table = left_out(rows(4), "kidney").set_index("kidney")
    assert list(table.index) == [0, 1, 2, 3, 4, "all"]
    within = table["within the radius %"]
    assert within.between(92, 98).all()
    assert table.loc["all", "rank correlation"] == pytest.approx(0.8, abs=0.1)
    assert table.loc["all", "over 5 mm"] <= 0.05 * len(rows(4))
    by_family = left_out(rows(4), "kidney", by="family").set_index("family")
    assert list(by_family.index) == ["pull", "rest", "all"]
    assert (by_family["rigid fit: median"] == 2.0).all()
    assert by_family.loc["all", "over 5 mm"] == table.loc["all", "over 5 mm"]


def test_an_answer_is_good_if_all_its_tumors_are_near():
    one, sure = rows(6), left_out(rows(6), "kidney").iloc[-1]["good %"]
    farther = np.exp(TRUE["center_std"] * (9.0 - one.center_std))
    far = one.assign(center_std=9.0, miss_mm=one.miss_mm * farther)
    both = left_out(pd.concat([one, far], ignore_index=True), "kidney").iloc[-1]["good %"]
    assert sure > 20
    assert both == 0


def test_weights_are_never_negative():
    turned = rows(5)
    turned["cost"] = -turned["center_std"] + np.random.default_rng(0).normal(0, 0.1, len(turned))
    assert min(learned(turned, {}).weights.values()) > 0
