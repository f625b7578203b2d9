"""lerobot's own processor pipelines of a tiny checkpoint, saved into it and loaded again."""

import json
from collections.abc import Callable, Mapping
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
import torch
from lerobot.configs.policies import PreTrainedConfig
from lerobot.policies.factory import make_pre_post_processors
from lerobot.processor import tokenizer_processor
from transformers import AutoTokenizer

from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LEAST, LOW, MOST


def statistics() -> dict[str, dict[str, torch.Tensor]]:
    """Of a data set: several kinds, which differ."""
    rows = {}
    for feature, low, high in (("observation.state", LOW, HIGH), ("action", LEAST, MOST)):
        span = high - low
        rows[feature] = {
            "q01": low, "q99": high, "min": (low - span / 9).clip(-1, 1),
            "max": (high + span / 7).clip(-1, 1), "q10": low + span / 8,
            "q90": high - span / 9, "mean": (low + high) / 2 + 0.01, "std": span / 3 + 0.01,
        }  # fmt: skip
    return {name: {kind: torch.from_numpy(array) for kind, array in row.items()} for name, row in rows.items()}


def without_hub(folder: Path, patch: pytest.MonkeyPatch) -> None:
    """lerobot's steps read the tokenizers of the folder, whatever name they were given."""
    tokenizer = AutoTokenizer.from_pretrained(str(folder))
    patch.setattr(
        tokenizer_processor, "AutoTokenizer", SimpleNamespace(from_pretrained=lambda *_, **__: tokenizer)
    )
    if (folder / "fast").is_dir():
        patch.setattr(tokenizer_processor, "AutoProcessor", SimpleNamespace(from_pretrained=lambda *_, **__: None))


def save_pipelines(
    folder: Path, change: Callable[[list[dict[str, Any]]], None] | None = None, **fields: Any
) -> tuple[Any, Any]:
    """lerobot's pipelines for the configuration with `fields`; `change` edits the saved steps of both in place."""
    path = folder / "config.json"
    path.write_text(json.dumps(json.loads(path.read_text(encoding="utf-8")) | fields), encoding="utf-8")
    for old in folder.glob("policy_*"):
        old.unlink()
    config = PreTrainedConfig.from_pretrained(folder)
    for pipeline in make_pre_post_processors(config, dataset_stats=statistics()):
        pipeline.save_pretrained(folder)
    if change is not None:
        for path in folder.glob("policy_*processor.json"):
            content = json.loads(path.read_text(encoding="utf-8"))
            change(content["steps"])
            path.write_text(json.dumps(content), encoding="utf-8")
    before, behind = make_pre_post_processors(config, pretrained_path=str(folder))
    return before, behind


def changed(name: str, **fields: Any) -> Callable[[list[dict[str, Any]]], None]:
    """A change of the fields of one step."""

    def change(steps: list[dict[str, Any]]) -> None:
        for step in steps:
            if step["registry_name"] == name:
                step["config"] |= fields

    return change


def raw(observation: Any, cameras: Mapping[str, Any]) -> dict[str, Any]:
    """What lerobot's pipelines are given of an observation. cameras: pictures (H, W, 3) by name."""
    pictures = {f"observation.images.{name}": torch.from_numpy(picture) for name, picture in cameras.items()}
    return {
        **{name: picture.permute(2, 0, 1).float() / 255 for name, picture in pictures.items()},
        "observation.state": torch.tensor(observation.state, dtype=torch.float32),
        "task": observation.instruction,
    }
