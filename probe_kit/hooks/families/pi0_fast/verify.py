"""Quantities in which pi0-FAST is compared with its golden references.

B batch, C cameras including empty ones, L layers, K captured tokens, N tokens put out, V ids.
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
from probe_kit.hooks.families.pi0_fast.adapter import Pi0Fast, load_pi0_fast
from probe_kit.hooks.families.shared.lerobot.policy import IMAGES, MASK, STATE, TOKENS
from probe_kit.hooks.families.shared.module_outputs import numpy_of, outputs_of, stacked
from probe_kit.hooks.verification.verify import Comparison, Produce, compare

TOLERANCE = 1e-5
Arrays = Mapping[str, NDArray[Any]]


def verify_pi0_fast(folder: Path, recorded: Arrays) -> tuple[Comparison, ...]:
    """Run the recorded inputs through the adapter and compare everything it can produce.

    The prompt's streams are compared at valid positions only: padding holds plausible numbers that mean nothing.
    """
    policy = load_pi0_fast(str(folder / "checkpoint"))
    policy = policy.showing([camera for camera in policy.cameras if f"in_image_{camera}" in recorded])
    batch = _batch(policy, recorded)
    sites = [*policy.further_streams["vision"].sites(), *policy.sites(), *policy.sites("final_norm")]
    with ExitStack() as stack:
        logits = outputs_of(policy.network.model.paligemma_with_expert.paligemma.lm_head, stack)
        tape = stack.enter_context(capture(policy, sites))
        ids = policy.tokens(batch, range(len(batch[TOKENS])))
    prompt = policy.packed_roles(batch[TOKENS], batch[MASK])["backbone"]
    actions = np.stack([chunk.values for chunk in policy.chunks(ids)])
    produced: dict[str, Produce] = {
        **_streams(policy, tape),
        "prep_images": lambda: numpy_of(torch.stack(policy.network._preprocess_images(batch)[0])),
        "prefix_pad": lambda: np.stack([row.valid for row in prompt]),
        "logits": lambda: numpy_of(torch.stack([one[:, -1] for one in logits])),
        "tokens": lambda: numpy_of(ids),
        "actions": lambda: actions,
        "actions_unnormalized": lambda: policy.action_units.restore(actions.astype(np.float32)),
    }
    masks = dict.fromkeys(("backbone_resid", "backbone_final_norm"), recorded["prefix_pad"].astype(bool))
    return compare(recorded, produced, TOLERANCE, masks)


def _batch(policy: Pi0Fast, recorded: Arrays) -> dict[str, Tensor]:
    images = {f"{IMAGES}{camera}": torch.from_numpy(recorded[f"in_image_{camera}"]) for camera in policy.shown}
    return images | {
        STATE: torch.from_numpy(policy.state_units.normalise(recorded["in_raw_state"])),
        TOKENS: torch.from_numpy(recorded["in_lang_tokens"]),
        MASK: torch.from_numpy(recorded["in_lang_mask"]),
    }


def _streams(policy: Pi0Fast, tape: ActivationCache) -> dict[str, Produce]:
    backbone, action = policy.streams["backbone"], policy.streams["action"]
    return {
        "vision_resid": lambda: stacked(tape, policy.further_streams["vision"]),
        "backbone_resid": lambda: stacked(tape, backbone)[0],
        "backbone_final_norm": lambda: stacked(tape, backbone, "final_norm")[0, 0],
        "action_resid": lambda: stacked(tape, action),
        "action_final_norm": lambda: stacked(tape, action, "final_norm")[:, 0],
    }
