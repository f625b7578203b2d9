"""A reference of other sizes, which is recorded here from the network itself, is reproduced too."""

import shutil
import warnings
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch

from probe_kit.errors import CheckpointError, InstructionError, ObservationError, UsageError
from probe_kit.hooks import Observation, Site, capture, load_policy
from probe_kit.hooks.checkpoints.weights import read_weights
from probe_kit.hooks.families.spatialvla.adapter import (
    LoadedSpatialVLA,
    SpatialVLA,
    Speech,
    load_checkpoint,
    load_spatialvla,
)
from probe_kit.hooks.families.spatialvla.network import SpatialVLAConfig
from probe_kit.hooks.testing import example_observations
from tests.hooks.families.spatialvla.checkpoints import (
    FIRST_ACTION,
    IMAGE,
    SIDE,
    WORDS,
    config_values,
    edges,
    processor_values,
    write_checkpoint,
    write_tokenizer,
)

pytestmark = pytest.mark.filterwarnings("ignore:the model put out tokens")

SCENE = np.array([[70, 0, 32], [0, 72, 24], [0, 0, 1]], np.float32)
FRACTAL = "fractal20220817_data/0.1.0"


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory) -> Path:
    bridge_statistics = processor_values()["statistics"]["bridge_orig/1.0.0"]
    processor_statistics = {
        "statistics": {
            "bridge_orig/1.0.0": bridge_statistics,
            "my_arm": {"action": {**bridge_statistics["action"], "q99": [0.2] * 7}},
        }
    }
    return write_checkpoint(tmp_path_factory.mktemp("spatialvla"), processor=processor_statistics)


@pytest.fixture(scope="module")
def plain(folder: Path) -> SpatialVLA:
    return load_spatialvla(str(folder), unnorm_key="bridge_orig/1.0.0")


@pytest.fixture(scope="module")
def chunked(folder: Path) -> SpatialVLA:
    return load_spatialvla(
        str(folder),
        iterations="chunk",
        constrained=True,
        camera="bridge_orig/1.0.0",
        unnorm_key="bridge_orig/1.0.0",
    )


@pytest.fixture(scope="module")
def flat(tmp_path_factory: pytest.TempPathFactory) -> SpatialVLA:
    where = tmp_path_factory.mktemp("flat")
    return load_spatialvla(
        str(write_checkpoint(where, use_vision_zoe=False, vision_zoe_config=None)), unnorm_key="bridge_orig/1.0.0"
    )


@pytest.fixture
def observations() -> list[Observation]:
    """Two cameras, two instructions of different length."""
    examples = example_observations(["Put the cube on the star", "Put the cube on the red shape"])
    return [replace(example, intrinsics=SCENE * [[1 + row], [1], [1]]) for row, example in enumerate(examples)]


# -- capture ---------------------------------------------------------------------------------------------------


@pytest.mark.slow
def test_the_first_step_of_a_chunk_is_the_same_whether_the_rest_is_captured(
    folder: Path, plain: SpatialVLA, observations: list[Observation]
) -> None:
    whole_chunk = load_spatialvla(str(folder), iterations="chunk", unnorm_key="bridge_orig/1.0.0")
    assert (plain.streams["action"].iterations, whole_chunk.streams["action"].iterations) == (3, 12)
    caches = []
    for policy in (plain, whole_chunk):
        with capture(policy, policy.sites()) as activations:
            policy.act(observations, [0, 1])
        caches.append(activations)
    for site in plain.sites():
        assert torch.equal(caches[0][site], caches[1][site])
    assert (caches[1][Site("action", 2, iteration=11)] - caches[1][Site("action", 2, iteration=2)]).abs().max() > 0


def test_picture_positions_know_the_instruction(plain: SpatialVLA, observations: list[Observation]) -> None:
    """Attention goes both ways over the prompt; docs/token-policies.md says what that means for probes."""
    captured = []
    for text in ("put the cube on the star", "take it away"):
        with capture(plain, plain.sites()) as activations:
            plain.act([replace(observations[0], instruction=text)], [0])
        captured.append(activations[Site("backbone", 2)][:, : plain.config.patches])
    assert (captured[0] - captured[1]).abs().max() > 1e-3


def test_every_position_has_its_role(plain: SpatialVLA, observations: list[Observation]) -> None:
    short, long = plain.roles(observations)["backbone"]
    patches = plain.config.patches
    assert [span.role for span in long.spans] == ["image.primary", "special", "language"]
    assert [span.role for span in short.spans] == ["image.primary", "special", "language", "padding"]
    assert (long.spans[0].stop, long.spans[1].stop) == (patches, patches + 1)
    ids = plain.token_ids([observation.instruction for observation in observations])
    assert len(long) == patches + len(ids[1]) - 1
    assert len(ids[0]) < len(ids[1])


# -- cameras ---------------------------------------------------------------------------------------------------


def test_a_picture_without_intrinsics_is_refused_by_name(
    plain: SpatialVLA, observations: list[Observation]
) -> None:
    assert plain.card.needs == {"intrinsics"}
    with pytest.raises(ObservationError, match="no intrinsics"):
        plain.act([replace(observations[0], intrinsics=None)], [0])
    with pytest.raises(ObservationError, match="invertible"):
        plain.act([replace(observations[0], intrinsics=np.zeros((3, 3), np.float32))], [0])


def test_the_camera_of_the_scene_reaches_the_network_scaled_to_the_models_picture(
    plain: SpatialVLA, observations: list[Observation]
) -> None:
    height, width = observations[0].image.shape[:2]
    expected = SCENE * np.array([[SIDE / width], [SIDE / height], [1]])
    np.testing.assert_allclose(plain.cameras(observations)[0].numpy(), expected, rtol=1e-6)
    residuals = []
    for matrix in (SCENE, SCENE * [[2], [2], [1]]):
        with capture(plain, plain.sites()) as activations:
            plain.act([replace(observations[0], intrinsics=matrix.astype(np.float32))], [0])
        residuals.append(activations[Site("backbone", 0)])
    patches = plain.config.patches
    assert (residuals[0] - residuals[1])[:, :patches].abs().max() > 1e-3
    assert torch.equal(residuals[0][:, patches:], residuals[1][:, patches:])


@pytest.mark.slow
def test_the_training_camera_may_stand_in_for_the_scenes(
    folder: Path, plain: SpatialVLA, observations: list[Observation]
) -> None:
    preset = load_spatialvla(str(folder), camera="default", unnorm_key="bridge_orig/1.0.0")
    assert preset.card.needs == frozenset()
    assert preset.card.settings["camera"] == "default"
    camera = processor_values()["intrinsic_config"]["default"]
    height, width = observations[0].image.shape[:2]
    scale = [[width / camera["width"]], [height / camera["height"]], [1]]
    same = replace(observations[0], intrinsics=np.array(camera["intrinsic"]) * scale)
    np.testing.assert_allclose(preset.cameras(observations[:1]), plain.cameras([same]), rtol=1e-6)
    np.testing.assert_array_equal(
        preset.act([replace(observations[0], intrinsics=None)], [0]), plain.act([same], [0])
    )
    with pytest.raises(
        UsageError, match=r"neither scene nor one of the checkpoint's: bridge_orig/1\.0\.0, default"
    ):
        load_spatialvla(str(folder), camera="wrist", unnorm_key="bridge_orig/1.0.0")


def test_a_model_without_depth_needs_no_camera(flat: SpatialVLA) -> None:
    assert flat.card.needs == frozenset()


# -- actions ---------------------------------------------------------------------------------------------------


def test_a_chunk_is_in_units_of_the_data_and_one_step_of_it_is_executed(
    plain: SpatialVLA, observations: list[Observation]
) -> None:
    actions = plain.act(observations, [0, 1])
    assert actions.shape == (2, 4, 7)
    assert (plain.card.chunk, plain.card.execute) == (4, 1)
    assert (np.abs(actions[..., :6]) <= 0.03).all()
    assert set(np.unique(actions[..., 6])) <= {0, 1}


def test_an_executed_step_that_names_no_action_is_flagged_and_said(
    plain: SpatialVLA, observations: list[Observation], monkeypatch: pytest.MonkeyPatch
) -> None:
    ids = torch.tensor([[slot.start for slot in plain.bins.slots] * 4] * 2)
    ids[0, 5] = 7  # in a step that is planned and not executed
    monkeypatch.setattr(plain, "generate", lambda *_: SimpleNamespace(ids=ids))
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        plain.act(observations, [0, 1])
    assert plain.flagged is not None
    assert plain.flagged.tolist() == [False, False]
    ids[1, 1] = plain.bins.slots[0].start  # a movement where a rotation belongs
    with pytest.warns(UserWarning, match="name no action"):
        plain.act(observations, [0, 1])
    assert plain.flagged.tolist() == [False, True]


@pytest.mark.slow
def test_decoding_within_slots_always_names_an_action_and_says_so(
    plain: SpatialVLA, chunked: SpatialVLA, observations: list[Observation]
) -> None:
    chunked.act(observations, [0, 1])
    assert chunked.flagged is not None
    assert not chunked.flagged.any()
    assert any("original does not" in note for note in chunked.card.notes)
    assert (plain.card.settings["constrained"], chunked.card.settings["constrained"]) == ("False", "True")


@pytest.fixture
def variants(tmp_path: Path) -> dict[str, SpatialVLA]:
    """The four released checkpoints as they differ: in bins and statistics, and in nothing else."""
    wide = {"q01": [-0.3] * 6 + [0.0], "q99": [0.5] * 6 + [1.0], "mask": [True] * 6 + [False]}
    even = edges()
    even["translation"]["r_bins"][1] = 1.6
    changes: dict[str, dict[str, Any]] = {
        "pt": {},
        "mix": {"statistics": {**processor_values()["statistics"], FRACTAL: {"action": wide}}},
        "sft-bridge": {"bin_policy": even},
        "sft-fractal": {"bin_policy": even, "statistics": {FRACTAL: {"action": wide}}},
    }
    return {
        name: load_spatialvla(
            str(write_checkpoint(tmp_path / name, processor=change)),
            constrained=True,
            unnorm_key=FRACTAL if name == "sft-fractal" else "bridge_orig/1.0.0",
        )
        for name, change in changes.items()
    }


@pytest.mark.slow
def test_the_released_variants_differ_in_bins_and_statistics_only(
    variants: dict[str, SpatialVLA], observations: list[Observation]
) -> None:
    assert len({policy.card.weights_sha256 for policy in variants.values()}) == 1
    keys = [policy.statistics.key for policy in variants.values()]
    assert keys == ["bridge_orig/1.0.0", "bridge_orig/1.0.0", "bridge_orig/1.0.0", FRACTAL]
    actions = {name: policy.act(observations, [0, 1]) for name, policy in variants.items()}
    np.testing.assert_array_equal(actions["pt"], actions["mix"])
    assert np.abs(actions["pt"] - actions["sft-bridge"])[..., :3].max() > 1e-3
    np.testing.assert_array_equal(actions["pt"][..., 3:6], actions["sft-bridge"][..., 3:6])
    values = (actions["sft-bridge"][..., :6] + 0.03) / 0.06
    np.testing.assert_allclose(actions["sft-fractal"][..., :6], values * 0.8 - 0.3, atol=1e-6)
    settings = [policy.card.settings for policy in variants.values()]
    assert (
        len({(s["action_bins"], s["action_statistics"], s["file processor_config.json"]) for s in settings}) == 4
    )
    assert len({s["action_bins"] for s in settings}) == 2


@pytest.mark.slow
def test_the_statistics_key_is_an_option_with_a_suggestion(tmp_path: Path) -> None:
    bridge_statistics = processor_values()["statistics"]["bridge_orig/1.0.0"]
    checkpoint = str(
        write_checkpoint(
            tmp_path, processor={"statistics": {"my_arm": bridge_statistics, FRACTAL: bridge_statistics}}
        )
    )
    assert load_spatialvla(checkpoint, unnorm_key=FRACTAL).statistics.key == FRACTAL
    with pytest.raises(UsageError, match="Did you mean my_arm"):
        load_spatialvla(checkpoint, unnorm_key="my_arms")
    with pytest.raises(UsageError, match="with -M unnorm_key=NAME: fractal"):
        load_spatialvla(checkpoint)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("statistics", "reason"),
    [({}, "has no statistics"), ({"arm": {"action": {"q01": [0.0] * 8, "q99": [1.0] * 8}}}, "8 dimensions")],
)
def test_statistics_that_cannot_be_used_are_refused(tmp_path: Path, statistics: Any, reason: str) -> None:
    with pytest.raises(CheckpointError, match=reason):
        load_spatialvla(str(write_checkpoint(tmp_path, processor={"statistics": statistics})))


@pytest.mark.slow
def test_a_longer_chunk_has_more_tokens(tmp_path: Path, observations: list[Observation]) -> None:
    checkpoint = str(write_checkpoint(tmp_path, processor={"action_chunk_size": 2}))
    policy = load_spatialvla(checkpoint, iterations="chunk", unnorm_key="bridge_orig/1.0.0")
    assert (policy.steps, policy.streams["action"].iterations) == (6, 6)
    assert policy.act(observations, [0, 1]).shape == (2, 2, 7)
    with pytest.raises(CheckpointError, match="action_chunk_size is 0"):
        load_spatialvla(
            str(write_checkpoint(tmp_path / "none", processor={"action_chunk_size": 0})),
            unnorm_key="bridge_orig/1.0.0",
        )


def test_a_prompt_longer_than_the_model_is_refused(plain: SpatialVLA, observations: list[Observation]) -> None:
    with pytest.raises(InstructionError, match="this model has 4096"):
        plain.act([replace(observations[0], instruction="x " * 4096)], [0])


def test_options_are_declared_and_checked(folder: Path) -> None:
    units = {"unnorm_key": "bridge_orig/1.0.0"}
    policy = load_policy("spatialvla", str(folder), lowercase="false", iterations="chunk", **units)
    assert policy.card.settings["lowercase"] == "False"
    for wrong in ({"iterations": "all"}, {"lowercase": "perhaps"}, {"lower_case": "true"}):
        with pytest.raises(UsageError):
            load_policy("spatialvla", str(folder), **units, **wrong)


@pytest.fixture(scope="module")
def sharded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_checkpoint(tmp_path_factory.mktemp("spatialvla"), shards=3)


def load(sharded: Path, dtype: str | None = None, random_weights: bool = False, seed: int = 0) -> LoadedSpatialVLA:
    return load_checkpoint(str(sharded), "cpu", dtype, random_weights, seed)


def test_every_tensor_of_every_shard_arrives_and_names_the_files(sharded: Path) -> None:
    loaded = load(sharded)
    stored = read_weights(sharded)
    assert loaded.audit.tensors == len(stored.tensors) == len(loaded.network.state_dict())
    assert loaded.audit.sha256 == stored.sha256()
    state = loaded.network.state_dict()
    table = "language_model.model.embed_tokens.weight"
    assert all(torch.equal(state[name], tensor) for name, tensor in stored.tensors.items() if name != table)
    assert torch.equal(state[table][:FIRST_ACTION], stored.tensors[table][:FIRST_ACTION])


def test_the_stale_rows_of_action_ids_are_overwritten_and_the_output_layer_stays(sharded: Path) -> None:
    stored, network = read_weights(sharded).tensors, load(sharded).network
    rows = network.language_model.model.embed_tokens.weight[FIRST_ACTION:]
    assert torch.equal(rows, stored["spatial_embed_tokens.weight"])
    assert not torch.equal(rows, stored["language_model.model.embed_tokens.weight"][FIRST_ACTION:])
    head = network.language_model.lm_head.weight
    assert torch.equal(head, stored["language_model.lm_head.weight"])
    assert head.data_ptr() != network.language_model.model.embed_tokens.weight.data_ptr()


def test_files_that_are_missing_or_of_another_kind_are_named(sharded: Path, tmp_path: Path) -> None:
    copy = Path(shutil.copytree(sharded, tmp_path / "bare"))
    (copy / "processor_config.json").unlink()
    with pytest.raises(CheckpointError, match=r"processor_config\.json is missing: it holds the action bins"):
        load(copy)


CONFIG = SpatialVLAConfig.from_json(config_values())


def speech(folder: Path, **fields: Any) -> Speech:
    speech_options = {"prompt": None, "lowercase": True, "tokenizer": None, **fields}
    return Speech.of(CONFIG, write_tokenizer(folder), **speech_options)


def words(ids: list[int]) -> str:
    return "".join(WORDS[number] for number in ids).replace("▁", " ")


def test_the_picture_comes_first_then_the_bare_instruction_in_lower_case_and_a_new_line(tmp_path: Path) -> None:
    ids = speech(tmp_path).prompt("Put the Cube on the star")
    assert ids[:9] == [IMAGE] * 9
    assert words(ids[9:]) == "<bos>put the cube on the star\n"
    assert ids.count(IMAGE) == CONFIG.patches


def test_case_and_template_are_options(tmp_path: Path) -> None:
    assert words(speech(tmp_path, lowercase=False).prompt("Put it")[9:]) == "<bos>Put it\n"
    prompt_ids = speech(tmp_path, prompt="question").prompt("Take it")
    assert words(prompt_ids[9:]) == "<bos>What action should the robot take to take it?\n"
    assert words(speech(tmp_path, prompt="do: {instruction}").prompt("it")[9:]) == "<bos>do: it\n"
    with pytest.raises(UsageError, match="neither one of bare, question nor a template"):
        speech(tmp_path, prompt="do it")


def test_letters_beyond_the_vocabulary_become_bytes(tmp_path: Path) -> None:
    assert words(speech(tmp_path).prompt("é")[9:]) == "<bos><0xC3><0xA9>\n"


def test_missing_tokenizer_files_are_named(tmp_path: Path) -> None:
    without = Speech.of(CONFIG, tmp_path, None, lowercase=True, tokenizer=None)
    with pytest.raises(CheckpointError, match=r"tokenizer\.json and tokenizer_config\.json are missing"):
        without.prompt("put the cube on the star")


def test_another_checkpoints_tokenizer_is_refused(tmp_path: Path) -> None:
    """Its words may mean something else, which nothing but the added tokens gives away."""
    other = write_tokenizer(tmp_path / "other", more=("<video>",))
    with pytest.raises(CheckpointError, match=r"reads <ACTION00000> as .* the model expects"):
        speech(tmp_path, tokenizer=str(other)).prompt("put it")


@pytest.mark.parametrize("text", ["put the <image> on the star", "do <ACTION00003> now"])
def test_an_instruction_cannot_smuggle_in_pictures_or_actions(tmp_path: Path, text: str) -> None:
    with pytest.raises(InstructionError, match="stands for a picture or an action"):
        speech(tmp_path, lowercase=False).prompt(text)


def test_a_new_line_that_melts_into_the_one_behind_it_is_refused(tmp_path: Path) -> None:
    with pytest.raises(InstructionError, match="merges with the new line"):
        speech(tmp_path).prompt("put the cube on the star\n")
