"""Quantities in which lerobot's policies are compared with golden references.

B batch, C cameras including empty ones, L layers, S steps of the flow or captured tokens. References hold either
what a robot gives (picture, state and task) or what lerobot's processors made of it (pictures and ids).
"""

from collections.abc import Callable
from functools import partial
from pathlib import Path

import numpy as np
import torch
from torch import Tensor

from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.families.shared.kinds import IMAGES, STATE
from probe_kit.hooks.families.shared.lerobot.packing import MASK, TOKENS
from probe_kit.hooks.families.shared.lerobot.policy import LerobotPolicy
from probe_kit.hooks.outputs import (
    Arrays,
    Outputs,
    Produce,
    RecordedRun,
    numpy_of,
    stream_outputs,
    watch,
)

_MASKED = ("backbone_resid", "backbone_final_norm", "prefix_embs")
"""The quantities that are compared at valid positions only: padding holds plausible numbers that mean nothing."""


def lerobot_outputs(load: Callable[..., LerobotPolicy], folder: Path, recorded: Arrays) -> Outputs:
    """Run the recorded inputs through the adapter; see `LerobotPolicy.further_outputs` for those of a family."""
    policy = load(str(folder / "checkpoint"), dtype="float32")
    if "in_lang_tokens" in recorded:
        policy = policy.with_cameras([camera for camera in policy.cameras if f"in_image_{camera}" in recorded])
        batch = _prepare_inputs(policy, recorded)
    else:
        batch = policy.batch(_observations(policy, recorded))
    replayed, activations, calls = watch(
        policy, lambda: policy.replay(batch, recorded), policy.recorded_modules(), policy.watched_inputs()
    )
    run = RecordedRun(batch, recorded, activations, calls)
    produced: dict[str, Produce] = {
        **{name: partial(numpy_of, values) for name, values in batch.items()},
        **stream_outputs(policy, activations),
        **{name: partial(run.outputs, name) for name in policy.recorded_modules() if calls[name]},
        **{name: partial(np.asarray, values) for name, values in replayed.items()},
        "actions_unnormalized": lambda: policy.action_units.restore(np.asarray(replayed["actions"], np.float32)),
        **policy.further_outputs(run),
    }
    if TOKENS in batch:
        produced["input_ids"] = lambda: numpy_of(batch[TOKENS])
    valid = recorded["prefix_pad"].astype(bool) if "prefix_pad" in recorded else None
    return Outputs(produced, valid={} if valid is None else dict.fromkeys(_MASKED, valid))


def _prepare_inputs(policy: LerobotPolicy, recorded: Arrays) -> dict[str, Tensor]:
    images = {
        f"{IMAGES}{camera}": torch.from_numpy(recorded[f"in_image_{camera}"]) for camera in policy.shown_cameras
    }
    return images | {
        STATE: torch.from_numpy(policy.state_units.normalise(recorded["in_raw_state"])),
        TOKENS: torch.from_numpy(recorded["in_lang_tokens"]),
        MASK: torch.from_numpy(recorded["in_lang_mask"]),
    }


def _observations(policy: LerobotPolicy, recorded: Arrays) -> list[Observation]:
    """Return the recorded rows; a reference of one observation has no batch axis."""
    if "in_image" in recorded:
        return [Observation(recorded["in_image"], recorded["in_raw_state"], str(recorded["in_task"]))]
    columns = (recorded[name] for name in (f"in_image_{policy.cameras[0]}", "in_raw_state", "in_tasks"))
    return [Observation(image, state, str(task)) for image, state, task in zip(*columns, strict=True)]
