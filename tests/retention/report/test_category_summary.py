"""What a report opens with: known, encoded, used, in a sentence per category."""

from typing import Any

import pytest

from probe_kit._terminal.console import out
from probe_kit.retention import RetentionRow
from probe_kit.retention.behaviour.success_rate import Regime
from probe_kit.retention.report.category_summary import policy_summaries
from probe_kit.retention.rows.row import MEAN


def row(kind: str, category: str, **fields: Any) -> RetentionRow:
    plain: dict[str, Any] = {
        "run": kind, "model": "pi0-tiny" if kind == "acts" else "vlm-tiny", "random_weights": False,
        "weights_sha256": None, "suite": "suite@1", "run_settings": "r", "probe_settings": None, "view": None,
        "n_episodes": 48, "n_items": 24, "sr": 0.5,
    }  # fmt: skip
    return RetentionRow(kind=kind, category=category, **{**plain, **fields})


def answers(category: str, sr: float = 1.0, **fields: Any) -> RetentionRow:
    return row("asks", category, sr=sr, regime=Regime.KNOWLEDGE if sr > 0.7 else None, **fields)


def acts(category: str, backbone: float | None, used: str, sr: float = 0.5, **fields: Any) -> RetentionRow:
    chance = None if backbone is None else backbone > 0.7
    beats = {"backbone_exceeds": {"chance": chance}, "backbone_accuracy": backbone, "used": used}
    return row("acts", category, sr=sr, view="mean", **beats, **fields)


ROWS = [
    answers("color"), answers("state"), answers("counting", 0.5), answers(MEAN),
    acts("color", 1.0, "used", 0.9375), acts("state", 0.979, "encoded, unused"), acts("counting", 0.52, "absent"),
    acts(MEAN, 0.83, "used"),
]  # fmt: skip


def test_every_category_is_a_sentence_with_the_numbers_it_rests_on() -> None:
    (story,) = policy_summaries(ROWS)
    assert (story.policy, story.reader) == ("pi0-tiny", "vlm-tiny")
    assert [one.outcome for one in story.chapters] == [
        "known; used", "known; encoded, unused", "not known; absent",
    ]  # fmt: skip
    color, state, counting = (one.sentence for one in story.chapters)
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
        assert {one.known for one in story.chapters} == {None}
        assert "reader" not in story.chapters[0].sentence


def test_a_category_that_was_not_asked_about_is_told_without_the_reader() -> None:
    (story,) = policy_summaries([answers("state"), *ROWS[4:]])
    assert [one.known for one in story.chapters] == [None, True, None]


def test_every_probed_policy_has_its_story_by_its_first_view() -> None:
    again = RetentionRow(**{**vars(acts("color", 0.6, "absent")), "view": "mean:language"})
    rows = [*ROWS, again, acts("color", 0.5, "absent", run="twin", random_weights=True)]
    first, twin = policy_summaries(rows)
    assert (first.policy, twin.policy) == ("pi0-tiny", "pi0-tiny (random weights)")
    assert [len(one.chapters) for one in (first, twin)] == [3, 1]


@pytest.mark.parametrize("fields", [{"listened": True}, {"backbone_accuracy": None}])
def test_who_only_listened_or_was_not_probed_has_none(fields: dict[str, Any]) -> None:
    plain = vars(acts("color", 1.0, "used"))
    assert policy_summaries([RetentionRow(**{**plain, **fields})]) == []


def test_the_table_fits_a_narrow_terminal() -> None:
    (story,) = policy_summaries(ROWS)
    with out.capture() as printed:
        out.print(story.to_rich(), width=80)
    text = printed.get()
    assert "vlm-tiny · pi0-tiny" in text
    for said in ("yes (97.9)", "no (52.0)", "encoded, unused (50.0)", "used (93.8)"):
        assert said in text
