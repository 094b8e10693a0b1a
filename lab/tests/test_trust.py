"""What margins are worth of physics and organs that are left out."""

from __future__ import annotations

import numpy as np
import pytest

from tumortrack.core import store
from tumortrack.core.errors import InputError
from tumortrack_lab.margins.table import Row
from tumortrack_lab.study import trust

FAMILIES = {"rest": 1.0, "plate": 1.0, "pull": 1.0, "cut": 4.0}  # how far it misses, times the size


@pytest.fixture(scope="module")
def states(tmp_path_factory):
    """Two organs' states; every tenth estimate is poor, a third of the scenes is partly hidden."""
    rng, rows = np.random.default_rng(0), []
    for organ in ("a", "b"):
        folder = tmp_path_factory.mktemp(organ)
        for n in range(480):
            scene = folder / f"scene{n}"
            scene.mkdir()
            store.write_json(scene / "meta.json", {"hidden_share": 0.5 if n % 3 == 0 else 0.0})
            family, s = list(FAMILIES)[n % 4], float(np.exp(0.4 * rng.normal()))
            size, label = s * FAMILIES[family], (family, "over 2/3", organ)
            row = Row(scene=str(scene), sha256="", label=label, doubt="poor")
            if n % 10:
                row = Row(
                    scene=str(scene), sha256="", label=label, measured={"fit_cost": rng.random()},
                    misses={"tumor": ((float(size * rng.uniform()), s),)},
                )  # fmt: skip
            rows.append(row)
    found = trust.states_of(rows)
    return found.assign(rigid=2 * found.miss)


def test_a_family_unlike_the_others_is_found_out_by_leaving_it_out(states, tmp_path):
    assert dict(states.hidden.value_counts()) == {"nothing hidden": 640, "over 40 %": 320}
    found = trust.left_out(states, states.family, 0, widest_mm=20.0)
    taken = found[found.accepted.astype(bool)]
    shares = taken.groupby("part")["within 0.95"].mean()
    assert shares["cut"] < 0.5  # calibrated on misses a quarter of its own
    assert (shares.drop("cut") > 0.93).all()
    assert (taken.groupby("part")["mm 0.9"].max() <= taken.groupby("part")["mm 0.95"].max()).all()
    rows = trust.coverage({"family": found})
    assert list(rows.part) == ["cut", "plate", "pull", "rest", "all of these"]
    assert float(rows["within 95 %"][0].split(" (")[0]) == round(100 * shares["cut"], 1)
    organs = trust.left_out(states, states.organ, 0, widest_mm=20.0)
    within = organs[organs.accepted.astype(bool)]["within 0.95"]
    assert within.mean() > 0.93  # the other organ has the same physics
    assert float(trust.ranks(organs)["95 % radius and miss"].iloc[-1]) > 0.3
    each = trust.coverage({"organ, by family": organs.assign(part=organs.family)})
    short = trust.by_family(each.assign(evidence="clouds alone"))
    answers = organs[organs.family == "cut"].accepted.sum()
    assert short["clouds alone"][0].endswith(f"({answers})")
    assert list(short.family) == [*sorted(FAMILIES), "all of these"]
    assert (short["rigid fit's 95 % mm"].astype(float) > each["miss 95 % mm"].astype(float)).all()
    trust.risk_picture(found, tmp_path / "risk.png")
    trust.reliability_picture({"each family left out": found}, tmp_path / "reliability.png")
    assert all((tmp_path / f"{name}.png").stat().st_size > 9000 for name in ("risk", "reliability"))


def test_too_few_states_are_refused(states):
    with pytest.raises(InputError, match="no limits hold 5 %"):
        trust.left_out(states[:60], states.family[:60], 0)


def test_a_share_is_stated_with_clopper_and_pearsons_interval():
    assert trust.share_words(59, 59) == "100.0 (93.9 to 100.0)"  # 0.025 ** (1 / 59)
    assert trust.share_words(0, 0) == "-"
