"""The processor files of a lerobot checkpoint, as far as they hold units."""

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import NDArray
from safetensors.numpy import save_file


def write_units(folder: Path, feature: str, mode: str, statistics: Mapping[str, NDArray[Any]]) -> None:
    """`policy_preprocessor.json` for the state and `policy_postprocessor.json` for the action, with statistics."""
    kind, step = ("post", "unnormalizer") if feature == "action" else ("pre", "normalizer")
    name = f"policy_{kind}processor"
    state = f"{name}_step_0_{step}_processor.safetensors"
    save_file(
        {f"{feature}.{key}": np.asarray(value, np.float32) for key, value in statistics.items()}, folder / state
    )
    modes = {"VISUAL": "IDENTITY", "STATE": mode, "ACTION": mode}
    config = {"eps": 1e-8, "features": {}, "norm_map": modes}
    steps = [{"registry_name": f"{step}_processor", "config": config, "state_file": state}]
    (folder / f"{name}.json").write_text(json.dumps({"name": name, "steps": steps}), encoding="utf-8")
