"""The transformer stacks of lerobot's flow policies, and the modules of their sites."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Any

from torch import nn

from probe_kit.hooks.contract.model import EVERY, Tap
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.families.shared.decoder_tap import decoder_tap, output_projection


@dataclass(frozen=True)
class Stack:
    """One transformer stack inside a policy; `entry` names the block's first submodule."""

    layers: Sequence[nn.Module]
    norm: nn.Module
    width: int
    iterations: int | None
    entry: str = "input_layernorm"

    def tap(self, site: Site) -> Tap:
        """Return the tap of a site of this stack."""
        return decoder_tap(self.layers, self.norm, site, self.iterations or 1, entry=self.entry)

    def stream(self, name: str) -> Stream:
        """The stored stream: the input of every block, and of the final norm."""
        attention: Any = self.layers[0].self_attn
        heads = int(output_projection(attention).in_features) // int(attention.head_dim)
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


def flow_stacks(backbone: Any, expert: Any, vision: Any, iterations: int) -> dict[str, Stack]:
    """The three stacks of a flow policy; the vision tower's iterations are the cameras, see `LerobotFlow`."""
    return {
        "backbone": Stack(backbone.layers, backbone.norm, backbone.config.hidden_size, None),
        "expert": Stack(expert.layers, expert.norm, expert.config.hidden_size, iterations),
        "vision": Stack(vision.encoder.layers, vision.post_layernorm, vision.config.hidden_size, 1, "layer_norm1"),
    }
