"""The transformer stacks of lerobot's flow policies, and the modules of their sites."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import nn

from probe_kit.hooks.contract.model import EVERY, Tap
from probe_kit.hooks.contract.sites import HEADS, Site, Stream


@dataclass(frozen=True)
class Stack:
    """One transformer stack inside a policy; `entry` names the block's first submodule."""

    layers: Sequence[nn.Module]
    norm: nn.Module
    width: int
    iterations: int | None
    entry: str = "input_layernorm"

    def tap(self, site: Site) -> Tap:
        """Where a site of this stack is read."""
        fires = self.iterations or 1
        if site.quantity == "final_norm":
            return Tap(self.norm, fires, "output")
        if site.layer == len(self.layers):
            return Tap(self.norm, fires)
        block: Any = self.layers[site.layer]
        if site.quantity == "mlp":
            return Tap(block.mlp, fires, "output")
        if site.quantity in ("attention", HEADS):
            return Tap(_projection(block.self_attn), fires, "output" if site.quantity == "attention" else "input")
        return Tap(getattr(block, self.entry), fires)

    def stream(self, name: str) -> Stream:
        """What is stored of it: the input of every block, and of the final norm."""
        attention: Any = self.layers[0].self_attn
        heads = int(_projection(attention).in_features) // int(attention.head_dim)
        return Stream(name, len(self.layers) + 1, self.width, self.iterations, heads=heads)


@dataclass(frozen=True)
class TokenStack(Stack):
    """A decoder that runs over the prompt and then over what it puts out, in one of these two roles.

    tokens: the positions of its passes that belong to the stream. first: passes before those of the stream.
    iterations: the captured passes, or None for the prompt.
    """

    tokens: slice = EVERY
    first: int = 0

    def tap(self, site: Site) -> Tap:
        """Calls behind those of the captured passes belong to no site."""
        return replace(super().tap(site), tokens=self.tokens, first=self.first, more=True)


def _projection(attention: Any) -> Any:
    """The output projection of an attention of a language model or a vision tower."""
    names = ("o_proj", "out_proj", "attn_out")
    return next(getattr(attention, name) for name in names if hasattr(attention, name))


def flow_stacks(backbone: Any, expert: Any, vision: Any, iterations: int) -> dict[str, Stack]:
    """The three stacks of a flow policy; the vision tower's iterations are the cameras, see `LerobotFlow`."""
    return {
        "backbone": Stack(backbone.layers, backbone.norm, backbone.config.hidden_size, None),
        "expert": Stack(expert.layers, expert.norm, expert.config.hidden_size, iterations),
        "vision": Stack(vision.encoder.layers, vision.post_layernorm, vision.config.hidden_size, 1, "layer_norm1"),
    }
