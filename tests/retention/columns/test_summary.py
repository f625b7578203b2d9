"""The summary: one table, and a sentence per category, from one definition for every format."""

import json
from dataclasses import replace
from typing import Any

import pytest
from rich.console import Console

from probe_kit.intervene import Behaviour, UseVerdict
from probe_kit.retention import RetentionRow, RetentionTable
from probe_kit.retention.behaviour import Regime, SuccessRate
from probe_kit.retention.columns.summary import HEADINGS, MARK, summarise_runs, summary_table
from probe_kit.retention.columns.text import warnings_of
from probe_kit.retention.rows.row import (
    MEAN,
    ActionPart,
    AnswerStats,
    BackbonePart,
    RetentionPart,
    RunInfo,
    SwapEffect,
)


def row(mode: str, category: str, sr: float | None = 0.5, **run: Any) -> RetentionRow:
    """Of a run that answers or acts. run: fields of its `RunInfo`."""
    plain: dict[str, Any] = {
        "location": mode, "model": "pi0-tiny" if mode == "acts" else "vlm-tiny", "random_weights": False,
        "weights_sha256": None, "suite": "suite@1", "settings": "r", "probes": None, "action_stream": "expert",
    }  # fmt: skip
    regime = None if sr is None else Regime.KNOWLEDGE if sr > 0.7 else Regime.NO_RELIABLE_KNOWLEDGE
    ci = None if sr is None else (sr - 0.1, min(1.0, sr + 0.1))
    return RetentionRow(
        category=category,
        view=None,
        run=RunInfo(mode=mode, **{**plain, **run}),  # type: ignore[arg-type]
        success=SuccessRate(n_episodes=48, n_items=24, sr=sr, ci=ci, regime=regime, chance_margin=0.2),
    )


def answers(category: str, sr: float = 1.0, picture: str | None = None, **run: Any) -> RetentionRow:
    return replace(row("answers", category, sr, **run), answers=AnswerStats(picture=picture))


def acts(
    category: str, backbone: float | None, used: Behaviour | None, sr: float | None = 0.5, **run: Any
) -> RetentionRow:
    exceeds = backbone is not None and backbone > 0.7
    part: dict[str, Any] = {
        "score": backbone,
        "ci": (0.4, 1.0),
        "at_most": 0.78,
        "exceeds": {"chance": exceeds, "random-features": True},
    }
    part["verdict"] = None if backbone is None else "shown" if exceeds else "not shown"
    return replace(
        row("acts", category, sr, **run),
        view="mean",
        backbone=BackbonePart(**part),
        action=ActionPart(**part),
        retention=RetentionPart(value=1.0, ci=(0.8, 1.2), defined=exceeds),
        image_swap=SwapEffect(
            follow_rate=0.04, net_follow_rate_ci=(-0.1, 0.12), use=UseVerdict(behaviour=used, reason="by the swap")
        )
        if used
        else SwapEffect(),
    )


ASKED = [answers("color"), answers("state"), answers("counting", 0.5), answers(MEAN, 0.83)]
ACTED = [
    acts("color", 1.0, "used", 0.9375), acts("state", 0.979, "not used", 0.66),
    acts("counting", 0.52, "not used"), acts(MEAN, 0.83, None),
]  # fmt: skip


ELSEWHERE = [answers(name, suite="another@1") for name in ("color", MEAN)]
BLIND = [answers(name, picture="none") for name in ("color", MEAN)]


@pytest.mark.parametrize("rows", [ACTED, [*ACTED, *ELSEWHERE], [*ACTED, *BLIND]])
def test_a_policy_stands_alone_where_no_vlm_was_asked_the_same(rows: list[RetentionRow]) -> None:
    summary = next(summarised for summarised in summarise_runs(rows) if summarised.run == "pi0-tiny")
    assert summary.vlm == ""
    assert all("VLM" not in sentence for sentence in summary.sentences)


def test_a_vlm_without_a_policy_is_described_as_answering() -> None:
    (summary,) = summarise_runs(ASKED)
    assert summary.sentences[0] == "Color     known: the VLM answers right in 100 %."
    assert summary.categories[0].details == "Color: The VLM knows the answer."
    assert summary_table([summary]).columns == ("category", "VLM %", "verdict")


def test_every_number_has_its_interval_and_a_mark_where_it_exceeds_every_control() -> None:
    (summary,) = summarise_runs([*ASKED, *ACTED])
    table = summary_table([summary])
    assert table.columns == ("category", *HEADINGS[3:])
    color, _, counting, mean = table.texts
    assert color == (
        "Color", f"100 [90, 100] {MARK}", f"100 [40, 100] {MARK}", f"100 [40, 100] {MARK}", f"94 [84, 100] {MARK}",
        "1.00 [0.80, 1.20]", "used",
    )  # fmt: skip
    assert counting[-2:] == ("n/a", "not shown")
    assert mean[0] == "Mean"
    assert mean[-1] == ""


def test_the_legend_explains_brackets_only_where_a_cell_has_them() -> None:
    explained = "in brackets: the 95 % interval, with groups as the unit"
    assert explained in summary_table(summarise_runs([*ASKED, *ACTED])).notes
    bare = [replace(answer_row, success=replace(answer_row.success, ci=None)) for answer_row in ASKED]
    assert explained not in summary_table(summarise_runs(bare)).notes


def test_the_legend_claims_controls_for_probes_alone() -> None:
    both = f"{MARK} above chance; of probes, above every control that was run too"
    assert both in summary_table(summarise_runs([*ASKED, *ACTED])).notes
    answered = summary_table(summarise_runs(ASKED))
    assert f"{MARK} above chance" in answered.notes
    assert "control" not in " ".join(answered.notes)


def test_nothing_is_marked_where_no_control_was_run_and_a_warning_names_the_run() -> None:
    bare = [
        replace(
            acted_row,
            backbone=replace(
                acted_row.backbone, exceeds={"chance": True, "random-features": None, "untrained": None}
            ),
            action=replace(acted_row.action, exceeds={"chance": True}),
            run=replace(acted_row.run, location="bare", label="bare"),
        )
        for acted_row in ACTED
    ]
    (summary,) = summarise_runs(bare)
    table = summary_table([summary])
    backbone, action, success = (table.columns.index(name) for name in ("backbone %", "action %", "success %"))
    assert MARK not in table.texts[0][backbone] + table.texts[0][action]
    assert MARK in table.texts[0][success]
    assert "No control was run: a signal is judged against chance only" in " ".join(table.notes)
    both = summary_table(summarise_runs([*ACTED, *bare]))
    assert "No control was run for bare:" in " ".join(both.notes)
    assert "No control" not in " ".join(summary_table(summarise_runs(ACTED)).notes)
    deep = [
        replace(
            bare_row, backbone=replace(bare_row.backbone, depth=0.5), action=replace(bare_row.action, depth=1.0)
        )
        for bare_row in bare
    ]
    assert any("No control was run" in warning for warning in warnings_of(deep[-1], deep[:-1]))


def test_several_runs_stand_in_one_table_by_category() -> None:
    again = [replace(acted_row, run=replace(acted_row.run, location="b", label="early")) for acted_row in ACTED]
    summaries = summarise_runs([*ACTED, *again])
    table = summary_table(summaries)
    assert [cells[:2] for cells in table.texts[:2]] == [("Color", "pi0-tiny"), ("Color", "early")]


@pytest.mark.parametrize("width", [80, 100, 120, 200])
def test_the_terminal_shows_one_table_at_any_width_and_ends_on_the_sentences(width: int) -> None:
    everything = [*ASKED, *ACTED]
    rows = [category_row for category_row in everything if category_row.category != MEAN]
    means = [category_row for category_row in everything if category_row.category == MEAN]
    console = Console(width=width, record=True)
    with console.capture() as printed:
        console.print(RetentionTable(rows, means).to_rich())
    text = printed.get()
    assert text.count("category") == 1, "one header: one table, and it is not split"
    assert "[40, 100]" in text.split("Counting  ")[0], "a narrow table has intervals below their values"
    assert " ".join(text.split()).endswith("next: probe-kit power how many items would show what is open")
    assert "State     not used: the VLM knows the answer and probes read it in the backbone" in text


@pytest.mark.parametrize(
    ("first", "second", "readouts", "expected", "legend"),
    [
        (
            "used",
            None,
            "first-chunk",
            "used in the first chunk",
            "of the first chunk of actions; --readout per-step gives",
        ),
        ("used", None, "per-step", "used over the whole episode", "of the whole episode"),
        (
            "not used",
            "used",
            "first-chunk",
            "chunk: by the swap; it is used over the whole episode",
            "of the first",
        ),
        ("used", "not used", "per-step", "chunk: by the swap; it is used over the whole episode", "of the first"),
        (
            "used",
            "used",
            "first-chunk",
            "used in the first chunk and over the whole episode",
            "and which of the whole",
        ),
    ],
)
def test_terminal_markdown_and_json_say_the_same_of_first_chunk_and_whole_episode(
    first: Behaviour, second: Behaviour | None, readouts: str, expected: str, legend: str
) -> None:
    """first: of the verdict's own readout, second: of the other one."""
    other = {"first-chunk": "per-step", "per-step": "first-chunk"}[readouts]
    second_use = None if second is None else UseVerdict(behaviour=second, reason="by the swap", readout=other)
    use = UseVerdict(behaviour=first, reason="by the swap", readout=readouts, other=second_use)
    color = acts("color", 1.0, "used")
    rows = [replace(color, image_swap=replace(color.image_swap, use=use))]
    table = RetentionTable(rows, [acts(MEAN, 1.0, None)])
    differ = second not in (None, first)
    verdict = "first chunk not used; episode used" if differ else "used"
    with (console := Console(width=200)).capture() as printed:
        console.print(table.to_rich("all"))
    text, (stored, _) = " ".join(printed.get().split()), json.loads(table.to_json())
    assert stored["verdict"] == verdict
    assert expected in stored["conclusion"]
    for rendering in (text, " ".join(table.to_markdown().split())):
        assert verdict in rendering
        assert stored["conclusion"] in rendering
        assert legend in rendering


def test_of_a_model_that_did_not_act_nothing_is_said_of_acting() -> None:
    summarised = (
        acts(name, score, None, None, capture_only=True) for name, score in (("color", 1.0), ("shape", 0.5))
    )
    rows = [*summarised, acts(MEAN, 0.75, None, None, capture_only=True)]
    (summarised,) = summarise_runs(rows)
    color, shape = (category.details for category in summarised.categories)
    assert color == "Color: Shown in the backbone."
    assert shape.endswith(
        "Not shown in the backbone: `probe-kit power` simulates how many items would show it."
    ), "the groups of items are not known"
    assert "success" not in " ".join(cell for line in summary_table([summarised]).texts for cell in line)


def test_a_category_goes_by_its_title() -> None:
    (summary,) = summarise_runs([answers("public-info"), answers("ripe-fruit"), answers(MEAN)])
    assert [category.name for category in summary.categories] == ["Public Info", "Ripe fruit"]
