"""The refusal of a folder that is no checkpoint names the checkpoint near it, or whose layout it has."""

import json
from pathlib import Path
from typing import Any

import pytest

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.folders import check_files

TYPES = ("pi0",)


def write(folder: Path, files: dict[str, Any]) -> Path:
    folder.mkdir()
    for name, content in files.items():
        (folder / name).parent.mkdir(parents=True, exist_ok=True)
        (folder / name).write_text(json.dumps(content), encoding="utf-8")
    return folder


def said_of(folder: Path) -> str:
    with pytest.raises(CheckpointError) as refusal:
        check_files(folder, TYPES)
    return str(refusal.value)


PI0, OTHER = {"type": "pi0"}, {"type": "act"}


@pytest.mark.parametrize(
    ("files", "first", "alternatives"),
    [
        ({"checkpoints/000100/pretrained_model/config.json": PI0}, "checkpoints/000100/pretrained_model", []),
        (
            {"checkpoints/9/config.json": PI0, "checkpoints/10/config.json": PI0},
            "checkpoints/10",
            ["checkpoints/9"],
        ),
        ({"checkpoint-9/config.json": PI0, "checkpoint-10/config.json": PI0}, "checkpoint-10", ["checkpoint-9"]),
        ({"200/config.json": OTHER, "100/config.json": PI0}, "100", []),
        ({"lora/adapter_config.json": {}, "notes/readme.json": {}}, "lora", []),
        ({"config.json": {"paligemma_variant": "x"}, "step-5/config.json": PI0}, "step-5", []),
    ],
    ids=["lerobot", "numbers", "transformers", "another type", "adapter", "beside openpi's"],
)
def test_the_latest_checkpoint_of_the_type_below_is_named_first(
    files: dict[str, Any], first: str, alternatives: list[str], tmp_path: Path
) -> None:
    folder = write(tmp_path / "train", files)
    more = f" (or {', '.join(str(folder / name) for name in alternatives)})" if alternatives else ""
    assert said_of(folder).endswith(f". One lies in it: pass --checkpoint {folder / first}{more}")


def test_the_link_to_the_last_checkpoint_counts_once_and_first(tmp_path: Path) -> None:
    folder = write(tmp_path / "train", {f"checkpoints/{step}/config.json": PI0 for step in ("100", "200")})
    (folder / "checkpoints" / "last").symlink_to("200")
    advice = said_of(folder)
    assert f"pass --checkpoint {folder / 'checkpoints' / 'last'} (or {folder / 'checkpoints' / '100'})" in advice
    assert str(folder / "checkpoints" / "200") not in advice


def test_the_model_beside_the_state_of_its_training_is_named(tmp_path: Path) -> None:
    step = write(tmp_path / "100", {"pretrained_model/config.json": PI0, "training_state/step.json": {}})
    assert f"pass --checkpoint {step / 'pretrained_model'}" in said_of(step / "training_state")


@pytest.mark.parametrize(
    ("files", "layout"),
    [
        ({"params/_METADATA": {}}, "openpi's JAX layout (params)"),
        ({"params/x": {}, "assets/droid/norm_stats.json": {}},
         "openpi's JAX layout (params, assets/droid/norm_stats.json)"),
        ({"assets/norm_stats.json": {}}, "openpi's PyTorch layout (assets/norm_stats.json)"),
        ({"config.json": {"action_expert_variant": "gemma_300m"}, "assets/me/mine/norm_stats.json": {}},
         "openpi's PyTorch layout (config.json without a type, assets/me/mine/norm_stats.json)"),
    ],
)  # fmt: skip
def test_a_folder_of_openpi_is_named_as_such(files: dict[str, Any], layout: str, tmp_path: Path) -> None:
    advice = said_of(write(tmp_path / "ours", files))
    assert f"This is {layout}" in advice
    assert "take a checkpoint that lerobot-train saved" in advice


@pytest.mark.parametrize(
    "files", [{}, {"x/y/config.json": OTHER}, {"params/x": {}}, {"a/b/c/d/e/config.json": PI0}]
)
def test_of_a_folder_without_any_sign_nothing_is_guessed(files: dict[str, Any], tmp_path: Path) -> None:
    folder = write(tmp_path / "folder", files)
    message = said_of(folder)
    assert "is not a checkpoint of pi0. Give the folder that holds config.json and the weights" in message
    assert "pass --checkpoint" not in message
