"""MolmoAct2 keeps the contract, gives lerobot's actions, and refuses CUDA graphs while it is captured."""

import json
import shutil
from contextlib import suppress
from copy import copy
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.errors import CaptureError, CheckpointError, ObservationError, WeightsError
from probe_kit.hooks import Observation, capture
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.molmoact2 import adapter as network
from probe_kit.hooks.families.molmoact2.adapter import MolmoAct2
from tests.hooks.families.molmoact2.checkpoints import write_molmoact2
from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LOW
from tests.support.lerobot_pipelines import changed, raw, save_pipelines


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_molmoact2(tmp_path_factory.mktemp("molmoact2"))


@pytest.fixture(scope="module")
def molmoact2(folder: Path) -> MolmoAct2:
    return MolmoAct2.load(str(folder))


@pytest.fixture
def observations(molmoact2: MolmoAct2) -> list[Observation]:
    return examples_for(molmoact2, "Put the cube on the star", "Put the cube on the red shape")


@pytest.mark.parametrize("dtype", ["float32", pytest.param("bfloat16", marks=pytest.mark.slow)])
def test_actions_are_those_of_lerobots_own_policy_bit_for_bit(
    folder: Path, observations: list[Observation], dtype: str
) -> None:
    """Its own sampling, with its own blocks, draws the noise of the same seed."""
    policy, checkpoint = MolmoAct2.load(str(folder), dtype=dtype), folder / "vlm"
    batch = policy.batch(observations[:1])
    plain = network.lerobots_policy(policy.config, network.network_config(checkpoint), checkpoint)
    assert not hasattr(plain._backbone().action_expert.blocks[0], "mlp_gate")
    plain.load_state_dict(policy.network.state_dict())
    drawn = torch.randn((1, 4, 32), generator=torch.Generator().manual_seed(5), dtype=network.DTYPES[dtype])
    ours = policy.infer(batch, drawn)
    theirs = plain.predict_action_chunk(batch, generator=torch.Generator().manual_seed(5))
    torch.testing.assert_close(theirs, ours.float(), rtol=0, atol=0)
    assert theirs.abs().max() > 0.1


NAMES = {"action": [*"xyzabc", "gripper"], "observation.state": [*"xyzabcd", "gripper"]}
MODES = {"VISUAL": "IDENTITY", "STATE": "QUANTILES", "ACTION": "QUANTILES"}
FRAME = {"joint_signs": [1, -1, 1, 1, -1, 1], "joint_offsets": [0.0, 0.1, 0.0, -0.2, 0.0, 0.3]}


def _without_clamps(steps: list[dict[str, Any]]) -> None:
    steps[:] = [step for step in steps if "clamp" not in step["registry_name"]]


@pytest.mark.slow
@pytest.mark.parametrize(
    ("fields", "change"),
    [
        ({}, None),
        ({"dataset_feature_names": NAMES}, None),
        ({"image_keys": ["observation.images.wrist", "observation.images.image"]}, None),
        (FRAME, None),
        ({"dataset_feature_names": NAMES, **FRAME}, _without_clamps),
        ({"normalization_mapping": MODES | {"ACTION": "IDENTITY"}}, None),
        ({"normalization_mapping": MODES | {"STATE": "MEAN_STD", "ACTION": "MIN_MAX"}}, None),
        ({}, changed("molmoact2_pack_inputs", setup_type="a single arm", control_mode="absolute pose")),
        ({}, changed("molmoact2_pack_inputs", num_state_tokens=8, normalize_language=False)),
        ({}, changed("molmoact2_pack_inputs", add_setup_tokens=False, add_control_tokens=False)),
    ],
)  # fmt: skip
def test_actions_are_those_of_lerobots_saved_pipelines_and_policy(
    tmp_path: Path, observations: list[Observation], fields: dict[str, Any], change: Any
) -> None:
    """From the raw pictures and state to metres: what the saved steps say counts, not the configuration."""
    write_molmoact2(tmp_path, cameras=("image", "wrist"))
    checkpoint = str(tmp_path / "vlm")  # the other action mode reads a FAST tokenizer on the hub
    before, behind = save_pipelines(
        tmp_path, change, action_mode="continuous", checkpoint_path=checkpoint, **fields
    )
    ours = MolmoAct2.load(str(tmp_path))
    ours = ours.with_cameras(ours.cameras)
    theirs = network.lerobots_policy(copy(ours.config), network.network_config(Path(checkpoint)), Path(checkpoint))
    theirs.load_state_dict(load_file(tmp_path / "model.safetensors"))
    states = np.array([LOW + 0.3 * (HIGH - LOW), LOW - 0.1 * (HIGH - LOW)], np.float32)
    states[:, 7] = np.abs(states[:, 7])
    for seed, (observation, state) in enumerate(zip(observations, states, strict=True)):
        pictures = {"image": observation.image, "wrist": observation.image[:, ::-1].copy()}
        packed = before(raw(replace(observation, state=state), pictures))
        first, second = ours.cameras
        rearranged = replace(observation, state=state, image=pictures[first], cameras={second: pictures[second]})
        for name in ("input_ids", "pixel_values"):
            torch.testing.assert_close(ours.batch([rearranged])[name], packed[name], rtol=0, atol=0)
        metres = behind(theirs.predict_action_chunk(packed, generator=torch.Generator().manual_seed(seed)))
        np.testing.assert_allclose(ours.act([rearranged], [seed]), metres.numpy(), atol=1e-6)


def test_a_gripper_that_stays_as_it_is_must_lie_between_its_bounds(
    tmp_path: Path, observations: list[Observation]
) -> None:
    """lerobot refuses it too."""
    write_molmoact2(tmp_path)
    save_pipelines(tmp_path, action_mode="continuous", checkpoint_path=str(tmp_path / "vlm"),
                   dataset_feature_names=NAMES)  # fmt: skip
    policy = MolmoAct2.load(str(tmp_path))
    state = np.array([0.3, 0, 0.1, 0, 0, 0, 0, 1.5], np.float32)
    with pytest.raises(ObservationError, match=r"number 7 of the state is 1\.5"):
        policy.act([replace(observations[0], state=state)], [0])


@pytest.mark.parametrize(
    ("fields", "change", "message"),
    [
        ({}, lambda steps: steps.insert(0, {"registry_name": "evo1_pad_state_processor"}), "evo1_pad_state"),
        ({}, changed("molmoact2_pack_inputs", image_keys=["observation.images.top"]), "top, which its config"),
        ({"joint_signs": [2.0], "joint_offsets": [0.0]}, None, "expected 1 or -1"),
        ({"norm_tag": "libero"}, None, "names the statistics 'libero'"),
    ],
)  # fmt: skip
def test_pipelines_that_say_something_else_are_refused(
    folder: Path, tmp_path: Path, fields: dict[str, Any], change: Any, message: str
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    tag = fields.pop("norm_tag", None)
    with suppress(KeyError, ImportError, ValueError, TypeError):
        save_pipelines(tmp_path, change, action_mode="continuous", checkpoint_path=str(tmp_path / "vlm"), **fields)
    if tag is not None:
        path = tmp_path / "config.json"
        path.write_text(
            json.dumps(json.loads(path.read_text(encoding="utf-8")) | {"norm_tag": tag}), encoding="utf-8"
        )
    with pytest.raises(CheckpointError, match=message):
        MolmoAct2.load(str(tmp_path))


def test_cuda_graphs_are_off_and_an_error_while_they_are_on(folder: Path, observations: list[Observation]) -> None:
    policy = MolmoAct2.load(str(folder))
    assert not network.uses_cuda_graphs(policy.network)
    policy.network._set_inference_cuda_graph_enabled(True)
    with pytest.raises(CaptureError, match="CUDA graphs"), capture(policy, policy.sites()):
        policy.act(observations, [0, 0])
    with pytest.raises(CaptureError, match="CUDA graphs"):
        policy.act(observations, [0, 0])


def test_every_block_of_the_expert_reads_the_keys_and_values_of_its_own_layer(
    molmoact2: MolmoAct2, observations: list[Observation]
) -> None:
    """Zeros in block n's change what block n of the expert reads, and nothing that enters it."""
    from probe_kit.hooks import Site, edit

    read = [Site("expert", layer, "cross_attention", 0) for layer in range(2)]
    entering = [Site("expert", layer, iteration=0) for layer in range(3)]
    with capture(molmoact2, [*read, *entering]) as plain:
        molmoact2.act(observations, [0, 0])
    for layer in range(2):
        with (
            edit(molmoact2, {Site("kv", layer, "values"): torch.zeros_like}),
            capture(molmoact2, [*read, *entering]) as changed,
        ):
            molmoact2.act(observations, [0, 0])
        assert torch.equal(plain[entering[layer]], changed[entering[layer]])
        assert not torch.equal(plain[read[layer]], changed[read[layer]])


def test_recorded_attention_on_the_values_is_what_the_block_reads(
    molmoact2: MolmoAct2, observations: list[Observation]
) -> None:
    """Weights times values, projected, is the block's cross-attention, which a fused kernel computes."""
    recorded: dict[tuple[int, int], torch.Tensor] = {}
    read: list[torch.Tensor] = []
    attention = molmoact2.network._backbone().action_expert.blocks[1].cross_attn
    handle = attention.register_forward_hook(
        lambda _, __, keywords, output: (read.append(output), values.append(keywords["kv_v"]), None)[-1],
        with_kwargs=True,
    )
    values: list[torch.Tensor] = []
    try:
        with molmoact2.record_attention(lambda *record: recorded.update({record[:2]: record[2]})):
            molmoact2.act(observations, [0, 1])
    finally:
        handle.remove()
    assert recorded.keys() == {(block, step) for block in range(2) for step in range(3)}
    for step in range(3):
        heads = recorded[1, step] @ attention._as_heads(values[step]).transpose(1, 2)
        ours = attention.out_proj(heads.transpose(1, 2).flatten(2))
        torch.testing.assert_close(ours, read[step], rtol=0, atol=1e-5)
    (roles,) = molmoact2.roles(observations[1:])["backbone"]
    assert recorded[1, 0].shape[-1] >= len(roles)
    padded = recorded[1, 0][1, :, :, len(roles) :]
    assert not padded.any()


def test_what_a_block_adds_makes_the_next_residual_with_both_attentions(
    molmoact2: MolmoAct2, observations: list[Observation]
) -> None:
    stream = molmoact2.streams["expert"]
    parts = [site for name in ("residual", "attention", "cross_attention", "mlp") for site in stream.sites(name)]
    with capture(molmoact2, parts) as cache:
        molmoact2.act(observations, [0, 0])
    for site in stream.sites("mlp"):
        added = sum(
            cache[replace(site, quantity=name)] for name in ("residual", "attention", "cross_attention", "mlp")
        )
        behind = cache[replace(site, layer=site.layer + 1, quantity="residual")]
        torch.testing.assert_close(added, behind, rtol=0, atol=1e-5)


def test_roles_name_pictures_instruction_and_state(molmoact2: MolmoAct2, observations: list[Observation]) -> None:
    row = molmoact2.packing.row(
        {"image": observations[0].image}, "Put the cube on the star", np.zeros(8, np.float32)
    )
    pieces = molmoact2.tokenizer.convert_ids_to_tokens(row.inputs["input_ids"][0].tolist())
    by_role = {role: "".join(piece for piece, label in zip(pieces, row.labels, strict=True) if label == role)
               for role in ("language", "state", "image.image")}  # fmt: skip
    assert by_role["language"].replace("\u0120", " ") == "put the cube on the star"
    assert by_role["state"] == "<state_8>" * 8
    assert by_role["image.image"] == "<im_patch>" * by_role["image.image"].count("<im_patch>")


def test_two_cameras_are_told_apart(tmp_path: Path) -> None:
    policy = MolmoAct2.load(str(write_molmoact2(tmp_path, cameras=("image", "wrist")))).with_cameras(
        ["image", "wrist"]
    )
    (example,) = examples_for(policy, "put the cube on the star")
    example = replace(example, cameras={"wrist": example.image[:, ::-1].copy()})
    (roles,) = policy.roles([example])["backbone"]
    counts = [int(roles.mask(f"image.{camera}").sum()) for camera in ("image", "wrist")]
    assert counts[0] == counts[1] > 0
    assert np.isfinite(policy.act([example], [0])).all()


@pytest.mark.parametrize(("field", "value"), [("action_mode", "discrete"), ("enable_lora_vlm", True)])
def test_what_the_flow_expert_cannot_do_is_refused(
    folder: Path, tmp_path: Path, field: str, value: object
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    config = json.loads((tmp_path / "config.json").read_text(encoding="utf-8"))
    config |= {field: value, "inference_action_mode": None}
    (tmp_path / "config.json").write_text(json.dumps(config), encoding="utf-8")
    with pytest.raises(CheckpointError):
        MolmoAct2.load(str(tmp_path))


def test_weights_without_an_expert_are_refused(folder: Path, tmp_path: Path) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    tensors = load_file(tmp_path / "model.safetensors")
    save_file(
        {name: tensor for name, tensor in tensors.items() if "action_expert" not in name},
        tmp_path / "model.safetensors",
    )
    with pytest.raises(WeightsError, match="action_expert"):
        MolmoAct2.load(str(tmp_path))


def test_half_precision_acts_as_captured_and_is_named_in_the_card(
    folder: Path, observations: list[Observation]
) -> None:
    policy = MolmoAct2.load(str(folder), dtype="bfloat16")
    assert policy.card.dtype == "bfloat16"
    plain = policy.act(observations, [0, 1])
    with capture(policy, policy.sites()) as cache:
        np.testing.assert_array_equal(policy.act(observations, [0, 1]), plain)
    assert cache["backbone.01.residual"].dtype == torch.bfloat16
    full = MolmoAct2.load(str(folder)).act(observations, [0, 1])
    np.testing.assert_allclose(plain, full, atol=0.05 * np.abs(full).max())
