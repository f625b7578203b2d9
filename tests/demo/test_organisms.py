"""The verdict over a row, and the truths the organisms were made to have."""

from dataclasses import replace
from pathlib import Path
from typing import get_args

import pytest

from probe_kit._terminal.console import out
from probe_kit.demo.pipeline import (
    COMPATIBLE,
    DOES_NOT_DECIDE,
    EARLY,
    ORGANISMS,
    OTHER_TWINS,
    STATE_USED,
    TRAINED,
    UNTRAINED_NETWORK,
    VLM,
    OrganismVerdict,
    measure_truth,
    organism_table,
    settings_of,
    source_of,
)
from probe_kit.errors import SettingsMismatchError
from probe_kit.extract import extract_run
from probe_kit.intervene import ImageSwap, InstructionSwap, UseVerdict, run_intervention
from probe_kit.intervene.verdict import Behaviour
from probe_kit.retention import RetentionRow
from probe_kit.retention.behaviour import SuccessRate, regime
from probe_kit.retention.columns.text import verdict
from probe_kit.retention.rows.row import BackbonePart, RunInfo, SwapEffect
from probe_kit.suite import Suite


def row(sr: float, p: float | None, **controls: bool) -> RetentionRow:
    """p: of the backbone's best site against chance."""
    chance = None if p is None else p < 0.05
    run = RunInfo(
        location="run", model="pi0-tiny", random_weights=False, weights_sha256="0" * 64, suite="suite@1",
        settings="s", probes="p",
    )  # fmt: skip
    return RetentionRow(
        category="color",
        view="mean",
        run=run,
        success=SuccessRate(n_episodes=48, n_items=24, sr=sr, regime=regime(sr, 0.14, 1 - sr, 0.0)[0]),
        backbone=BackbonePart(
            score=0.9, p_fwe=p, exceeds={"chance": chance, "random-features": None, "untrained": None} | controls
        ),
    )


@pytest.mark.parametrize(
    ("sr", "p", "expected"),
    [
        (0.9, 0.005, "shown, success"),
        (0.64, 0.005, "shown, success not shown"),
        (0.02, 0.005, "shown, failure"),
        (0.5, 0.2, "not shown"),
        (0.5, None, "not shown"),
        (0.9, 0.2, "not shown, success"),
    ],
)
def test_the_verdict_asks_whether_it_is_in_the_backbone_and_whether_it_is_acted_on(
    sr: float, p: float | None, expected: str
) -> None:
    assert verdict(row(sr, p)) == expected


def test_absent_is_said_only_where_the_best_site_is_below_the_bound() -> None:
    table_row = row(0.5, 0.2)
    assert verdict(replace(table_row, backbone=replace(table_row.backbone, verdict="absent"))) == "absent"


@pytest.mark.parametrize("control", ["random-features", "untrained"])
def test_an_accuracy_that_does_not_exceed_a_control_is_not_shown(control: str) -> None:
    """Color of the untrained network had p = 0.005 against chance, and knew nothing."""
    assert verdict(row(0.5, 0.005, **{control: False})) == "not shown"
    assert verdict(row(0.5, 0.005, **{control: True})) == "shown, success not shown"


def test_organisms_differ_in_one_truth_at_a_time() -> None:
    assert (TRAINED.expected("color"), TRAINED.expected("state")) == ("used", "not used")
    assert {EARLY.expected(category) for category in ("color", "shape", "state")} == {DOES_NOT_DECIDE}
    assert dict(STATE_USED.truth) == {**dict(TRAINED.truth), "state": "used"}
    assert {organism.expected("counting") for organism in ORGANISMS} == {"absent"}
    untrained = [organism for organism in ORGANISMS if organism.random_weights]
    assert untrained == [UNTRAINED_NETWORK, *OTHER_TWINS]
    assert [organism.weights_seed for organism in untrained] == [0, 1, 2]
    assert {organism.expected(category) for organism in untrained for category in ("color", "state")} == {"absent"}


@pytest.mark.parametrize(
    ("p", "bounded", "is_shown", "expected"),
    [
        (0.005, True, True, "not used"),
        (0.005, True, False, "undecided"),
        (0.005, False, True, "undecided"),
        (0.3, False, True, "undecided"),
        (0.3, True, False, "absent"),
    ],
)
def test_what_the_trained_one_follows_is_the_control_of_those_that_follow_nothing(
    p: float, bounded: bool, is_shown: bool, expected: str
) -> None:
    use = UseVerdict(behaviour="undecided", reason="why", lacks_control=bounded)
    alone = replace(row(0.4, p), image_swap=SwapEffect(use=use))
    assert measure_truth(alone, is_shown) == expected
    follows = UseVerdict(behaviour="used", reason="why")
    assert measure_truth(replace(alone, image_swap=SwapEffect(use=follows)), is_shown) == "used"


@pytest.mark.slow
def test_a_random_network_of_another_seed_is_found_again(small_suite: Suite, tmp_path: Path) -> None:
    """Its pictures are exchanged before its own weights; those of another seed are refused."""
    other = replace(OTHER_TWINS[0], max_steps=1)
    settings = settings_of(other, small_suite).changed(categories=("color",), items=2, video="none", env_workers=0)
    run = extract_run(settings, tmp_path / "run")
    assert len(run_intervention(run, ImageSwap(), source_of(other, small_suite)).table) == 1
    with pytest.raises(SettingsMismatchError, match="weights"):
        run_intervention(run, InstructionSwap(), source_of(UNTRAINED_NETWORK, small_suite))


def test_organisms_have_a_name_and_a_folder_of_their_own() -> None:
    everybody = (VLM, *ORGANISMS)
    assert (
        len({organism.name for organism in everybody})
        == len({organism.folder for organism in everybody})
        == len(everybody)
    )


def test_the_table_shows_the_margin_that_decides() -> None:
    """Over 48 episodes Δ is 14.1 points, over their 24 items 20.0, and that is what the verdict rests on."""
    table_row = row(0.66, 0.3)
    margins = {"chance_margin_episodes": 0.1414, "chance_margin": 0.2001}
    changed_row = replace(table_row, success=replace(table_row.success, **margins))
    with out.capture() as printed:
        out.print(
            organism_table([OrganismVerdict("trained", "color", "used", verdict(changed_row), changed_row)]),
            width=160,
        )
    text = printed.get()
    assert "20.0" in text
    assert "14.1" not in text


def test_the_table_counts_the_true_verdicts() -> None:
    findings = [
        OrganismVerdict("trained", "color", "used", "used", row(0.9, 0.005)),
        OrganismVerdict("trained", "state", "not used", "absent", row(0.5, 0.3)),
        OrganismVerdict("early", "state", DOES_NOT_DECIDE, "undecided", row(0.5, 0.3)),
    ]
    with out.capture() as printed:
        out.print(organism_table(findings), width=160)
    text = " ".join(printed.get().split())
    assert "1 of 3 verdicts are true, 1 undecided, 1 is wrong" in text
    assert "*not used* and *moves with it, does not decide* are both true of it" in text
    assert [text.count(f" {label} ") for label in ("absent wrong", "undecided undecided")] == [1, 1]


@pytest.mark.parametrize(
    ("expected", "verdict", "agreement"),
    [
        (DOES_NOT_DECIDE, "not used", "true"),
        (DOES_NOT_DECIDE, "moves with it, does not decide", "true"),
        (DOES_NOT_DECIDE, "against: moves with it, does not decide", "true"),
        (DOES_NOT_DECIDE, "undecided", "undecided"),
        (DOES_NOT_DECIDE, "partly used, graded", "wrong"),
        (DOES_NOT_DECIDE, "against: used", "wrong"),
        (DOES_NOT_DECIDE, "absent", "wrong"),
        ("not used", "moves with it, does not decide", "wrong"),
        ("used", "undecided", "undecided"),
    ],
)
def test_a_verdict_is_true_undecided_or_wrong(expected: str, verdict: str, agreement: str) -> None:
    """An expert of random weights was not trained to choose by the answer, nor to ignore it."""
    assert OrganismVerdict("early", "state", expected, verdict, row(0.5, 0.3)).agreement == agreement


def test_every_compatible_verdict_is_one_that_the_instrument_gives() -> None:
    possible = {f"{against}{behaviour}" for behaviour in get_args(Behaviour) for against in ("", "against: ")}
    assert {compatible for verdicts in COMPATIBLE.values() for compatible in verdicts} <= possible


@pytest.mark.parametrize(("sr", "expected"), [(0.9, "known"), (0.6, "not shown"), (0.5, "not shown")])
def test_a_vlm_knows_what_it_answers_far_from_one_half(sr: float, expected: str) -> None:
    table_row = row(sr, None)
    assert verdict(replace(table_row, run=replace(table_row.run, mode="answers"))) == expected
    assert VLM.expected("state") == "known"
    assert VLM.expected("counting") == "not shown"
