"""A tiny EO-1 in lerobot's layout, with the processor's files inside."""

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import torch

from tests.hooks.families.groot.checkpoints import write_processor_files
from tests.hooks.families.pi0.pi05_checkpoints import HIGH, LEAST, LOW, MOST
from tests.support.vlm_checkpoints import write_qwen2_5_vl
from tests.support.written_once import written_once


@written_once
def write_eo1(folder: Path, seed: int = 0, cameras: Sequence[str] = ("image",), **fields: Any) -> Path:
    """Three layers of a Qwen2.5-VL that denoise four actions in three steps. fields: of the configuration."""
    from lerobot.configs.types import FeatureType, NormalizationMode, PolicyFeature
    from lerobot.policies.eo1.configuration_eo1 import EO1Config
    from lerobot.policies.eo1.processor_eo1 import make_eo1_pre_post_processors
    from transformers import Qwen2_5_VLConfig

    from probe_kit.hooks.families.eo1.adapter import build_eo1
    from probe_kit.models.building import initialise

    write_processor_files(folder / "vlm", write_qwen2_5_vl)
    config = EO1Config(
        input_features={
            **{f"observation.images.{name}": PolicyFeature(FeatureType.VISUAL, (3, 48, 80)) for name in cameras},
            "observation.state": PolicyFeature(FeatureType.STATE, (len(LOW),)),
        },
        output_features={"action": PolicyFeature(FeatureType.ACTION, (len(MOST),))},
        normalization_mapping={
            "VISUAL": NormalizationMode.IDENTITY,
            "STATE": NormalizationMode.MIN_MAX,
            "ACTION": NormalizationMode.MIN_MAX,
        },
        device="cpu", dtype="float32", vlm_base=str(folder / "vlm"), chunk_size=4, n_action_steps=4,
        vlm_config=Qwen2_5_VLConfig.from_pretrained(folder / "vlm").to_dict(), max_state_dim=10, max_action_dim=9,
        num_denoise_steps=3, image_min_pixels=28 * 28, image_max_pixels=84 * 84, **fields,
    )  # fmt: skip
    policy = build_eo1(config)
    initialise(policy, seed)
    units = {"observation.state": {"min": LOW, "max": HIGH}, "action": {"min": LEAST, "max": MOST}}
    tensors = {key: {name: torch.from_numpy(array) for name, array in row.items()} for key, row in units.items()}
    for pipeline, name in zip(make_eo1_pre_post_processors(config, tensors), ("pre", "post"), strict=True):
        pipeline.save_pretrained(folder, config_filename=f"policy_{name}processor.json")
    config.vlm_base, config.pretrained_path = "vlm", None
    policy.save_pretrained(folder)
    file = folder / "policy_preprocessor.json"
    file.write_text(file.read_text(encoding="utf-8").replace(str(folder / "vlm"), "vlm"), encoding="utf-8")
    return folder
