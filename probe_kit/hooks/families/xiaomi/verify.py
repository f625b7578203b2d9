"""Quantities in which Xiaomi-Robotics-R0 is compared with its golden references.

B batch, P prompt positions, L backbone layers, T expert positions, S Euler steps.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.hooks.capturing.capture_context import ActivationCache, capture
from probe_kit.hooks.families.shared.module_outputs import numpy_of, outputs_of, stacked
from probe_kit.hooks.families.xiaomi.adapter import Xiaomi, load_xiaomi
from probe_kit.hooks.verification.verify import Comparison, Produce, compare
from probe_kit.models.qwen import QwenInputs

TOLERANCE = 1e-5
Arrays = Mapping[str, NDArray[Any]]
_NORMS = ("norm_mean", "norm_std")


def verify_xiaomi(folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Run the recorded inputs through the adapter and compare everything it can produce.

    The backbone is compared at valid positions only: padding holds plausible numbers that nothing reads.
    """
    steps = len(recorded["denoise_times"]) if "denoise_times" in recorded else 5
    policy = load_xiaomi(str(folder / "checkpoint"), dtype="float32", steps=steps)
    inputs = _inputs(policy, recorded)
    given = {name: torch.from_numpy(recorded[name]) for name in ("in_state", "in_action_mask", "in_noise")}
    watched = {
        "layers": list(policy.language.layers),
        "dit": list(policy.network.dit.layers),
        "velocity": [policy.network.action_output_layer],
        "model": [policy.vlm.model],
        "merger": [policy.tower.merger],
    }
    with ExitStack() as stack:
        calls = {name: [outputs_of(module, stack) for module in modules] for name, modules in watched.items()}
        every = [*policy.sites(), *policy.backbone_stream().sites("final_norm"), *policy.vision_stream().sites()]
        tape = stack.enter_context(capture(policy, every))
        actions = policy.infer(inputs, given["in_state"], given["in_action_mask"], given["in_noise"])
    produced = {
        **_backbone(policy, inputs, tape, calls),
        **_expert(policy, tape, calls),
        **_path(calls["velocity"][0], given["in_noise"]),
        "actions": lambda: numpy_of(actions),
        "actions_unnormalized": lambda: _restored(policy, numpy_of(actions), recorded),
    }
    outputs = {name: values for name, values in recorded.items() if name not in _NORMS}
    return compare(outputs, produced, TOLERANCE, _valid(policy, recorded["in_attention_mask"].astype(bool)))


def _inputs(policy: Xiaomi, recorded: Arrays) -> QwenInputs:
    names = ("in_input_ids", "in_attention_mask", "in_pixel_values", "in_image_grid_thw")
    ids, mask, pixels, grid = (torch.from_numpy(recorded[name]) for name in names)
    return QwenInputs(ids, mask, pixels, grid, int(policy.vlm.config.image_token_id))


def _valid(policy: Xiaomi, mask: NDArray[np.bool_]) -> dict[str, NDArray[np.bool_]]:
    """(B, P) for streams, (B, heads, P) for keys and values."""
    heads = int(policy.vlm.config.text_config.num_key_value_heads)
    cached = np.repeat(mask[:, None], heads, axis=1)
    streams = ("backbone_layer_input", "backbone_layer_output", "backbone_final_norm")
    return dict.fromkeys(streams, mask) | dict.fromkeys(("kv_keys", "kv_values"), cached)


def _backbone(
    policy: Xiaomi, inputs: QwenInputs, tape: ActivationCache, calls: Mapping[str, list[list[Any]]]
) -> dict[str, Produce]:
    backbone = policy.streams["backbone"]
    cache = calls["model"][0][0].past_key_values.layers
    return {
        "position_ids": lambda: numpy_of(inputs.positions(policy.vlm.model)),
        "vision_resid": lambda: stacked(tape, policy.vision_stream()).reshape(
            policy.vision_stream().layers, -1, policy.vision_stream().width
        ),
        "vision_merged": lambda: numpy_of(calls["merger"][0][0]),
        "backbone_layer_input": lambda: stacked(tape, backbone)[0],
        "backbone_layer_output": lambda: numpy_of(torch.stack([layer[0] for layer in calls["layers"]])),
        "backbone_final_norm": lambda: stacked(tape, backbone, "final_norm")[0, 0],
        "kv_keys": lambda: numpy_of(torch.stack([layer.keys for layer in cache])),
        "kv_values": lambda: numpy_of(torch.stack([layer.values for layer in cache])),
    }


def _expert(policy: Xiaomi, tape: ActivationCache, calls: Mapping[str, list[list[Any]]]) -> dict[str, Produce]:
    return {
        "dit_layer_input": lambda: stacked(tape, policy.streams["expert"])[:, :-1],
        "dit_layer_output": lambda: numpy_of(
            torch.stack([torch.stack([layer[step] for layer in calls["dit"]]) for step in range(policy.steps)])
        ),
    }


def _path(velocities: list[Tensor], noise: Tensor) -> dict[str, Produce]:
    """Euler steps x ← x + v/S from the velocities the network put out."""
    steps = len(velocities)

    def path() -> NDArray[Any]:
        states = [noise]
        for velocity in velocities:
            states.append(states[-1] + velocity * (1.0 / steps))
        return numpy_of(torch.stack(states))

    return {
        "velocity": lambda: numpy_of(torch.stack(velocities)),
        "x_t": path,
        "denoise_times": lambda: np.array([step / steps for step in range(steps)], np.float32),
    }


def _restored(policy: Xiaomi, actions: NDArray[Any], recorded: Arrays) -> NDArray[Any]:
    """With the recorded statistics, where there are some; else with the checkpoint's."""
    from probe_kit.models.xiaomi import ActionUnits

    if not set(_NORMS) <= set(recorded):
        return policy.units.restore(actions)
    mean, deviation = (np.asarray(recorded[name], np.float64) for name in _NORMS)
    mean, deviation = (part.reshape(part.shape[-2:]) for part in (mean, deviation))
    return ActionUnits("recorded", mean, deviation).restore(actions)
