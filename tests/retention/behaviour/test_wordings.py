"""Wordings of one run against each other, on the episodes that were played in both."""

from dataclasses import dataclass, field
from pathlib import Path

import pandas as pd
import pytest

from probe_kit.errors import UsageError
from probe_kit.retention.behaviour import success_rate
from probe_kit.retention.columns.tables import wording_tables
from probe_kit.retention.compare.compare import Difference, compare_wordings
from probe_kit.runs.reader import check_several_wordings
from probe_kit.train import ArrayRun


@dataclass(frozen=True)
class Ladder(ArrayRun):
    """A run of several wordings."""

    wordings: tuple[str, ...] = ()
    settings: dict = field(default_factory=dict)


@pytest.fixture
def ladder(outcome_table):
    """Six items: in their own words right half of the time, by their side always; two have no plainer words."""

    def worded(wording, table):
        return table.assign(wording=wording, episode_id=table["episode_id"] + f":{wording}")

    parts = [
        worded("knowledge", outcome_table(6, 6, 0)),
        worded("named", outcome_table(8, 0, 0)),
        worded("side", outcome_table(12, 0, 0)),
    ]
    return pd.concat(parts, ignore_index=True)


def pairs(episodes: pd.DataFrame, *wordings: str) -> list[Difference]:
    return compare_wordings([Ladder(Path("run"), "m", "suite@1#0123456789ab", episodes, {}, wordings=wordings)])


def test_pairs_count_what_one_wording_alone_got_right_on_the_same_episodes(ladder):
    by_names = {(p.group, p.minus): p for p in pairs(ladder, "knowledge", "named", "side") if p.category != "mean"}
    assert len(by_names) == 3
    pair = by_names["knowledge", "side"]
    assert (pair.n_items, pair.sr_group, pair.sr_minus, pair.only, pair.only_minus) == (6, 0.5, 1.0, 0, 6)
    assert pair.sr == -0.5
    assert pair.p == pytest.approx(2 / 2**3), "three groups of two items, each a toss of a coin"
    fewer = by_names["knowledge", "named"]
    assert (fewer.n_items, fewer.of_items, fewer.sr_group, fewer.only_minus) == (4, 6, 0.75, 2)
    assert all(pair.p_holm >= pair.p for pair in by_names.values())


def test_several_categories_have_a_mean(ladder):
    shape = ladder.assign(category="shape", item_id="s" + ladder["item_id"], group_id="s" + ladder["group_id"])
    compared = pairs(pd.concat([ladder, shape]), "knowledge", "side")
    assert [(p.category, p.n_items) for p in compared] == [("color", 6), ("shape", 6), ("mean", 12)]


def test_success_rates_and_probes_take_one_wording(ladder):
    for measure in (success_rate, check_several_wordings):
        with pytest.raises(UsageError, match=r"several wordings \(knowledge, named, side\)"):
            measure(ladder)
        measure(ladder[ladder["wording"] == "side"])


def test_a_pair_that_shares_no_episode_is_left_out(ladder):
    apart = ladder[(ladder["wording"] == "knowledge") == (ladder["item_id"] < "color-3")]
    compared = pairs(apart, "knowledge", "named", "side")
    assert {(p.group, p.minus) for p in compared} == {("named", "side")}


def test_the_wordings_are_a_table(ladder):
    (table,) = wording_tables(pairs(ladder, "knowledge", "side"), {"run": "m"})
    assert table.title == "Wordings, m"
    assert table.texts[0][0] == "color"
    assert "0 / 6" in table.texts[0]  # what one wording alone got right, and the other
