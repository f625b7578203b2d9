"""What NVIDIA's processor file says of state, actions and pictures is honoured, or refused by name."""

import json
import re
import shutil
from collections.abc import Callable
from dataclasses import replace
from itertools import permutations
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.groot import processor_groot
from lerobot.policies.groot.configuration_groot import GrootConfig
from lerobot.policies.groot.modeling_groot import GrootPolicy
from numpy.typing import NDArray
from safetensors.torch import load_file, save_file
from torchvision.transforms import v2

from probe_kit.errors import CheckpointError, InstructionError, UsageError, WeightsError
from probe_kit.hooks import Observation, Site, capture, edit
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.groot.adapter import Groot
from probe_kit.hooks.families.groot.network import check_version
from probe_kit.hooks.families.shared.kinds import IMAGES
from probe_kit.hooks.families.shared.lerobot.pipelines import read_views
from probe_kit.hooks.registry import find_family
from tests.hooks.families.groot.checkpoints import CHUNK, HORIZON, TAG, write_groot, write_nvidias
from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LEAST, LOW, MOST

STATE = np.linspace(-0.2, 0.7, 8, dtype=np.float32)
_MINMAX = (2 * (STATE - LOW) / (HIGH - LOW) - 1).clip(-1, 1)
_SCORES = (STATE - LOW) / (HIGH - LOW)  # the tiny files have these as mean and deviation


@pytest.fixture(scope="module")
def stored(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_nvidias(tmp_path_factory.mktemp("nvidia"))


Changed = Callable[..., Groot]


@pytest.fixture
def changed(stored: Path, tmp_path: Path) -> Changed:
    """Load the checkpoint with other fields; `state`, `action` and `top` are parts of the file of their own."""

    def load(
        state: dict[str, Any] | None = None,
        action: dict[str, Any] | None = None,
        top: dict[str, Any] | None = None,
        options: dict[str, Any] | None = None,
        **settings: Any,
    ) -> Groot:
        shutil.copytree(stored, tmp_path, dirs_exist_ok=True)
        file = tmp_path / "processor_config.json"
        content = json.loads(file.read_text(encoding="utf-8"))
        content["processor_kwargs"] |= settings
        modalities = content["processor_kwargs"]["modality_configs"][TAG]
        modalities["state"] |= state or {}
        modalities["action"] |= action or {}
        file.write_text(json.dumps(content | (top or {})), encoding="utf-8")
        return Groot.load(str(tmp_path), embodiment=TAG, **(options or {}))

    return load


def seen_by(policy: Groot, picture: NDArray[np.uint8] | None = None) -> list[Observation]:
    (example,) = examples_for(policy, "put the cube on the star")
    image = np.random.default_rng(0).integers(0, 256, (48, 80, 3), np.uint8) if picture is None else picture
    return [replace(example, image=image, state=STATE)]


def state_read(policy: Groot) -> NDArray[np.float32]:
    state: NDArray[np.float32] = policy.batch(seen_by(policy))["state"][0, 0].numpy()
    return state


def expected(*parts: NDArray[Any]) -> NDArray[np.float32]:
    row = np.concatenate(parts)
    return np.pad(row, (0, 12 - len(row))).astype(np.float32)


def test_without_further_fields_the_state_is_mapped_by_its_quantiles(changed: Changed) -> None:
    np.testing.assert_allclose(state_read(changed()), expected(_MINMAX), atol=1e-6)


def test_angles_are_read_as_sines_then_cosines_in_the_place_of_their_group(changed: Changed) -> None:
    policy = changed({"sin_cos_embedding_keys": ["rotation"]}, apply_sincos_state_encoding=True)
    angles = STATE[3:6]
    expected_state = expected(_MINMAX[:3], np.sin(angles), np.cos(angles), _MINMAX[6:])
    np.testing.assert_allclose(state_read(policy), expected_state, atol=1e-6)
    assert any("SIN_COS" in note for note in policy.card.notes)
    assert policy.state_statistics is not None
    assert not policy.state_statistics.outside(np.full((1, 8), -6, np.float32))[0, 3:6].any()  # less than a turn
    assert policy.state_statistics.outside(np.full((1, 8), 99, np.float32))[0, 3:6].all()  # degrees
    assert policy.act(seen_by(policy), [0]).shape[-1] == 7


@pytest.mark.parametrize("switched_on", [True, False])
def test_angles_need_the_switch_and_the_group(changed: Changed, switched_on: bool) -> None:
    keys = [] if switched_on else ["rotation"]
    policy = changed({"sin_cos_embedding_keys": keys}, apply_sincos_state_encoding=switched_on)
    np.testing.assert_allclose(state_read(policy), expected(_MINMAX), atol=1e-6)


def test_groups_with_mean_and_deviation_are_scores_that_are_not_clamped(changed: Changed) -> None:
    policy = changed({"mean_std_embedding_keys": ["x", "gripper"]})
    expected_state = expected(_SCORES[:1], _MINMAX[1:6], _SCORES[6:])
    np.testing.assert_allclose(state_read(policy), expected_state, atol=1e-5)
    far = policy.state_units.normalise(np.full((1, 8), 50, np.float32))[0]
    assert far[0] > 1
    assert far[1] == 1


def test_sines_win_over_scores_as_in_nvidias_processor(changed: Changed) -> None:
    keys = {"sin_cos_embedding_keys": ["rotation"], "mean_std_embedding_keys": ["rotation"]}
    policy = changed(keys, apply_sincos_state_encoding=True)
    np.testing.assert_allclose(state_read(policy)[3:6], np.sin(STATE[3:6]), atol=1e-6)


@pytest.mark.parametrize(("inside", "outside"), [(True, False), (False, True)])
def test_a_state_that_is_excluded_in_either_part_of_the_file_is_read_as_zeros(
    changed: Changed, inside: bool, outside: bool
) -> None:
    policy = changed({"exclude_state": inside}, exclude_state=outside)
    assert not state_read(policy).any()
    assert any("EXCLUDED" in note for note in policy.card.notes)


def test_actions_with_mean_and_deviation_are_restored_by_them(changed: Changed) -> None:
    policy = changed(action={"mean_std_embedding_keys": ["x", "yaw"]})
    put_out = np.full((1, 7), 2, np.float32)
    metres = policy.action_units.restore(put_out)[0]
    for number in (0, 5):
        assert metres[number] == pytest.approx(LEAST[number] + 2 * (MOST - LEAST)[number], rel=1e-5)
    assert metres[1] == pytest.approx(MOST[1], rel=1e-5)  # clamped
    slopes = policy.action_units.slopes(put_out)[0]
    assert slopes[0] == pytest.approx((MOST - LEAST)[0], rel=1e-5)
    assert slopes[1] == 0


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"use_mean_std": True}, "use_mean_std: True"),
        ({"use_tactile": True, "tactile_state_keys": ["gripper"]}, "use_tactile: True"),
        ({"state": {"delta_indices": [-1, 0]}}, r"states of the steps \[-1, 0\] \(delta_indices\)"),
        ({"state": {"smoothing": 3}}, "field smoothing: 3"),
        ({"action": {"rescale": 2}}, "field rescale: 2"),
        ({"state_noise": 0.1}, "field state_noise: 0.1"),
        ({"top": {"state_scale": 2}}, "field state_scale: 2"),
        ({"top": {"processor_class": "Gr00tN1d6Processor"}}, "processor_class: 'Gr00tN1d6Processor'"),
        ({"use_percentiles": "false"}, "use_percentiles: 'false'"),
        ({"clip_outliers": None}, "clip_outliers: None"),
        ({"image_target_size": [64]}, r"image_target_size: \[64\]"),
        ({"crop_fraction": 1.5}, "crop_fraction: 1.5"),
        ({"model_type": "eagle"}, "model_type: 'eagle'"),
        ({"max_state_dim": 64}, "max_state_dim: 64, config.json 12"),
        ({"state": {"mean_std_embedding_keys": ["wrist"]}}, "unknown: wrist"),
        ({"state": {"sin_cos_embedding_keys": ["x", "y", "z", "rotation"]}, "apply_sincos_state_encoding": True},
         "14 numbers"),
    ],
)  # fmt: skip
def test_what_is_not_honoured_is_refused_by_name(changed: Changed, change: dict[str, Any], message: str) -> None:
    with pytest.raises(CheckpointError, match=message):
        _ = changed(**change).state_units


VIEWS = ["front", "wrist_image", "top"]
CAMERAS = ("front", "wrist_image", "image2", "side")


@pytest.mark.parametrize("views", [VIEWS, VIEWS[::-1], ["wrist_image"], ["other"], []], ids=" ".join)
def test_the_cameras_of_a_checkpoint_are_those_whose_pictures_lerobot_packs(views: list[str]) -> None:
    """One picture for each view, under the other name of a wrist if it has no picture of its own, or else all."""
    step = processor_groot.GrootN17PackInputsStep.__new__(processor_groot.GrootN17PackInputsStep)
    step.video_modality_keys, step._warned_image_keys = views, True
    for cameras in (cameras for size in range(1, 5) for cameras in permutations(CAMERAS, size)):
        features = [f"{IMAGES}{camera}" for camera in cameras]
        packed = read_views(features, views) if views else features
        assert packed == [name for name in features if name in packed]
        assert sorted(packed) == sorted(step._ordered_image_keys(dict.fromkeys(features)))


@pytest.mark.parametrize(
    ("values", "older"),
    [
        ({"base_model_path": "nvidia/GR00T-N1-2B"}, "N1;"),
        ({"base_model_path": "nvidia/GR00T-N1.5-3B"}, "N1.5;"),
        ({"base_model_path": "me/gr00t_n1_6_kitchen"}, "N1.6;"),
        ({"model_version": "n1.6"}, "N1.6;"),
        ({"model_version": "n1_5"}, "N1.5;"),
        ({"tokenizer_assets_repo": "lerobot/eagle2hg-processor-groot-n1p5"}, "N1.5;"),
        ({"base_model_path": "nvidia/GR00T-N1.7-3B"}, None),
        ({"base_model_path": "me/gr00t-n17"}, None),
        ({"base_model_path": None, "model_version": "n1.7"}, None),
        ({}, None),
    ],
)
def test_a_fine_tune_of_an_older_groot_is_refused(values: dict[str, Any], older: str | None) -> None:
    if older is None:
        check_version(values, Path("config.json"))
        return
    with pytest.raises(CheckpointError, match=f"a fine-tune of GR00T {re.escape(older)} lerobot .* reads N1.7"):
        check_version(values, Path("config.json"))


@pytest.mark.parametrize(("kind", "older"), [("gr00t_n1", "N1"), ("gr00t_n1_5", "N1.5"), ("Gr00tN1d6", "N1.6")])
def test_a_checkpoint_of_the_type_of_an_older_groot_is_named(kind: str, older: str, tmp_path: Path) -> None:
    (tmp_path / "config.json").write_text(json.dumps({"model_type": kind}), encoding="utf-8")
    expected = rf"It is a GR00T {re.escape(older)}, and only N1\.7 is read here: take a fine-tune of N1\.7"
    with pytest.raises(CheckpointError, match=expected):
        find_family("groot").check(str(tmp_path))


@pytest.mark.slow
def test_fields_of_training_change_nothing(changed: Changed) -> None:
    training = {
        "state_dropout_prob": 0.8, "random_rotation_angle": 5, "color_jitter_params": {"hue": 0.1},
        "use_mean_std": False, "use_tactile": False, "max_state_dim": 12, "model_type": "qwen",
    }  # fmt: skip
    np.testing.assert_array_equal(state_read(changed(**training)), state_read(changed()))


def pictures_of(policy: Groot, picture: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """What the network's image processor is given."""
    (frames,) = policy.packing.encode._build_sample_images(picture[None, None, None], 1, None)
    tensor: NDArray[np.uint8] = np.asarray(frames[0])
    return tensor


PICTURE = np.random.default_rng(1).integers(0, 256, (48, 80, 3), np.uint8)


def test_pictures_are_squashed_bilinearly_and_cut_as_nvidias_newest_code(changed: Changed) -> None:
    policy = changed()
    pipeline = v2.Compose([v2.Resize((64, 64)), v2.CenterCrop((58, 58)), v2.Resize((64, 64))])
    np.testing.assert_array_equal(
        pictures_of(policy, PICTURE), pipeline(torch.from_numpy(PICTURE).permute(2, 0, 1))
    )
    assert any("Isaac-GR00T" in note and "without letterbox" in note for note in policy.card.notes)
    assert policy.card.settings["resize"] == "nvidia"


def test_lerobots_resizing_is_another_one_and_can_be_chosen(changed: Changed) -> None:
    plain, other = (pictures_of(changed(options=options), PICTURE) for options in ({}, {"resize": "lerobot"}))
    assert plain.shape == other.shape == (3, 64, 64)
    assert np.abs(plain.astype(int) - other).max() > 10


@pytest.mark.slow
@pytest.mark.parametrize("where", ["file", "option"])
def test_letterbox_puts_black_bars_above_and_below(changed: Changed, where: str) -> None:
    white = np.full((48, 80, 3), 255, np.uint8)
    policy = changed(letter_box_transform=True) if where == "file" else changed(options={"letterbox": True})
    rows = pictures_of(policy, white)[0].mean(1)
    assert rows[0] == rows[-1] == 0
    assert rows[32] == 255
    assert any("black bars" in note for note in policy.card.notes)
    off = changed(letter_box_transform=True, options={"letterbox": False})
    assert pictures_of(off, white).min() == 255


def test_area_resizing_keeps_proportions_with_a_shortest_edge_and_squashes_where_it_is_null(
    changed: Changed,
) -> None:
    proportional = changed(use_albumentations=True, shortest_image_edge=32, crop_fraction=None)
    assert pictures_of(proportional, PICTURE).shape == (3, 32, 53)
    squashed = changed(use_albumentations=True, shortest_image_edge=None, crop_fraction=1.0)
    area = cv2.resize(PICTURE, (64, 64), interpolation=cv2.INTER_AREA)
    np.testing.assert_array_equal(pictures_of(squashed, PICTURE), area.transpose(2, 0, 1))


def test_a_file_without_sizes_is_refused_where_nvidias_code_has_none(changed: Changed) -> None:
    with pytest.raises(CheckpointError, match=r"no image_target_size.*-M resize=lerobot"):
        changed(image_target_size=None)
    assert pictures_of(changed(image_target_size=None, options={"resize": "lerobot"}), PICTURE).shape[-1] == 256


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_groot(tmp_path_factory.mktemp("groot"))


@pytest.fixture(scope="module")
def groot(folder: Path) -> Groot:
    return Groot.load(str(folder))


@pytest.fixture
def observations(groot: Groot) -> list[Observation]:
    (example,) = examples_for(groot, "Put the cube on the star!")
    picture = np.random.default_rng(0).integers(0, 256, (48, 80, 3), np.uint8)
    return [replace(example, image=picture, state=np.linspace(-0.2, 0.7, 8, dtype=np.float32))]


def lerobots(folder: Path, monkeypatch: pytest.MonkeyPatch) -> tuple[GrootPolicy, Any, Any]:
    """lerobot's own policy and processors of a checkpoint in either layout, with the tiny tokenizer."""
    nvidias = not (folder / "base").is_dir()
    base = folder if nvidias else folder / "base"
    monkeypatch.chdir(base)  # the network's configuration says `vlm`
    build = processor_groot._build_n1_7_processor
    monkeypatch.setattr(processor_groot, "_build_n1_7_processor", lambda _: build("vlm"))
    if nvidias:
        configuration = Groot.load(str(folder), embodiment=TAG).config
        config = GrootConfig(
            device="cpu", base_model_path=str(folder), embodiment_tag=TAG, max_state_dim=12, max_action_dim=10,
            input_features=configuration.input_features, output_features=configuration.output_features,
        )  # fmt: skip
    else:
        config = PreTrainedConfig.from_pretrained(folder)
        config.base_model_path = str(base)
    policy = GrootPolicy.from_pretrained(str(folder), config=config)
    pipelines = processor_groot.make_groot_pre_post_processors_from_pretrained(config, str(folder))
    return policy.eval(), *pipelines


@pytest.mark.parametrize(
    ("layout", "dtype"),
    [
        ("lerobot", "float32"),
        ("nvidia", "bfloat16"),
        pytest.param("lerobot", "bfloat16", marks=pytest.mark.slow),
        pytest.param("nvidia", "float32", marks=pytest.mark.slow),
    ],
)
def test_actions_are_those_of_lerobots_own_loading_processors_and_sampling_bit_for_bit(
    folder: Path, observations: list[Observation], monkeypatch: pytest.MonkeyPatch, layout: str, dtype: str
) -> None:
    """From the raw picture and state to metres, with noise that lerobot draws itself of the same seed."""
    checkpoint = folder if layout == "lerobot" else folder / "base"
    ours = Groot.load(
        str(checkpoint), dtype=dtype, embodiment=TAG if layout == "nvidia" else None, resize="lerobot"
    )
    policy, before, behind = lerobots(checkpoint, monkeypatch)
    policy.config.use_bf16 = dtype == "bfloat16"
    (observation,) = observations
    raw = {
        "observation.images.image": torch.from_numpy(observation.image).permute(2, 0, 1),
        "observation.state": torch.from_numpy(np.asarray(observation.state, np.float32)),
        "task": observation.instruction,
    }
    packed = before(raw)
    batch = ours.batch(observations)
    for name, tensor in batch.items():
        torch.testing.assert_close(tensor, packed[name], rtol=0, atol=0)
    torch.manual_seed(7)
    theirs = policy.predict_action_chunk(packed)
    drawn = ours.noise([7])
    if dtype == "bfloat16":  # lerobot draws in the precision of what the bridge puts out
        torch.manual_seed(7)
        drawn = torch.randn(drawn.shape, dtype=_end_of_bridge(ours, observations).dtype)
    torch.testing.assert_close(ours.infer(batch, drawn), theirs[:, :CHUNK], rtol=0, atol=0)
    metres = behind(theirs).numpy()
    assert metres.shape == (1, CHUNK, 7)
    np.testing.assert_allclose(ours.action_units.restore(theirs[:, :CHUNK].float().numpy()), metres, atol=1e-6)
    if dtype == "float32":
        np.testing.assert_allclose(ours.act(observations, [7]), metres, atol=1e-6)
    assert theirs.abs().max() > 0.1


def _end_of_bridge(policy: Groot, observations: list[Observation]) -> torch.Tensor:
    site = policy.streams["bridge"].sites()[-1]
    with capture(policy, [site]) as cache:
        policy.infer(policy.batch(observations), policy.noise([0]))
    return cache[site]


def test_select_action_of_lerobot_gives_the_first_actions(
    folder: Path, groot: Groot, observations: list[Observation], monkeypatch: pytest.MonkeyPatch
) -> None:
    policy, _, behind = lerobots(folder, monkeypatch)
    torch.manual_seed(3)
    actions = [behind(policy.select_action(groot.batch(observations))).numpy() for _ in range(2)]
    np.testing.assert_allclose(groot.act(observations, [3])[:, :2], np.stack(actions, 1), atol=1e-6)


def test_everything_that_the_expert_reads_passes_the_end_of_the_bridge(
    groot: Groot, observations: list[Observation]
) -> None:
    """Zeros there, and in what the bridge reads, change the expert; Qwen's own last norm is not read."""
    expert = groot.streams["expert"].sites()
    with capture(groot, expert) as plain:
        actions = groot.act(observations, [0])
    for site in (groot.streams["bridge"].sites()[-1], groot.streams["backbone"].sites()[-1]):
        with edit(groot, {site: torch.zeros_like}):
            changed = groot.act(observations, [0])
        assert not np.array_equal(changed, actions)
    norm = groot.network._groot_model.backbone.language_model.norm
    handle = norm.register_forward_hook(lambda *_: torch.zeros(1, 38, 32))
    try:
        np.testing.assert_array_equal(groot.act(observations, [0]), actions)
    finally:
        handle.remove()
    other = replace(observations[0], instruction="Put the cube on the moon")
    unread = []
    for observation in (observations[0], other):
        with edit(groot, {groot.streams["bridge"].sites()[-1]: torch.zeros_like}):
            unread.append(groot.act([observation], [0]))
    np.testing.assert_array_equal(*unread)
    assert plain[expert[1]].shape == (1, 1 + HORIZON, 24)


@pytest.mark.slow
def test_blocks_attend_by_turns_to_words_to_themselves_and_to_pictures(
    groot: Groot, observations: list[Observation]
) -> None:
    """As lerobot's masks have it: block 0 reads the text, block 2 the pictures, 1 and 3 nothing of the prompt."""
    sites = [Site("expert", layer, "attention", 0) for layer in range(4)]
    end = groot.streams["bridge"].sites()[-1]
    (roles,) = groot.roles(observations)["bridge"]
    with capture(groot, sites) as plain:
        groot.act(observations, [0])

    def changed(role: str) -> list[bool]:
        mask = torch.from_numpy(roles.mask(role))

        def without(activation: torch.Tensor) -> torch.Tensor:
            return torch.where(mask[None, :, None], 0, activation)

        differences = []
        for layer, site in enumerate(sites):
            entering = Site("expert", layer, iteration=0)
            with capture(groot, [entering]) as before:
                groot.act(observations, [0])
            with (
                edit(groot, {end: without, entering: lambda _, replaced=before[entering]: replaced}),
                capture(groot, [site]) as now,
            ):
                groot.act(observations, [0])
            differences.append(not torch.equal(plain[site], now[site]))
        return differences

    assert changed("language") == [True, False, False, False]
    assert changed("image.image") == [False, False, True, False]


def test_roles_name_pictures_and_the_instruction_as_lerobot_writes_it(
    groot: Groot, observations: list[Observation]
) -> None:
    (roles,) = groot.roles(observations)["backbone"]
    ids = groot.batch(observations)["input_ids"][0]
    assert groot.tokenizer.decode(ids[torch.from_numpy(roles.mask("language"))]) == "put the cube on the star"
    assert set(ids[torch.from_numpy(roles.mask("image.image"))].tolist()) == {
        groot.tokenizer.convert_tokens_to_ids("<|image_pad|>")
    }
    assert groot.token_ids(["Put the cube on the star!"]) == groot.token_ids(["put the cube on the star"])


@pytest.mark.slow
def test_two_cameras_are_told_apart_in_the_checkpoints_order(
    tmp_path: Path, observations: list[Observation]
) -> None:
    policy = Groot.load(str(write_groot(tmp_path, cameras=("image", "wrist")))).with_cameras(["image", "wrist"])
    two_cameras = replace(observations[0], cameras={"wrist": observations[0].image[:, ::-1].copy()})
    (roles,) = policy.roles([two_cameras])["bridge"]
    counts = [int(roles.mask(f"image.{camera}").sum()) for camera in ("image", "wrist")]
    assert counts[0] == counts[1] > 0
    assert policy.batch([two_cameras])["image_grid_thw"].shape == (2, 3)
    assert np.isfinite(policy.act([two_cameras], [0])).all()


def test_a_checkpoint_that_reads_a_video_says_that_its_frame_is_repeated(
    folder: Path, tmp_path: Path, groot: Groot, observations: list[Observation]
) -> None:
    assert not any("video" in note for note in groot.card.notes)
    shutil.copytree(folder / "base", tmp_path, dirs_exist_ok=True)
    file = tmp_path / "processor_config.json"
    content = json.loads(file.read_text(encoding="utf-8"))
    content["processor_kwargs"]["modality_configs"][TAG]["video"]["delta_indices"] = [-5, 0]
    file.write_text(json.dumps(content), encoding="utf-8")
    policy = Groot.load(str(tmp_path), embodiment=TAG)
    assert any("given 2 times" in note for note in policy.card.notes)
    (roles,) = policy.roles(observations)["backbone"]
    assert (
        roles.mask("image.image").sum() == 2 * groot.roles(observations)["backbone"][0].mask("image.image").sum()
    )
    assert np.isfinite(policy.act(observations, [0])).all()


def test_units_are_the_quantiles_clamped_and_libero_closes_by_sign(groot: Groot) -> None:
    np.testing.assert_array_equal(groot.state_units.normalise(HIGH[None] + 3), np.ones((1, 8), np.float32))
    ends = groot.action_units.restore(np.stack([np.full(7, -2), np.full(7, 2)]).astype(np.float32))
    np.testing.assert_allclose(ends[:, :6], np.stack([LEAST, MOST])[:, :6], atol=1e-6)
    np.testing.assert_array_equal(ends[:, 6], [1, -1])
    slopes = groot.own_units("action", "ACTION").slopes(np.array([[0.5, 0.5, 2, 0, 0, 0, 0.5]], np.float32))[0]
    np.testing.assert_allclose(slopes[:2], (MOST - LEAST)[:2] / 2, atol=1e-6)
    assert (slopes[[2, 6]] == 0).all()


def test_actions_relative_to_the_state_are_captured_and_not_carried_out(
    tmp_path: Path, observations: list[Observation]
) -> None:
    policy = Groot.load(str(write_nvidias(tmp_path, relative=True)), embodiment=TAG)
    assert policy.predicts_relative
    assert "relative to the state" in str(policy.embodiment_mismatch())
    with pytest.raises(CheckpointError, match="relative to the state"):
        policy.act(observations, [0])
    assert policy.infer_without_acting(observations, [0]).shape == (1, CHUNK, 7)


@pytest.mark.slow
def test_the_embodiment_of_nvidias_layout_must_be_chosen_and_be_there(folder: Path) -> None:
    with pytest.raises(UsageError, match="libero_sim, other"):
        Groot.load(str(folder / "base"))
    with pytest.raises(UsageError, match="no embodiment 'gr1'"):
        Groot.load(str(folder / "base"), embodiment="gr1")
    with pytest.raises(UsageError, match="Leave it out"):
        Groot.load(str(folder), embodiment=TAG)
    first, other = (Groot.load(str(folder / "base"), embodiment=tag) for tag in (TAG, "other"))
    observation = examples_for(first, "put the cube on the star")
    actions = [policy.infer_without_acting(observation, [0]) for policy in (first, other)]
    assert not np.array_equal(*actions)


@pytest.mark.parametrize("text", ["", "?!"])
def test_an_instruction_without_words_is_refused_and_never_replaced(
    groot: Groot, observations: list[Observation], text: str
) -> None:
    """lerobot would write 'Perform the task.' for an empty one."""
    with pytest.raises(InstructionError, match="no word"):
        groot.act([replace(observations[0], instruction=text)], [0])
    Groot.check_words(str(groot.folder), ["put the cube on the star"])
    with pytest.raises(InstructionError, match="no word"):
        Groot.check_words(str(groot.folder), [text])


@pytest.mark.parametrize(
    ("file", "old", "new", "message"),
    [
        ("policy_preprocessor.json", "groot_n1_7_pack_inputs_v1", "another_step", "another_step"),
        ("policy_postprocessor.json", '"q99"', '"q98"', "no statistics q99"),
        ("policy_preprocessor.json", '"libero_sim": 2', '"libero": 2', "gives 'libero_sim' no number"),
        ("base/config.json", '"backbone_model_type": "qwen"', '"backbone_model_type": "eagle"', "'eagle'"),
    ],
)
def test_files_that_would_change_numbers_in_silence_are_refused(
    folder: Path, tmp_path: Path, observations: list[Observation], file: str, old: str, new: str, message: str
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    text = (tmp_path / file).read_text(encoding="utf-8")
    assert old in text
    (tmp_path / file).write_text(text.replace(old, new), encoding="utf-8")
    with pytest.raises(CheckpointError, match=message):
        Groot.load(str(tmp_path)).act(observations, [0])


def test_remote_code_beside_the_language_model_is_never_run(
    folder: Path, tmp_path: Path, observations: list[Observation]
) -> None:
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    vlm = tmp_path / "base" / "vlm"
    (vlm / "evil.py").write_text(f"open({str(tmp_path / 'ran')!r}, 'w')", encoding="utf-8")
    for name, kind in (("config.json", "AutoConfig"), ("tokenizer_config.json", "AutoTokenizer")):
        content = json.loads((vlm / name).read_text(encoding="utf-8"))
        entry = ["evil.Thing", None] if kind == "AutoTokenizer" else "evil.Thing"
        (vlm / name).write_text(json.dumps({**content, "auto_map": {kind: entry}}), encoding="utf-8")
    Groot.load(str(tmp_path)).act(observations, [0])
    assert not (tmp_path / "ran").exists()


@pytest.mark.parametrize("name", ["action_head.vl_self_attention", "lm_head", "embed_tokens"])
def test_weights_must_be_whole_but_for_the_output_weights_that_nothing_reads(
    folder: Path, tmp_path: Path, observations: list[Observation], groot: Groot, name: str
) -> None:
    """lerobot's file holds the tied embeddings under one of their names."""
    shutil.copytree(folder, tmp_path, dirs_exist_ok=True)
    tensors = load_file(tmp_path / "model.safetensors")
    embedding = next(tensor for key, tensor in tensors.items() if "embed_tokens" in key or "lm_head" in key)
    both = {"embed_tokens": network_name("model.language_model.embed_tokens"), "lm_head": network_name("lm_head")}
    tensors |= {key: embedding.clone() for key in both.values()}
    save_file({key: tensor for key, tensor in tensors.items() if name not in key}, tmp_path / "model.safetensors")
    if name in both:
        np.testing.assert_array_equal(
            Groot.load(str(tmp_path)).act(observations, [0]), groot.act(observations, [0])
        )
    else:
        with pytest.raises(WeightsError, match="vl_self_attention"):
            Groot.load(str(tmp_path))


def network_name(name: str) -> str:
    return f"_groot_model.backbone.model.{name}.weight"


def test_without_a_bridge_the_expert_reads_the_norm_of_the_backbone(
    tmp_path: Path, observations: list[Observation]
) -> None:
    policy = Groot.load(str(write_nvidias(tmp_path, vl_self_attention_cfg={"num_layers": 0})), embodiment=TAG)
    assert list(policy.streams) == ["backbone", "expert"]
    with capture(policy, policy.sites()):
        assert np.isfinite(policy.act(observations, [0])).all()
