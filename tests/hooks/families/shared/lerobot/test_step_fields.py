"""Fields of known processor steps are honoured or refused by name, in every family of lerobot's."""

import json
from pathlib import Path
from typing import Any

import pytest

from probe_kit.errors import CheckpointError
from probe_kit.hooks import load_policy
from probe_kit.hooks.families.shared.lerobot.pipelines import (
    POSTPROCESSOR,
    PREPROCESSOR,
    SavedStep,
    check_fields,
    check_steps,
    tokenizer_folder,
)
from tests.support.eo1_checkpoints import write_eo1
from tests.support.lerobot_pipelines import without_hub
from tests.support.molmoact2_checkpoints import write_molmoact2
from tests.support.pi0_fast_checkpoints import write_pi0_fast
from tests.support.pi05_checkpoints import write_pi05
from tests.support.smolvla_checkpoints import write_smolvla
from tests.support.xvla_checkpoints import write_xvla

WRITERS = {
    "pi05": write_pi05,
    "pi0-fast": write_pi0_fast,
    "molmoact2": write_molmoact2,
    "smolvla": write_smolvla,
    "xvla": write_xvla,
    "eo1": write_eo1,
}


def steps_of(folder: Path, pipeline: str = PREPROCESSOR) -> list[dict[str, Any]]:
    path = folder / f"{pipeline}.json"
    steps: list[dict[str, Any]] = json.loads(path.read_text(encoding="utf-8"))["steps"] if path.is_file() else []
    return steps


def write_steps(folder: Path, steps: list[dict[str, Any]], pipeline: str = PREPROCESSOR) -> None:
    (folder / f"{pipeline}.json").write_text(json.dumps({"name": pipeline, "steps": steps}), encoding="utf-8")


@pytest.mark.parametrize("family", list(WRITERS))
def test_an_unknown_field_of_any_step_is_refused_by_name_in_every_family(family: str, tmp_path: Path) -> None:
    folder = WRITERS[family](tmp_path / "checkpoint")
    steps = steps_of(folder) or [{"registry_name": "device_processor", "config": {"device": "cpu"}}]
    for step in steps:
        changed = [
            {**own, "config": {**own.get("config", {}), "blur": 2}} if own is step else own for own in steps
        ]
        write_steps(folder, changed)
        with pytest.raises(CheckpointError, match=f"'{step['registry_name']}' has the field blur: 2"):
            load_policy(family, str(folder))


def test_a_prompt_without_the_state_is_refused(tmp_path: Path) -> None:
    folder = write_pi05(tmp_path / "checkpoint")
    name = "pi05_prepare_state_tokenizer_processor_step"
    others = [step for step in steps_of(folder) if step["registry_name"] != name]
    for value in (True, False):
        step = {"registry_name": name, "config": {"max_state_dim": 32, "include_state_in_prompt": value}}
        write_steps(folder, [*others, step])
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
def test_a_value_that_changes_numbers_is_refused(name: str, field: str, value: str, plain: str) -> None:
    check_fields(SavedStep(name, {field: plain}, None), "pipeline.json")
    with pytest.raises(CheckpointError, match=f"says {field}: '{value}'"):
        check_fields(SavedStep(name, {field: value}, None), "pipeline.json")


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


def test_pictures_that_a_step_leaves_out_are_named(tmp_path: Path) -> None:
    folder = write_xvla(tmp_path / "checkpoint")
    steps = steps_of(folder)
    own = next(step for step in steps if step["registry_name"] == "xvla_imagenet_normalize")
    own["config"] = {"image_keys": ["observation.images.elsewhere"]}
    write_steps(folder, steps)
    with pytest.raises(CheckpointError, match=r"leaves out observation\.images"):
        load_policy("xvla", str(folder))


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
