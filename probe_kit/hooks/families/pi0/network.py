"""The policies `PI0Policy` and `PI05Policy` of lerobot, built at a checkpoint's size, and names in their files.

The norms of pi0.5's expert are adaptive: the time of the flow step gives each norm a scale, a shift and a gate.
The output of half a block is multiplied by that gate before it is added. lerobot multiplies in a function, so no
module ever holds the product; here one does. Parameters and results stay lerobot's, bit for bit.
"""

from functools import partial
from types import MethodType
from typing import Any, cast

from lerobot.policies.pi0.configuration_pi0 import PI0Config
from lerobot.policies.pi0.modeling_pi0 import PI0Policy
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from torch import Tensor

from probe_kit.hooks.families.shared.lerobot.paligemma import (
    PALIGEMMA_NAMES,
    GemmaSize,
    PaliGemmaSize,
    build_resized,
    current_keys,
)
from probe_kit.models.building import Gate

_TIME_OF_PI0 = (("time_mlp_in.", "action_time_mlp_in."), ("time_mlp_out.", "action_time_mlp_out."))
_TIME_OF_PI05 = tuple((new, old) for old, new in _TIME_OF_PI0)
current_pi0_keys = partial(current_keys, names=(*PALIGEMMA_NAMES, *_TIME_OF_PI0))
current_pi05_keys = partial(current_keys, names=(*PALIGEMMA_NAMES, *_TIME_OF_PI05))


# -- pi0 ------------------------------------------------------------------------------------------------------


class Pi0Size(PaliGemmaSize):
    """The same dimensions of a policy with an expert beside it."""

    network = "pi0"

    expert: GemmaSize


def build_pi0(config: PI0Config, size: Pi0Size | None = None, device: str = "cpu") -> PI0Policy:
    """Return a `PI0Policy`; see `build_resized`."""
    return cast(PI0Policy, build_resized(PI0Policy, config, size, device))


def full_size_pi0() -> PI0Policy:
    """Return the released size, on the meta device."""
    return build_pi0(PI0Config(device="cpu"), device="meta")


# -- pi0.5 ----------------------------------------------------------------------------------------------------


def build_pi05(config: PI05Config, size: Pi0Size | None = None, device: str = "cpu") -> PI05Policy:
    """Return a `PI05Policy`; see `build_resized`."""
    policy = build_resized(PI05Policy, config, size, device)
    for block in policy.model.paligemma_with_expert.gemma_expert.model.layers:
        _attach_gates(block)
    return cast(PI05Policy, policy)


def full_size_pi05() -> PI05Policy:
    """Return the released size, on the meta device."""
    return build_pi05(PI05Config(device="cpu"), device="meta")


def _attach_gates(block: Any) -> None:
    """Give an adaptive block of the expert the modules `attention_gate` and `mlp_gate`."""
    block.attention_gate, block.mlp_gate = Gate(), Gate()
    block.forward = MethodType(_gated_forward, block)


def _gated_forward(block: Any, hidden_states: Tensor, adarms_cond: Tensor, **attention: Any) -> Tensor:
    """Return the stream (B, T, D) after the block's attention and its MLP.

    The output of each is gated as it is added (arXiv 2504.16054, section IV).
    """
    normed, gate = block.input_layernorm(hidden_states, cond=adarms_cond)
    attended, _ = block.self_attn(normed, **attention)
    between = hidden_states + block.attention_gate(attended, gate)
    normed, gate = block.post_attention_layernorm(between, cond=adarms_cond)
    written: Tensor = between + block.mlp_gate(block.mlp(normed), gate)
    return written
