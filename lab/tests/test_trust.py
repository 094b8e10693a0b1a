"""What tables of margins say of physics and organs that are left out."""

from __future__ import annotations

import json

import numpy as np
import pytest

from tumortrack.core import store
from tumortrack.core.config import to_builtins
from tumortrack.core.errors import InputError
from tumortrack_lab.margins.table import Row, head_of
from tumortrack_lab.study import trust

FAMILIES = {"rest": 1.0, "plate": 1.0, "pull": 1.0, "cut": 4.0}  # how far it misses, times the size


@pytest.fixture(scope="module")
def tables(tmp_path_factory):
    """Two organs' tables; every tenth estimate is poor, a third of the scenes is partly hidden."""
    rng, paths = np.random.default_rng(0), []
    for organ in ("a", "b"):
        folder = tmp_path_factory.mktemp("models") / organ
        folder.mkdir()
        lines = [head_of("", 0)]
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
            lines.append(to_builtins(row))
        paths.append(folder / "margins.jsonl")
        paths[-1].write_text("".join(f"{json.dumps(line)}\n" for line in lines))
    return paths


def test_a_family_unlike_the_others_is_found_out_by_leaving_it_out(tables, tmp_path):
    read = trust.read_tables(tables)
    assert [table.organ for table in read] == ["a", "b"]
    states = trust.states_of([row for table in read for row in table.rows])
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
    trust.risk_picture(found, tmp_path / "risk.png")
    trust.reliability_picture({"each family left out": found}, tmp_path / "reliability.png")
    assert all((tmp_path / f"{name}.png").stat().st_size > 9000 for name in ("risk", "reliability"))


def test_too_few_states_and_other_methods_are_refused(tables, tmp_path):
    states = trust.states_of(trust.read_tables(tables)[0].rows[:60])
    with pytest.raises(InputError, match="no limits hold 5 %"):
        trust.left_out(states, states.family, 0)
    head, *rest = tables[0].read_text().splitlines()
    old = {**json.loads(head), "method": 1}
    (tmp_path / "margins.jsonl").write_text("\n".join([json.dumps(old), *rest]))
    with pytest.raises(InputError, match="another version of the method"):
        trust.read_tables([tmp_path / "margins.jsonl"])


def test_a_share_is_stated_with_clopper_and_pearsons_interval():
    assert trust.share_words(59, 59) == "100.0 (93.9 to 100.0)"  # 0.025 ** (1 / 59)
    assert trust.share_words(0, 0) == "-"
