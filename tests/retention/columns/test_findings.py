"""The last lines of a command: a sentence for every combination of verdicts, and the next step."""

import re
from dataclasses import replace
from itertools import product
from pathlib import Path
from typing import Any

import pytest

from probe_kit.intervene.verdict import UseVerdict
from probe_kit.retention.behaviour import Regime
from probe_kit.retention.columns.summary import MOST_NUMBERS, MOST_WORDS, count_words, finding, next_step
from probe_kit.retention.rows.row import ActionPart, BackbonePart, RetentionRow, SwapEffect
from tests.retention.columns.test_summary import answers, row


def stream(verdict: str, exceeds: dict[str, bool | None]) -> dict[str, Any]:
    score = 0.98 if verdict == "shown" else 0.55
    return {"score": score, "ci": (0.4, 1.0), "at_most": 0.78, "verdict": verdict, "exceeds": exceeds}


MORE_PERMUTATIONS = "train with --permutations 20 or more"
STREAMS: dict[str, dict[str, Any]] = {
    "shown": stream("shown", {"chance": True, "random-features": True}),
    "absent": stream("absent", {"chance": False}),
    "not shown": stream("not shown", {"chance": False, "random-features": None}),
    "as random features": stream("not shown", {"chance": True, "random-features": False}),
    "no permutations": stream("not shown", {"chance": None}) | {"remedy": MORE_PERMUTATIONS},
    "few permutations": stream("not shown", {"chance": False}) | {"remedy": MORE_PERMUTATIONS},
    "few groups": stream("not shown", {"chance": False}) | {"remedy": "extract more items"},
    "no score": {"exceeds": {"chance": True}},
    "not probed": {},
}
OTHER_READOUT = UseVerdict(behaviour="used", reason="", readout="per-step")
USES: dict[str, UseVerdict | None] = {
    "no swap": None,
    "used": UseVerdict(behaviour="used", reason=""),
    "used in reverse": UseVerdict(behaviour="used", reason="", reversed=True),
    "one-sided": UseVerdict(behaviour="partly used, one-sided", reason="", side="left"),
    "graded": UseVerdict(behaviour="partly used, graded", reason=""),
    "moves": UseVerdict(behaviour="moves with it, does not decide", reason=""),
    "not used": UseVerdict(behaviour="not used", reason=""),
    "used later": UseVerdict(behaviour="not used", reason="", other=OTHER_READOUT),
    "open": UseVerdict(behaviour="undecided", reason=""),
    "no control": UseVerdict(behaviour="undecided", reason="", lacks_control=True),
}
RATES: dict[str, tuple[float | None, Regime | None]] = {
    "success": (0.94, Regime.KNOWLEDGE),
    "guessing": (0.55, Regime.NO_RELIABLE_KNOWLEDGE),
    "failure": (0.1, Regime.FAILURE),
    "did not act": (None, None),
}


def policy(backbone: str, action: str, use: str, rate: str) -> RetentionRow:
    sr, regime = RATES[rate]
    plain = row("acts", "public-info", sr, capture_only=sr is None)
    swap = SwapEffect() if USES[use] is None else SwapEffect(use=USES[use])
    return replace(
        plain, view=None if backbone == "not probed" else "mean",
        success=replace(plain.success, regime=regime, n_groups=12),
        backbone=BackbonePart(**STREAMS[backbone]), action=ActionPart(**STREAMS[action]), image_swap=swap,
    )  # fmt: skip


ASKED = {"": None, "known": answers("public-info", 0.96), "not known": answers("public-info", 0.5)}


def test_every_sentence_is_short_and_has_no_brackets_whatever_the_verdicts() -> None:
    for backbone, action, use, rate, asked in product(STREAMS, STREAMS, USES, RATES, ASKED):
        text = finding(policy(backbone, action, use, rate), ASKED[asked])
        named = f"Color {text}"
        assert count_words(named) <= MOST_WORDS, (count_words(named), named)
        assert len(re.findall(r"\d+", text)) <= MOST_NUMBERS, text
        assert re.fullmatch(r"[a-z][a-z ,]*: .*[a-z%]\.", text), text
        assert not re.search(r"[][()]|None|–|nan|  |; ;|\.\.", text), text


def table() -> list[list[str]]:
    """The lines of findings.md."""
    text = Path(__file__).with_name("findings.md").read_text(encoding="utf-8")
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in text.splitlines()[4:]]


@pytest.mark.parametrize(("asked", "backbone", "use", "rate", "sentence"), table())
def test_each_combination_of_verdicts_has_this_sentence(
    asked: str, backbone: str, use: str, rate: str, sentence: str
) -> None:
    action = "shown" if backbone == "shown" else "not probed"
    assert finding(policy(backbone, action, use, rate), ASKED[asked]) == sentence


def test_the_sentences_say_where_the_answer_is_lost_between_backbone_and_action() -> None:
    actions = ("shown", "absent", "not shown")
    held, lost, open_ = (finding(policy("shown", action, "not used", "guessing")) for action in actions)
    assert "in the backbone and the action expert, the action does not follow it" in held
    assert "in the backbone, absent in the action expert, the action does not follow it" in lost
    assert "in the backbone, not shown in the action expert, the action does not follow it" in open_


@pytest.mark.parametrize(
    ("sr", "said"),
    [
        (1.0, "known: the VLM answers right in 100 %."),
        (0.5, "not shown: the VLM answers right in 50 %, which guessing can reach."),
    ],
)
def test_a_vlm_alone_knows_or_is_not_shown_to_know(sr: float, said: str) -> None:
    assert finding(answers("color", sr)) == said


def test_the_next_step_is_the_command_for_what_is_open() -> None:
    unprobed, untested = (
        policy("not probed", "not probed", "no swap", "success"),
        policy("shown", "shown", "no swap", "success"),
    )
    names = ("not shown", "few permutations", "shown")
    unshown, untestable, decided = (policy(name, name, "not used", "success") for name in names)
    rows = (unprobed, untested, unshown, untestable, decided)
    assert [next_step([one]).partition("  ")[0] for one in rows] == [
        "next: probe-kit train acts", "next: probe-kit intervene acts", "next: probe-kit power",
        "next: probe-kit train acts --permutations 200", "next: probe-kit view acts",
    ]  # fmt: skip
    few = replace(unprobed, category="shape", success=replace(unprobed.success, n_groups=4))
    assert next_step([unprobed, few]).partition("  ")[0] == "next: probe-kit train acts --categories public-info"
    assert "train" not in next_step([few]), "`train` would refuse it"
    assert next_step([answers("color")]) == ""
    scripted = replace(unprobed, run=replace(unprobed.run, action_stream=None, location="my run"))
    assert next_step([scripted]).startswith("next: probe-kit view 'my run'")
