"""A newer configuration is read where its new fields do nothing, and refused by name where they do."""

import json
import shutil
from collections.abc import Callable, Iterator
from contextlib import suppress
from fnmatch import fnmatch
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from lerobot.policies.pi0_fast import modeling_pi0_fast
from lerobot.policies.pi05 import modeling_pi05
from lerobot.processor import ImageCropResizeProcessorStep
from safetensors.torch import load_file, save_file

from probe_kit.errors import CheckpointError, InstructionError, ObservationError, ProbeKitError
from probe_kit.hooks import Observation, load_policy
from probe_kit.hooks.conformance.subject import examples_for
from probe_kit.hooks.families.molmoact2.packing import FramedUnits, JointFrame
from probe_kit.hooks.families.pi0.adapter import Pi05
from probe_kit.hooks.families.pi0.network import Pi0Size
from probe_kit.hooks.families.pi0_fast.adapter import Pi0Fast
from probe_kit.hooks.families.shared.lerobot.normaliser import Bounds, Normaliser
from probe_kit.hooks.families.shared.lerobot.packing import TEXT_FILES
from probe_kit.hooks.families.shared.lerobot.paligemma import PaliGemmaSize, resize_network
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    CROP,
    POSTPROCESSOR,
    PREPROCESSOR,
    check_steps,
    declared_inputs,
    known_values,
    tokenizer_folder,
)
from probe_kit.hooks.families.shared.lerobot.window import PictureWindow, read_window
from probe_kit.hooks.registry import find_family
from tests.hooks.families.molmoact2.checkpoints import write_molmoact2
from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LOW, write_pi05
from tests.hooks.families.pi0_fast.checkpoints import fast_processor, write_pi0_fast
from tests.hooks.families.xvla.checkpoints import write_xvla
from tests.support.every_checkpoint import WRITERS
from tests.support.lerobot_pipelines import changed, raw, save_pipelines, without_hub

LEROBOTS = ("pi0", "pi05", "pi0-fast", "molmoact2", "groot", "xvla", "eo1", "smolvla")
CONFIG_WRITERS = {name: WRITERS[name][0] for name in LEROBOTS}
NEWER: dict[str, dict[str, Any]] = {
    "pi05": {
        "use_visual_memory": False, "use_proprioceptive_memory": False, "memory_frames": 6, "memory_stride": 30,
        "memory_temporal_attention_every": 4, "rtc_training_max_delay": 0,
        "rtc_config": {"enabled": False, "mode": "guided"},
    },
    "molmoact2": {
        "norm_stats_path": None, "train_mode_vlm": "lora", "compile_model": False, "llm_residual_dropout": 0.1,
    },
}  # fmt: skip
"""What lerobot's main writes by default, and lerobot 0.6.1 does not know (commit 7427f318)."""
GONE = ("enable_lora_vlm", "enable_lora_action_expert", "train_action_expert_only")


def change(folder: Path, **fields: Any) -> Path:
    path = folder / "config.json"
    values = json.loads(path.read_text(encoding="utf-8")) | fields
    path.write_text(json.dumps(values), encoding="utf-8")
    return folder


def acted(family: str, folder: Path, seen_once: Observation) -> Any:
    return load_policy(family, str(folder)).infer_without_acting([seen_once], [0])


@pytest.fixture
def seen_once() -> Observation:
    picture = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    return Observation(picture, np.zeros(8, np.float32), "put the cube on the star")


@pytest.mark.parametrize("family", list(NEWER))
def test_a_newer_configuration_at_its_defaults_gives_the_same_numbers(
    family: str, tmp_path: Path, seen_once: Observation
) -> None:
    folder = CONFIG_WRITERS[family](tmp_path / "checkpoint")
    before = acted(family, folder, seen_once)
    path = folder / "config.json"
    values = json.loads(path.read_text(encoding="utf-8"))
    if "model_dtype" in values:
        values["dtype"] = values.pop("model_dtype")
    values = {name: value for name, value in values.items() if name not in GONE} | NEWER[family]
    path.write_text(json.dumps(values), encoding="utf-8")
    np.testing.assert_array_equal(acted(family, folder, seen_once), before)


@pytest.mark.parametrize(
    ("family", "field", "value"),
    [
        ("pi05", "use_visual_memory", True),
        ("pi05", "use_proprioceptive_memory", True),
        ("pi05", "rtc_training_max_delay", 3),
        ("molmoact2", "norm_stats_path", "norm_stats.json"),
    ],
)
def test_a_newer_field_that_changes_inference_is_refused_with_what_is_supported(
    family: str, field: str, value: Any, tmp_path: Path
) -> None:
    folder = change(CONFIG_WRITERS[family](tmp_path / "checkpoint"), **{field: value})
    with pytest.raises(CheckpointError, match=f"asks for {field}: .*Supported is {field}") as caught:
        load_policy(family, str(folder))
    assert "ownload" not in str(caught.value)


@pytest.mark.parametrize("family", list(CONFIG_WRITERS))
def test_an_unknown_setting_is_named_in_every_family(family: str, tmp_path: Path) -> None:
    folder = change(CONFIG_WRITERS[family](tmp_path / "checkpoint"), gaze_ahead=2)
    with pytest.raises(CheckpointError, match="unknown settings: gaze_ahead: 2") as caught:
        load_policy(family, str(folder))
    assert "ownload" not in str(caught.value)


@pytest.mark.parametrize("family", list(CONFIG_WRITERS))
def test_a_policy_that_reads_several_observations_is_refused(family: str, tmp_path: Path) -> None:
    folder = change(CONFIG_WRITERS[family](tmp_path / "checkpoint"), n_obs_steps=2)
    with pytest.raises(ProbeKitError, match=r"reads the last 2 observations \(n_obs_steps\)"):
        load_policy(family, str(folder))


@pytest.mark.parametrize("family", list(CONFIG_WRITERS))
def test_a_picture_under_a_name_that_is_no_cameras_is_refused(family: str, tmp_path: Path) -> None:
    folder = CONFIG_WRITERS[family](tmp_path / "checkpoint")
    features = json.loads((folder / "config.json").read_text(encoding="utf-8"))["input_features"]
    picture = next(feature for name, feature in features.items() if name.startswith("observation.images."))
    change(folder, input_features={**features, "observation.image": picture})
    with pytest.raises(ProbeKitError, match=r"observation\.image\b"):
        load_policy(family, str(folder))


def test_delta_indices_of_the_configuration_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot.policies.pi05.configuration_pi05 import PI05Config

    folder = CONFIG_WRITERS["pi05"](tmp_path / "checkpoint")
    monkeypatch.setattr(PI05Config, "observation_delta_indices", property(lambda _: [-2, -1, 0]))
    with pytest.raises(CheckpointError, match=r"steps \[-2, -1, 0\] \(observation_delta_indices\)"):
        load_policy("pi05", str(folder))


def test_two_names_of_one_precision_have_to_agree(tmp_path: Path) -> None:
    folder = CONFIG_WRITERS["molmoact2"](tmp_path / "checkpoint")
    change(folder, model_dtype="float32", dtype="bfloat16")
    with pytest.raises(CheckpointError, match="model_dtype: 'float32' and dtype: 'bfloat16'"):
        load_policy("molmoact2", str(folder))


def test_zero_is_not_false() -> None:
    with pytest.raises(CheckpointError, match="flag: 0"):
        known_values({"flag": 0}, (), {"flag": (False,)}, (), Path("config.json"))


CAMERAS = ("base", "wrist")


@pytest.fixture(scope="module")
def patch() -> Iterator[pytest.MonkeyPatch]:
    with pytest.MonkeyPatch.context() as patch:
        yield patch


@pytest.fixture(scope="module")
def folder(tmp_path_factory: pytest.TempPathFactory, patch: pytest.MonkeyPatch) -> Path:
    folder = write_pi05(tmp_path_factory.mktemp("pi05"), cameras=CAMERAS, empty_cameras=1)
    without_hub(folder, patch)
    return folder


def observations() -> list[Observation]:
    """Two observations with states that lie beyond the quantiles too."""
    rng, texts = np.random.default_rng(0), ("Put_the cube\non the star", "put the cube on the red shape")
    return [
        Observation(
            rng.integers(0, 256, (24, 40, 3), np.uint8),
            (LOW + (HIGH - LOW) * rng.uniform(-0.1, 1.1, LOW.shape)).astype(np.float32),
            text,
            cameras={"wrist": rng.integers(0, 256, (24, 40, 3), np.uint8)},
        )
        for text in texts
    ]


@pytest.mark.parametrize(
    ("mode", "dtype"),
    [
        ("QUANTILES", "bfloat16"),
        pytest.param("QUANTILES", "float32", marks=pytest.mark.slow),
        ("QUANTILE10", "float32"),
        ("MEAN_STD", "float32"),
        pytest.param("MIN_MAX", "float32", marks=pytest.mark.slow),
    ],
)
def test_pi05_acts_as_lerobots_own_loading_processors_and_policy_bit_for_bit(
    folder: Path, mode: str, dtype: str
) -> None:
    modes = {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}
    before, behind = save_pipelines(folder, normalization_mapping=modes, dtype=dtype)
    every = Pi05.load(str(folder))
    with resize_network(modeling_pi05, Pi0Size.from_file(folder / "dims.json"), every.config):
        theirs = modeling_pi05.PI05Policy.from_pretrained(folder).eval()
    for cameras in (CAMERAS, CAMERAS[:1]):
        ours = every.with_cameras(cameras)
        for seed, observation in enumerate(observations()):
            pictures = {"base": observation.image, **observation.cameras}
            packed = before(raw(observation, {name: pictures[name] for name in cameras}))
            chunk = theirs.predict_action_chunk(packed, noise=ours.noise([seed]))
            metres = torch.stack([behind(action) for action in chunk.float().unbind(1)], 1)
            np.testing.assert_array_equal(ours.act([observation], [seed]), metres.numpy())


def test_pi0_fast_acts_as_lerobots_own_select_action(
    golden_pi0_fast: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Trained weights: whole chunks, of which lerobot hands out one action after the other."""
    folder = Path(shutil.copytree(golden_pi0_fast / "checkpoint", tmp_path / "checkpoint"))
    ours = _fast_acts_as_lerobot(folder, monkeypatch)
    assert ours.flagged is not None
    assert not ours.flagged.any()


@pytest.mark.slow
@pytest.mark.filterwarnings("ignore:the model put out tokens")
def test_pi0_fast_decodes_broken_chunks_as_lerobot_does_and_flags_them(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_pi0_fast(tmp_path, cameras=CAMERAS, empty_cameras=1, validate_action_token_prefix=False)
    ours = _fast_acts_as_lerobot(folder, monkeypatch)
    assert ours.flagged is not None
    assert ours.flagged.all()


def _fast_acts_as_lerobot(folder: Path, patch: pytest.MonkeyPatch) -> Any:
    without_hub(folder, patch)
    before, behind = save_pipelines(folder)
    ours, fast = Pi0Fast.load(str(folder)), fast_processor(folder / "fast")
    for name, component in (("AutoTokenizer", ours.tokenizer), ("AutoProcessor", fast)):
        patch.setattr(
            modeling_pi0_fast, name, SimpleNamespace(from_pretrained=lambda *_, returned=component, **__: returned)
        )
    with resize_network(modeling_pi0_fast, PaliGemmaSize.from_file(folder / "dims.json"), ours.config):
        theirs = modeling_pi0_fast.PI0FastPolicy.from_pretrained(folder).eval()
    for observation in observations():
        packed = before(raw(observation, {"base": observation.image}))
        theirs.reset()
        actions = [behind(theirs.select_action(packed)).numpy() for _ in range(4)]
        np.testing.assert_array_equal(ours.act([observation], [0]), np.stack(actions, 1))
    return ours


def _inserted(steps: list[dict[str, Any]]) -> None:
    steps.insert(1, {"registry_name": "vla_jepa_binarize_gripper", "config": {}})


def _of_a_class(steps: list[dict[str, Any]]) -> None:
    steps.insert(1, {"class": "somewhere.Step", "config": {}})


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (_inserted, "vla_jepa_binarize_gripper"),
        (_of_a_class, r"somewhere\.Step"),
        (changed("tokenizer_processor", padding_side="left"), "padding_side: 'left'"),
    ],
)
def test_a_step_that_would_change_numbers_unread_is_refused_by_name(
    folder: Path, change: Callable[[list[dict[str, Any]]], None], message: str
) -> None:
    with suppress(KeyError, ImportError, ValueError, TypeError):  # lerobot may not know it either
        save_pipelines(folder, change)
    with pytest.raises(CheckpointError, match=message):
        Pi05.load(str(folder))


def test_an_unknown_step_behind_the_policy_forbids_to_act_and_not_to_capture(folder: Path) -> None:
    save_pipelines(folder)
    path = folder / "policy_postprocessor.json"
    content = json.loads(path.read_text(encoding="utf-8"))
    _inserted(content["steps"])
    path.write_text(json.dumps(content), encoding="utf-8")
    policy = Pi05.load(str(folder))
    examples = examples_for(policy, "put the cube on the star")
    with pytest.raises(CheckpointError, match="vla_jepa_binarize_gripper"):
        policy.act(examples, [0])
    assert "vla_jepa_binarize_gripper" in str(policy.embodiment_mismatch())
    assert policy.infer_without_acting(examples, [0]).shape == (1, 4, 7)


def test_pictures_that_lerobot_would_normalise_are_refused(folder: Path) -> None:
    save_pipelines(
        folder, normalization_mapping={"VISUAL": "MEAN_STD", "STATE": "QUANTILES", "ACTION": "QUANTILES"}
    )
    assert Pi05.load(str(folder)).embodiment_mismatch() is None  # without statistics of pictures lerobot does not
    (file,) = folder.glob("policy_preprocessor_*.safetensors")
    tensors = load_file(file)
    pictures = {f"observation.images.base.{name}": torch.full((3, 1, 1), 0.5) for name in ("mean", "std")}
    save_file(tensors | pictures, file)
    with pytest.raises(CheckpointError, match=r"normalises observation\.images\.base by statistics"):
        Pi05.load(str(folder))


@pytest.mark.parametrize("where", ["configuration", "relative_actions_processor", "absolute_actions_processor"])
def test_changes_relative_to_the_state_are_no_actions_of_this_arm(folder: Path, where: str) -> None:
    """lerobot adds the state; a delta of the end effector without it would be another motion."""
    save_pipelines(folder, None if where == "configuration" else changed(where, enabled=True),
                   use_relative_actions=where == "configuration")  # fmt: skip
    policy = Pi05.load(str(folder))
    save_pipelines(folder, use_relative_actions=False)  # what was read at loading counts
    assert policy.predicts_relative
    assert any("relative to the state" in note for note in policy.card.notes)
    (example,) = examples_for(policy, "put the cube on the star")
    with pytest.raises(CheckpointError, match="relative to the state"):
        policy.act([example], [0])


def test_the_length_of_the_text_is_that_of_the_saved_step(folder: Path) -> None:
    save_pipelines(folder, changed("tokenizer_processor", max_length=20))
    policy = Pi05.load(str(folder))
    (example,) = examples_for(policy, "put the cube on the star")
    with pytest.raises(InstructionError, match="this checkpoint reads 20"):
        policy.act([example], [0])


@pytest.mark.parametrize("numbers", [1, 5])
def test_statistics_of_another_width_are_no_units(folder: Path, numbers: int) -> None:
    """One number would be spread over all of them."""
    save_pipelines(folder)
    (file,) = folder.glob("policy_postprocessor_*.safetensors")
    tensors = load_file(file)
    save_file(
        {name: tensor[:numbers] if name.startswith("action") else tensor for name, tensor in tensors.items()}, file
    )
    assert f"statistics of shape ({numbers},)" in str(Pi05.load(str(folder)).embodiment_mismatch())


def test_a_state_that_the_pipeline_leaves_out_is_read_as_it_is(folder: Path) -> None:
    save_pipelines(folder, changed("normalizer_processor", normalize_observation_keys=[]))
    policy = Pi05.load(str(folder))
    assert policy.state_units.mode == "IDENTITY"
    assert policy.action_units.mode == "QUANTILES"


def steps_of(folder: Path, pipeline: str = PREPROCESSOR) -> list[dict[str, Any]]:
    path = folder / f"{pipeline}.json"
    steps: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["steps"] if path.is_file() else []
    return steps


def write_steps(folder: Path, steps: list[dict[str, Any]], pipeline: str = PREPROCESSOR) -> None:
    (folder / f"{pipeline}.json").write_text(json.dumps({"name": pipeline, "steps": steps}), encoding="utf-8")


@pytest.mark.parametrize("family", ["pi05", "pi0-fast", "molmoact2", "smolvla", "xvla", "eo1"])
def test_an_unknown_field_of_any_step_is_refused_by_name_in_every_family(family: str, tmp_path: Path) -> None:
    folder = CONFIG_WRITERS[family](tmp_path / "checkpoint")
    steps = steps_of(folder) or [{"registry_name": "device_processor", "config": {"device": "cpu"}}]
    for step in steps:
        changed = [
            {**saved_step, "config": {**saved_step.get("config", {}), "blur": 2}}
            if saved_step is step
            else saved_step
            for saved_step in steps
        ]
        write_steps(folder, changed)
        with pytest.raises(CheckpointError, match=f"'{step['registry_name']}' has the field blur: 2"):
            load_policy(family, str(folder))


def test_a_prompt_without_the_state_is_refused(tmp_path: Path) -> None:
    folder = write_pi05(tmp_path / "checkpoint")
    name = "pi05_prepare_state_tokenizer_processor_step"
    other_steps = [step for step in steps_of(folder) if step["registry_name"] != name]
    for value in (True, False):
        step = {"registry_name": name, "config": {"max_state_dim": 32, "include_state_in_prompt": value}}
        write_steps(folder, [*other_steps, step])
        if value:
            load_policy("pi05", str(folder))
    with pytest.raises(CheckpointError, match=r"include_state_in_prompt: False.*Supported is True"):
        load_policy("pi05", str(folder))


@pytest.mark.parametrize(
    ("name", "field", "value", "plain"),
    [
        ("device_processor", "float_dtype", "float16", "float32"),
        ("tokenizer_processor", "task_key", "subtask", "task"),
        ("tokenizer_processor", "padding_side", "left", "right"),
        ("tokenizer_processor", "padding", "do_not_pad", "longest"),
    ],
)
def test_a_value_that_changes_numbers_is_refused(
    name: str, field: str, value: str, plain: str, tmp_path: Path
) -> None:
    write_steps(tmp_path, [{"registry_name": name, "config": {field: plain}}], PREPROCESSOR)
    check_steps(tmp_path, PREPROCESSOR, (name,))
    write_steps(tmp_path, [{"registry_name": name, "config": {field: value}}], PREPROCESSOR)
    with pytest.raises(CheckpointError, match=f"says {field}: '{value}'"):
        check_steps(tmp_path, PREPROCESSOR, (name,))


def test_a_step_that_stands_twice_is_refused(tmp_path: Path) -> None:
    step = {"registry_name": "normalizer_processor", "config": {"norm_map": {}}}
    write_steps(tmp_path, [step, step], POSTPROCESSOR)
    with pytest.raises(CheckpointError, match="'normalizer_processor' twice"):
        check_steps(tmp_path, POSTPROCESSOR, ("normalizer_processor",))


def test_an_entry_with_more_than_a_step_has_is_refused(tmp_path: Path) -> None:
    write_steps(tmp_path, [{"registry_name": "to_batch_processor", "config": {}, "unless": "training"}])
    with pytest.raises(CheckpointError, match="with unless"):
        check_steps(tmp_path, PREPROCESSOR, ())


def test_packing_of_another_configuration_is_refused(tmp_path: Path) -> None:
    folder = write_molmoact2(tmp_path / "checkpoint")
    path = folder / "config.json"
    chunk = json.loads(path.read_text(encoding="utf-8"))["chunk_size"]
    write_steps(folder, [{"registry_name": "molmoact2_pack_inputs", "config": {"chunk_size": chunk + 1}}])
    with pytest.raises(CheckpointError, match=rf"chunk_size: {chunk + 1} \(config.json: {chunk}\)"):
        load_policy("molmoact2", str(folder))


@pytest.mark.parametrize("name", ["xvla_imagenet_normalize", "xvla_image_to_float"])
def test_pictures_that_a_step_leaves_out_are_named(name: str, tmp_path: Path) -> None:
    folder = write_xvla(tmp_path / "checkpoint")
    steps = [step for step in steps_of(folder) if step["registry_name"] != name]
    write_steps(
        folder, [*steps, {"registry_name": name, "config": {"image_keys": ["observation.images.elsewhere"]}}]
    )
    with pytest.raises(CheckpointError, match=rf"the step '{name}' leaves out observation\.images"):
        load_policy("xvla", str(folder))


@pytest.mark.parametrize(
    ("of_step", "of_config", "cameras"),
    [
        (("wrist", "image"), ("image", "wrist"), ("wrist", "image")),
        (("wrist",), ("image", "wrist"), ("wrist",)),
        (None, ("wrist", "image"), ("wrist", "image")),
        (None, None, ("image", "wrist")),
    ],
    ids=["step", "fewer", "configuration", "features"],
)
def test_the_cameras_of_molmoact2_are_those_that_are_packed_in_their_order(
    of_step: tuple[str, ...] | None, of_config: tuple[str, ...] | None, cameras: tuple[str, ...], tmp_path: Path
) -> None:
    """Known before anything is loaded: the step of the packing counts, then the configuration."""

    def keys(names: tuple[str, ...] | None) -> dict[str, list[str]]:
        return {} if names is None else {"image_keys": [f"observation.images.{name}" for name in names]}

    picture = {"type": "VISUAL", "shape": [3, 8, 8]}
    features = {f"observation.images.{name}": picture for name in ("image", "wrist")}
    config = {"type": "molmoact2", "input_features": features, **keys(of_config)}
    (tmp_path / "config.json").write_text(json.dumps(config), encoding="utf-8")
    step = {"registry_name": "molmoact2_pack_inputs", "config": keys(of_step)}
    write_steps(tmp_path, [] if of_step is None else [step])
    inputs = declared_inputs(tmp_path)
    assert inputs is not None
    assert inputs.cameras == cameras


def test_the_tokenizer_that_a_newer_lerobot_saved_into_the_checkpoint_is_read(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    folder = write_pi05(tmp_path / "checkpoint")
    without_hub(folder, monkeypatch)
    (folder / "tokenizer").mkdir()
    for name in ("tokenizer.json", "tokenizer_config.json"):
        (folder / name).rename(folder / "tokenizer" / name)
    step = {"registry_name": "tokenizer_processor", "config": {"tokenizer_name": "tokenizer", "max_length": 48},
            "artifacts": {"tokenizer_name": "tokenizer"}}  # fmt: skip
    write_steps(folder, [*steps_of(folder), step])
    assert tokenizer_folder(folder) == folder / "tokenizer"
    policy = load_policy("pi05", str(folder))
    assert "file tokenizer/tokenizer.json" in policy.card.settings
    assert policy.token_ids(["put the cube on the star"])


STATE_LOW, STATE_HIGH = np.array([-1.0, 0.0], np.float32), np.array([1.0, 0.5], np.float32)
MAPS: dict[str, tuple[Normaliser, list[float], list[float]]] = {
    "MIN_MAX": (Normaliser("MIN_MAX", STATE_LOW, STATE_HIGH, 1e-8, "file"), [-2, -0.25], [2, 0.75]),
    "QUANTILES": (Normaliser("QUANTILES", STATE_LOW, STATE_HIGH, 1e-8, "file"), [-3, -0.5], [3, 1]),
    "QUANTILE10": (Normaliser("QUANTILE10", STATE_LOW, STATE_HIGH, 1e-8, "file"), [-5, -1], [5, 1.5]),
    "MEAN_STD": (Normaliser("MEAN_STD", STATE_LOW, STATE_HIGH, 1e-8, "file"), [-6, -2.5], [4, 2.5]),
    "clipped": (Bounds("BOUNDS", STATE_LOW, STATE_HIGH, 0.0, "file"), [-3, -0.5], [3, 1]),
    "clamped": (Normaliser("MIN_MAX", STATE_LOW, STATE_HIGH, 1e-8, "file", clamped=True), [-2, -0.25], [2, 0.75]),
}


@pytest.mark.parametrize("name", MAPS)
def test_values_beyond_the_support_of_the_statistics_are_outside_also_where_they_are_clipped(name: str) -> None:
    """Half a range beyond the extremes, further beyond quantiles, five deviations from the mean."""
    units, lowest, highest = MAPS[name]
    statistics = units.statistics
    assert statistics is not None
    np.testing.assert_allclose(statistics.support, (lowest, highest), atol=1e-2)
    for ends, direction in ((lowest, -1), (highest, 1)):
        inside, outside = (np.array(ends) - direction * by for by in (0.01, -0.01))
        assert not statistics.outside(inside).any()
        assert statistics.outside(outside).all()


def test_a_number_that_never_moved_has_its_own_value_whose_rounding_is_no_other_unit() -> None:
    """lerobot stores a mean that is a float32 step off beside a deviation of exactly 0."""
    value = np.float32(-1.5708)
    mean, deviation = np.array([value + np.float32(2e-7), 1], np.float32), np.array([0, 1], np.float32)
    statistics = Normaliser("MEAN_STD", mean, deviation, 1e-8, "file").statistics
    assert statistics is not None
    assert statistics.outside(np.array([[value, 0], [-1.6, 0]])).tolist() == [[False, False], [True, False]]


def test_numbers_without_statistics_are_never_outside() -> None:
    nothing = np.zeros(0, np.float32)
    assert Normaliser("IDENTITY", nothing, nothing, 0.0, "file").statistics is None
    plain = np.array([True, False])
    masked = Normaliser("MIN_MAX", STATE_LOW, STATE_HIGH, 1e-8, "file", plain=plain, clamped=True).statistics
    assert masked is not None
    assert masked.outside(np.array([[-9.0, 9.0]])).tolist() == [[False, True]]


def test_recorded_joints_are_compared_in_the_frame_of_the_robot() -> None:
    frame = JointFrame(np.array([-1], np.float32), np.array([2], np.float32))
    units = FramedUnits("MIN_MAX", STATE_LOW, STATE_HIGH, 1e-8, "file", clamped=True, frame=frame)
    values = np.array([[2.0, 0.2], [-0.5, 0.2]], np.float32)
    assert units.statistics is not None
    np.testing.assert_allclose(units.statistics.bounds, ([1, 0], [3, 0.5]))
    assert units.statistics.outside(values).tolist() == [[False, False], [True, False]]
    np.testing.assert_allclose(units.restore(units.normalise(values[:1])), values[:1])


CAMERA = "observation.images.base"


def write_step(folder: Path, config: dict[str, object]) -> None:
    steps = [{"registry_name": CROP, "config": config}]
    (folder / "policy_preprocessor.json").write_text(json.dumps({"steps": steps}), encoding="utf-8")


def test_the_window_is_the_one_lerobots_own_step_cuts(tmp_path: Path) -> None:
    crop, size = (3, 5, 20, 30), (12, 10)
    write_step(tmp_path, {"crop_params_dict": {CAMERA: crop}, "resize_size": size})
    pictures = torch.from_numpy(np.random.default_rng(0).random((2, 3, 40, 50), np.float32))
    step = ImageCropResizeProcessorStep(crop_params_dict={CAMERA: crop}, resize_size=size)
    torch.testing.assert_close(
        read_window(tmp_path, CAMERA)(pictures), step.observation({CAMERA: pictures})[CAMERA], rtol=0, atol=0
    )


def test_a_checkpoint_without_the_step_sees_the_whole_picture(tmp_path: Path) -> None:
    assert read_window(tmp_path, CAMERA) == PictureWindow()
    pictures = torch.rand(1, 3, 8, 8)
    assert torch.equal(PictureWindow()(pictures), pictures)


def test_a_crop_of_another_camera_is_not_applied(tmp_path: Path) -> None:
    write_step(tmp_path, {"crop_params_dict": {"observation.images.wrist": [0, 0, 4, 4]}, "resize_size": None})
    assert read_window(tmp_path, CAMERA).crop is None


def test_a_crop_outside_the_picture_is_an_error_and_not_black_padding() -> None:
    with pytest.raises(ObservationError, match="rows 30 to 50"):
        PictureWindow(crop=(30, 0, 20, 10))(torch.rand(1, 3, 40, 40))


def test_a_broken_step_names_the_file(tmp_path: Path) -> None:
    write_step(tmp_path, {"crop_params_dict": {CAMERA: [1, 2, 3]}})
    with pytest.raises(CheckpointError, match="policy_preprocessor"):
        read_window(tmp_path, CAMERA)


def test_a_smaller_picture_is_brought_to_the_size_the_crop_was_chosen_on() -> None:
    window = PictureWindow(crop=(10, 0, 20, 40), size=(20, 40), camera=(40, 40))
    picture = torch.linspace(0, 1, 40).expand(1, 3, 40, 40)
    halved = torch.nn.functional.interpolate(picture, (20, 20), mode="area")
    assert (window(halved) - window(picture)).abs().max() < 0.02
    wide = window(torch.ones(1, 3, 10, 40))
    assert float(wide[..., 0, :].max()) == 0.0, "padding is black"
    assert float(wide[..., 10, :].min()) == pytest.approx(1.0)


@pytest.mark.slow
@pytest.mark.parametrize("name", LEROBOTS)
def test_a_text_that_does_not_fit_is_refused_and_never_cut_also_without_the_weights(
    name: str, tmp_path: Path
) -> None:
    write, options = WRITERS[name]
    checkpoint, family = write(tmp_path / "checkpoint"), find_family(name)
    policy = family.load(str(checkpoint), options=options)
    for path in [path for path in checkpoint.rglob("*") if path.is_file()]:
        if not any(fnmatch(path.relative_to(checkpoint).as_posix(), pattern) for pattern in TEXT_FILES):
            path.unlink()
    assert not (checkpoint / "model.safetensors").exists()
    family.check_instructions(str(checkpoint), ["Put the cube on the star"], options)
    unreadable = "?" if name == "groot" else " " if name == "eo1" else "Put the cube on the star " * 200
    with pytest.raises(InstructionError):
        policy.token_ids([unreadable])
    with pytest.raises(InstructionError):
        family.check_instructions(str(checkpoint), [unreadable], options)
