"""Quantities in which InternVLA-M1 is compared with its golden references.

B batch, V views, P prompt positions, L backbone layers, S DDIM steps, C conditions, A actions of a chunk.
"""

from collections.abc import Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hooks.capturing.capture_context import ActivationCache, capture
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.families.internvla.adapter import InternVLA, load_internvla
from probe_kit.hooks.families.internvla.checkpoint import find_parts
from probe_kit.hooks.families.internvla.units import ActionUnits
from probe_kit.hooks.families.shared.module_outputs import numpy_of, outputs_of, stacked
from probe_kit.hooks.verification.verify import Comparison, Produce, compare
from probe_kit.models.internvla import dino_pixels
from probe_kit.models.qwen import QwenInputs

TOLERANCE = 1e-5
Arrays = Mapping[str, NDArray[Any]]
Calls = Mapping[str, list[Any]]
_INPUTS = ("cfg_scale", "unnorm_q01", "unnorm_q99", "unnorm_mask")


def verify_internvla(folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Run the recorded inputs through the adapter and compare everything it can produce.

    Whole batches, padding included: that padding reaches the actions is part of the original. The backbone itself
    is compared at valid positions.
    """
    steps = len(recorded["ddim_timestep_map"]) if "ddim_timestep_map" in recorded else 10
    guidance = float(recorded["cfg_scale"]) if "cfg_scale" in recorded else 1.5
    place = str(folder / "checkpoint")
    units = next(iter(find_parts(place, None, unread=True).statistics()), None)  # nothing compared depends on them
    policy = load_internvla(place, dtype="float32", steps=steps, guidance=guidance, unnorm_key=units)
    inputs, pixels = _inputs(policy, recorded), _pixels(policy, recorded)
    network = policy.network
    modules = {
        "merger": policy.tower.merger,
        "dino": network.dino_encoder.body,
        "projected": network.dino_pro,
        "condition": network.layer_qformer,
        "final": network.head.final_layer,
    }
    with ExitStack() as stack:
        calls: dict[str, list[Any]] = {name: outputs_of(module, stack) for name, module in modules.items()}
        calls["head"] = _given(network.head, stack)
        every = [*policy.sites(), *policy.backbone_stream().sites("final_norm")]
        every += [site for stream in policy.further_streams.values() for site in stream.sites()]
        tape = stack.enter_context(capture(policy, every))
        actions = policy.infer(inputs, pixels, torch.from_numpy(recorded["in_noise"]))
    produced = {
        **_vision(policy, tape, calls, pixels),
        **_backbone(policy, inputs, tape),
        **_head(policy, tape, calls, actions),
        "qformer_layer_out": lambda: stacked(tape, policy.streams["bridge"])[0, 1:],
        "condition": lambda: numpy_of(calls["condition"][0]),
        "actions": lambda: numpy_of(actions),
        "actions_unnormalized": lambda: _units(policy, recorded).restore(numpy_of(actions)),
    }
    outputs = {name: values for name, values in recorded.items() if name not in _INPUTS}
    if "in_images_uint8" in recorded and "in_dino_pixels" in recorded:
        outputs["dino_pixels"] = recorded["in_dino_pixels"]
    streams = ("backbone_resid", "backbone_final_norm", "hf_hidden_states")
    return compare(
        outputs, produced, TOLERANCE, dict.fromkeys(streams, recorded["in_attention_mask"].astype(bool))
    )


def _inputs(policy: InternVLA, recorded: Arrays) -> QwenInputs:
    names = ("in_input_ids", "in_attention_mask", "in_pixel_values", "in_image_grid_thw")
    ids, mask, pixels, grid = (torch.from_numpy(recorded[name]) for name in names)
    return QwenInputs(ids, mask, pixels, grid, int(policy.vlm.config.image_token_id))


def _pixels(policy: InternVLA, recorded: Arrays) -> Tensor:
    """(B x V, 3, H, W): made of the recorded pictures, or else as recorded."""
    if "in_images_uint8" not in recorded:
        return torch.from_numpy(recorded["in_dino_pixels"])
    pictures = recorded["in_images_uint8"]
    flat = pictures.reshape(-1, *pictures.shape[-3:])
    return torch.stack([dino_pixels(picture, policy.config.dino.side) for picture in flat])


def _given(module: nn.Module, stack: ExitStack) -> list[tuple[Tensor, ...]]:
    """A list that fills with copies of what `module` is called with."""
    given: list[tuple[Tensor, ...]] = []
    hook = module.register_forward_pre_hook(lambda _, inputs: given.append(tuple(part.clone() for part in inputs)))
    stack.callback(hook.remove)
    return given


def _vision(policy: InternVLA, tape: ActivationCache, calls: Calls, pixels: Tensor) -> dict[str, Produce]:
    vision, dino = policy.further_streams["vision"], policy.further_streams["vision_dino"]
    return {
        "dino_pixels": lambda: numpy_of(pixels),
        "vision_block_out": lambda: stacked(tape, vision)[0, 1:].reshape(vision.layers - 1, -1, vision.width),
        "vision_merged": lambda: numpy_of(calls["merger"][0]),
        "dino_block_out": lambda: stacked(tape, dino)[0, 1:],
        "dino_patchtokens": lambda: numpy_of(calls["dino"][0]),
        "dino_projected": lambda: numpy_of(calls["projected"][0]),
    }


def _backbone(policy: InternVLA, inputs: QwenInputs, tape: ActivationCache) -> dict[str, Produce]:
    backbone = policy.streams["backbone"]

    def normed() -> NDArray[Any]:
        return numpy_of(tape[Site("backbone", backbone.layers - 1, "final_norm")])

    return {
        "position_ids": lambda: numpy_of(inputs.positions(policy.vlm.model)),
        "backbone_resid": lambda: stacked(tape, backbone)[0],
        "backbone_final_norm": normed,
        "hf_hidden_states": lambda: np.concatenate([stacked(tape, backbone)[0, :-1], normed()[None]]),
    }


def _head(policy: InternVLA, tape: ActivationCache, calls: Calls, actions: Tensor) -> dict[str, Produce]:
    halves = [stream for stream in policy.streams.values() if stream.part == "action"]
    rows = len(actions)

    def path() -> NDArray[Any]:
        return numpy_of(torch.stack([*(given[0][:rows] for given in calls["head"]), actions]))

    return {
        "dit_resid": lambda: np.concatenate([stacked(tape, half) for half in halves], axis=2),
        "dit_final_layer": lambda: numpy_of(torch.stack(calls["final"])),
        "ddim_timesteps_passed": lambda: numpy_of(torch.stack([given[1] for given in calls["head"]])),
        "ddim_timestep_map": lambda: policy.schedule.moments,
        "ddim_alphas_cumprod": lambda: policy.schedule.signal,
        "x_t": path,
    }


def _units(policy: InternVLA, recorded: Arrays) -> ActionUnits:
    """The recorded statistics, where there are some; else the checkpoint's."""
    names = {"q01": "unnorm_q01", "q99": "unnorm_q99", "mask": "unnorm_mask"}
    if "unnorm_q01" not in recorded:
        return policy.units
    return ActionUnits.of("recorded", {key: recorded[name] for key, name in names.items() if name in recorded})
