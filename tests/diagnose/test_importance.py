"""How much an input decides, against policies whose shares of the variance are known by construction."""

import re
from collections.abc import Sequence
from dataclasses import replace
from hashlib import sha256
from math import nan
from statistics import NormalDist
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from probe_kit.diagnose.importance import Exchanges, importance_of
from probe_kit.diagnose.inputs import PICTURE, STATE
from probe_kit.diagnose.measure import InputExchange, count_inferences
from probe_kit.diagnose.results import (
    Diagnosis,
    InputDiagnosis,
    SitePassage,
    Verdict,
    describe_passage,
    exit_code,
    sentence,
    sentences,
)
from probe_kit.errors import InstructionError, UsageError
from probe_kit.extract.sources.inputs import Frame
from probe_kit.hooks.contract.observation import Observation

WORDS = ["lift the cube", "open the drawer", "push the plate", "turn the knob"]
Actions = NDArray[np.float32]


def frames(count: int = 48, groups: int = 24, seed: int = 0) -> list[Frame]:
    """Frames whose words, colour and state are drawn independently of each other."""
    rng = np.random.default_rng(seed)
    return [
        Frame.of(
            name=f"frame {index}",
            observation=Observation(
                (rng.integers(40, 216) + rng.integers(-4, 5, (8, 8, 3))).astype(np.uint8),
                rng.standard_normal(8).astype(np.float32),
                str(rng.choice(WORDS)),
            ),
            group=f"group {index % groups}",
            seed=int(rng.integers(2**31)),
        )
        for index in range(count)
    ]


def numbers_of(observation: Observation) -> NDArray[np.float64]:
    """Words, colour and state of an observation, each about as spread as a standard normal."""
    words = observation.instruction.lower().rstrip(".")
    word = WORDS.index(words) if words in WORDS else 9.0
    return np.array([(word - 1.5) / 1.12, (observation.image.mean() - 128) / 50, observation.state[0]])


def linear_policy(weights: Sequence[float], noise: float = 0.0, wandering: float = 0.0):  # type: ignore[no-untyped-def]
    """Two numbers that are a weighted sum of words, colour and state, and of noise of the seed.

    wandering: a part that changes at every change of any input, however small, as an untrained network's.
    """

    def infer(observations: Sequence[Observation], seeds: Sequence[int]) -> Actions:
        chunks = np.zeros((len(seeds), 3, 2), np.float32)
        for row, (observation, seed) in enumerate(zip(observations, seeds, strict=True)):
            value = numbers_of(observation) @ np.asarray(weights)
            if noise:
                value += noise * np.random.default_rng(seed).standard_normal()
            if wandering:
                content = observation.image.tobytes() + observation.state.tobytes()
                digest = sha256(content + observation.instruction.encode()).digest()
                # By the quantile: a generator for every inference would take most of the time.
                value += wandering * NormalDist().inv_cdf((int.from_bytes(digest[:7]) + 0.5) / 2**56)
            chunks[row] = value
        return chunks

    return infer


def verdicts(infer, **settings: object) -> dict[str, str]:  # type: ignore[no-untyped-def]
    return {
        measured_input.name: measured_input.verdict
        for measured_input in InputExchange(infer, frames()).measure(**settings)
    }


@pytest.mark.slow
def test_the_shares_are_the_total_indices_of_sobol_for_a_policy_that_adds_its_inputs() -> None:
    weights, noise = np.array([1.0, 0.7, 0.4]), 0.5
    measured = InputExchange(linear_policy(weights, noise), frames(600, 150)).measure()
    spread = np.var([numbers_of(frame.observation) for frame in frames(600, 150)], axis=0)
    parts = weights**2 * spread
    # Donors hold another value: words that are exchanged never happen to be the same again.
    parts[0] *= len(WORDS) / (len(WORDS) - 1)
    expected = parts / (weights**2 @ spread + noise**2)
    shares = {measured_input.name: measured_input.share for measured_input in measured}
    assert [shares["instruction"], shares[PICTURE], shares[STATE]] == pytest.approx(expected, abs=0.08)


def test_one_input_decides_another_moves_and_one_has_no_effect() -> None:
    assert verdicts(linear_policy([1.0, 0.3, 0.0])) == {
        "instruction": "decides",
        "picture": "moves",
        "state": "does not arrive",
    }


def test_an_effect_below_a_tenth_of_the_spread_is_none() -> None:
    state = InputExchange(linear_policy([1.0, 0.5, 0.01]), frames()).measure()[-1]
    assert state.verdict == "no effect"
    assert "up to 12 % of all frames" in state.reason, "0.05 is 0.88 to the 24: rarer effects are not excluded"


def test_a_policy_that_its_seed_decides_is_moved_by_its_inputs_at_most() -> None:
    input_verdicts = verdicts(linear_policy([0.5, 0.0, 0.0], noise=2.0))
    assert input_verdicts["instruction"] in ("moves", "open")


@pytest.mark.slow
def test_nothing_matters_where_every_change_moves_as_much() -> None:
    policy = linear_policy([0.0, 0.0, 0.0], wandering=1.0)
    draws = [InputExchange(policy, frames(16, 8, seed), seed).measure() for seed in range(20)]
    alarms = sum(diagnosed.verdict not in ("open", "no effect") for inputs in draws for diagnosed in inputs)
    assert alarms <= 8, "5 % of 60, and three standard deviations"


@pytest.mark.slow
def test_words_that_mean_the_same_move_as_much_as_others_in_five_of_a_hundred_draws() -> None:
    policy = linear_policy([0.0, 1.0, 1.0], wandering=0.3)
    alarms = 0
    for seed in range(100):
        (words,) = InputExchange(policy, frames(16, 8, seed), seed).measure(["instruction"])
        alarms += words.verdict in ("moves", "decides")
    assert alarms <= 10, "5 % of 100, and three standard deviations"


SCENE, RECORDED = (12, 2, 6), (24, 1, 6)
"""Groups, frames of a group and donors of a frame, as 24 frames of the scene and of recordings have them."""


def turned_around(chance: float, alike: float, seed: int, design: tuple[int, int, int] = SCENE) -> Exchanges:
    """Exchanges that turn the action around or leave it, as a policy with two answers does.

    chance: that an exchange of one input does; of all inputs, in half. alike: how alike donors of a frame are.
    design: groups, frames of a group, donors of a frame.
    """
    groups, of_group, donors = design
    frame_count, count = groups * of_group, groups * of_group * donors
    rng = np.random.default_rng(seed)
    of_frame = rng.beta(chance * (1 - alike) / alike, (1 - chance) * (1 - alike) / alike, (frame_count, 1))
    exchanged = 2.0 * (rng.random((frame_count, donors)) < of_frame).ravel()
    every = 2.0 * (rng.random(count) < 0.5)
    names = np.repeat([f"group {index}" for index in range(groups)], of_group * donors)
    frame_of = np.repeat(range(frame_count), donors)
    repeated = np.zeros(count, bool)
    return Exchanges(exchanged, np.zeros(count), every, names, frame_of, repeated, exchanged, np.ones(frame_count))


@pytest.mark.slow
@pytest.mark.parametrize("design", [SCENE, RECORDED], ids=["scene", "recorded"])
@pytest.mark.parametrize("alike", [0.3, 0.9])
def test_an_input_that_changes_half_as_much_as_all_decides_in_five_of_a_hundred_draws(
    alike: float, design: tuple[int, int, int]
) -> None:
    verdicts = [importance_of("words", turned_around(0.25, alike, seed, design)).verdict for seed in range(400)]
    assert verdicts.count("decides") <= 0.05 * 400 + 3 * np.sqrt(0.05 * 0.95 * 400)


def test_one_of_two_inputs_that_are_needed_together_is_seen_to_decide_in_nine_of_ten_draws() -> None:
    verdicts = [importance_of("words", turned_around(0.5, 0.5, seed)).verdict for seed in range(200)]
    assert verdicts.count("decides") >= 0.85 * 200
    assert verdicts.count("decides") + verdicts.count("moves") == 200


def test_few_large_changes_are_more_than_those_of_a_control() -> None:
    """An input that turns one action in twenty around matters little, and not nothing."""
    verdicts = [importance_of("words", turned_around(0.05, 0.1, seed)).verdict for seed in range(100)]
    assert verdicts.count("no effect") <= 5


def test_an_input_that_all_frames_share_is_not_varied_and_the_others_are_tested() -> None:
    same = [
        Frame.of(frame.name, Observation(frame.observation.image, frame.observation.state, "lift"), frame.group, 1)
        for frame in frames()
    ]
    words, picture, _ = InputExchange(linear_policy([1.0, 1.0, 0.0]), same).measure()
    assert (words.verdict, words.matters) == ("not varied", None)
    assert picture.verdict == "decides"
    assert exit_code([words, picture]) == 0
    assert exit_code([words, picture], ["instruction"]) == 1, "what is required must be shown"


def test_a_policy_that_differs_from_itself_is_refused() -> None:
    rng = np.random.default_rng(0)

    def infer(observations: Sequence[Observation], seeds: Sequence[int]) -> Actions:
        return rng.standard_normal((len(observations), len(seeds), 2)).astype(np.float32)

    with pytest.raises(UsageError, match="expected none"):
        InputExchange(infer, frames()).measure()


def test_a_policy_that_always_does_the_same_is_refused() -> None:
    with pytest.raises(UsageError, match="all 96 actions are equal"):
        InputExchange(linear_policy([0.0, 0.0, 0.0]), frames()).measure()


def test_an_unknown_input_is_refused_by_name() -> None:
    with pytest.raises(UsageError, match=r"picture\.wrist.*instruction, picture, state"):
        InputExchange(linear_policy([1.0, 0.0, 0.0]), frames()).measure(["picture.wrist"])


def test_a_second_camera_that_is_not_read_does_not_arrive() -> None:
    rng = np.random.default_rng(1)
    two = [
        Frame.of(
            frame.name,
            Observation(
                frame.observation.image,
                frame.observation.state,
                frame.observation.instruction,
                cameras={"wrist": rng.integers(0, 255, (8, 8, 3), np.uint8)},
            ),
            frame.group,
            frame.seed,
        )
        for frame in frames()
    ]
    by_name = {
        measured_input.name: measured_input
        for measured_input in InputExchange(linear_policy([1.0, 1.0, 0.0]), two).measure()
    }
    wrist = by_name["picture.wrist"]
    assert (wrist.verdict, wrist.unchanged) == ("does not arrive", wrist.n_inferences)
    assert exit_code(list(by_name.values()), ["instruction", "picture.first"]) == 0
    assert exit_code(list(by_name.values())) == 1


def test_a_family_that_refuses_an_empty_instruction_is_diagnosed_without_that_blank() -> None:
    policy = linear_policy([1.0, 0.3, 0.0])

    def infer(observations: Sequence[Observation], seeds: Sequence[int]) -> Actions:
        if not all(observation.instruction for observation in observations):
            raise InstructionError("'' holds no word")
        return policy(observations, seeds)  # type: ignore[no-any-return]

    words, picture, _ = InputExchange(infer, frames()).measure()
    assert (words.verdict, words.n_inferences) == ("decides", words.n_pairs)
    assert picture.n_inferences == picture.n_pairs + 48


def change_of(tuned: Sequence[float], base: Sequence[float]) -> dict[str, str]:
    exchange = InputExchange(linear_policy(tuned), frames())
    compared = exchange.against(linear_policy(base), exchange.measure())
    return {diagnosed.name: diagnosed.base.change for diagnosed in compared if diagnosed.base is not None}


@pytest.mark.slow
def test_a_base_says_what_was_lost_gained_or_never_there() -> None:
    changes = change_of([0.0, 1.0, 1.0], [1.0, 1.0, 0.0])
    assert changes["instruction"] == "lost in fine-tuning"
    assert changes["state"] == "gained"
    assert changes["picture"] in ("in both", "stronger"), "its share of a variance that is another"
    assert change_of([1.0, 0.0, 0.0], [1.0, 0.0, 0.0]) == {
        "instruction": "in both",
        "picture": "never there",
        "state": "never there",
    }
    assert change_of([1.0, 0.3, 1.0], [0.3, 1.0, 1.0])["instruction"] == "stronger"
    assert change_of([0.3, 1.0, 1.0], [1.0, 0.3, 1.0])["instruction"] == "weaker"


@pytest.mark.slow
def test_a_base_with_other_effects_by_chance_is_not_a_loss_in_more_than_five_of_a_hundred_draws() -> None:
    alarms = 0
    for seed in range(100):
        exchange = InputExchange(linear_policy([1.0, 0.5, 0.0], wandering=0.5), frames(16, 8, seed), seed)
        twin = linear_policy([0.5, 1.0, 0.0], wandering=0.5)
        (state,) = exchange.against(twin, exchange.measure(["state"]))
        alarms += state.base is not None and state.base.change in ("lost in fine-tuning", "gained")
    assert alarms <= 10, "5 % of 100, and three standard deviations"


def test_the_plan_counts_every_inference() -> None:
    inference_count = 0
    policy = linear_policy([1.0, 1.0, 1.0])

    def infer(observations: Sequence[Observation], seeds: Sequence[int]) -> Actions:
        nonlocal inference_count
        inference_count += len(seeds)
        return policy(observations, seeds)  # type: ignore[no-any-return]

    exchange = InputExchange(infer, frames())
    inputs = exchange.measure()
    assert inference_count == count_inferences(len(frames()), len(inputs))
    exchange.against(infer, inputs)
    assert inference_count == count_inferences(len(frames()), len(inputs), base=True)


def test_an_input_that_is_declared_absent_is_none_unless_it_moves_the_action() -> None:
    exchange = InputExchange(linear_policy([1.0, 1.0, 0.0]), frames())
    inputs = {diagnosed.name: diagnosed for diagnosed in exchange.measure(absent={"state", "picture"})}
    assert inputs["state"].verdict == "not an input"
    assert inputs["picture"].matters, "a declaration does not outweigh what was measured"


def test_a_tokenizer_of_one_spelling_is_given_another_control_and_without_any_only_a_decision_is_shown() -> None:
    def knowing(refused: str, weights: Sequence[float]) -> Any:
        policy = linear_policy(weights)

        def infer(observations: Sequence[Observation], seeds: Sequence[int]) -> Actions:
            if any(re.search(refused, observation.instruction) for observation in observations):
                raise InstructionError("a word that this tokenizer does not know")
            return policy(observations, seeds)  # type: ignore[no-any-return]

        return infer

    (stopped,) = InputExchange(knowing("^[A-Z]|^$", [1.0, 1.0, 1.0]), frames()).measure(["instruction"])
    assert stopped.control == 0
    other_spelling = "[.]|^[A-Z]|^$"
    (decides,) = InputExchange(knowing(other_spelling, [1.0, 0.2, 0.0]), frames()).measure(["instruction"])
    assert (decides.verdict, np.isnan(decides.control)) == ("decides", True)
    (moves,) = InputExchange(knowing(other_spelling, [0.5, 1.0, 0.0]), frames()).measure(["instruction"])
    assert moves.verdict == "open"
    assert "--paraphrases" in moves.reason


@pytest.mark.parametrize(("verdict", "is_loss"), [("no effect", True), ("open", False)])
def test_a_loss_is_named_where_the_input_is_shown_to_have_no_effect_and_not_where_that_is_open(
    verdict: Verdict, is_loss: bool
) -> None:
    passage = [SitePassage("backbone.00", 0.8, 0.0), SitePassage("expert.03", 0.2, 0.0)]
    text = describe_passage(passage, verdict)
    assert text.startswith("it is strongest at backbone.00 (relative difference 0.8) and reaches expert.03")
    assert ("the loss is in the action part" in text) == is_loss


def test_a_loss_behind_the_last_site_is_not_looked_for_before_it() -> None:
    passage = [SitePassage("backbone.00", 0.2, 0.0), SitePassage("expert.03", 0.8, 0.0)]
    assert describe_passage(passage, "no effect").endswith(
        "expert.03 (relative difference 0.8), the last site: the loss is behind it"
    )


@pytest.mark.parametrize(("control", "is_named"), [(0.08, True), (0.0, False), (None, False)])
def test_a_text_of_which_the_length_alone_arrives_is_told_from_one_of_which_nothing_does(
    control: float | None, is_named: bool
) -> None:
    zeros, groups = np.zeros(12), np.array([f"group {index // 2}" for index in range(12)])
    deaf = importance_of(
        "instruction",
        Exchanges(
            exchanged=zeros,
            control=None if control is None else zeros + control,
            every=zeros + 0.5,
            groups=groups,
            frames=np.arange(12),
            repeated=np.zeros(12, bool),
            largest=zeros,
            blanked=zeros,
        ),
    )
    assert deaf.verdict == "does not arrive"
    assert ("its control changes some in 12 of 12" in sentence(deaf)) is is_named


@pytest.mark.parametrize(("every", "is_named"), [(0.05, True), (0.5, False)])
def test_diagnose_says_that_the_seed_decides_the_action(every: float, is_named: bool) -> None:
    inputs = (
        InputDiagnosis("instruction", "moves", "", share=every, every=every),
        InputDiagnosis("state", "not varied", ""),
    )
    lines = sentences(Diagnosis("key", "policy", 24, 12, inputs))
    assert ("the seed decides it" in lines[-1]) is is_named


@pytest.mark.parametrize("verdict", ["no effect", "does not arrive"])
def test_a_state_in_other_units_is_lost_in_front_of_the_network_wherever_its_difference_ends(
    verdict: Verdict,
) -> None:
    passage = (SitePassage("backbone.00", 0.5, nan), SitePassage("expert.00", 0.2, nan))
    state = InputDiagnosis("state", verdict, "", passage=passage)
    assert "in front of" not in sentence(state)
    units = "j0 about 57.3 times smaller than in training, as radians for degrees"
    certain = replace(state, units=units, units_are_other=True)
    assert certain.where == f"the loss is in front of the network: {units}"
    assert "behind" not in sentence(certain)
    assert replace(state, units=units).where == f"a loss may be in front of the network: {units}"
    assert replace(state, verdict="moves", units=units, units_are_other=True).where.endswith(units)
