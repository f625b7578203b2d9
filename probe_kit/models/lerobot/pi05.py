"""lerobot's own `PI05Policy`, built at the size a checkpoint has, with a module where each gate acts.

The expert's norms are adaptive: the time of the flow step gives each norm a scale, a shift and a gate. What half a
block computes is multiplied by that gate before it is added. lerobot multiplies in a function, so no module ever
holds what is added; here one does. Parameters and results stay lerobot's, bit for bit.
"""

from types import MethodType
from typing import Any, cast

import torch
from lerobot.policies.pi05 import modeling_pi05
from lerobot.policies.pi05.configuration_pi05 import PI05Config
from lerobot.policies.pi05.modeling_pi05 import PI05Policy
from torch import Tensor, nn

from probe_kit.models.lerobot.pi0 import Pi0Size, resized
from probe_kit.models.sizes_only import building_device


class Gate(nn.Module):
    """The addition of half a block to the stream: its output, times the gate of the norm in front of it."""

    def forward(self, computed: Tensor, gate: Tensor) -> Tensor:
        """(B, T, D) of (B, T, D) and (B, 1, D)."""
        return computed * gate


def build_pi05(config: PI05Config, size: Pi0Size | None = None, device: str = "cpu") -> PI05Policy:
    """A `PI05Policy` in eval mode with uninitialised weights; see `build_pi0`."""
    device = building_device(device)
    config.device = device
    with resized(modeling_pi05, size), torch.device(device):
        policy = PI05Policy(config)
    policy.eval()
    for block in policy.model.paligemma_with_expert.gemma_expert.model.layers:
        _attach_gates(block)
    return cast(PI05Policy, policy)


def full_size_pi05() -> PI05Policy:
    """The released size, on the meta device."""
    return build_pi05(PI05Config(device="cpu"), device="meta")


def _attach_gates(block: Any) -> None:
    """Give an adaptive block of the expert the modules `attention_gate` and `mlp_gate`."""
    block.attention_gate, block.mlp_gate = Gate(), Gate()
    block.forward = MethodType(_gated_forward, block)


def _gated_forward(block: Any, hidden_states: Tensor, adarms_cond: Tensor, **attention: Any) -> Tensor:
    """(B, T, D): the block's attention, then its MLP, each gated as it is added (arXiv 2504.16054, section IV)."""
    normed, gate = block.input_layernorm(hidden_states, cond=adarms_cond)
    attended, _ = block.self_attn(normed, **attention)
    between = hidden_states + block.attention_gate(attended, gate)
    normed, gate = block.post_attention_layernorm(between, cond=adarms_cond)
    written: Tensor = between + block.mlp_gate(block.mlp(normed), gate)
    return written
