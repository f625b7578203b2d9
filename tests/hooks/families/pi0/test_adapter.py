"""The protocol's pi0: units, picture and state that its evaluation decides, on a generated tiny checkpoint."""

import json
import shutil
from dataclasses import replace
from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from probe_kit.env.arm import WIDOWX
from probe_kit.errors import (
    CheckpointError,
    InstructionError,
    ObservationError,
    UnknownSiteError,
    UsageError,
    WeightsError,
)
from probe_kit.hooks import Observation, Site
from probe_kit.hooks.contract.observation import CLOSED, OPENED, laid_out
from probe_kit.hooks.families.pi0 import adapter
from probe_kit.hooks.families.pi0.adapter import Pi0, current_config
from probe_kit.hooks.families.shared.lerobot.normaliser import StatisticsFile
from probe_kit.hooks.registry import find_family
from probe_kit.hooks.verify import verify_reference
from tests.hooks.families.pi0.checkpoints import (
    bounds_of,
    network_chunk,
    old_golden,
    write_intact,
    write_statistics,
)


def test_roles_describe_the_packing_the_model_really_uses(pi0_tiny: Pi0, observation: Observation) -> None:
    """Position ids count valid tokens, so they say which positions the model treats as padding."""
    position_ids: list[torch.Tensor] = []
    layer = pi0_tiny.stacks["backbone"].layers[0]
    handle = layer.register_forward_pre_hook(
        lambda _m, _a, kw: position_ids.append(kw["position_ids"]), with_kwargs=True
    )
    longer = replace(observation, instruction="Put the cube on the picture with three apples")
    pi0_tiny.act([observation, longer], [0, 0])
    handle.remove()
    roles = pi0_tiny.roles([observation, longer])["backbone"]
    expected = np.stack([np.cumsum(row.valid) - 1 for row in roles])
    np.testing.assert_array_equal(position_ids[0], expected)
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


SEED = 3


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_intact(tmp_path_factory.mktemp("intact") / "pi0")


@pytest.fixture(scope="module")
def statistics(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_statistics(tmp_path_factory.mktemp("statistics") / "client.json")


@pytest.fixture(scope="module")
def policy(folder: Path, statistics: Path) -> Pi0:
    return Pi0.load(str(folder), statistics=str(statistics))


@pytest.fixture
def wide_observation() -> Observation:
    image = np.random.default_rng(1).integers(0, 256, (480, 640, 3), dtype=np.uint8)
    state = np.array([0.292, -0.006, 0.135, -0.0045, 0.0568, -0.019, 0.0, 0.8], np.float32)
    return Observation(image, state, "Put the cube on the red shape")


@pytest.mark.slow
@pytest.mark.parametrize("openness", ["measured", "release"])
def test_actions_are_those_of_the_bare_network_in_the_evaluations_units(
    folder: Path, statistics: Path, policy: Pi0, wide_observation: Observation, openness: str
) -> None:
    """Everything around the network recomputed in float64: squashed picture, seven numbers, p01 and p99."""
    acting = (
        policy if openness == "measured" else Pi0.load(str(folder), statistics=str(statistics), openness=openness)
    )
    low, high = bounds_of("proprio")
    gripper = 0.8 if openness == "measured" else 1 - (0.015 + 0.8 * 0.022)
    numbers = np.array([*wide_observation.state[:6], gripper], np.float64)
    state = np.clip((numbers - low) / (high - low) * 2 - 1, -1, 1)
    picture = cv2.resize(wide_observation.image, (96, 96), interpolation=cv2.INTER_LANCZOS4)
    raw = network_chunk(acting, picture, state, wide_observation.instruction, SEED)
    first, last = bounds_of("action")
    expected = (raw + 1) / 2 * (last - first) + first
    expected[:, 6] = raw[:, 6] > 0.5

    actions = acting.act([wide_observation], [SEED])
    assert actions.shape == (1, 4, 7)
    np.testing.assert_allclose(actions[0], expected, atol=1e-5)
    assert set(np.unique(actions[..., 6])) <= {0.0, 1.0}
    assert acting.embodiment_mismatch() is None


def test_what_the_evaluation_decides_is_part_of_the_identity(folder: Path, statistics: Path, policy: Pi0) -> None:
    settings = policy.card.settings
    assert settings["statistics"] == StatisticsFile.read(str(statistics)).sha256
    assert settings["picture"] == "squashed"
    assert "openness" not in settings
    released = Pi0.load(str(folder), statistics=str(statistics), openness="release", picture="padded")
    assert released.card.settings["openness"] == "release"
    assert "picture" not in released.card.settings
    assert policy.card.chunk == 4
    assert "BOUNDS from client.json" in policy.card.notes[-1]


def test_without_statistics_the_checkpoint_is_refused_with_the_way_out(
    folder: Path, observation: Observation
) -> None:
    policy = Pi0.load(str(folder))
    assert "-M statistics=bridge" in str(policy.embodiment_mismatch())
    with pytest.raises(CheckpointError, match="-M statistics=bridge"):
        policy.act([observation], [0])


def test_statistics_that_lie_in_the_folder_are_read(folder: Path, statistics: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "pi0"))
    shutil.copy(statistics, copy / "dataset_statistics.json")
    policy = Pi0.load(str(copy))
    assert policy.embodiment_mismatch() is None
    np.testing.assert_allclose(policy.action_units.low, bounds_of("action")[0], rtol=1e-6)


def test_the_protocols_checkpoint_by_its_name_gets_the_shipped_statistics(
    folder: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The hub is stood in for by a folder: what is proved is what follows from the name."""
    name = find_family("pi0").default_checkpoint
    assert name in adapter.EVALUATED_WITH
    monkeypatch.setattr("probe_kit.hooks.families.shared.lerobot.policy.checkpoint_folder", lambda _: folder)
    policy = adapter.Pi0.load(str(name))
    assert policy.embodiment_mismatch() is None
    assert policy.state_units.source == "bridge statistics shipped with probe_kit"
    assert policy.picture == "squashed"


def test_shipped_statistics_are_those_of_the_bridge_data() -> None:
    shipped = StatisticsFile.read("bridge")
    action, state = shipped.bounds("action", 7), shipped.bounds("proprio", 7)
    assert action.low[0] == np.float32(-0.028539552688598632)
    assert state.high[5] == np.float32(1.8378053522109963)


@pytest.mark.parametrize(
    ("content", "complaint"),
    [
        ("{", "are not JSON"),
        ("[]", "are a list"),
        ("{}", "as none; this checkpoint needs 7"),
        ('{"action": {"p01": [0], "p99": [1]}, "proprio": {"p01": [0], "p99": [1]}}', r"\(1,\) and \(1,\)"),
        (json.dumps({p: {"p01": [1.0] * 7, "p99": [0.0] * 7} for p in ("action", "proprio")}), "p99 lies below"),
        (json.dumps({"action": {"p01": [float("nan")] * 7, "p99": [0.0] * 7}}), "not finite"),
    ],
)
def test_statistics_that_cannot_be_meant_are_refused(tmp_path: Path, content: str, complaint: str) -> None:
    file = tmp_path / "client.json"
    file.write_text(content, encoding="utf-8")
    with pytest.raises(CheckpointError, match=complaint):
        _ = StatisticsFile.read(str(file)).bounds("action", 7)


def test_a_statistics_file_that_is_not_there_is_named(folder: Path) -> None:
    with pytest.raises(CheckpointError, match=r"no statistics at nowhere\.json"):
        Pi0.load(str(folder), statistics="nowhere.json")


def test_openness_as_the_release_has_it_uses_the_fingers_of_our_widowx() -> None:
    assert (WIDOWX.closed, WIDOWX.opened) == (CLOSED, OPENED)
    state = np.arange(8, dtype=np.float32)[None]
    np.testing.assert_array_equal(laid_out(state, 7), [[0, 1, 2, 3, 4, 5, 7]])
    state[0, 7] = 1.0
    assert laid_out(state, 8, "release")[0, 7] == pytest.approx(1 - 0.037)
    assert state[0, 7] == 1.0


def test_inference_without_acting_equals_that_of_acting(policy: Pi0, observation: Observation) -> None:
    captured = policy.infer_without_acting([observation], [SEED])
    np.testing.assert_array_equal(policy.action_units.restore(captured), policy.act([observation], [SEED]))


def test_a_checkpoint_of_other_actions_and_another_state_can_be_captured(
    folder: Path, tmp_path: Path, observation: Observation
) -> None:
    copy = Path(shutil.copytree(folder, tmp_path / "base"))
    config = json.loads((copy / "config.json").read_text(encoding="utf-8"))
    config["input_features"]["observation.state"]["shape"] = [32]
    config["output_features"]["action"]["shape"] = [32]
    (copy / "config.json").write_text(json.dumps(config), encoding="utf-8")
    policy = Pi0.load(str(copy))
    assert "acts in 32 dimensions" in str(policy.embodiment_mismatch())
    assert policy.zero_filled_inputs() == ("state",)
    with pytest.raises(CheckpointError, match="acts in 32 dimensions"):
        policy.act([observation], [0])
    captured = policy.infer_without_acting([observation], [SEED])
    assert captured.shape == (1, 4, 32)
    moved = replace(observation, state=observation.state + 1)
    np.testing.assert_array_equal(policy.infer_without_acting([moved], [SEED]), captured)


@pytest.mark.parametrize("option", [{"picture": "cropped"}, {"openness": "wide"}])
def test_options_of_other_values_are_refused(option: dict[str, str]) -> None:
    with pytest.raises(UsageError, match="expected one of"):
        find_family("pi0").check("/nowhere", options=option)


@pytest.fixture(scope="module")
def golden(golden_pi0: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    return old_golden(golden_pi0, tmp_path_factory.mktemp("old") / "pi0")


@pytest.fixture(scope="module")
def old_policy(golden: Path) -> Pi0:
    return Pi0.load(str(golden / "checkpoint"))


def test_the_golden_reference_in_the_old_layout_gives_every_recorded_number(golden: Path) -> None:
    verification = verify_reference("pi0", golden)
    compared = {comparison.output for comparison in verification.comparisons if comparison.status == "ok"}
    assert verification.passed
    assert {"actions", "actions_unnormalized", "backbone_resid", "expert_resid", "prep_images"} <= compared


def test_statistics_among_the_weights_are_those_of_the_processor_files(golden_pi0: Path, old_policy: Pi0) -> None:
    today = Pi0.load(str(golden_pi0 / "checkpoint"))
    for old, new in ((old_policy.state_units, today.state_units), (old_policy.action_units, today.action_units)):
        assert old.source == "the weights"
        np.testing.assert_array_equal(old.low, new.low)
        np.testing.assert_array_equal(old.high, new.high)
    assert "MEAN_STD from the weights" in old_policy.card.notes[-1]


def test_pictures_are_padded_on_the_left_and_top_as_that_lerobot_did(old_policy: Pi0) -> None:
    """Today's pads on both sides; another place in the picture is another token."""
    picture = np.full((24, 40, 3), 255, np.uint8)
    padded = old_policy.look("top", [picture])[0, 0]
    assert padded.shape == (32, 32)
    assert old_policy.card.settings["picture"] == "padded-top-left"
    rows = padded.mean(dim=1)
    height = int(24 * 32 / 40)
    assert (rows[: 32 - height] == 0).all()
    assert (rows[32 - height :] == 1).all()


def test_a_random_twin_keeps_the_statistics_that_lie_among_the_weights(golden: Path, old_policy: Pi0) -> None:
    twin = Pi0.load(str(golden / "checkpoint"), random_weights=True)
    assert twin.card.random_weights
    np.testing.assert_array_equal(twin.action_units.low, old_policy.action_units.low)


def test_a_tensor_of_the_old_layout_that_is_missing_is_named(golden: Path, tmp_path: Path) -> None:
    copy = old_copy(golden, tmp_path)
    weights = load_file(copy / "model.safetensors")
    weights.pop("model.paligemma_with_expert.paligemma.vision_tower.vision_model.post_layernorm.weight")
    save_file(weights, copy / "model.safetensors")
    with pytest.raises(WeightsError, match=r"1 tensors missing.*post_layernorm"):
        Pi0.load(str(copy))


@pytest.mark.parametrize("change", ["absent", "unfilled"])
def test_statistics_that_nobody_filled_are_no_statistics(golden: Path, tmp_path: Path, change: str) -> None:
    """lerobot filled the buffers with infinity until statistics were given."""
    copy = old_copy(golden, tmp_path)
    weights = load_file(copy / "model.safetensors")
    name = "unnormalize_outputs.buffer_action.std"
    weights[name] = torch.full_like(weights[name], torch.inf)
    if change == "absent":
        del weights[name]
    save_file(weights, copy / "model.safetensors")
    old_policy = Pi0.load(str(copy))
    with pytest.raises(CheckpointError, match=r"buffer_action\.std"):
        _ = old_policy.action_units
    assert "buffer_action.std" in str(old_policy.embodiment_mismatch())


def test_statistics_given_to_a_checkpoint_that_has_its_own_are_refused(
    golden: Path, observation: Observation
) -> None:
    old_policy = Pi0.load(str(golden / "checkpoint"), statistics="bridge")
    assert "leave -M statistics out" in str(old_policy.embodiment_mismatch())
    with pytest.raises(CheckpointError, match="leave -M statistics out"):
        old_policy.act([observation], [0])


def test_a_setting_that_nobody_knows_is_an_error_until_it_is_accepted(golden: Path, tmp_path: Path) -> None:
    copy = old_copy(golden, tmp_path)
    config = json.loads((copy / "config.json").read_text(encoding="utf-8"))
    (copy / "config.json").write_text(
        json.dumps({**config, "flip_pictures": True, "num_views": 1}), encoding="utf-8"
    )
    with pytest.raises(CheckpointError, match="-M unread=flip_pictures,num_views"):
        Pi0.load(str(copy))
    assert Pi0.load(str(copy), unread="flip_pictures,num_views").config.num_inference_steps == 10


def test_settings_that_changed_states_and_actions_are_refused() -> None:
    for name in ("adapt_to_pi_aloha", "use_delta_joint_actions_aloha"):
        with pytest.raises(CheckpointError, match=f"{name}=True"):
            current_config({"type": "pi0", name: True}, "config.json")


def old_copy(golden: Path, target: Path) -> Path:
    import shutil

    return Path(shutil.copytree(golden, target / "pi0")) / "checkpoint"
