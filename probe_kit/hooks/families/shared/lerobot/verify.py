"""Quantities in which pi0 and SmolVLA are compared with their golden references.

B batch, C cameras including empty ones, L layers, S flow-matching steps.
"""

from collections.abc import Callable, Mapping
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hooks.capturing.capture_context import ActivationCache, capture
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.families.shared.lerobot.flow import LerobotFlow
from probe_kit.hooks.families.shared.lerobot.policy import IMAGES, MASK, STATE, TOKENS
from probe_kit.hooks.verification.verify import Comparison, Produce, compare

TOLERANCE = 1e-5
Arrays = Mapping[str, NDArray[Any]]


def verify_flow(load: Callable[[str], LerobotFlow], folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Run the recorded inputs through the adapter and compare everything it can produce.

    Backbone and vision streams are compared at valid positions only: padding holds plausible numbers that
    mean nothing.
    """
    policy = load(str(folder / "checkpoint"))
    policy = policy.showing([camera for camera in policy.cameras if f"in_image_{camera}" in recorded])
    batch = _batch(policy, recorded)
    noise = torch.from_numpy(recorded["in_noise"])
    calls: dict[str, list[Tensor]] = {}
    with ExitStack() as stack:
        for name, module in _extra_modules(policy).items():
            calls[name] = _record_outputs(module, stack)
        calls["positions"] = _record_positions(policy, stack)
        tape = stack.enter_context(capture(policy, _sites(policy)))
        actions = policy.infer(batch, noise)
    produced: dict[str, Produce] = {
        **_streams(policy, tape),
        **_integration(calls["velocity"], noise, policy.iterations),
        **_preparation(policy, batch, recorded),
        "vision_resid": lambda: _stacked(tape, policy.further_streams["vision"], "residual"),
        "actions": lambda: _numpy(actions),
        "actions_unnormalized": lambda: policy.action_units.restore(_numpy(actions)),
    }
    if calls["positions"]:
        produced["prefix_position_ids"] = lambda: _numpy(calls["positions"][0])
    if calls.get("connector"):
        produced["connector_out"] = lambda: _numpy(torch.stack(calls["connector"]))
    valid = recorded["prefix_pad"].astype(bool)
    masks = dict.fromkeys(("backbone_resid", "backbone_final_norm", "prefix_embs"), valid)
    return compare(recorded, produced, TOLERANCE, masks)


def _batch(policy: LerobotFlow, recorded: Arrays) -> dict[str, Tensor]:
    images = {f"{IMAGES}{camera}": torch.from_numpy(recorded[f"in_image_{camera}"]) for camera in policy.shown}
    return images | {
        STATE: torch.from_numpy(policy.state_units.normalise(recorded["in_raw_state"])),
        TOKENS: torch.from_numpy(recorded["in_lang_tokens"]),
        MASK: torch.from_numpy(recorded["in_lang_mask"]),
    }


def _sites(policy: LerobotFlow) -> list[Site]:
    return [*policy.further_streams["vision"].sites(), *policy.sites(), *policy.sites("final_norm")]


def _streams(policy: LerobotFlow, tape: ActivationCache) -> dict[str, Produce]:
    backbone, expert = policy.streams["backbone"], policy.streams["expert"]
    return {
        "prefix_embs": lambda: _numpy(tape[Site("backbone", 0)]),
        "backbone_resid": lambda: _stacked(tape, backbone, "residual")[0],
        "backbone_final_norm": lambda: _stacked(tape, backbone, "final_norm")[0, 0],
        "expert_resid": lambda: _stacked(tape, expert, "residual"),
        "expert_final_norm": lambda: _stacked(tape, expert, "final_norm")[:, 0],
    }


def _stacked(tape: ActivationCache, stream: Stream, quantity: str) -> NDArray[Any]:
    """(iterations or 1, layers, B, T, D)."""
    sites = stream.sites(quantity)
    values = torch.stack([tape[site] for site in sites])
    steps = stream.iterations or 1
    return _numpy(values.reshape(steps, len(sites) // steps, *values.shape[1:]))


def _integration(velocities: list[Tensor], noise: Tensor, steps: int) -> dict[str, Produce]:
    """Euler steps x ← x - v/S from the velocities the network put out."""

    def path() -> NDArray[Any]:
        states = [noise]
        for velocity in velocities:
            states.append(states[-1] - velocity / steps)
        return _numpy(torch.stack(states))

    return {
        "velocity": lambda: _numpy(torch.stack(velocities)),
        "x_t": path,
        "actions_padded": lambda: np.asarray(path()[-1]),
        "denoise_times": lambda: np.array([1 - step / steps for step in range(steps)], np.float32),
    }


def _preparation(policy: LerobotFlow, batch: dict[str, Tensor], recorded: Arrays) -> dict[str, Produce]:
    network = policy.network
    prepare = getattr(network, "_preprocess_images", None) or network.prepare_images

    def images(part: int) -> NDArray[Any]:
        return _numpy(torch.stack(prepare(batch)[part]))

    return {
        "prep_images": lambda: images(0),
        "prep_image_masks": lambda: images(1),
        "prep_state": lambda: _numpy(network.prepare_state(batch)),
        "prefix_pad": lambda: _prefix_pad(policy, recorded),
    }


def _prefix_pad(policy: LerobotFlow, recorded: Arrays) -> NDArray[np.bool_]:
    """(B, T) validity of every backbone position, as the adapter's own roles say it."""
    tokens, mask = (torch.from_numpy(recorded[name]) for name in ("in_lang_tokens", "in_lang_mask"))
    return np.stack([row.valid for row in policy.packed_roles(tokens, mask.bool())["backbone"]])


def _extra_modules(policy: LerobotFlow) -> dict[str, nn.Module]:
    model = policy.network.model
    modules: dict[str, nn.Module] = {"velocity": model.action_out_proj}
    if hasattr(model, "vlm_with_expert"):
        modules["connector"] = model.vlm_with_expert.vlm.model.connector
    return modules


def _record_outputs(module: nn.Module, stack: ExitStack) -> list[Tensor]:
    outputs: list[Tensor] = []
    handle = module.register_forward_hook(lambda _, __, output: outputs.append(output.detach().clone()))
    stack.callback(handle.remove)
    return outputs


def _record_positions(policy: LerobotFlow, stack: ExitStack) -> list[Tensor]:
    """Position ids as the backbone's first layer gets them, where the layer is called with them."""
    positions: list[Tensor] = []

    def note_keywords(_module: nn.Module, _inputs: tuple[Any, ...], keywords: dict[str, Any]) -> None:
        positions.append(keywords["position_ids"].detach().clone())

    handle = policy.stacks["backbone"].layers[0].register_forward_pre_hook(note_keywords, with_kwargs=True)
    stack.callback(handle.remove)
    return positions


def _numpy(tensor: Tensor) -> NDArray[Any]:
    return np.asarray(tensor.float().cpu().numpy() if tensor.is_floating_point() else tensor.cpu().numpy())
