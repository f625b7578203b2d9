"""Token-by-token decoding after the prefill of a prompt.

B batch, T positions of the prompts, V vocabulary.
"""

from collections.abc import Collection, Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from probe_kit.models.packing import LeftPacked


@dataclass(frozen=True)
class Prefill:
    """What one pass over prompts left.

    network: called like transformers' own classes. mask: (B, T). last: (…, B, 1), positions of the last tokens.
    logits: (B, V), choosing the first tokens of the answers. cache: keys and values of all prompts.
    """

    network: Any
    mask: Tensor
    last: Tensor
    logits: Tensor
    cache: Any

    @classmethod
    def of(cls, network: Any, packed: LeftPacked, positions: Tensor, shown: Mapping[str, Tensor]) -> "Prefill":
        """Read prompts once. positions: (…, B, T). shown: further keywords, such as pictures."""
        output = network(
            input_ids=packed.ids,
            attention_mask=packed.mask,
            position_ids=positions,
            use_cache=True,
            logits_to_keep=1,
            **shown,
        )
        last = positions.amax(dim=-1, keepdim=True)
        return cls(network, packed.mask, last, output.logits[:, -1], output.past_key_values)

    def speak(self, tokens: int, ends: Collection[int]) -> Tensor:
        """(B, at most `tokens`) greedy ids, up to where every row has put out one of `ends`.

        The cache is left as it was, so that the same can be said again.
        """
        length = self.mask.shape[1]
        mask, position, logits = self.mask, self.last, self.logits
        said: list[Tensor] = []
        try:
            while len(said) < tokens:
                said.append(logits.argmax(dim=-1))
                if len(said) == tokens or _all_over(said, ends):
                    break
                position = position + 1
                mask = torch.cat([mask, torch.ones_like(mask[:, :1])], dim=1)
                logits = self.network(
                    input_ids=said[-1][:, None],
                    attention_mask=mask,
                    position_ids=position,
                    past_key_values=self.cache,
                    use_cache=True,
                    logits_to_keep=1,
                ).logits[:, -1]
        finally:
            self.cache.crop(length)
        return torch.stack(said, dim=1) if said else torch.zeros(len(mask), 0, dtype=torch.long)


def _all_over(said: list[Tensor], ends: Collection[int]) -> bool:
    spoken = torch.stack(said, dim=1).cpu().numpy()
    return bool(np.isin(spoken, list(ends)).any(axis=1).all())
