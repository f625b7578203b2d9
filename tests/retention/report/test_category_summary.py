"""What a report opens with: known, encoded, used, in a sentence per category."""

from dataclasses import replace
from typing import Any

from probe_kit._terminal.console import out
from probe_kit.retention import RetentionRow
from probe_kit.retention.behaviour.success_rate import Regime, SuccessRate
from probe_kit.retention.report.category_summary import policy_summaries, verdict
from probe_kit.retention.rows.parts import AnswerStats, BackbonePart, RunInfo, SwapEffect
from probe_kit.retention.rows.row import MEAN


def row(
    mode: str, category: str, sr: float | None = 0.5, regime: Regime | None = None, **run: Any
) -> RetentionRow:
    """Of a run that answers or acts. run: fields of its `RunInfo`."""
    plain: dict[str, Any] = {
        "location": mode, "model": "pi0-tiny" if mode == "acts" else "vlm-tiny", "random_weights": False,
        "weights_sha256": None, "suite": "suite@1", "settings": "r", "probes": None,
    }  # fmt: skip
    return RetentionRow(
        category=category,
        view=None,
        run=RunInfo(mode=mode, **{**plain, **run}),  # type: ignore[arg-type]
        success=SuccessRate(n_episodes=48, n_items=24, sr=sr, regime=regime),
    )


def answers(category: str, sr: float = 1.0, picture: str | None = None, **run: Any) -> RetentionRow:
    made = row("answers", category, sr, Regime.KNOWLEDGE if sr > 0.7 else None, **run)
    return replace(made, answers=AnswerStats(picture=picture))


def acts(category: str, backbone: float | None, used: str | None, sr: float = 0.5, **run: Any) -> RetentionRow:
    chance = None if backbone is None else backbone > 0.7
    return replace(
        row("acts", category, sr, Regime.KNOWLEDGE if sr > 0.7 else None, **run),
        view="mean",
        backbone=BackbonePart(score=backbone, exceeds={"chance": chance}),
        image_swap=SwapEffect(used=used),
    )


ROWS = [
    answers("color"), answers("state"), answers("counting", 0.5), answers(MEAN),
    acts("color", 1.0, "used", 0.9375), acts("state", 0.979, "encoded, unused"), acts("counting", 0.52, "absent"),
    acts(MEAN, 0.83, "used"),
]  # fmt: skip


def test_every_category_is_a_sentence_with_the_numbers_it_rests_on() -> None:
    (story,) = policy_summaries(ROWS)
    assert (story.policy, story.reader) == ("pi0-tiny", "vlm-tiny")
    assert [one.outcome for one in story.categories] == [
        "known; used", "known; encoded, unused", "not known; absent",
    ]  # fmt: skip
    color, state, counting = (one.sentence for one in story.categories)
    assert color == (
        "Color: the reader knows it (answers 100.0 % of the questions right), the answer can be read in the "
        "policy's backbone (probe 100.0 %), and the policy acts on it (right in 93.8 % of the episodes)."
    )
    assert all(words in state for words in ("knows it", "probe 97.9 %", "does not act on it"))
    assert all(words in counting for words in ("does not know it", "cannot be read"))


def test_without_a_reader_nothing_is_said_of_knowing() -> None:
    for rows in (
        ROWS[4:],
        [*ROWS[4:], answers("color", suite="another@1")],
        [*ROWS[4:], answers("color", picture="none")],
    ):
        (story,) = policy_summaries(rows)
        assert story.reader == ""
        assert {one.reader_above_chance for one in story.categories} == {None}
        assert "reader" not in story.categories[0].sentence


def test_a_category_that_was_not_asked_about_is_told_without_the_reader() -> None:
    (story,) = policy_summaries([answers("state"), *ROWS[4:]])
    assert [one.reader_above_chance for one in story.categories] == [None, True, None]


def test_every_probed_policy_has_its_story_by_its_first_view() -> None:
    again = replace(acts("color", 0.6, "absent"), view="mean:language")
    rows = [*ROWS, again, acts("color", 0.5, "absent", location="untrained", random_weights=True)]
    first, untrained = policy_summaries(rows)
    assert (first.policy, untrained.policy) == ("pi0-tiny", "pi0-tiny (random weights)")
    assert [len(one.categories) for one in (first, untrained)] == [3, 1]


def test_a_run_that_did_not_act_or_was_not_probed_has_none() -> None:
    assert policy_summaries([acts("color", 1.0, "used", capture_only=True)]) == []
    assert policy_summaries([acts("color", None, "used")]) == []


def test_used_is_said_only_where_an_intervention_was_stored() -> None:
    assert verdict(acts("color", 1.0, None, 0.95)) == "acted on"
    assert verdict(acts("color", 1.0, None, 0.5)) == "encoded, not acted on"
    assert verdict(acts("color", 0.5, None, 0.95)) == "acted on, not found"
    assert verdict(acts("color", 0.5, None, 0.5)) == "absent"
    assert verdict(acts("color", 0.5, "used", 0.5)) == "used"


def test_the_table_fits_a_narrow_terminal() -> None:
    (story,) = policy_summaries(ROWS)
    with out.capture() as printed:
        out.print(story.to_rich(), width=80)
    text = printed.get()
    assert "vlm-tiny · pi0-tiny" in text
    for said in ("yes (97.9)", "no (52.0)", "encoded, unused (50.0)", "used (93.8)"):
        assert said in text
