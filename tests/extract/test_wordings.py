"""A run in several wordings: what is played, what names it, and how one wording of it is read."""

import json

import numpy as np
import pytest

from probe_kit.env import SceneSpec
from probe_kit.errors import InstructionError, UsageError
from probe_kit.extract import ExtractSettings, prepare
from probe_kit.hooks import Site
from probe_kit.retention import retention_table
from probe_kit.runs import open_run
from probe_kit.suite import build_suite
from probe_kit.train.results.inventory import inventory
from tests.support.plans import scene_rows

SHORT = SceneSpec(max_steps=2)
LADDER = ("knowledge", "named", "side", "neutral")


@pytest.fixture(scope="module")
def suite(tmp_path_factory):
    return build_suite(tmp_path_factory.mktemp("worded") / "suite", ["emotion", "color"], 2)


@pytest.fixture(scope="module")
def ladder(suite, pi0_tiny, tmp_path_factory):
    """The embedded policy, asked in the two wordings whose words it knows."""
    settings = ExtractSettings(
        "pi0-tiny", suite=suite.folder, categories=("color",), wordings=("knowledge", "named"), scene=SHORT,
        env_workers=0,
    )  # fmt: skip
    return prepare(settings, model=pi0_tiny).run(tmp_path_factory.mktemp("worded") / "ladder")


def test_every_item_is_planned_in_every_wording_that_it_has_on_the_same_seeds(suite):
    plan = prepare(ExtractSettings("expert", suite=suite.folder, wordings=LADDER, scene=SHORT)).plan
    assert plan.selection["wordings"]["skipped"] == {"knowledge": 0, "named": 2, "side": 0, "neutral": 0}
    assert len(plan.episodes) == 4 * 2 * 4 - 4
    rows = [planned.to_json() for planned in plan.episodes]
    assert len({row["episode_id"] for row in rows}) == len(rows)
    plain = {planned.content.episode_id: planned for planned in scene_rows(suite, 0)}
    for row in rows:
        plain_episode = plain[":".join(row["episode_id"].split(":")[:2])]
        assert (row["scene_seed"], row["policy_seed"]) == (
            plain_episode.columns["scene_seed"],
            plain_episode.policy_seed,
        )


@pytest.mark.slow
def test_a_run_without_the_option_is_what_it_was(suite):
    plain = prepare(ExtractSettings("expert", suite=suite.folder, scene=SHORT))
    assert "wordings" not in plain.plan.selection
    assert not [row for row in (e.to_json() for e in plain.plan.episodes) if "wording" in row]
    prepared = prepare(ExtractSettings("expert", suite=suite.folder, scene=SHORT, wordings=("knowledge",)))
    assert prepared.plan.selection["wordings"]["names"] == ["knowledge"]
    assert prepared.identity() == plain.identity()
    assert prepared.default_name() != plain.default_name()


def test_a_wording_that_no_item_has_is_refused_before_anything_is_played(suite):
    with pytest.raises(UsageError, match=r"no item of .* has the wording 'named'"):
        prepare(ExtractSettings("expert", suite=suite.folder, categories=("emotion",), wordings=("named",)))
    with pytest.raises(UsageError, match="'nmaed'"):
        ExtractSettings("expert", wordings=("nmaed",))


def test_a_policy_that_does_not_know_a_word_refuses(suite):
    settings = ExtractSettings(
        "pi0-tiny", suite=suite.folder, categories=("color",), wordings=("knowledge", "neutral")
    )
    with pytest.raises(InstructionError, match="two pictures"):
        prepare(settings)


@pytest.mark.slow
def test_one_wording_of_a_run_is_read_like_a_run(ladder):
    assert ladder.wordings == ("knowledge", "named")
    assert ladder.episodes["wording"].value_counts().to_dict() == {"knowledge": 4, "named": 4}
    site = Site("backbone", 1)
    full_column = ladder.column(site)
    assert ladder.sealed
    for name in ladder.wordings:
        one_wording = ladder.in_wording(name)
        mine = (ladder.episodes["wording"] == name).to_numpy()
        assert (one_wording.episodes["wording"] == name).all()
        assert one_wording.planned == 4
        np.testing.assert_array_equal(one_wording.column(site), full_column[mine])
        assert one_wording.xarray()["backbone_pooled"].sizes["episode"] == 4
        assert one_wording.all_wordings.episodes.equals(ladder.episodes)
    assert ladder.in_wording().wording == "knowledge"
    assert (ladder.in_wording("named").column(site) != ladder.in_wording("knowledge").column(site)).any()


@pytest.mark.slow
def test_a_wording_that_was_not_asked_is_refused_by_name(ladder):
    with pytest.raises(UsageError, match=r"no wording 'side'; it has knowledge, named"):
        ladder.in_wording("side")


def test_the_inventory_says_how_many_episodes_each_wording_has(ladder):
    assert inventory(ladder).wordings == {"knowledge": 4, "named": 4}


def test_retention_shows_one_wording_and_all_of_them_against_each_other(ladder):
    with pytest.raises(UsageError, match="several wordings"):
        retention_table([ladder])
    table = retention_table([ladder.in_wording("named")])
    assert {row.success.n_episodes for row in table.rows} == {4}
    assert [(pair.group, pair.minus, pair.category, pair.n_items) for pair in table.wordings] == [
        ("knowledge", "named", name, 2) for name in ("color", "mean")
    ]
    assert any("wording 'named'" in note for note in table.notes)
    assert set(json.loads(table.to_json())) == {"rows", "wordings"}
    assert "knowledge / named" in table.to_markdown()
    assert open_run(ladder.location).in_wording("named").stamp == ladder.stamp
