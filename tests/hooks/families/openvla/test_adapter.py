""""""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks import Observation, Site, capture, load_policy
from probe_kit.hooks.families.openvla.adapter import PROMPTS, OpenVLA, load_openvla
from probe_kit.hooks.families.shared.action_statistics import ActionStatistics
from probe_kit.hooks.families.shared.action_tokens import ActionTokens
from probe_kit.models.checkpoint_files import STATISTICS_FILE
from tests.hooks.families.prismatic.checkpoints import SINGLE, config_values, write_checkpoint, write_tokenizer

TOKENS = ActionTokens(vocabulary=32000, bins=256)


def entry(**changes: object) -> dict[str, object]:
    return {"action": {"q01": [-2.0, 0.0], "q99": [4.0, 1.0], "mask": [True, False]} | changes}


def test_ids_count_down_from_the_end_of_the_vocabulary() -> None:
    values = TOKENS.values(np.array([31999, 31872, 31744]))
    np.testing.assert_allclose(values, [-1 + 1 / 255, 0.0, 1 - 1 / 255], atol=1e-12)


def test_encoding_as_in_training_and_decoding_stays_within_half_a_bin() -> None:
    """Training digitises the action against 256 edges and subtracts the number from the vocabulary."""
    actions = np.linspace(-1, 1, 1001)
    ids = 32000 - np.digitize(actions, np.linspace(-1, 1, 256))
    assert TOKENS.is_action(ids).all()
    assert np.abs(TOKENS.values(ids) - actions).max() <= 1 / 255 + 1e-12


def test_ids_that_name_no_bin_are_known_as_such_and_count_as_the_nearest() -> None:
    ids = np.array([5, 31743, 32010])
    assert not TOKENS.is_action(ids).any()
    np.testing.assert_allclose(TOKENS.values(ids), [1 - 1 / 255, 1 - 1 / 255, -1 + 1 / 255])


def test_masked_dimensions_stay_as_decoded_and_others_span_their_quantiles() -> None:
    statistics = ActionStatistics.choose({"mine": entry()}, None)
    np.testing.assert_allclose(
        statistics.restore(np.array([[-1, -1], [0, 0.5], [1, 1]])), [[-2, -1], [1, 0.5], [4, 1]]
    )


def test_the_only_data_set_needs_no_name_and_several_have_to_be_chosen_from() -> None:
    statistics_by_name = {"bridge_orig": entry(), "other": entry()}
    assert ActionStatistics.choose(statistics_by_name, "other").key == "other"
    with pytest.raises(UsageError, match="with -M unnorm_key=NAME: bridge_orig, other"):
        ActionStatistics.choose(statistics_by_name, None)


@pytest.mark.parametrize(
    ("statistics", "message"),
    [
        ({}, "no physical unit"),
        ({"mine": {"action": {"q01": [0.0]}}}, "lack q99"),
        ({"mine": entry(q99=[1.0])}, "one finite number"),
        ({"mine": entry(q99=[1.0, float("nan")])}, "one finite number"),
    ],
)
def test_statistics_that_cannot_be_used_are_an_error(statistics: dict, message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        ActionStatistics.choose(statistics, None)


pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens")


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bridge = config_values()["norm_stats"]["bridge_orig"]
    other = {"action": {**bridge["action"], "q99": [0.2] * 7}}
    statistics = {"bridge_orig": bridge, "other": other}
    return write_checkpoint(tmp_path_factory.mktemp("openvla"), norm_stats=statistics)


@pytest.fixture(scope="module")
def fused(folder: Path) -> OpenVLA:
    return load_openvla(str(folder), unnorm_key="bridge_orig")


@pytest.fixture(scope="module")
def mistral(tmp_path_factory: pytest.TempPathFactory) -> OpenVLA:
    where = tmp_path_factory.mktemp("mistral")
    write_checkpoint(where, vision=SINGLE, language="mistral-v0.1-7b-pure", image_resize_strategy="letterbox")
    return load_openvla(str(write_tokenizer(where)), unnorm_key="bridge_orig")


@pytest.fixture(scope="module")
def golden(golden_openvla: Path) -> OpenVLA:
    return load_openvla(str(golden_openvla / "checkpoint"), unnorm_key="bridge_orig")


# -- prompt ----------------------------------------------------------------------------------------------------


def test_the_prompt_is_lower_case_and_ends_with_one_empty_token(fused: OpenVLA) -> None:
    text = "In: What action should the robot take to put the cube on the star?\nOut:"
    expected = [*fused.tokenizer.encode(text), 29]
    assert fused.prompt("Put the Cube on the star") == expected
    assert fused.with_empty_token(expected) == expected


def test_a_file_tokenizer_gets_the_beginning_of_the_sequence(mistral: OpenVLA) -> None:
    """The file has no rule that adds it; then "in:" and "what", with which the prompt begins."""
    assert mistral.prompt("put the cube")[:3] == [1, 6, 7]


def test_a_word_the_tokenizer_does_not_know_is_an_error(mistral: OpenVLA, observation: Observation) -> None:
    with pytest.raises(InstructionError, match="<unk>"):
        mistral.act([replace(observation, instruction="put the cube on the zebra")], [0])


def test_the_first_release_gets_vicunas_prompt(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path, vision=SINGLE, language="vicuna-v15-7b")
    assert load_openvla(str(folder), unnorm_key="bridge_orig").template == PROMPTS["openvla-v01"]
    assert (
        load_openvla(str(folder), prompt="do {instruction} now", unnorm_key="bridge_orig").template
        == "do {instruction} now"
    )
    with pytest.raises(UsageError, match="instruction"):
        load_openvla(str(folder), prompt="do something", unnorm_key="bridge_orig")


def test_another_split_of_the_prompt_than_llamas_is_refused_at_full_vocabulary(tmp_path: Path) -> None:
    text = config_values()["text_config"] | {"vocab_size": 32064, "pad_token_id": 32000}
    folder = write_checkpoint(tmp_path, vision=SINGLE, text_config=text)
    policy = load_openvla(str(folder), unnorm_key="bridge_orig")
    with pytest.raises(CheckpointError, match="512, 29901, 1724"):
        policy.prompt("put the cube on the star")


def test_without_a_tokenizer_the_missing_files_are_named(tmp_path: Path, observation: Observation) -> None:
    folder = write_checkpoint(tmp_path)
    (folder / "tokenizer.json").unlink()
    policy = load_openvla(str(folder), unnorm_key="bridge_orig")
    with pytest.raises(CheckpointError, match=r"tokenizer\.json and tokenizer_config\.json are missing") as caught:
        policy.act([observation], [0])
    assert str(folder) in str(caught.value)


def test_picture_positions_cannot_know_the_instruction(fused: OpenVLA, observation: Observation) -> None:
    """Attention is causal and the picture comes first; docs/token-policies.md says what that means for probes."""
    captured = []
    for text in ("Put the cube on the star", "Take it away"):
        with capture(fused, fused.sites()) as activations:
            fused.act([replace(observation, instruction=text)], [0])
        captured.append(activations[Site("backbone", 2)])
    patches = 1 + fused.network.patches
    torch.testing.assert_close(captured[0][:, :patches], captured[1][:, :patches], rtol=0, atol=1e-5)
    assert (captured[0][:, -1] - captured[1][:, -1]).abs().max() > 1e-3


# -- actions ---------------------------------------------------------------------------------------------------


def test_the_gripper_is_open_or_closed_and_the_rest_in_units_of_the_data(
    fused: OpenVLA, observation: Observation
) -> None:
    action = fused.act([observation], [0])[0, 0]
    assert action[6] in (0, 1)
    assert (np.abs(action[:6]) <= 0.1).all()


def test_other_statistics_give_other_units_for_the_same_tokens(golden_openvla: Path) -> None:
    checkpoint = str(golden_openvla / "checkpoint")
    policies = [load_openvla(checkpoint, unnorm_key=key) for key in ("bridge_orig", "other_set")]
    assert [policy.card.settings["unnorm_key"] for policy in policies] == ["bridge_orig", "other_set"]
    assert policies[0].card.settings["action_statistics"] != policies[1].card.settings["action_statistics"]


@pytest.mark.slow
def test_statistics_that_fine_tuning_wrote_are_found_beside_the_weights(folder: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "tuned"))
    mine = {"my_arm": {"action": {"q01": [-1.0] * 7, "q99": [1.0] * 7}}}
    (copy / STATISTICS_FILE).write_text(json.dumps(mine), encoding="utf-8")
    assert load_openvla(str(copy)).statistics.key == "my_arm"
    assert load_openvla(str(copy), unnorm_key="my_arm").statistics.mask.all()
    with pytest.raises(UsageError, match="no action statistics of 'bridge_orig'"):
        load_openvla(str(copy), unnorm_key="bridge_orig")
    with pytest.raises(UsageError, match="Did you mean my_arm"):
        load_openvla(str(copy), unnorm_key="my_arms")


def test_actions_of_another_number_of_dimensions_are_refused(tmp_path: Path, observation: Observation) -> None:
    two_arms = {"two_arms": {"action": {"q01": [0.0] * 14, "q99": [1.0] * 14}}}
    policy = load_openvla(str(write_checkpoint(tmp_path, norm_stats=two_arms)))
    assert policy.streams["action"].iterations == 14
    with pytest.raises(CheckpointError, match="14 dimensions"):
        policy.act([observation], [0])


def test_tokens_that_name_no_action_are_said(fused: OpenVLA, observation: Observation) -> None:
    head = fused.network.language_model.lm_head.weight
    before = head.clone()
    with torch.no_grad():
        head.zero_()  # every logit equal: the first id wins, which is text
    try:
        with pytest.warns(UserWarning, match="name no action"):
            fused.act([observation], [0])
    finally:
        with torch.no_grad():
            head.copy_(before)


def test_the_centre_crop_changes_what_the_model_sees_and_is_written_down(
    folder: Path, observation: Observation
) -> None:
    uncropped, middle = (
        load_openvla(str(folder), centre_crop=crop, unnorm_key="bridge_orig") for crop in (False, True)
    )
    edge = observation.image.copy()
    edge[:2] = 255 - edge[:2]
    pixels = [middle.pixel_values([middle._look(image)]) for image in (observation.image, edge)]
    torch.testing.assert_close(pixels[0][..., 4:, :], pixels[1][..., 4:, :], rtol=0, atol=1e-5)
    assert (uncropped.card.settings["centre_crop"], middle.card.settings["centre_crop"]) == ("False", "True")
    assert any("90%" in note for note in middle.card.notes)


# -- loading ---------------------------------------------------------------------------------------------------


def test_a_prismatic_model_without_actions_is_refused(tmp_path: Path) -> None:
    folder = write_checkpoint(tmp_path, model_type="prismatic")
    with pytest.raises(CheckpointError, match="--model prismatic"):
        load_openvla(str(folder), unnorm_key="bridge_orig")


def test_bfloat16_is_exactly_the_files_weights_rounded(folder: Path, observation: Observation) -> None:
    policy = load_openvla(str(folder), dtype="bfloat16", unnorm_key="bridge_orig")
    exact = load_openvla(str(folder), unnorm_key="bridge_orig")
    assert policy.card.dtype == "bfloat16"
    assert policy.card.exact
    for name, tensor in exact.network.state_dict().items():
        assert torch.equal(policy.network.state_dict()[name], tensor.to(torch.bfloat16))
    assert np.isfinite(policy.act([observation], [0])).all()
    with pytest.raises(UsageError, match="float16"):
        load_openvla(str(folder), dtype="float16", unnorm_key="bridge_orig")


def test_an_option_of_another_family_is_refused() -> None:
    with pytest.raises(UsageError, match="pi0-tiny has no model option unnorm_key; it has none"):
        load_policy("pi0-tiny", unnorm_key="bridge_orig")


def test_drawn_actions_repeat_by_their_seed_and_name_actions_only(folder: Path, observation: Observation) -> None:
    """At a temperature random weights, which put out any token when greedy, choose among the 256 of actions."""
    policy = load_openvla(str(folder), temperature=0.6, unnorm_key="bridge_orig")
    chunks = [policy.act([observation], [seed]) for seed in (1, 1, 2)]
    np.testing.assert_array_equal(chunks[0], chunks[1])
    assert np.abs(chunks[0] - chunks[2]).max() > 0
    assert policy.flagged is not None
    assert not policy.flagged.any()
    other = replace(observation, instruction="Put the cube on the star")
    both = policy.act([other, observation], [5, 1])
    np.testing.assert_array_equal(both[1], chunks[0][0])
    with pytest.raises(UsageError, match="temperature"):
        load_openvla(str(folder), temperature=-1.0, unnorm_key="bridge_orig")


@pytest.mark.slow
def test_draws_as_the_release_does_are_of_the_50_likeliest_tokens_of_actions(
    folder: Path, observation: Observation
) -> None:
    """At a temperature that makes all kept tokens alike: the first of the seven tokens has 50 values, not 256."""
    policy = load_openvla(str(folder), temperature=1e6, top_k="checkpoint", unnorm_key="bridge_orig")
    assert policy.card.settings["top_k"] == "50"
    observations = [observation] * 300
    drawn = policy.infer_without_acting(observations, range(300))[:, 0, 0]
    assert 40 < len(set(drawn.tolist())) <= 51  # two tokens name the last bin's neighbour alike
    everything = load_openvla(str(folder), temperature=1e6, unnorm_key="bridge_orig")
    assert "top_k" not in everything.card.settings
    assert len(set(everything.infer_without_acting(observations, range(300))[:, 0, 0].tolist())) > 100


def test_pictures_resized_as_tensors_are_near_those_of_pil_and_not_the_same(
    folder: Path, observation: Observation
) -> None:
    """bfloat16 keeps eight bits; the filter is the same."""
    smooth = np.linspace(0, 255, 48 * 64 * 3).reshape(48, 64, 3).astype(np.uint8)
    pil, tensor = (load_openvla(str(folder), resize=way, unnorm_key="bridge_orig") for way in ("pil", "tensor"))
    ours, theirs = (policy.pixel_values([smooth]).numpy() for policy in (pil, tensor))
    assert ours.shape == theirs.shape
    difference = np.abs(ours - theirs).max()
    assert 0 < difference < 0.08
    assert tensor.act([observation], [0]).shape == (1, 1, 7)
