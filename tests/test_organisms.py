"""The verdict over a row, and the truths the organisms were made to have."""

from dataclasses import replace

import pytest

from probe_kit.console import out
from probe_kit.organisms import ORGANISMS, READER, TRAINED, Finding, to_rich, verdict
from probe_kit.retention import RetentionRow
from probe_kit.retention.success import regime


def row(sr: float, p: float | None, **beats: bool) -> RetentionRow:
    """p: of the backbone's best site against chance."""
    chance = None if p is None else p < 0.05
    return RetentionRow(
        run="run", model="pi0-tiny", random_weights=False, weights_sha256="0" * 64, suite="suite@1",
        run_settings="s", probe_settings="p", category="color", view="mean", n_episodes=48, n_items=24, sr=sr,
        regime=regime(sr, 0.14, 1 - sr, 0.0)[0], prefix_accuracy=0.9, prefix_p_fwe=p,
        prefix_beats={"chance": chance, "binding": None, "twin": None} | beats,
    )  # fmt: skip


@pytest.mark.parametrize(
    ("sr", "p", "expected"),
    [
        (0.9, 0.005, "used"),
        (0.64, 0.005, "encoded, unused"),
        (0.02, 0.005, "encoded, unused"),
        (0.5, 0.2, "absent"),
        (0.5, None, "absent"),
        (0.9, 0.2, "acted on, not found"),
    ],
)
def test_the_verdict_asks_whether_it_is_in_the_backbone_and_whether_it_is_acted_on(
    sr: float, p: float | None, expected: str
) -> None:
    assert verdict(row(sr, p)) == expected


@pytest.mark.parametrize("control", ["binding", "twin"])
def test_what_is_no_better_than_a_control_is_absent(control: str) -> None:
    """Color of the random twin had p = 0.005 against chance, and knew nothing."""
    assert verdict(row(0.5, 0.005, **{control: False})) == "absent"
    assert verdict(row(0.5, 0.005, **{control: True})) == "encoded, unused"


def test_only_the_trained_organism_knows_anything() -> None:
    assert TRAINED.expected("state") == "encoded, unused"
    assert TRAINED.expected("counting") == "absent"
    assert {organism.expected("color") for organism in ORGANISMS if organism != TRAINED} == {"absent"}


def test_the_table_shows_the_margin_that_decides() -> None:
    """Over 48 episodes Δ is 14.1 points, over their 24 items 20.0, and that is what the verdict rests on."""
    shown = replace(row(0.66, 0.3), delta=0.1414, delta_regime=0.2001)
    with out.capture() as printed:
        out.print(to_rich([Finding("trained", "color", "used", verdict(shown), shown)]), width=160)
    text = printed.get()
    assert "20.0" in text
    assert "14.1" not in text


def test_the_table_counts_the_true_verdicts() -> None:
    findings = [
        Finding("trained", "color", "used", "used", row(0.9, 0.005)),
        Finding("trained", "state", "encoded, unused", "absent", row(0.5, 0.3)),
    ]
    with out.capture() as printed:
        out.print(to_rich(findings), width=100)
    text = printed.get()
    assert "1 of 2 verdicts are true" in text
    assert "encoded" in text


@pytest.mark.parametrize(("sr", "expected"), [(0.9, "known"), (0.6, "unknown"), (0.5, "unknown")])
def test_a_reader_knows_what_it_answers_far_from_one_half(sr: float, expected: str) -> None:
    assert verdict(replace(row(sr, None), kind="asks")) == expected
    assert READER.expected("state") == "known"
    assert READER.expected("counting") == "unknown"
