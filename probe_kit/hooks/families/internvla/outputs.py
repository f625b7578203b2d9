"""Quantities in which InternVLA-M1 is compared with its golden references.

B batch, V views, P prompt positions, L backbone layers, S DDIM steps, C conditions, A actions of a chunk.
"""

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.hooks.families.internvla.adapter import InternVLA
from probe_kit.hooks.families.internvla.checkpoint import find_parts
from probe_kit.hooks.families.internvla.units import ActionUnits
from probe_kit.hooks.families.shared.qwen.vla import recorded_inputs
from probe_kit.hooks.verification.outputs import Arrays, Outputs, Produce, numpy_of, stream_outputs, watch
from probe_kit.models.internvla import dino_pixels

_INPUTS = ("cfg_scale", "unnorm_q01", "unnorm_q99", "unnorm_mask")


def internvla_outputs(load: Callable[..., InternVLA], folder: Path, recorded: Arrays) -> Outputs:
    """Run the recorded inputs through the adapter.

    Whole batches, padding included: that padding reaches the actions is part of the original. The backbone itself
    is compared at valid positions.
    """
    steps = len(recorded["ddim_timestep_map"]) if "ddim_timestep_map" in recorded else 10
    guidance = float(recorded["cfg_scale"]) if "cfg_scale" in recorded else 1.5
    checkpoint = str(folder / "checkpoint")
    units = next(
        iter(find_parts(checkpoint, None, unread=True).statistics()), None
    )  # nothing compared depends on them
    policy = load(checkpoint, dtype="float32", steps=steps, guidance=guidance, unnorm_key=units)
    inputs, pixels = recorded_inputs(policy, recorded), _pixels(policy, recorded)
    network, noise = policy.network, torch.from_numpy(recorded["in_noise"])
    modules = {
        "merger": policy.tower.merger,
        "dino": network.dino_encoder.body,
        "projected": network.dino_pro,
        "condition": network.layer_qformer,
        "final": network.head.final_layer,
    }
    actions, tape, calls = watch(
        policy, lambda: policy.infer(inputs, pixels, noise), modules, {"head": network.head}
    )
    streams, vision = stream_outputs(policy, tape), policy.further_streams["vision"]
    halves = [f"{stream.name}_resid" for stream in policy.streams.values() if stream.part == "action"]
    passed = [positional for positional, _ in calls["head"]]

    def states() -> NDArray[Any]:
        return np.concatenate([streams["backbone_resid"]()[:-1], streams["backbone_final_norm"]()[None]])

    produced: dict[str, Produce] = {
        **streams,
        "dino_pixels": lambda: numpy_of(pixels),
        "vision_block_out": lambda: streams["vision_resid"]()[1:].reshape(vision.layers - 1, -1, vision.width),
        "vision_merged": lambda: numpy_of(calls["merger"][0]),
        "dino_block_out": lambda: streams["vision_dino_resid"]()[1:],
        "dino_patchtokens": lambda: numpy_of(calls["dino"][0]),
        "dino_projected": lambda: numpy_of(calls["projected"][0]),
        "position_ids": lambda: numpy_of(inputs.positions(policy.vlm.model)),
        "hf_hidden_states": states,
        "qformer_layer_out": lambda: streams["bridge_resid"]()[1:],
        "condition": lambda: numpy_of(calls["condition"][0]),
        "dit_resid": lambda: np.concatenate([streams[half]() for half in halves], axis=2),
        "dit_final_layer": lambda: numpy_of(torch.stack(calls["final"])),
        "ddim_timesteps_passed": lambda: numpy_of(torch.stack([moments for _, moments, *_ in passed])),
        "ddim_timestep_map": lambda: policy.schedule.moments,
        "ddim_alphas_cumprod": lambda: policy.schedule.signal,
        "x_t": lambda: numpy_of(torch.stack([*(noisy[: len(actions)] for noisy, *_ in passed), actions])),
        "actions": lambda: numpy_of(actions),
        "actions_unnormalized": lambda: _units(policy, recorded).restore(numpy_of(actions)),
    }
    remade = {"dino_pixels": "in_dino_pixels"} if "in_images_uint8" in recorded else {}
    valid = recorded["in_attention_mask"].astype(bool)
    masked = dict.fromkeys(("backbone_resid", "backbone_final_norm", "hf_hidden_states"), valid)
    return Outputs(produced, inputs=_INPUTS, remade=remade, valid=masked)


def _pixels(policy: InternVLA, recorded: Arrays) -> Tensor:
    """(B x V, 3, H, W): made of the recorded pictures, or else as recorded."""
    if "in_images_uint8" not in recorded:
        return torch.from_numpy(recorded["in_dino_pixels"])
    pictures = recorded["in_images_uint8"]
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    return torch.stack([dino_pixels(picture, policy.config.dino.side) for picture in flat])


def _units(policy: InternVLA, recorded: Arrays) -> ActionUnits:
    """The recorded statistics, where there are some; else the checkpoint's."""
    names = {"q01": "unnorm_q01", "q99": "unnorm_q99", "mask": "unnorm_mask"}
    if "unnorm_q01" not in recorded:
        return policy.units
    return ActionUnits.of("recorded", {key: recorded[name] for key, name in names.items() if name in recorded})
