import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch

from probe_kit.errors import CheckpointError, InstructionError, ObservationError, UnknownSiteError
from probe_kit.hooks import Observation, Site, capture
from probe_kit.hooks.families.pi0.adapter import Pi0

TOLERANCE = 1e-5


def test_capture_reproduces_the_golden_streams_and_actions(golden_pi0: Path) -> None:
    """Backbone at every layer, expert at every layer and iteration, against lerobot's original outputs."""
    reference = np.load(golden_pi0 / "reference.npz")
    cameras = json.loads((golden_pi0 / "dims.json").read_text(encoding="utf-8"))["cameras"]
    policy = Pi0.load(str(golden_pi0 / "checkpoint"))
    batch = {
        "observation.state": torch.from_numpy(reference["in_state"]),
        "observation.language.tokens": torch.from_numpy(reference["in_lang_tokens"]),
        "observation.language.attention_mask": torch.from_numpy(reference["in_lang_mask"]),
    } | {c: torch.from_numpy(reference[f"in_image_{c.split('.')[-1]}"]) for c in cameras}
    with capture(policy, policy.sites()) as tape:
        actions = policy.network.predict_action_chunk(batch, noise=torch.from_numpy(reference["in_noise"]))

    np.testing.assert_allclose(actions, reference["actions"], atol=TOLERANCE)
    valid = reference["prefix_pad"]
    for layer, expected in enumerate(reference["backbone_resid"]):
        np.testing.assert_allclose(tape[Site("backbone", layer)][valid], expected[valid], atol=TOLERANCE)
    for iteration, layers in enumerate(reference["expert_resid"]):
        for layer, expected in enumerate(layers):
            site = Site("expert", layer, iteration=iteration)
            np.testing.assert_allclose(tape[site], expected, atol=TOLERANCE)


def test_golden_statistics_turn_into_the_recorded_units(golden_pi0: Path) -> None:
    reference = np.load(golden_pi0 / "reference.npz")
    policy = Pi0.load(str(golden_pi0 / "checkpoint"))
    np.testing.assert_allclose(
        policy.state_units.normalise(reference["in_raw_state"]), reference["in_state"], atol=TOLERANCE
    )
    np.testing.assert_allclose(
        policy.action_units.restore(reference["actions"]), reference["actions_unnormalized"], atol=TOLERANCE
    )


def test_roles_describe_the_packing_the_model_really_uses(pi0_tiny: Pi0, observation: Observation) -> None:
    """Position ids count valid tokens, so they say which positions the model treats as padding."""
    seen: list[torch.Tensor] = []
    layer = pi0_tiny.stacks["backbone"].layers[0]
    handle = layer.register_forward_pre_hook(lambda _m, _a, kw: seen.append(kw["position_ids"]), with_kwargs=True)
    longer = replace(observation, instruction="Put the cube on the picture with three apples")
    pi0_tiny.act([observation, longer], [0, 0])
    handle.remove()
    roles = pi0_tiny.roles([observation, longer])["backbone"]
    expected = np.stack([np.cumsum(row.valid) - 1 for row in roles])
    np.testing.assert_array_equal(seen[0], expected)
    assert roles[0].mask("image.base").sum() == 36
    assert roles[0].mask("language").sum() == 8  # seven words and the newline
    assert roles[0].mask("special").sum() == 1


def test_every_instruction_of_the_embedded_suite_is_read_whole(pi0_tiny: Pi0, small_suite) -> None:
    for instruction in {item.instruction for item in small_suite.items}:
        tokens, mask = pi0_tiny.tokenise([instruction])
        words = pi0_tiny.tokenizer.convert_ids_to_tokens(tokens[0, mask[0]].tolist())
        assert words == ["<bos>", *instruction.lower().split(), "\n"]


def test_a_word_the_tokenizer_does_not_know_is_an_error(pi0_tiny: Pi0, observation: Observation) -> None:
    with pytest.raises(InstructionError, match="<unk>"):
        pi0_tiny.act([replace(observation, instruction="Put the cube on the zebra")], [0])


@pytest.mark.parametrize(
    "image", [np.zeros((4, 4, 3), np.float32), np.zeros((4, 4), np.uint8), np.zeros((3, 4, 4), np.uint8)]
)
def test_pictures_of_another_type_or_shape_are_refused(
    pi0_tiny: Pi0, observation: Observation, image: np.ndarray
) -> None:
    with pytest.raises(ObservationError, match="expected uint8"):
        pi0_tiny.act([replace(observation, image=image)], [0])


def test_a_state_of_another_size_is_refused(pi0_tiny: Pi0, observation: Observation) -> None:
    with pytest.raises(ObservationError, match="7 numbers"):
        pi0_tiny.act([replace(observation, state=np.zeros(7, np.float32))], [0])


def test_a_site_the_model_does_not_have_is_refused(pi0_tiny: Pi0) -> None:
    with pytest.raises(UnknownSiteError, match=r"backbone\.04"):
        pi0_tiny.tap(Site("backbone", 4))


def test_missing_statistics_are_an_error_and_not_an_identity(tmp_path: Path, pi0_tiny: Pi0) -> None:
    import shutil

    copy = Path(shutil.copytree(pi0_tiny.folder, tmp_path / "checkpoint"))
    next(copy.glob("policy_postprocessor*.safetensors")).unlink()
    policy = Pi0.load(str(copy))
    with pytest.raises(CheckpointError, match=r"action\.mean"):
        _ = policy.action_units
