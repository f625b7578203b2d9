"""Named tables from runs whose outcomes are known."""

from pathlib import Path

import numpy as np

from probe_kit.retention.behaviour.vlm_answers import scored
from probe_kit.retention.compare.known_used import match_runs
from probe_kit.study.tables.compared import stages_table
from tests.retention.asked_runs import acted, asked, probes


def test_stages_count_items_that_are_right_in_both_layouts(tmp_path: Path) -> None:
    draw = np.random.default_rng(3)
    known, used = draw.random((20, 2)) < 0.8, draw.random((20, 2)) < 0.6
    vlm, policy = asked(tmp_path, {"color": known}), acted(tmp_path, {"color": used})
    bare = stages_table([match_runs(scored(vlm, "text"), policy)])
    (row,) = bare.text.cells
    assert row[1:6] == ("Color", "20", str(int(known.all(axis=1).sum())), "–", str(int(used.all(axis=1).sum())))
    with_probes = stages_table([match_runs(scored(vlm, "text"), policy, probes(policy, {"color": [0.9, 0.5]}))])
    (number,) = with_probes.numbers
    assert number["encoded"] is not None
    assert number["answered_and_encoded"] <= min(number["answered"], number["encoded"])
    (shown,) = with_probes.text.cells
    assert shown[6] == str(number["answered_and_encoded"])
    assert shown[7].startswith(f"{100 * number['share_not_acted_on']:.1f} [")
