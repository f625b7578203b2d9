"""Quantities in which Xiaomi-Robotics-R0 is compared with its golden references.

B batch, P prompt positions, L backbone layers, T expert positions, S Euler steps.
"""

from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hooks.families.shared.qwen.vla import recorded_inputs
from probe_kit.hooks.families.xiaomi.adapter import Xiaomi
from probe_kit.hooks.verification.outputs import (
    Arrays,
    Outputs,
    Produce,
    euler_path,
    numpy_of,
    stream_outputs,
    watch,
)
from probe_kit.models.xiaomi import ActionUnits

_NORMS = ("norm_mean", "norm_std")


def xiaomi_outputs(load: Callable[..., Xiaomi], folder: Path, recorded: Arrays) -> Outputs:
    """Run the recorded inputs through the adapter.

    The backbone is compared at valid positions only: padding holds plausible numbers that nothing reads.
    """
    steps = len(recorded["denoise_times"]) if "denoise_times" in recorded else 5
    policy = load(str(folder / "checkpoint"), dtype="float32", steps=steps)
    inputs = recorded_inputs(policy, recorded)
    state, mask, noise = (torch.from_numpy(recorded[f"in_{name}"]) for name in ("state", "action_mask", "noise"))
    blocks, dit = policy.language.layers, policy.network.dit.layers
    modules: dict[str, nn.Module] = {
        **{f"block{number}": block for number, block in enumerate(blocks)},
        **{f"dit{number}": block for number, block in enumerate(dit)},
        "velocity": policy.network.action_output_layer,
        "model": policy.vlm.model,
        "merger": policy.tower.merger,
    }
    actions, tape, calls = watch(policy, lambda: policy.infer(inputs, state, mask, noise), modules)
    streams, vision = stream_outputs(policy, tape), policy.vision_stream()
    cache = calls["model"][0].past_key_values.layers
    produced: dict[str, Produce] = {
        **streams,
        "position_ids": lambda: numpy_of(inputs.positions(policy.vlm.model)),
        "vision_resid": lambda: streams["vision_resid"]().reshape(vision.layers, -1, vision.width),
        "vision_merged": lambda: numpy_of(calls["merger"][0]),
        "backbone_layer_input": streams["backbone_resid"],
        "backbone_layer_output": lambda: _outputs(calls, "block", len(blocks))[0],
        "kv_keys": lambda: numpy_of(torch.stack([layer.keys for layer in cache])),
        "kv_values": lambda: numpy_of(torch.stack([layer.values for layer in cache])),
        "dit_layer_input": lambda: streams["expert_resid"]()[:, :-1],
        "dit_layer_output": lambda: _outputs(calls, "dit", len(dit)),
        "velocity": lambda: numpy_of(torch.stack(calls["velocity"])),
        "x_t": lambda: euler_path(noise, calls["velocity"], lambda velocity: velocity * (1.0 / steps)),
        "denoise_times": lambda: np.array([step / steps for step in range(steps)], np.float32),
        "actions": lambda: numpy_of(actions),
        "actions_unnormalized": lambda: _restored(policy, numpy_of(actions), recorded),
    }
    return Outputs(produced, inputs=_NORMS, valid=_valid(policy, recorded["in_attention_mask"].astype(bool)))


def _outputs(calls: Mapping[str, list[Tensor]], kind: str, blocks: int) -> NDArray[Any]:
    """(calls, blocks, …) of every block of a stack."""
    rows = zip(*(calls[f"{kind}{number}"] for number in range(blocks)), strict=True)
    return numpy_of(torch.stack([torch.stack(row) for row in rows]))


def _valid(policy: Xiaomi, mask: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """(B, P) for streams, (B, heads, P) for keys and values."""
    heads = int(policy.vlm.config.text_config.num_key_value_heads)
    cached = np.repeat(mask[:, None], heads, axis=1)
    streams = ("backbone_layer_input", "backbone_layer_output", "backbone_final_norm")
    return dict.fromkeys(streams, mask) | dict.fromkeys(("kv_keys", "kv_values"), cached)


def _restored(policy: Xiaomi, actions: NDArray[Any], recorded: Arrays) -> NDArray[Any]:
    """Actions in units of the recorded statistics, where there are some; else of the checkpoint's."""
    if not set(_NORMS) <= set(recorded):
        return policy.units.restore(actions)
    mean, deviation = (np.asarray(recorded[name], np.float64) for name in _NORMS)
    mean, deviation = (part.reshape(part.shape[-2:]) for part in (mean, deviation))
    return ActionUnits("recorded", mean, deviation).restore(actions)
