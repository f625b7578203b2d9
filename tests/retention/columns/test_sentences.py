"""The sentence about a category, over every combination of success rate, streams and effect of an image swap."""

import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any, Literal

import pytest

from probe_kit.intervene.evidence import StoredEvidence
from probe_kit.intervene.kinds.image_swap import ImageSwapEffect
from probe_kit.intervene.verdict import Places, UseVerdict
from probe_kit.retention.behaviour import Regime, SuccessRate
from probe_kit.retention.columns.summary import MOST_NUMBERS, MOST_WORDS, count_words, finding, next_step
from probe_kit.retention.columns.text import conclusion, verdict
from probe_kit.retention.rows.build import add_image_swap
from probe_kit.retention.rows.row import ActionPart, BackbonePart, RetentionRow, RunInfo, SwapEffect
from tests.retention.columns.test_summary import answers
from tests.retention.columns.test_summary import row as row_of

RUN = RunInfo(
    location="run", model="pi0-tiny", random_weights=False, weights_sha256=None, suite="suite@1", settings="r",
    probes=None, action_stream="expert",
)  # fmt: skip


def rate(sr: float, low: float, high: float, regime: Regime, wrong: float = 0.0) -> SuccessRate:
    return SuccessRate(
        n_episodes=48, n_items=24, n_groups=12, sr=sr, ci=(low, high), regime=regime, chance_margin=0.2,
        share_wrong=wrong, share_outside=1 - sr - wrong,
    )  # fmt: skip


OPEN = Regime.NO_RELIABLE_KNOWLEDGE
RATES = {
    "knowledge": rate(0.94, 0.84, 1.0, Regime.KNOWLEDGE),
    "guessing": rate(0.54, 0.34, 0.74, OPEN),
    "little above": rate(0.66, 0.56, 0.76, OPEN),
    "little below": rate(0.34, 0.24, 0.44, OPEN),
    "wide": rate(0.75, 0.45, 0.95, OPEN),
    "wrong": rate(0.1, 0.02, 0.25, Regime.FAILURE, wrong=0.8),
    "misses": rate(0.1, 0.02, 0.25, Regime.FAILURE, wrong=0.1),
    "none": SuccessRate(n_episodes=48, n_items=24, n_groups=12),
}


def part(
    stream_verdict: Literal["shown", "not shown", "absent"], score: float, most: float, **exceeds: bool | None
) -> Any:
    limits = (score - 0.1, min(1.0, score + 0.05))
    found_: dict[str, Any] = {"score": score, "ci": limits, "at_most": most, "verdict": stream_verdict}
    return {**found_, "exceeds": {"chance": False, "random-features": None, "untrained": None, **exceeds}}


PARTS: dict[str, dict[str, Any]] = {
    "shown": part("shown", 0.98, 1.0, **{"chance": True, "random-features": True}),
    "shown, no control": part("shown", 0.98, 1.0, chance=True),
    "at chance": part("not shown", 0.52, 0.78),
    "no better than controls": part("not shown", 0.9, 0.97, **{"chance": True, "random-features": False}),
    "no permutations": part("not shown", 0.9, 0.97, chance=None)
    | {"remedy": "train with --permutations 20 or more"},
    "absent": part("absent", 0.5, 0.62),
    "no score": {"peak": 0.9, "exceeds": {"chance": True, "random-features": None, "untrained": None}},
    "not probed": {},
}


def swap(
    follow: float,
    reversal: float,
    ci: tuple[float, float],
    p: float,
    reversal_p: float,
    share: float,
    spread: float = 0.03,
    reached: tuple[float, float] = (0.9, 0.9),
) -> ImageSwapEffect:
    """share: displacement, of the reach, give or take `spread`."""
    return ImageSwapEffect(
        category="color", n_episodes=48, n_items=24, n_groups=12, follow_rate=follow, reversal_rate=reversal,
        net_follow_rate=follow - reversal, net_follow_rate_ci=ci, follow_p=p, reversal_p=reversal_p,
        median_displacement=0.1, reach=0.3, reach_source="actions", reach_share=share,
        reach_share_ci=(share - spread, share + spread), moved_share=abs(share), left_reached=reached[0],
        right_reached=reached[1],
    )  # fmt: skip


FOLLOWS = swap(0.92, 0.02, (0.6, 1.0), 0.001, 1.0, 0.9)
SWAPS: dict[str, ImageSwapEffect | None] = {
    "no swap": None,
    "follows": FOLLOWS,
    "reverses": swap(0.0, 0.9, (-1.0, -0.6), 1.0, 0.001, -0.9),
    "does not follow": swap(0.04, 0.02, (-0.1, 0.12), 0.6, 0.6, 0.02),
    "open": swap(0.2, 0.1, (-0.1, 0.42), 0.3, 0.9, 0.1, 0.2),
    "one side": swap(0.04, 0.02, (-0.1, 0.12), 0.001, 1.0, 0.5, reached=(1.0, 0.0)),
    "moves": swap(0.04, 0.02, (-0.1, 0.12), 0.001, 1.0, 0.3, reached=(0.0, 0.0)),
}
CONTROL = {"shape": replace(FOLLOWS, category="shape")}
"""Another category that follows."""


def combination(
    rate_: str,
    backbone: str,
    action: str,
    swapped: str,
    control: bool = True,
    located: tuple[str, ...] | None = None,
) -> RetentionRow:
    row = RetentionRow(
        category="color", view="mean", run=replace(RUN, capture_only=rate_ == "none"), success=RATES[rate_],
        backbone=BackbonePart(**PARTS[backbone]), action=ActionPart(**PARTS[action]),
    )  # fmt: skip
    swap_effect = SWAPS[swapped]
    swaps = {} if swap_effect is None else {"color": swap_effect, **(CONTROL if control else {})}
    evidence = StoredEvidence(None)  # type: ignore[arg-type]
    places = {} if located is None else {"color": Places(located)}
    evidence.__dict__.update(swaps=swaps, other_readouts={}, places=places)
    return add_image_swap(row, evidence)


@cache
def every_combination() -> list[tuple[str, str, str, str, RetentionRow]]:
    """Made when a test first needs it, and not by each process that collects the tests."""
    locating = ((True, None), (False, None), (True, ()), (True, ("backbone.02",)))
    return [
        (rate_, backbone, action, swapped, combination(rate_, backbone, action, swapped, control, located))
        for rate_, backbone, action, swapped in product(RATES, PARTS, PARTS, SWAPS)
        for control, located in locating
    ]


def test_no_combination_of_rate_streams_and_swap_lacks_a_word_or_a_number() -> None:
    for *_, row in every_combination():
        text = conclusion(row)
        assert not text or text.endswith(".")
        assert not re.search(r"None|–|nan|  |\.\.|;\.|: \.|\(\)|^; ", text), text


def test_use_is_concluded_from_a_swap_and_knowledge_never_beside_an_interval_that_includes_one_half() -> None:
    for rate_, backbone, _, swapped, row in every_combination():
        text = conclusion(row)
        assert ("The answer is used" in text) == (swapped in ("follows", "reverses")), text
        assert ("The answer is used in the first chunk, against the correct picture" in text) == (
            swapped == "reverses"
        ), text
        if "the policy succeeds;" in text.lower():
            assert (rate_, swapped) == ("knowledge", "no swap"), text
        assert "in the backbone" not in text or backbone != "not probed", text
        is_untested = "hether the answer is used was not tested" in text
        assert is_untested <= (swapped == "no swap"), text
        if swapped == "no swap" and rate_ != "none":
            assert is_untested or verdict(row).split(",")[0] in ("absent", "not shown"), text


def test_absence_is_said_of_a_bounded_backbone_only_and_more_items_are_asked_for_what_is_open_only() -> None:
    for rate_, backbone, _, swapped, row in every_combination():
        text = conclusion(row)
        assert ("bsent from the backbone" not in text) or backbone == "absent", text
        if "probes cannot show" in text or "takes about" in text:
            guessed = RATES[rate_].regime == OPEN and swapped == "no swap"
            assert backbone in ("at chance", "no better than controls") or swapped == "open" or guessed, text
        assert ("train with --permutations 20 or more" in text) <= (backbone == "no permutations"), text


CONCLUSIONS = """
knowledge | shown | no swap | shown, success
Shown in the backbone; the policy succeeds; whether the answer is used was not tested: run `probe-kit
intervene`.

guessing | shown | no swap | shown, success not shown
Shown in the backbone; success is not shown; whether the answer is used was not tested: run
`probe-kit intervene`.

wrong | shown | no swap | shown, failure
Shown in the backbone; the policy is right less often than guessing; whether the answer is used was not tested: run
`probe-kit intervene`.

knowledge | at chance | no swap | not shown, success
The policy succeeds; the answer is not shown in the backbone; whether the answer is used was not tested: run
`probe-kit intervene`.

guessing | absent | no swap | absent
Absent from the backbone for a linear probe of so many items; success is not shown: a rate of 54 % takes about
600 items.

misses | absent | no swap | absent, failure
Absent from the backbone for a linear probe of so many items; the policy is right less often than guessing.

misses | at chance | no swap | not shown, failure
The policy is right less often than guessing; not shown in the backbone: with fewer than 34 items,
probes cannot show that the backbone lacks it.

none | absent | no swap | absent
Absent from the backbone for a linear probe of so many items.

none | at chance | no swap | not shown
Not shown in the backbone: with fewer than 34 items, probes cannot show that the backbone lacks it.

none | no permutations | no swap | not shown
Not shown in the backbone: train with --permutations 20 or more.

none | shown | no swap | shown
Shown in the backbone.

knowledge | not probed | no swap | success
The policy succeeds; whether the answer is used was not tested: run `probe-kit intervene`. The backbone was
not probed: run `probe-kit train`.

misses | not probed | no swap | failure
The policy is right less often than guessing; whether the answer is used was not tested: run `probe-kit
intervene`. The backbone was not probed: run `probe-kit train`.

guessing | not probed | no swap | success not shown
Success is not shown; whether the answer is used was not tested: run `probe-kit
intervene`. The backbone was not probed: run `probe-kit train`.

none | not probed | no swap | not shown
The backbone was not probed: run `probe-kit train`.

guessing | shown | follows | used
The answer is used in the first chunk; whether the readable copy is the one used was not tested.

knowledge | absent | follows | used
The answer is used in the first chunk; no readable copy found.

knowledge | not probed | follows | used
The answer is used in the first chunk. The backbone was not probed: run `probe-kit train`.

wrong | shown | reverses | against: used
The answer is used in the first chunk, against the correct picture; whether the readable copy is the one
used was not tested.

wrong | at chance | reverses | against: used
The answer is used in the first chunk, against the correct picture; no readable copy found.

wrong | not probed | reverses | against: used
The answer is used in the first chunk, against the correct picture. The backbone was not probed: run `probe-kit
train`.

guessing | shown | does not follow | not used
The answer is not used in the first chunk: within 0.1 of its reach and 0.25 of the episodes (moved by 0.02
[-0.01, 0.05] of its reach, net follow rate 0.02 [-0.10, 0.12]); positive control: shape.

knowledge | shown | does not follow | not used
The answer is not used in the first chunk: within 0.1 of its reach and 0.25 of the episodes (moved by 0.02
[-0.01, 0.05] of its reach, net follow rate 0.02 [-0.10, 0.12]); positive control: shape. Yet the policy
succeeds: actions after the first inference may follow.

guessing | absent | does not follow | absent
Absent from the backbone for a linear probe of so many items. The answer is not used in the first chunk: within
0.1 of its reach and 0.25 of the episodes (moved by 0.02 [-0.01, 0.05] of its reach, net follow rate 0.02
[-0.10, 0.12]); positive control: shape.

guessing | at chance | does not follow | not shown
Not shown in the backbone: with fewer than 34 items, probes cannot show that the backbone lacks it. The answer is
not used in the first chunk: within 0.1 of its reach and 0.25 of the episodes (moved by 0.02 [-0.01, 0.05] of its
reach, net follow rate 0.02 [-0.10, 0.12]); positive control: shape.

none | not probed | does not follow | not used
The answer is not used in the first chunk: within 0.1 of its reach and 0.25 of the episodes (moved by 0.02
[-0.01, 0.05] of its reach, net follow rate 0.02 [-0.10, 0.12]); positive control: shape. The backbone was not
probed: run `probe-kit train`.

guessing | shown | open | undecided
Whether the answer is used in the first chunk is undecided: moved by 0.10 [-0.10, 0.30] of its reach, net follow
rate 0.10 [-0.10, 0.42]; more than 1000 groups would tell, there are 12.

guessing | shown | one side | partly used, one-sided (left)
The answer is partly used, one-sided (left) in the first chunk; whether the readable copy is the one used was
not tested.

guessing | shown | moves | moves with it, does not decide
The answer moves the action in the first chunk, does not decide: moved by 0.30 [0.27, 0.33] of its reach,
net follow rate 0.02 [-0.10, 0.12]; whether the readable copy is the one used was not tested.
"""
"""Success rate, backbone, swap and verdict; then the conclusion."""


def conclusions() -> Iterator[tuple[str, ...]]:
    for record in CONCLUSIONS.strip().split("\n\n"):
        names, _, sentence = record.partition("\n")
        yield (*names.split(" | "), sentence.replace("\n", " "))


@pytest.mark.parametrize(
    ("rate_", "backbone", "swapped", "expected_verdict", "expected_conclusion"), list(conclusions())
)
def test_each_verdict_has_its_conclusion(
    rate_: str, backbone: str, swapped: str, expected_verdict: str, expected_conclusion: str
) -> None:
    row = combination(rate_, backbone, "not probed", swapped)
    assert verdict(row) == expected_verdict
    assert conclusion(row) == expected_conclusion


def test_an_open_verdict_says_what_is_missing_where_items_are_not() -> None:
    alone = conclusion(combination("guessing", "shown", "shown", "does not follow", control=False))
    assert alone.startswith("Whether the answer is used in the first chunk is undecided: within 0.1 of its reach")
    assert alone.endswith("no other category of the run is used, so that use is not known to show.")


def test_the_place_is_named_behind_the_behaviour() -> None:
    tie = "whether the readable copy is the one used was not tested."
    nowhere = combination("knowledge", "shown", "shown", "follows", located=())
    assert (
        conclusion(nowhere)
        == f"The answer is used in the first chunk; no place that was tried carries half of it; {tie}"
    )
    somewhere = combination("knowledge", "shown", "shown", "follows", located=("backbone.02",))
    assert conclusion(somewhere) == f"The answer is used in the first chunk; passes at backbone.02; {tie}"


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
RATES_FINDINGS: dict[str, tuple[float | None, Regime | None]] = {
    "success": (0.94, Regime.KNOWLEDGE),
    "guessing": (0.55, Regime.NO_RELIABLE_KNOWLEDGE),
    "failure": (0.1, Regime.FAILURE),
    "did not act": (None, None),
}


def policy(backbone: str, action: str, use: str, rate: str) -> RetentionRow:
    sr, regime = RATES_FINDINGS[rate]
    plain = row_of("acts", "public-info", sr, capture_only=sr is None)
    swap = SwapEffect() if USES[use] is None else SwapEffect(use=USES[use])
    return replace(
        plain, view=None if backbone == "not probed" else "mean",
        success=replace(plain.success, regime=regime, n_groups=12),
        backbone=BackbonePart(**STREAMS[backbone]), action=ActionPart(**STREAMS[action]), image_swap=swap,
    )  # fmt: skip


ASKED = {"": None, "known": answers("public-info", 0.96), "not known": answers("public-info", 0.5)}


def test_every_sentence_is_short_and_has_no_brackets_whatever_the_verdicts() -> None:
    for backbone, action, use, rate, vlm_finding in product(STREAMS, STREAMS, USES, RATES_FINDINGS, ASKED):
        text = finding(policy(backbone, action, use, rate), ASKED[vlm_finding])
        for sentence in re.split(r"(?<=\.) ", f"Color {text}"):
            assert count_words(sentence) <= MOST_WORDS, (count_words(sentence), sentence)
        assert len(re.findall(r"\d+", text)) <= MOST_NUMBERS, text
        assert re.fullmatch(r"[a-z][a-z ,]*: .*[a-z%]\.", text), text
        assert not re.search(r"[][()]|None|–|nan|  |; ;|\.\.", text), text


def table() -> list[list[str]]:
    """The lines of findings.md."""
    text = Path(__file__).with_name("findings.md").read_text(encoding="utf-8")
    return [[cell.strip() for cell in line[1:-1].split("|")] for line in text.splitlines()[4:]]


@pytest.mark.parametrize(("vlm_finding", "backbone", "use", "rate", "sentence"), table())
def test_each_combination_of_verdicts_has_this_sentence(
    vlm_finding: str, backbone: str, use: str, rate: str, sentence: str
) -> None:
    action = "shown" if backbone == "shown" else "not probed"
    assert finding(policy(backbone, action, use, rate), ASKED[vlm_finding]) == sentence


def test_the_sentences_say_where_the_answer_is_lost_between_backbone_and_action() -> None:
    actions = ("shown", "absent", "not shown")
    in_both, lost, open_ = (finding(policy("shown", action, "not used", "guessing")) for action in actions)
    assert "in the backbone and the action expert, but the action does not follow it" in in_both
    assert "in the backbone but not in the action expert; the action does not follow it" in lost
    assert "in the backbone but do not show it in the action expert; the action does not follow it" in open_


@pytest.mark.parametrize(
    ("sr", "expected"),
    [
        (1.0, "known: the VLM answers right in 100 %."),
        (0.5, "not shown: the VLM answers right in 50 %, which guessing can reach."),
    ],
)
def test_a_vlm_alone_knows_or_is_not_shown_to_know(sr: float, expected: str) -> None:
    assert finding(answers("color", sr)) == expected


def test_the_next_step_is_the_command_for_what_is_open() -> None:
    unprobed, untested = (
        policy("not probed", "not probed", "no swap", "success"),
        policy("shown", "shown", "no swap", "success"),
    )
    names = ("not shown", "few permutations", "shown")
    unshown, untestable, decided = (policy(name, name, "not used", "success") for name in names)
    rows = (unprobed, untested, unshown, untestable, decided)
    assert [next_step([row]).partition("  ")[0] for row in rows] == [
        "next: probe-kit train acts", "next: probe-kit intervene acts", "next: probe-kit power",
        "next: probe-kit train acts --permutations 200", "next: probe-kit view acts",
    ]  # fmt: skip
    few = replace(unprobed, category="shape", success=replace(unprobed.success, n_groups=4))
    assert next_step([unprobed, few]).partition("  ")[0] == "next: probe-kit train acts --categories public-info"
    assert "train" not in next_step([few]), "`train` would refuse it"
    assert next_step([answers("color")]) == ""
    scripted = replace(unprobed, run=replace(unprobed.run, action_stream=None, location="my run"))
    assert next_step([scripted]).startswith("next: probe-kit view 'my run'")
