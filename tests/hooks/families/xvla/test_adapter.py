"""X-VLA keeps the contract, and gives the actions of lerobot's own loading, processors and sampling."""

import json
import shutil
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.xvla.modeling_xvla import XVLAPolicy
from lerobot.processor import PolicyProcessorPipeline
from lerobot.processor.converters import policy_action_to_transition, transition_to_policy_action
from lerobot.utils.constants import IMAGENET_STATS
from PIL import Image
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, ObservationError, UsageError, WeightsError
from probe_kit.hooks import Observation, Site, capture, edit
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.xvla.adapter import Xvla
from tests.hooks.families.xvla.checkpoints import CHUNK, DOMAIN, DOMAINS, TEXT, to_authors_layout, write_xvla


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_xvla(tmp_path_factory.mktemp("xvla"))


@pytest.fixture(scope="module")
def xvla(folder: Path) -> Xvla:
    return Xvla.load(str(folder))


@pytest.fixture
def observations(xvla: Xvla) -> list[Observation]:
    (example,) = examples_for(xvla, "Put the cube on the star")
    picture = np.random.default_rng(0).integers(0, 256, (48, 80, 3), np.uint8)
    return [replace(example, image=picture, state=np.linspace(-0.2, 0.7, 8, dtype=np.float32))]


def lerobots(folder: Path) -> tuple[XVLAPolicy, Any, Any]:
    """lerobot's own policy and saved processors."""
    before = PolicyProcessorPipeline.from_pretrained(
        folder, "policy_preprocessor.json", overrides={"tokenizer_processor": {"tokenizer_name": str(folder)}}
    )
    behind: Any = PolicyProcessorPipeline.from_pretrained(
        folder,
        "policy_postprocessor.json",
        to_transition=policy_action_to_transition,
        to_output=transition_to_policy_action,
    )
    return XVLAPolicy.from_pretrained(str(folder)), before, behind


@pytest.mark.parametrize("dtype", ["float32", pytest.param("bfloat16", marks=pytest.mark.slow)])
def test_actions_are_those_of_lerobots_own_loading_processors_and_sampling_bit_for_bit(
    folder: Path, tmp_path: Path, observations: list[Observation], dtype: str
) -> None:
    """From the raw picture and state to metres, with noise that lerobot draws itself of the same seed."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / "config.json").read_text(encoding="utf-8")
    (tmp_path / "config.json").write_text(text.replace('"float32"', f'"{dtype}"'), encoding="utf-8")
    ours = Xvla.load(str(tmp_path))
    assert ours.card.dtype == dtype
    policy, before, behind = lerobots(tmp_path)
    (observation,) = observations
    packed = before(
        {
            "observation.images.image": torch.from_numpy(observation.image).permute(2, 0, 1),
            "observation.state": torch.from_numpy(np.asarray(observation.state, np.float32)),
            "task": observation.instruction,
        }
    )
    batch = ours.batch(observations)
    for name in ("observation.images.image", "observation.language.tokens", "domain_id"):
        torch.testing.assert_close(batch[name], packed[name], rtol=0, atol=0)
    torch.testing.assert_close(batch["observation.state"], packed["observation.state"], rtol=0, atol=1e-6)
    torch.manual_seed(7)
    theirs = policy.predict_action_chunk({**packed, "observation.state": batch["observation.state"]})
    torch.manual_seed(7)
    drawn = torch.randn(1, CHUNK, 9, dtype=torch.float32 if dtype == "float32" else torch.bfloat16)
    torch.testing.assert_close(ours.infer(batch, drawn), theirs, rtol=0, atol=0)
    metres = behind(theirs.float()).numpy()
    assert metres.shape == (1, CHUNK, 7)
    np.testing.assert_allclose(ours.action_units.restore(theirs.float().numpy()), metres, atol=1e-6)
    if dtype == "float32":
        np.testing.assert_allclose(ours.act(observations, [7]), metres, atol=1e-6)
    assert theirs.abs().max() > 0.1


def network_reads(policy: Xvla, observations: list[Observation]) -> np.ndarray[Any, Any]:
    """(3, H, W) bytes of the picture that enters the network, without ImageNet's mean and deviation."""
    mean, deviation = (np.array(IMAGENET_STATS[name]).reshape(3, 1, 1) for name in ("mean", "std"))
    picture = policy.network._prepare_images(policy.batch(observations))[0][0, 0].numpy()
    return np.asarray((picture * deviation + mean) * 255)


def test_pictures_are_padded_as_the_configuration_says_or_squashed_as_the_authors_do(
    folder: Path, xvla: Xvla, observations: list[Observation]
) -> None:
    squashed = Xvla.load(str(folder), picture="squashed")
    resized = np.asarray(
        Image.fromarray(observations[0].image).resize((64, 64), Image.Resampling.BICUBIC), np.float32
    )
    np.testing.assert_allclose(network_reads(squashed, observations), resized.transpose(2, 0, 1), atol=1e-3)
    assert xvla.card.settings["picture"] == "padded"
    assert np.abs(network_reads(xvla, observations) - network_reads(squashed, observations)).max() > 10
    np.testing.assert_array_equal(
        Xvla.load(str(folder), picture="padded").act(observations, [0]), xvla.act(observations, [0])
    )
    assert any("authors squash" in note for note in xvla.card.notes)
    assert any("squashed to 64 x 64" in note for note in squashed.card.notes)


@pytest.mark.slow
def test_a_checkpoint_that_resizes_nothing_can_be_given_either_way(
    tmp_path: Path, observations: list[Observation]
) -> None:
    checkpoint = write_xvla(tmp_path)
    values = json.loads((checkpoint / "config.json").read_text(encoding="utf-8"))
    values["resize_imgs_with_padding"] = None
    values["input_features"]["observation.images.image"]["shape"] = [3, 64, 64]
    (checkpoint / "config.json").write_text(json.dumps(values), encoding="utf-8")
    with pytest.raises(ObservationError, match="resizes nothing"):
        Xvla.load(str(checkpoint)).act(observations, [0])
    actions = [
        Xvla.load(str(checkpoint), picture=picture_mode).act(observations, [0])
        for picture_mode in ("padded", "squashed")
    ]
    assert not np.array_equal(*actions)


def test_select_action_of_lerobot_gives_the_first_actions(
    folder: Path, xvla: Xvla, observations: list[Observation]
) -> None:
    policy, _, behind = lerobots(folder)
    torch.manual_seed(3)
    actions = [behind(policy.select_action(xvla.batch(observations))).numpy() for _ in range(2)]
    np.testing.assert_allclose(xvla.act(observations, [3])[:, :2], np.stack(actions, 1), atol=1e-6)


def test_lerobot_ignores_the_noise_that_it_is_given_and_the_adapter_does_not(
    folder: Path, xvla: Xvla, observations: list[Observation]
) -> None:
    policy, _, _ = lerobots(folder)
    batch, chunks = xvla.batch(observations), []
    for seed in (0, 1):
        torch.manual_seed(5)
        chunks.append(policy.predict_action_chunk(batch, noise=xvla.noise([seed])))
    assert torch.equal(*chunks)
    assert not torch.equal(*(xvla.infer(batch, xvla.noise([seed])) for seed in (0, 1)))


def test_files_of_2025_have_florence_in_its_authors_layout(
    folder: Path, tmp_path: Path, xvla: Xvla, observations: list[Observation]
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    to_authors_layout(tmp_path)
    assert "model.vlm.image_projection" in load_file(tmp_path / "model.safetensors")
    np.testing.assert_array_equal(Xvla.load(str(tmp_path)).act(observations, [0]), xvla.act(observations, [0]))


@pytest.mark.parametrize(
    ("name", "missing"),
    [("encoder.embed_tokens", False), ("language_model.shared", False), ("soft_prompt_hub", True)],
)
def test_weights_must_be_whole_but_tied_embeddings_may_have_either_name(
    folder: Path, tmp_path: Path, xvla: Xvla, observations: list[Observation], name: str, missing: bool
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    tensors = Xvla.current_keys(load_file(tmp_path / "model.safetensors"))
    remaining = {key: tensor.clone() for key, tensor in tensors.items() if name not in key}
    assert len(remaining) == len(tensors) - 1
    save_file(remaining, tmp_path / "model.safetensors")
    if missing:
        with pytest.raises(WeightsError, match=name):
            Xvla.load(str(tmp_path))
    else:
        np.testing.assert_array_equal(Xvla.load(str(tmp_path)).act(observations, [0]), xvla.act(observations, [0]))


def test_the_expert_reads_the_end_of_the_backbone_as_tokens_of_its_own(
    xvla: Xvla, observations: list[Observation]
) -> None:
    """Zeros there change what enters the expert at the prompt's positions, and nowhere else."""
    first, end = Site("expert", 0, iteration=0), xvla.streams["backbone"].sites()[-1]
    with capture(xvla, [first]) as plain:
        xvla.act(observations, [0])
    with edit(xvla, {end: torch.zeros_like}), capture(xvla, [first]) as changed:
        xvla.act(observations, [0])
    moved = (plain[first] != changed[first]).any(-1)[0].numpy()
    roles = xvla.roles(observations)
    begin = CHUNK
    expected = np.zeros(len(moved), bool)
    expected[begin : begin + xvla.tokens_per_camera + TEXT] = True
    np.testing.assert_array_equal(moved, expected)
    names = ("image.image", "language")
    for name in names:
        assert roles["backbone"][0].mask(name).sum() == roles["expert"][0].mask(name).sum() > 0


def test_each_layer_of_the_backbone_norms_what_it_adds(xvla: Xvla, observations: list[Observation]) -> None:
    """As BART: the norm of the normed sum and the MLP's part."""
    stream = xvla.streams["backbone"]
    with capture(xvla, [site for name in stream.quantities for site in stream.sites(name)]) as cache:
        xvla.act(observations, [0])
    for site in stream.sites("mlp"):
        layer = xvla.network.model.vlm.language_model.encoder.layers[site.layer]
        entered, attended, added = (cache[replace(site, quantity=name)] for name in stream.quantities)
        with torch.inference_mode():
            normed = layer.final_layer_norm(layer.self_attn_layer_norm(entered + attended) + added)
        behind = cache[replace(site, layer=site.layer + 1, quantity="residual")]
        torch.testing.assert_close(normed, behind, rtol=0, atol=1e-5)


def test_further_cameras_reach_the_expert_past_the_backbone(
    tmp_path: Path, observations: list[Observation]
) -> None:
    folder = write_xvla(tmp_path, cameras=("image", "wrist"), views=3)
    policy = Xvla.load(str(folder)).with_cameras(["image", "wrist"])
    two_cameras = replace(observations[0], cameras={"wrist": observations[0].image[:, ::-1].copy()})
    other = replace(two_cameras, cameras={"wrist": observations[0].image})
    roles = policy.roles([two_cameras])
    assert roles["expert"][0].mask("image.wrist").sum() == policy.tokens_per_camera
    assert "image.wrist" not in {span.role for span in roles["backbone"][0].spans}
    masked = roles["expert"][0].mask("special").sum() - roles["backbone"][0].mask("special").sum()
    assert masked == policy.tokens_per_camera
    end, first = policy.streams["backbone"].sites()[-1], Site("expert", 0, iteration=0)
    caches = []
    for observation in (two_cameras, other):
        with capture(policy, [end, first]) as cache:
            policy.act([observation], [0])
        caches.append(cache)
    assert torch.equal(caches[0][end], caches[1][end])
    moved = (caches[0][first] != caches[1][first]).any(-1)[0].numpy()
    np.testing.assert_array_equal(moved, roles["expert"][0].mask("image.wrist"))


def test_the_robot_is_read_from_the_files_and_may_be_chosen(
    folder: Path, tmp_path: Path, xvla: Xvla, observations: list[Observation]
) -> None:
    assert xvla.card.settings["domain"] == str(DOMAIN)
    assert not np.array_equal(Xvla.load(str(folder), domain=1).act(observations, [0]), xvla.act(observations, [0]))
    with pytest.raises(UsageError, match=f"0 to {DOMAINS - 1}"):
        Xvla.load(str(folder), domain=DOMAINS)
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    file = tmp_path / "policy_preprocessor.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    content["steps"] = [
        saved_step for saved_step in content["steps"] if saved_step["registry_name"] != "xvla_add_domain_id"
    ]
    file.write_text(json.dumps(content), encoding="utf-8")
    with pytest.raises(CheckpointError, match="names no robot"):
        Xvla.load(str(tmp_path))
    np.testing.assert_array_equal(
        Xvla.load(str(tmp_path), domain=DOMAIN).act(observations, [0]), xvla.act(observations, [0])
    )


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("policy_postprocessor.json", '"device_processor"', '"xvla_rotation_6d_to_axis_angle"', "rotation_6d"),
        ("policy_preprocessor.json", '"right"', '"left"', "padding_side"),
        ("config.json", '"max_state_dim": 10', '"max_state_dim": 5', "leaves out"),
    ],
)
def test_files_that_would_change_numbers_in_silence_are_refused(
    folder: Path, tmp_path: Path, file: str, old: str, new: str, message: str
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / file).read_text(encoding="utf-8")
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(CheckpointError, match=message):
        Xvla.load(str(tmp_path))


def test_a_picture_of_another_size_is_refused_where_nothing_resizes(
    folder: Path, tmp_path: Path, observations: list[Observation]
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    content = json.loads((tmp_path / "config.json").read_text(encoding="utf-8"))
    content |= {"resize_imgs_with_padding": None, "max_len_seq": 160}
    content["input_features"]["observation.images.image"]["shape"] = [3, 64, 96]
    (tmp_path / "config.json").write_text(json.dumps(content), encoding="utf-8")
    policy = Xvla.load(str(tmp_path))
    with pytest.raises(ObservationError, match="resizes nothing"):
        policy.act(observations, [0])
    fitting = replace(observations[0], image=np.zeros((64, 96, 3), np.uint8))
    with capture(policy, policy.sites()) as cache:
        policy.act([fitting], [0])
    (roles,) = policy.roles([fitting])["expert"]
    assert cache["expert.00.residual@0"].shape[1] == roles.spans[-1].stop


def test_absolute_poses_are_captured_and_not_carried_out(tmp_path: Path, observations: list[Observation]) -> None:
    """The released action space: two arms with 6D rotations, 20 numbers."""
    folder = write_xvla(tmp_path)
    content = json.loads((folder / "config.json").read_text(encoding="utf-8"))
    content["action_mode"], content["max_state_dim"] = "ee6d", 20
    content["output_features"]["action"]["shape"] = [20]
    (folder / "config.json").write_text(json.dumps(content), encoding="utf-8")
    policy = Xvla.load(str(folder), random_weights=True)
    assert "20 dimensions" in str(policy.embodiment_mismatch())
    assert policy.infer_without_acting(observations, [0]).shape == (1, CHUNK, 20)
