"""The sentence of each kind of intervention about a category."""

import re
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.intervene import InterventionResult, kinds
from probe_kit.intervene.kinds import every_kind
from probe_kit.intervene.kinds.attribution import AttributionPatching
from probe_kit.intervene.kinds.base import Intervention
from probe_kit.intervene.kinds.closed_loop import ClosedLoop, ClosedLoopEffect
from probe_kit.intervene.kinds.erase import ConceptErasure, ErasureEffect
from probe_kit.intervene.kinds.image_swap import ImageSwap, ImageSwapEffect, InputEffect, SwapFinding, input_effect
from probe_kit.intervene.kinds.instruction_swap import InstructionSwap
from probe_kit.intervene.kinds.interchange import Interchange, PatchEffect, unit_of_doses
from probe_kit.intervene.kinds.joint import EVERY, MINIMAL, JointEffect, JointPlaces
from probe_kit.intervene.kinds.steer import Steering
from probe_kit.intervene.outcomes import CLEAN, CONTROL_INPUT, DONOR, IMAGE_SWAP, NOISE, ConditionOutcomes
from probe_kit.intervene.patching.attribution import AttributionEffect
from probe_kit.intervene.verdict import UseVerdict, classify_use
from probe_kit.retention.columns.summary import MOST_NUMBERS, MOST_WORDS, count_words
from tests.intervene.answers import measured, said_of, with_parts

SWAPS = {
    "follows": (0.92, 0.02, (0.6, 1.0), 0.001, 1.0, 0.9, (0.8, 1.0)),
    "reverses": (0.0, 0.9, (-1.0, -0.6), 1.0, 0.001, -0.9, (-1.0, -0.8)),
    "does not follow": (0.04, 0.02, (-0.1, 0.12), 0.6, 0.6, 0.01, (-0.02, 0.03)),
    "open": (0.2, 0.1, (-0.1, 0.42), 0.3, 0.9, 0.1, (-0.1, 0.3)),
    "in part": (0.2, 0.0, (0.05, 0.35), 0.01, 0.99, 0.2, (0.15, 0.3)),
}
"""Follow and reversal rate, interval of the net rate, p and its mirror, share of the reach and its interval."""
SAID = {
    "follows": "the action follows a swap of the pictures in 92 % of episodes (net of reversals 60 to 100 %).",
    "reverses": "the action goes against the pictures, swapped or not, in 90 % of episodes.",
    "does not follow": "the action does not follow a swap of the pictures (in 4 % of episodes).",
    "open": "whether the action follows a swap of the pictures is undecided (in 20 % of episodes).",
    "in part": "the action follows a swap of the pictures in part (in 20 % of episodes, net of reversals 5 to 35 "
    "%, moved by 0.20 of its reach).",
}


def swap(response: str) -> ImageSwapEffect:
    follow, reversal, ci, p, reversal_p, share, share_ci = SWAPS[response]
    return ImageSwapEffect(
        category="public-info", n_episodes=48, n_items=24, n_groups=12, follow_rate=follow, reversal_rate=reversal,
        net_follow_rate=follow - reversal, net_follow_rate_ci=ci, follow_p=p, reversal_p=reversal_p,
        median_displacement=0.1, reach=0.3, reach_source="actions", reach_share=share, reach_share_ci=share_ci,
        moved_share=abs(share), left_reached=follow - reversal, right_reached=follow - reversal,
    )  # fmt: skip


def context(verdict: UseVerdict | None) -> InterventionResult:
    verdicts = {} if verdict is None else {"public-info": verdict}
    names, numbers, moved = np.array(["one"]), np.zeros((1, 1)), np.zeros((1, 1, 5))
    outcomes = ConditionOutcomes(
        (CLEAN,), names, names, names, names, np.array(["left"]), numbers, numbers, moved, numbers[0]
    )
    return said_of(measured(outcomes, "", {"kind": Steering.kind}), verdicts)


@pytest.mark.parametrize("response", SWAPS)
@pytest.mark.parametrize("encoded", [True, False, None])
@pytest.mark.parametrize("control", ["color", None])
def test_an_image_swap_is_described_by_what_the_action_does_and_then_its_verdict(
    response: str, encoded: bool | None, control: str | None
) -> None:
    use = classify_use(encoded, swap(response), control)
    (sentence,) = ImageSwap.sentences([swap(response)], context(use))
    assert sentence == f"Public Info (24 items): {SAID[response]} {use.sentence}"


def test_an_instruction_swap_is_described_without_a_verdict() -> None:
    (sentence,) = InstructionSwap.sentences([swap("reverses")], context(None))
    assert sentence == (
        "Public Info (24 items): the action follows a swap of the instruction in 0 % of episodes and does the "
        "reverse in 90 % (net -100 to -60 %)."
    )


COMMON: dict[str, Any] = {
    "category": "color", "role": "image", "direction": "", "is_control": False, "n_episodes": 48, "n_items": 24,
    "net_ci": (0.0, 1.0), "max_action_change": 1.0, "fires": 1, "no_op_fires": 0, "relative_change": 0.5,
}  # fmt: skip


def patch(sites: str, effect: float | None, p: float, centimetres: float = 3.0) -> PatchEffect:
    return PatchEffect(
        **COMMON, sites=sites, coefficient="", effect=effect, effect_ci=None, net=0.4, net_left=0.4, net_right=0.4,
        mean_displacement=centimetres / 100, control_displacement=None, t=2.0, p=p, p_fwe=p,
    )  # fmt: skip


CARRY = "edits that carry half of the image swap's effect"
MOVE = "edits that move the action at least 2 cm to the target side, beyond their controls"
HAVE = "edits that have half of the image swap's effect"


@pytest.mark.parametrize(
    ("rows", "expected"),
    [
        (
            [patch("backbone.01", 0.97, 0.001), patch("backbone.02", 0.6, 0.01), patch("backbone.03", 0.9, 0.4)],
            f"{CARRY}: 2 of 3 (backbone.01 image 0.97, backbone.02 image 0.60).",
        ),
        ([patch("backbone.01", 0.2, 0.001)], f"{CARRY}: none of 1."),
        (
            [patch("backbone.00", 1.0, 0.001), patch("backbone.02", 0.6, 0.01), patch("expert.01", 1.0, 0.001)],
            f"{CARRY}: 1 of 1 (backbone.02 image 0.60); 2 more carry it by construction and locate nothing (*).",
        ),
        (
            [patch("backbone.01", None, 0.001), patch("backbone.02", None, 0.2)],
            f"{MOVE}: 1 of 2 (backbone.01 image +3.0 cm).",
        ),
        ([patch("backbone.01", None, 0.5)], f"{MOVE}: none of 1."),
        ([patch("backbone.01", None, 0.001, 0.004)], f"{MOVE}: none of 1."),
        (
            [patch(f"kv.{at:02d}", 0.9, 0.001) for at in range(5)],
            f"{CARRY}: 5 of 5 (kv.00 image 0.90, kv.01 image 0.90, kv.02 image 0.90 and 2 more).",
        ),
        (
            [
                replace(patch("backbone.02", share, 0.001), coefficient=dose)
                for dose, share in (("0", 0.0), ("2", 0.9))
            ],
            f"{HAVE}: 1 of 1 (backbone.02 image coefficient 2 0.90).",
        ),
    ],
)
def test_edits_of_sites_are_counted_and_the_largest_are_named(rows: Sequence[PatchEffect], expected: str) -> None:
    assert Interchange.sentences(rows, context(None)) == [f"Color: {expected}"]


@pytest.mark.parametrize(
    ("category", "title"), [("color", "Color"), ("red · or blue", "Red · or blue"), (" · ", " · ")]
)
def test_a_category_of_any_name_stays_in_its_own_column(category: str, title: str) -> None:
    described = replace(context(None), settings={"kind": "interchange"})
    table = Interchange.table([replace(patch("kv.01", 0.9, 0.001), category=category)], described)
    (line,) = table.rows
    assert [cell.text for cell in line.cells[: table.names]] == [title, "kv.01 image"]
    assert [heading.text for heading in table.headings[: table.names]] == ["category", "edit"]


def closed_loop(sites: str, net: float, p: float | None, disrupted: bool = False) -> ClosedLoopEffect:
    return ClosedLoopEffect(
        **COMMON, sites=sites, correct=0.5, wrong=0.5, in_zone=1.0, wrong_in_zone=0.5, net=net, net_left=net,
        net_right=net, control_net=0.0, gained=1, lost=0, p_mcnemar=0.1, t=1.0, p=p, p_fwe=p, disrupted=disrupted,
    )  # fmt: skip


TURN = "edits that turn the cube to the other picture beyond their controls"


def test_closed_loops_say_what_is_confirmed_and_what_disrupts_the_task() -> None:
    rows = [closed_loop(CLEAN, 0.0, None), closed_loop("backbone.02", 0.8, 0.001), closed_loop("kv.01", 0.1, 0.5)]
    assert ClosedLoop.sentences(rows, context(None)) == [f"Color: {TURN}: 1 of 2 (backbone.02 image +0.80)."]
    rows = [closed_loop(CLEAN, 0.0, None), closed_loop("backbone.02", 0.8, None, disrupted=True)]
    assert ClosedLoop.sentences(rows, context(None)) == [
        f"Color: {TURN}: none of 1; that disrupt the task: 1 of 1 (backbone.02 image)."
    ]


def erasure(share_left: float | None, p: float) -> ErasureEffect:
    common = COMMON | {"direction": "leace"}
    return ErasureEffect(
        **common, sites="backbone.02", right_before=1.0, right=0.5, share_left=share_left, net=0.5,
        mean_displacement=0.1, control_share_left=0.9, control_net=0.0, control_displacement=0.0, p=p, p_fwe=p,
        probe_accuracy_before=1.0, probe_accuracy=0.5,
    )  # fmt: skip


TAKE = "erasures that take the answer from the action beyond their controls"


@pytest.mark.parametrize(
    ("row", "expected"),
    [
        (erasure(0.1, 0.001), f"{TAKE}: 1 of 1 (backbone.02 image leace keeps 0.10)."),
        (erasure(0.8, 0.3), f"{TAKE}: none of 1."),
        (
            erasure(None, 0.3),
            "the unedited action does not go to the correct picture, so that nothing can be lost.",
        ),
    ],
)
def test_erasures_say_what_is_lost(row: ErasureEffect, expected: str) -> None:
    (sentence,) = ConceptErasure.sentences([row], context(None))
    assert sentence == f"Color: {expected}"


def joint(part: str, cells: str, finding: str) -> JointEffect:
    return JointEffect(
        category="color", part=part, cells=cells, n_episodes=48, n_groups=12, alone=1.0, alone_ci=(0.9, 1.1),
        needed=1.0, needed_ci=(0.9, 1.1), p=0.01, p_fwe=0.01, finding=finding,
    )  # fmt: skip


def test_joint_places_say_where_the_answer_is_read_or_that_this_is_open() -> None:
    every = joint(EVERY, "kv.00 + kv.01", "carries it")
    rows = [every, joint("cell", "kv.01 image", "read here")]
    assert JointPlaces.sentences(rows, context(None)) == ["Color: read at kv.01 image."]
    rows = [every, joint(MINIMAL, "kv.00 + kv.01", "read jointly")]
    assert JointPlaces.sentences(rows, context(None)) == ["Color: no single place: read jointly at kv.00 + kv.01."]
    assert JointPlaces.sentences([every], context(None)) == ["Color: where the answer is read remains open."]


def input_row(changed: float, share: float | None, finding: SwapFinding) -> InputEffect:
    return InputEffect(
        category="public-info", vary="picture.wrist", n_episodes=12, n_items=6, n_groups=6, changed=changed,
        size=1.0, control_size=0.1, full_size=1.0, share=share, share_ci=None, p=0.01, finding=finding,
    )  # fmt: skip


def anchor(estimate: float, finding: str, exact: float = 1.0) -> AttributionEffect:
    return AttributionEffect(
        category="public-info", sites="kv.*", role="all", is_anchor=True, is_drawn=False, n_episodes=48,
        n_groups=12, estimate=estimate, estimate_ci=None, exact=exact, exact_ci=None, p_fwe=0.01, finding=finding,
    )  # fmt: skip


EVERY_CELL = joint(EVERY, "kv.00 + kv.01", "carries it")
FINDINGS: list[tuple[type[Intervention], Sequence[Any], str]] = [
    (ImageSwap, [swap("follows")], "swapped: a swap turns it in 92 % of the episodes."),
    (
        InstructionSwap,
        [swap("reverses")],
        "reversed: another instruction turns the action to its own picture in 0 % of the episodes, and away from "
        "it in 90 %.",
    ),
    (
        InstructionSwap,
        [swap("open")],
        "not shown: another instruction turns the action to its own picture in 20 % of the episodes, and away "
        "from it in 10 %.",
    ),
    (
        Interchange,
        [patch("backbone.01", 0.97, 0.001), patch("backbone.02", 0.6, 0.01), patch("backbone.03", 0.9, 0.4)],
        "located: at least half of the effect passes in 2 of 3 edits, most at backbone.01 image.",
    ),
    (
        Interchange,
        [patch("backbone.01", 0.2, 0.001)],
        "not located: none of 1 edits has half of the image swap's effect.",
    ),
    (
        Interchange,
        [patch("expert.01", 1.0, 0.001)],
        "not located: all edits lie where the whole effect must pass, so that no place is shown.",
    ),
    (
        Interchange,
        [patch("backbone.01", None, 0.001)],
        "moved: to the target side by 1 of 1 edits, at backbone.01 image.",
    ),
    (
        Interchange,
        [patch("backbone.01", None, 0.5)],
        "not moved: neither the image swap nor any edit moves the action beyond chance.",
    ),
    (
        Steering,
        [replace(patch("backbone.02", 0.9, 0.001), coefficient="2")],
        "steered: at least half of the image swap's effect by 1 of 1 edits, at backbone.02 image.",
    ),
    (
        Steering,
        [replace(patch("backbone.02", 0.1, 0.001), coefficient="2")],
        "not steered: none of 1 edits has half of the image swap's effect.",
    ),
    (
        ClosedLoop,
        [closed_loop(CLEAN, 0.0, None), closed_loop("backbone.02", 0.8, 0.001)],
        "confirmed: the cube turns to the other picture after 1 of 1 edits, at backbone.02 image.",
    ),
    (
        ClosedLoop,
        [closed_loop("backbone.02", 0.1, 0.5)],
        "not confirmed: none of 1 edits turns the cube to the other picture more than its controls.",
    ),
    (
        ClosedLoop,
        [closed_loop("backbone.02", 0.8, None, disrupted=True)],
        "task disrupted: after every edit the cube stays away from both pictures.",
    ),
    (
        ConceptErasure,
        [erasure(0.1, 0.001)],
        "lost: the action no longer follows the answer after 1 of 1 erasures, at backbone.02 image.",
    ),
    (
        ConceptErasure,
        [erasure(0.8, 0.3)],
        "not lost: none of 1 erasures takes the answer from the action more than its controls.",
    ),
    (
        ConceptErasure,
        [erasure(None, 0.3)],
        "nothing to lose: the unedited action does not go to the correct picture.",
    ),
    (JointPlaces, [EVERY_CELL, joint("cell", "kv.01 image", "read here")], "read: at kv.01 image."),
    (
        JointPlaces,
        [EVERY_CELL, joint(MINIMAL, "kv.00 + kv.01", "read jointly")],
        "read jointly: at kv.00 + kv.01.",
    ),
    (JointPlaces, [EVERY_CELL], "open: no place was found at which the answer is read."),
    (
        JointPlaces,
        [joint(EVERY, "kv", "past it")],
        "past kv: the answer reaches the action without passing there.",
    ),
    (
        JointPlaces,
        [EVERY_CELL, *(joint("cell", f"kv.{2 * at:02d} image", "read here") for at in range(5))],
        "read: at kv.00 image, kv.02 image, kv.04 image and 2 more.",
    ),
    (
        AttributionPatching,
        [anchor(0.1, "void")],
        "void: gradients miss the effect at kv.* all by more than a factor of 3; patch instead.",
    ),
    (
        AttributionPatching,
        [anchor(0.1, "n/a", exact=0.1)],
        "no order: no anchor carries the effect, so that nothing tests the estimates.",
    ),
    (
        AttributionPatching,
        [anchor(0.9, "anchored"), replace(anchor(0.7, "anchored"), sites="kv.01", is_anchor=False, rank=1)],
        "ordered: gradients agree with patches; kv.01 all comes first with 0.70 of the effect.",
    ),
]
INPUTS = [
    (input_row(0.0, 0.0, "no effect"), "does not arrive: another picture.wrist changes no number of any action."),
    (
        input_row(1.0, 0.8, "decides"),
        "decides: the action follows the picture.wrist, by 0.80 of what all inputs do.",
    ),
    (
        input_row(1.0, 0.2, "moves"),
        "moves: the picture.wrist shifts the action without deciding it, by 0.20 of what all inputs do.",
    ),
    (input_row(1.0, 0.0, "no effect"), "no effect: another picture.wrist hardly changes the action."),
    (input_row(1.0, None, "open"), "open: these items do not decide whether the picture.wrist matters."),
]


def check_short(line: str) -> None:
    """At most 25 words and two numbers besides names of places, and no brackets."""
    assert count_words(line) <= MOST_WORDS, line
    assert len(re.findall(r"\d[\d.]*", re.sub(r"\b(kv|backbone|expert)\.[\d*]+", "", line))) <= MOST_NUMBERS, line
    assert not re.search(r"[][()]|None|nan|\.\.$", line), line


@pytest.mark.parametrize(("kind", "rows", "expected"), FINDINGS)
def test_the_last_line_of_each_kind_is_short_and_without_brackets(
    kind: type[Intervention], rows: Sequence[Any], expected: str
) -> None:
    (line,) = kind.findings(rows, context(None))
    assert line.partition("  ")[2] == expected
    check_short(line)


@pytest.mark.parametrize(("row", "expected"), INPUTS)
@pytest.mark.parametrize("kind", [ImageSwap, InstructionSwap])
def test_the_last_line_about_an_input_of_a_run_without_sides_is_short(
    kind: type[Intervention], row: InputEffect, expected: str
) -> None:
    described = context(None)
    without_sides = with_parts(described, replace(described.outcomes, sides=np.array([""])))
    (line,) = kind.findings([row], without_sides)
    assert line == f"Public Info  {expected}"
    check_short(line)


def test_every_kind_that_tests_something_says_what_it_found() -> None:
    for kind in every_kind():
        assert (kind.finding is not Intervention.finding) != kind.is_descriptive, kind.kind


def test_an_effect_below_the_resolution_of_its_measure_is_significant_of_nothing() -> None:
    """Signs that agree in every episode have the smallest p there is, however small the effect."""
    small = replace(
        patch("backbone.02", 0.003, 0.004), net=0.0, net_left=0.0, net_right=0.0, mean_displacement=1e-5
    )
    assert not small.is_resolved
    assert not small.is_significant
    assert replace(small, effect=0.6).is_localised
    assert replace(small, net=0.02).is_significant, "an episode turns"
    assert replace(small, effect=None, mean_displacement=0.03).moves_action
    assert not replace(small, effect=None).is_significant
    doses = [
        replace(small, coefficient=dose, direction="color.mean.backbone.02-316f1fe4") for dose in ("0", "1", "2")
    ]
    table = Steering.table(doses, context(None))
    assert [row[table.columns.index("p")] for row in table.texts] == ["–", "–", "–"]
    assert "lengths of the file's vector" in table.all_notes[0]
    assert "the smallest that its measure resolves" in table.all_notes[0]
    steering_table = Steering.table([replace(patch("backbone.02", 0.6, 0.004), coefficient="1")], context(None))
    assert "the smallest that its measure resolves" not in steering_table.all_notes[0]
    assert unit_of_doses("mean-difference:1") == unit_of_doses("probe") == "half class-mean differences"


def unsided() -> InterventionResult:
    described = context(None)
    return with_parts(described, replace(described.outcomes, sides=np.array([""])))


def test_without_sides_sentences_name_the_input_that_is_exchanged() -> None:
    varied = replace(unsided(), settings={"kind": Interchange.kind, "vary": "instruction"})
    for rows in ([patch("backbone.02", 0.9, 0.001)], [patch("backbone.02", 0.1, 0.9)]):
        sentences = [*Interchange.sentences(rows, varied), *Interchange.findings(rows, varied)]
        notes = Interchange.table(rows, varied).all_notes
        assert "half of the exchange of the instruction's effect" in sentences[0]
        assert "effect: share of what the whole exchange of the instruction does" in notes[0]
        assert "image swap" not in " ".join((*sentences, *notes))


def test_no_noun_of_a_sentence_is_replaced_in_its_text() -> None:
    for file in Path(kinds.__file__).parents[1].rglob("*.py"):
        assert '.replace("image' not in file.read_text(encoding="utf-8"), file.name


@pytest.mark.parametrize("seed", [None, 1.0])
def test_where_the_seed_decides_no_input_does_and_both_commands_say_so_in_one_sentence(seed: float | None) -> None:
    row = replace(input_row(1.0, 0.94, "no effect"), every=0.005, seed=seed)
    expected = "all inputs together change 0 % of the action: the seed decides it"
    (finding,) = ImageSwap.findings([row], unsided())
    assert expected in finding
    assert expected in ImageSwap.sentences([row], unsided())[0]
    without_noise = replace(row, seed=0.0, finding="decides")
    assert "the seed decides" not in ImageSwap.findings([without_noise], unsided())[0]


def test_a_share_of_next_to_nothing_decides_nothing() -> None:
    """Sizes as of an untrained network: all inputs change a tenth of the spread, the picture 0.94 of that."""
    rng, groups = np.random.default_rng(0), np.array([f"g{number}" for number in range(8)])
    sizes = np.zeros((5, 8))
    sizes[1:4] = np.array([0.1, 0.06, 0.106])[:, None] * rng.uniform(0.9, 1.1, (3, 8))
    sizes[4] = 1.4
    displacement = np.where(np.arange(5)[:, None] == 2, 0.0, sizes)
    names = (CLEAN, IMAGE_SWAP, CONTROL_INPUT, DONOR, NOISE)
    outcomes = ConditionOutcomes(
        names, groups, groups, groups, np.full(8, "all"), np.full(8, ""), displacement,
        sizes, np.zeros((5, 8, 5)), np.zeros(8), size=sizes, seed_text="seed",
    )  # fmt: skip
    row = input_effect(outcomes, IMAGE_SWAP, "picture")
    assert row.share is not None
    assert row.share > 0.9
    assert (row.finding, row.every < 0.01, row.seed) == ("no effect", True, pytest.approx(0.98))
    large = replace(outcomes, size=10 * sizes, displacement=10 * displacement)
    assert input_effect(large, IMAGE_SWAP, "picture").finding == "decides"
