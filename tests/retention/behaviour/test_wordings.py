import json

import pandas as pd
import pytest

from probe_kit.errors import UsageError
from probe_kit.retention.behaviour.success_rate import success_rate
from probe_kit.retention.behaviour.wordings import wording_pairs
from probe_kit.retention.columns.comparisons import wording_tables
from probe_kit.train.data.labels import target_labels


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


def test_pairs_count_what_one_wording_alone_got_right_on_the_same_episodes(ladder):
    by_names = {(p.wording, p.other): p for p in wording_pairs(ladder, ("knowledge", "named", "side"), "r", "m")}
    assert len(by_names) == 3
    pair = by_names["knowledge", "side"]
    assert (pair.n_episodes, pair.sr, pair.other_sr, pair.only, pair.only_other) == (12, 0.5, 1.0, 0, 6)
    assert pair.p == pytest.approx(2 / 2**6)
    assert pair.p_groups == pytest.approx(2 / 2**3)
    fewer = by_names["knowledge", "named"]
    assert (fewer.n_episodes, fewer.sr, fewer.only_other) == (8, 0.75, 2)
    assert all(pair.p_holm >= pair.p_groups for pair in by_names.values())


def test_several_categories_have_a_row_together(ladder):
    shape = ladder.assign(category="shape", item_id="s" + ladder["item_id"], group_id="s" + ladder["group_id"])
    pairs = wording_pairs(pd.concat([ladder, shape]), ("knowledge", "side"), "r", "m")
    assert [(p.category, p.n_episodes) for p in pairs] == [("color", 12), ("shape", 12), ("all", 24)]


def test_success_rates_and_probes_take_one_wording(ladder):
    for measure in (success_rate, lambda episodes: target_labels(episodes, "correct", 0)):
        with pytest.raises(UsageError, match=r"several wordings \(knowledge, named, side\)"):
            measure(ladder)
        measure(ladder[ladder["wording"] == "side"])


def test_a_pair_that_shares_no_episode_is_left_out(ladder):
    apart = ladder[(ladder["wording"] == "knowledge") == (ladder["item_id"] < "color-3")]
    pairs = wording_pairs(apart, ("knowledge", "named", "side"), "r", "m")
    assert [(p.wording, p.other) for p in pairs] == [("named", "side")]
    assert json.dumps(pairs[0].p)


def test_the_wordings_are_a_table_wherever_plain_tables_are(ladder):
    pairs = wording_pairs(ladder, ("knowledge", "side"), "r", "m")
    (table,) = wording_tables(pairs)
    assert table.texts[0][0] == "color"
    assert "0 / 6" in table.texts[0]  # what one wording alone got right, and the other
