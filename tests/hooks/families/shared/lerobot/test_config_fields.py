"""A newer configuration is read where its new fields do nothing, and refused by name where they do."""

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from probe_kit.errors import CheckpointError, ProbeKitError
from probe_kit.hooks import Observation, load_policy
from probe_kit.hooks.families.shared.lerobot.pipelines import known_values
from tests.support import (
    eo1_checkpoints,
    groot_checkpoints,
    molmoact2_checkpoints,
    pi0_checkpoints,
    pi0_fast_checkpoints,
    pi05_checkpoints,
    smolvla_checkpoints,
    xvla_checkpoints,
)

WRITERS: dict[str, Callable[[Path], Path]] = {
    "pi0": pi0_checkpoints.write_intact,
    "pi05": pi05_checkpoints.write_pi05,
    "pi0-fast": pi0_fast_checkpoints.write_pi0_fast,
    "molmoact2": molmoact2_checkpoints.write_molmoact2,
    "groot": groot_checkpoints.write_groot,
    "xvla": xvla_checkpoints.write_xvla,
    "eo1": eo1_checkpoints.write_eo1,
    "smolvla": smolvla_checkpoints.write_smolvla,
}
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


def acted(family: str, folder: Path, seen: Observation) -> Any:
    return load_policy(family, str(folder)).infer_without_acting([seen], [0])


@pytest.fixture
def seen() -> Observation:
    picture = np.random.default_rng(0).integers(0, 256, (96, 96, 3), np.uint8)
    return Observation(picture, np.zeros(8, np.float32), "put the cube on the star")


@pytest.mark.parametrize("family", list(NEWER))
def test_a_newer_configuration_at_its_defaults_gives_the_same_numbers(
    family: str, tmp_path: Path, seen: Observation
) -> None:
    folder = WRITERS[family](tmp_path / "checkpoint")
    before = acted(family, folder, seen)
    path = folder / "config.json"
    values = json.loads(path.read_text(encoding="utf-8"))
    if "model_dtype" in values:
        values["dtype"] = values.pop("model_dtype")
    values = {name: value for name, value in values.items() if name not in GONE} | NEWER[family]
    path.write_text(json.dumps(values), encoding="utf-8")
    np.testing.assert_array_equal(acted(family, folder, seen), before)


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
    folder = change(WRITERS[family](tmp_path / "checkpoint"), **{field: value})
    with pytest.raises(CheckpointError, match=f"asks for {field}: .*Supported is {field}") as caught:
        load_policy(family, str(folder))
    assert "ownload" not in str(caught.value)


@pytest.mark.parametrize("family", list(WRITERS))
def test_an_unknown_setting_is_named_in_every_family(family: str, tmp_path: Path) -> None:
    folder = change(WRITERS[family](tmp_path / "checkpoint"), gaze_ahead=2)
    with pytest.raises(CheckpointError, match="unknown settings: gaze_ahead: 2") as caught:
        load_policy(family, str(folder))
    assert "ownload" not in str(caught.value)


@pytest.mark.parametrize("family", list(WRITERS))
def test_a_policy_that_reads_several_observations_is_refused(family: str, tmp_path: Path) -> None:
    folder = change(WRITERS[family](tmp_path / "checkpoint"), n_obs_steps=2)
    with pytest.raises(ProbeKitError, match="n_obs_steps"):
        load_policy(family, str(folder))


def test_delta_indices_of_the_configuration_are_refused(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from lerobot.policies.pi05.configuration_pi05 import PI05Config

    folder = WRITERS["pi05"](tmp_path / "checkpoint")
    monkeypatch.setattr(PI05Config, "observation_delta_indices", property(lambda _: [-2, -1, 0]))
    with pytest.raises(CheckpointError, match=r"steps \[-2, -1, 0\] \(observation_delta_indices\)"):
        load_policy("pi05", str(folder))


def test_two_names_of_one_precision_have_to_agree(tmp_path: Path) -> None:
    folder = WRITERS["molmoact2"](tmp_path / "checkpoint")
    change(folder, model_dtype="float32", dtype="bfloat16")
    with pytest.raises(CheckpointError, match="model_dtype: 'float32' and dtype: 'bfloat16'"):
        load_policy("molmoact2", str(folder))


def test_zero_is_not_false() -> None:
    with pytest.raises(CheckpointError, match="flag: 0"):
        known_values({"flag": 0}, (), {"flag": (False,)}, (), Path("config.json"))
