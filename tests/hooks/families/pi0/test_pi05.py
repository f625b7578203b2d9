"""pi0.5 keeps the contract, reads its state as digits, and adds what its gates let through."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from lerobot.lerobot_types import TransitionKey
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from lerobot.policies.pi05.processor_pi05 import Pi05PrepareStateTokenizerProcessorStep
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, WeightsError
from probe_kit.hooks import Observation, capture
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.pi0 import network
from probe_kit.hooks.families.pi0.adapter import Pi05
from tests.hooks.families.pi0.pi05_checkpoints import write_pi05


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_pi05(tmp_path_factory.mktemp("pi05"))


@pytest.fixture(scope="module")
def pi05(folder: Path) -> Pi05:
    return Pi05.load(str(folder))


@pytest.fixture
def observations(pi05: Pi05) -> list[Observation]:
    return examples_for(pi05, "put the cube on the red shape", "put the cube on the star")


def test_actions_are_those_of_lerobots_own_blocks_bit_for_bit(
    pi05: Pi05, folder: Path, observations: list[Observation], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The blocks that hold gates as modules put out what lerobot's blocks do."""
    batch, noise = pi05.batch(observations), pi05.noise([3, 4])
    ours = pi05.infer(batch, noise)
    monkeypatch.setattr(network, "_attach_gates", lambda _: None)
    plain = Pi05.build(pi05.config, folder)
    assert isinstance(plain, PI05Policy)
    assert not hasattr(plain.model.paligemma_with_expert.gemma_expert.model.layers[0], "mlp_gate")
    plain.load_state_dict(pi05.network.state_dict())
    with torch.inference_mode():
        torch.testing.assert_close(plain.predict_action_chunk(batch, noise=noise), ours, rtol=0, atol=0)


def test_prompts_are_those_of_lerobots_processor(pi05: Pi05) -> None:
    texts = ["put_the cube\non the star ", "Put the cube on the red shape"]
    state = np.array([[-1.2, -1, -0.999, 0, 0.5, 0.99999, 1, 1.3], np.linspace(-1, 1, 8)], np.float32)
    step = Pi05PrepareStateTokenizerProcessorStep()
    transition = {
        TransitionKey.OBSERVATION: {"observation.state": torch.from_numpy(state)},
        TransitionKey.COMPLEMENTARY_DATA: {"task": texts},
    }
    prompts = step(transition)[TransitionKey.COMPLEMENTARY_DATA]["task"]
    assert pi05.prompts(texts, state) == prompts
    assert prompts[0].startswith("Task: put the cube on the star, State: -1 0 0 128 192 255 255 255;")


def test_the_state_reaches_the_network_as_digits_of_its_prompt(
    pi05: Pi05, observations: list[Observation]
) -> None:
    moved = replace(observations[0], state=np.array(observations[0].state) + np.float32(0.05))
    tokens = pi05.batch([observations[0], moved])["observation.language.tokens"]
    changed = (tokens[0] != tokens[1]).numpy()
    roles = pi05.roles([observations[0]])["backbone"][0]
    text = len(roles) - tokens.shape[1]
    assert changed.any()
    assert not changed[~roles.mask("state")[text:]].any()


def test_roles_name_the_instruction_the_digits_and_the_words_around_them(
    pi05: Pi05,
) -> None:
    tokens, mask = pi05.tokenise(["put the cube on the star"])
    pieces = pi05.tokenizer.convert_ids_to_tokens(tokens[0].tolist())
    labels = pi05.text_labels(tokens[0].tolist(), mask[0].tolist())
    by_role = {role: [piece for piece, label in zip(pieces, labels, strict=True) if label == role]
               for role in ("language", "state", "special")}  # fmt: skip
    assert by_role["language"] == ["put", "the", "cube", "on", "the", "star"]
    assert by_role["state"] == list("128" * 8)
    assert by_role["special"] == ["<bos>", "task", ":", ",", "state", ":", ";", "\n", "action", ":"]


def test_an_instruction_that_words_a_state_itself_keeps_its_role(pi05: Pi05) -> None:
    text = "put, state: 3; action: the cube on the star"
    tokens, mask = pi05.tokenise([text])
    labels = pi05.text_labels(tokens[0].tolist(), mask[0].tolist())
    assert labels.count("state") == 24
    assert labels.count("language") == 13


def test_the_ids_of_an_instruction_hold_no_digit_of_a_state(pi05: Pi05) -> None:
    (ids,) = pi05.token_ids(["put the cube on the star"])
    pieces = pi05.tokenizer.convert_ids_to_tokens(list(ids))
    assert " ".join(pieces) == "<bos> task : put the cube on the star , state : ; \n action :"


def test_what_a_block_adds_is_behind_its_gate(pi05: Pi05, observations: list[Observation]) -> None:
    """Not what its MLP puts out: the gates of random weights are far from 1."""
    block, written = pi05.stacks["expert"].layers[0], []
    handle = block.mlp.register_forward_hook(lambda _m, _i, output: written.append(output.clone()))
    with capture(pi05, pi05.streams["expert"].sites("mlp")) as cache:
        pi05.act(observations, [0, 0])
    handle.remove()
    added = cache["expert.00.mlp@0"]
    assert added.shape == written[0].shape
    assert (added - written[0]).abs().max() > 0.1 * written[0].abs().max()


@pytest.mark.parametrize(
    ("old", "new"),
    [("model.time_mlp_in.", "model.action_time_mlp_in."), ("model.paligemma", "paligemma"), ("model.", "")],
)
def test_older_names_of_tensors_are_read(pi05: Pi05, folder: Path, tmp_path: Path, old: str, new: str) -> None:
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    tensors = load_file(folder / "model.safetensors")
    renamed = {new + name.removeprefix(old) if name.startswith(old) else name: tensor
               for name, tensor in tensors.items()}  # fmt: skip
    assert renamed.keys() != tensors.keys()
    save_file(renamed, tmp_path / "model.safetensors")
    assert Pi05.load(str(tmp_path)).network.state_dict().keys() == pi05.network.state_dict().keys()


def test_statistics_beside_those_of_the_checkpoint_are_refused(folder: Path) -> None:
    assert Pi05.load(str(folder), statistics="bridge").embodiment_mismatch() is not None


def test_the_weights_of_a_pi0_are_refused(folder: Path, tmp_path: Path) -> None:
    """Its norms have weights where pi0.5 has networks, and it projects a state."""
    for path in folder.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    tensors = load_file(folder / "model.safetensors")
    tensors["model.state_proj.weight"] = torch.zeros(24, 10)
    save_file(tensors, tmp_path / "model.safetensors")
    with pytest.raises(WeightsError, match="state_proj"):
        Pi05.load(str(tmp_path))


@pytest.mark.parametrize(
    ("field", "value", "message"),
    [
        ("num_inference_steps", 0, "makes 0 flow steps"),
        ("num_inference_steps", -1, "makes -1 flow steps"),
        ("tokenizer_max_length", None, "reads None tokens"),
        ("tokenizer_max_length", 10**7, "reads 10000000 tokens"),
    ],
)
def test_counts_with_which_no_action_is_made_are_refused(
    folder: Path, tmp_path: Path, field: str, value: object, message: str
) -> None:
    """Without a step the action would be the noise."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    path = tmp_path / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | {field: value}), encoding="utf-8")
    with pytest.raises(CheckpointError, match=message):
        Pi05.load(str(tmp_path))
