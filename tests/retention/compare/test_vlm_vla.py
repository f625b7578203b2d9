"""Asked rows in the table, by every score, and VLM − VLA recomputed by hand."""

import json
import math
import shutil
from dataclasses import asdict, replace
from io import StringIO
from itertools import product
from pathlib import Path

import numpy as np
import pytest
import torch
from rich.console import Console
from safetensors.torch import load_file

from probe_kit.errors import UsageError
from probe_kit.hooks import ModelCard, load_model
from probe_kit.hooks.registry import find_family, own_families
from probe_kit.models.embedded import embedded_checkpoint
from probe_kit.retention import retention_table
from probe_kit.retention.compare.models import grew_from
from probe_kit.retention.report import report_html
from tests.retention.asked_runs import SaidRun, acted, answer_run
from tests.retention.paired_limits import mover


def by_chance(seed: int, share: float) -> dict[str, np.ndarray]:
    draw = np.random.default_rng(seed)
    return {category: draw.random((count, 2)) < share for category, count in (("color", 20), ("shape", 16))}


@pytest.fixture
def runs(tmp_path: Path) -> list[SaidRun]:
    return [acted(tmp_path, by_chance(2, 0.5)), answer_run(tmp_path, by_chance(1, 0.9))]


def test_asked_rows_stand_first_and_say_what_they_are(runs: list[SaidRun]) -> None:
    table = retention_table(runs)
    assert [row.run.mode for row in table.all_rows] == ["answers"] * 3 + ["acts"] * 3
    color, _, mean = table.all_rows[:3]
    answers = color.answers
    assert (answers.prompt, answers.picture_size, answers.asked_for, answers.score) == (
        "p1",
        "224x224",
        "target",
        "text",
    )
    assert answers.accuracy_text == color.success.sr
    assert (
        answers.accuracy_logits,
        answers.accuracy_order_balanced,
        answers.letter_bias,
        answers.option_mass,
    ) == (
        0.5,
        1,
        1.5,
        0.8,
    )
    assert answers.share_unparsable == color.success.share_outside > 0
    assert answers.share_by_clause == 0.25
    assert answers.accuracy_strict < answers.accuracy_text
    assert (mean.run.mode, mean.answers.prompt, mean.answers.accuracy_logits) == ("answers", "p1", 0.5)
    few = replace(runs[1], episodes=runs[1].episodes.assign(parse_tier="strict"))
    assert retention_table([few]).rows[0].answers.accuracy_strict is None
    assert "no answer could be read" in retention_table([_mostly_silent(runs[1])]).rows[0].success.reason


def _mostly_silent(run: SaidRun) -> SaidRun:
    return replace(run, episodes=run.episodes.assign(outcome="oob", side_placed="none"))


@pytest.mark.parametrize(("score", "sr"), [("logits", 0.5), ("order-balanced", 1.0)])
def test_the_score_is_what_the_table_shows(runs: list[SaidRun], score: str, sr: float) -> None:
    table = retention_table(runs, score=score)
    assert all(
        row.success.sr == sr and row.answers.score == score for row in table.rows if row.run.mode == "answers"
    )
    assert [row.success.sr for row in table.rows if row.run.mode == "acts"] == [
        row.success.sr for row in retention_table(runs).rows if row.run.mode == "acts"
    ]
    assert table.rows[0].answers.accuracy_text == retention_table(runs).rows[0].success.sr
    with pytest.raises(UsageError, match="score is 'luck'"):
        retention_table(runs, score="luck")


def test_a_constant_answer_has_one_right_per_item_and_no_paired_evidence(runs: list[SaidRun]) -> None:
    row = retention_table(runs, score="logits").rows[0]
    assert (row.success.sr, row.success.paired.exactly_one, row.success.paired.p) == (0.5, 20, 1)


def test_items_with_a_side_in_their_name_are_left_out_unless_asked_for(tmp_path: Path) -> None:
    run = answer_run(tmp_path, by_chance(1, 0.9), worded=True)
    table = retention_table([run])
    assert table.rows[0].success.n_items == 19
    assert any("4 episodes are left out because a side stands in the name" in note for note in table.notes)
    assert retention_table([run], with_side_words=True).rows[0].success.n_items == 20


def test_the_gap_is_what_an_independent_count_gives(runs: list[SaidRun]) -> None:
    table = retention_table(runs, vlm_vla=True)
    policy, vlm = (run.episodes.set_index("episode_id") for run in runs)
    ps = []
    for gap in table.vlm_vla[:2]:
        answered_right = vlm[vlm["category"] == gap.category]["outcome"] == "correct"
        acted_right = (policy["outcome"] == "correct")[answered_right.index]
        assert gap.sr == pytest.approx(
            sum(answered_right) / len(answered_right) - sum(acted_right) / len(acted_right)
        )
        gains: dict[str, int] = {}
        for name in answered_right.index:
            group = vlm.loc[name, "group_id"]
            gains[group] = gains.get(group, 0) + int(answered_right[name]) - int(acted_right[name])
        values = [value for value in gains.values() if value]
        sums = [
            abs(sum(map(math.prod, zip(signs, values, strict=True))))
            for signs in product((1, -1), repeat=len(values))
        ]
        ps.append(sum(flipped >= abs(sum(values)) for flipped in sums) / len(sums))
        assert gap.p == pytest.approx(ps[-1])
        tables = [run.loc[answered_right.index].reset_index() for run in (vlm, policy)]
        assert gap.sr_ci == pytest.approx(mover(*tables))
        assert (gap.paired, gap.same_frames) == (True, True)
    smaller, larger = sorted(ps)
    corrected = {smaller: min(1, 2 * smaller), larger: min(1, max(2 * smaller, larger))}
    assert [gap.p_holm for gap in table.vlm_vla[:2]] == [pytest.approx(corrected[p]) for p in ps]
    mean = table.vlm_vla[2]
    assert mean.category == "mean"
    assert mean.sr == pytest.approx(np.mean([gap.sr for gap in table.vlm_vla[:2]]))


def test_only_items_in_common_are_compared_and_counted(runs: list[SaidRun]) -> None:
    policy, vlm = runs
    fewer = replace(policy, episodes=policy.episodes[policy.episodes["item_id"] != "color-0"])
    color, _, mean = retention_table([vlm, fewer], vlm_vla=True).vlm_vla
    asked_too = replace(vlm, episodes=vlm.episodes[vlm.episodes["item_id"] != "color-0"])
    assert replace(color, of_items=19) == retention_table([asked_too, fewer], vlm_vla=True).vlm_vla[0]
    assert (color.n_items, color.of_items, mean.n_items, mean.of_items) == (19, 20, 35, 36)
    gap_table = retention_table([vlm, fewer], vlm_vla=True).further_tables[-1]
    assert [line[-1] for line in gap_table.texts] == ["19 of 20", "16", "35 of 36"]


def test_other_items_are_not_paired_and_have_no_p(runs: list[SaidRun]) -> None:
    policy, vlm = runs
    renamed_episodes = policy.episodes.assign(item_id="new " + policy.episodes["item_id"])
    color = retention_table([vlm, replace(policy, episodes=renamed_episodes)], vlm_vla=True).vlm_vla[0]
    assert (color.paired, color.p) == (False, None)
    other = replace(policy, episodes=policy.episodes.assign(first_frame_sha256="another"))
    assert retention_table([vlm, other], vlm_vla=True).vlm_vla[0].same_frames is False
    bare = replace(policy, episodes=policy.episodes.drop(columns="first_frame_sha256"))
    assert retention_table([vlm, bare], vlm_vla=True).vlm_vla[0].same_frames is None


def test_a_policy_is_compared_with_the_vlm_it_grew_from(tmp_path: Path) -> None:
    qwen = answer_run(tmp_path / "a", by_chance(1, 0.9), "qwen3-vl")
    gemma = answer_run(tmp_path / "b", by_chance(3, 0.8), "paligemma")
    weights = {"family": "paligemma", "checkpoint": "google/paligemma-3b-pt-224"}
    gemma = replace(gemma, certificate={"policy": weights})
    qwen = replace(qwen, certificate={"policy": {"family": "qwen3-vl", "checkpoint": "Qwen/Qwen3-VL-8B-Instruct"}})
    pi0 = acted(tmp_path / "c", by_chance(2, 0.5), "pi0")
    grown = {"source": "paligemma", "source_weights": {"checkpoint": "google/paligemma-3b-pt-224"}}
    pi0 = replace(pi0, certificate={"policy": grown})
    tiny = acted(tmp_path / "d", by_chance(4, 0.5), "pi0-tiny")
    pairs = {(gap.group, gap.minus) for gap in retention_table([qwen, gemma, pi0, tiny], vlm_vla=True).vlm_vla}
    assert pairs == {("paligemma", "pi0"), ("qwen3-vl", "pi0-tiny"), ("paligemma", "pi0-tiny")}


def test_a_gap_needs_both_kinds(runs: list[SaidRun]) -> None:
    with pytest.raises(UsageError, match="have no such pair"):
        retention_table(runs[:1], vlm_vla=True)


def test_runs_of_one_name_prompt_and_size_have_a_line_each_however_many(tmp_path: Path) -> None:
    same = [answer_run(tmp_path / str(seed), by_chance(seed, 0.7), called=f"seed {seed}") for seed in range(4)]
    (sizes,) = [
        extra_table
        for extra_table in retention_table(same).further_tables
        if extra_table.columns[:2] == ("model", "prompt")
    ]
    assert len({cells[0] for cells in sizes.texts}) == len(sizes.texts) == 4


@pytest.mark.slow
def test_every_format_shows_answers_sizes_and_gaps(runs: list[SaidRun], tmp_path: Path) -> None:
    larger = answer_run(tmp_path / "large", by_chance(5, 0.7), called="large", picture_size="560x480")
    other = answer_run(tmp_path / "other", by_chance(6, 0.7), called="other", prompt="seen")
    table = retention_table([*runs, larger, other], vlm_vla=True)
    console = Console(width=200, record=True, file=StringIO())
    console.print(table.to_rich("all"))
    printed = console.export_text()
    for words in (
        "Accuracy of answers",
        "VLM − VLA",
        "560x480",
        "letter bias",
    ):
        assert words in printed
    markdown = table.to_markdown()
    for words in ("accuracy % [95 %]", "**Accuracy of answers", "**VLM − VLA: ", "| qwen3-vl | seen |"):
        assert words in markdown
    latex = table.to_latex("all")
    assert "accuracy \\,\\%".replace(" ", "") in latex
    assert "VLM $-$ VLA" in latex
    content = json.loads(table.to_json())
    assert len(content["vlm_vla"]) == 9
    assert {"difference", "difference_ci", "accuracy", "sr", "p_holm", "paired"} <= content["vlm_vla"][0].keys()
    assert isinstance(json.loads(retention_table(runs).to_json()), list)
    sizes = next(
        extra_table for extra_table in table.further_tables if extra_table.columns[:2] == ("model", "prompt")
    )
    assert sizes.columns == ("model", "prompt", "224x224", "560x480")
    assert [cells[:2] for cells in sizes.texts] == [("qwen3-vl", "p1"), ("qwen3-vl", "seen")]


GROWN = {name: family for name, family in own_families().items() if family.checkpoints.source_weights is not None}
RIGHT = {"color": np.random.default_rng(0).random((12, 2)) < 0.7}


def vlm(path: Path, card: ModelCard, called: str = "") -> SaidRun:
    return replace(answer_run(path, RIGHT, card.family, called), certificate={"policy": card.to_json()})


def policy(path: Path, card: ModelCard) -> SaidRun:
    return replace(acted(path, RIGHT, card.family), certificate={"policy": card.to_json()})


def card(family: str, checkpoint: str, parameters: int, random: bool = False) -> ModelCard:
    """As a loader fills it; `Family.load` adds what is known of the source."""
    plain = ModelCard(family, checkpoint, "0" * 64, random, parameters, "float32", "cpu", "", (), 0, 0)
    return replace(plain, **find_family(family)._source_of(plain, checkpoint))


def xiaomi(checkpoint: str | None = None, random: bool = False) -> ModelCard:
    return card("xiaomi-r0", checkpoint or str(GROWN["xiaomi-r0"].default_checkpoint), 1, random)


QWEN_4B = card("qwen3-vl", "Qwen/Qwen3-VL-4B-Instruct", 4_437_815_808)
QWEN_32B = card("qwen3-vl", "Qwen/Qwen3-VL-32B-Instruct", 33_357_000_000)
OTHERS = {
    "the same folder's size": (replace(QWEN_4B, checkpoint="my/copy"), "unknown"),
    "a folder of another size": (replace(QWEN_32B, checkpoint="my/copy"), "no"),
    "a untrained network": (replace(QWEN_4B, random_weights=True), "no"),
    "another network": (card("paligemma", "google/paligemma-3b-pt-224", 2_923_466_480), "no"),
}


def test_another_size_of_the_same_family_is_not_the_source(tmp_path: Path) -> None:
    grown = policy(tmp_path / "p", xiaomi())
    assert grew_from(grown, vlm(tmp_path, QWEN_4B)) == "yes"
    assert grew_from(grown, vlm(tmp_path, QWEN_32B)) == "no"


@pytest.mark.parametrize("name", OTHERS)
def test_the_origin_of_a_policy_is_unknown_if_no_hash_or_id_matches(tmp_path: Path, name: str) -> None:
    asked_card, expected = OTHERS[name]
    assert grew_from(policy(tmp_path / "p", xiaomi()), vlm(tmp_path, asked_card)) == expected


def test_a_checkpoint_that_is_not_the_familys_own_grew_from_unknown_weights(tmp_path: Path) -> None:
    mine = policy(tmp_path / "p", xiaomi("my/fine-tune"))
    assert grew_from(mine, vlm(tmp_path, QWEN_4B)) == "unknown"
    assert grew_from(mine, vlm(tmp_path, OTHERS["another network"][0])) == "no"
    assert grew_from(policy(tmp_path / "p", xiaomi(random=True)), vlm(tmp_path, QWEN_4B)) == "no"


def test_runs_of_before_whose_cards_hold_a_family_only_are_unknown(tmp_path: Path) -> None:
    """Their `source` is a name; a run without a certificate has an unknown source."""
    old = acted(tmp_path / "p", RIGHT, "xiaomi-r0", source="qwen3-vl")
    assert grew_from(old, vlm(tmp_path, QWEN_4B)) == "unknown"
    assert grew_from(old, answer_run(tmp_path / "r", RIGHT)) == "unknown"
    assert grew_from(acted(tmp_path / "p", RIGHT), vlm(tmp_path, QWEN_4B)) == "unknown"


@pytest.mark.slow
def test_the_embedded_policies_grew_from_the_embedded_vlm_and_only_from_it(tmp_path: Path) -> None:
    source_vlm = vlm(tmp_path / "r", load_model("vlm-tiny").card)
    untrained = vlm(tmp_path / "t", load_model("vlm-tiny", random_weights=True).card)
    copy_folder = tmp_path / "copy of the VLM"
    shutil.copytree(embedded_checkpoint("vlm-tiny"), copy_folder)
    copied = vlm(tmp_path / "c", load_model("paligemma", str(copy_folder)).card)
    for name in ("pi0-tiny", "pi0-tiny-early", "pi0-tiny-state"):
        acting = policy(tmp_path / name, load_model(name).card)
        assert [grew_from(acting, candidate) for candidate in (source_vlm, untrained, copied)] == [
            "yes",
            "no",
            "yes",
        ]
    assert grew_from(policy(tmp_path / "x", load_model("pi0-tiny", random_weights=True).card), source_vlm) == "no"


def test_the_early_policy_holds_the_weights_that_its_family_declares() -> None:
    """It was stored in half precision before any training."""
    policy_weights = load_file(embedded_checkpoint("pi0-tiny-early") / "model.safetensors")
    source = load_file(embedded_checkpoint("vlm-tiny") / "model.safetensors")
    prefix = "model.paligemma_with_expert.paligemma."
    shared = [name for name in source if prefix + name in policy_weights]
    assert len(shared) > 70
    assert all(torch.equal(source[name].half(), policy_weights[prefix + name].half()) for name in shared)


@pytest.mark.parametrize("name", GROWN)
def test_the_declared_source_is_a_released_size_of_its_family(name: str) -> None:
    family = GROWN[name]
    source, declared = find_family(str(family.checkpoints.source)), family.checkpoints.source_weights
    assert declared is not None
    if source.checkpoints.full_size is None:
        assert asdict(declared)["sha256"] == load_model(source.name).card.weights_sha256
        assert declared.parameters == load_model(source.name).card.parameters
        return
    sizes = {checkpoint: size for size, checkpoint in source.checkpoints.sizes} or {
        source.default_checkpoint: None
    }
    size = sizes[declared.checkpoint]
    network = source.function("full_size")(*([] if size is None else [size]))
    assert sum(parameter.numel() for parameter in network.parameters()) == declared.parameters


def test_a_policy_whose_source_was_asked_is_not_compared_with_other_weights(tmp_path: Path) -> None:
    vlms = [vlm(tmp_path / str(n), model_card, f"vlm {n}") for n, model_card in enumerate((QWEN_4B, QWEN_32B))]
    grown = policy(tmp_path / "p", xiaomi())
    gaps = retention_table([*vlms, grown], vlm_vla=True).vlm_vla
    assert {(gap.group, gap.source) for gap in gaps} == {("vlm 0", "yes")}
    assert {(gap.group, gap.source) for gap in retention_table([vlms[1], grown], vlm_vla=True).vlm_vla} == {
        ("vlm 1", "no")
    }
    unknown = vlm(tmp_path / "u", replace(QWEN_4B, checkpoint="my/copy"), "copy")
    assert {(gap.group, gap.source) for gap in retention_table([*vlms, unknown, grown], vlm_vla=True).vlm_vla} == {
        ("vlm 0", "yes"),
        ("copy", "unknown"),
    }


@pytest.mark.slow
@pytest.mark.parametrize(
    ("card", "words"),
    [
        (QWEN_4B, "the policy grew from these weights"),
        (QWEN_32B, "the policy did NOT grow from these weights"),
        (replace(QWEN_4B, checkpoint="my/copy"), "unknown whether the policy grew from these weights"),
    ],
)
def test_every_format_says_whether_the_vlm_is_the_source(tmp_path: Path, card: ModelCard, words: str) -> None:
    runs = [vlm(tmp_path / "r", card), policy(tmp_path / "p", xiaomi())]
    table = retention_table(runs, vlm_vla=True)
    console = Console(width=300, record=True, file=StringIO())
    console.print(table.to_rich("all"))
    pages = (table.to_markdown(), table.to_latex("all"), report_html(runs, table), console.export_text())
    assert [words in " ".join(page.split()) for page in pages] == [True] * 4
