"""Token-by-token decoding after the prefill of a prompt.

B batch, T positions of the prompts, V vocabulary.
"""

from abc import abstractmethod
from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor

from probe_kit.errors import UsageError
from probe_kit.hooks.contract.model import AnswerModel, Reading
from probe_kit.models.decoding import Decoded, positions
from probe_kit.models.packing import LeftPacked


@dataclass(frozen=True)
class Prefill:
    """The result of one pass over prompts.

    network: called like transformers' own classes. mask: (B, T). last: (…, B, 1), positions of the last tokens.
    logits: (B, V), choosing the first tokens of the answers. cache: keys and values of all prompts.
    """

    network: Any
    mask: Tensor
    last: Tensor
    logits: Tensor
    cache: Any

    @classmethod
    def of(
        cls, network: Any, packed: LeftPacked, counted: Tensor, picture_inputs: Mapping[str, Tensor]
    ) -> "Prefill":
        """Read prompts once. counted: (…, B, T) positions. picture_inputs: further keywords, such as pictures."""
        output = network(
            input_ids=packed.ids,
            attention_mask=packed.mask,
            position_ids=counted,
            use_cache=True,
            logits_to_keep=1,
            **picture_inputs,
        )
        last = counted.amax(dim=-1, keepdim=True)
        return cls(network, packed.mask, last, output.logits[:, -1], output.past_key_values)

    @classmethod
    def of_decoded(cls, network: Any, decoded: Decoded) -> "Prefill":
        """Return what came before the first of decoded tokens. network: the language model that continues."""
        decoded.cache.crop(decoded.mask.shape[1])
        last = positions(decoded.mask)[:, -1:]
        return cls(network, decoded.mask.long(), last, decoded.logits[:, 0], decoded.cache)

    def speak(self, tokens: int, ends: Collection[int]) -> Tensor:
        """(B, at most `tokens`) greedy ids, up to where every row has put out one of `ends`.

        The cache is left as it was, so that the same can be said again.
        """
        length = self.mask.shape[1]
        mask, position, logits = self.mask, self.last, self.logits
        tokens_out: list[Tensor] = []
        try:
            while len(tokens_out) < tokens:
                tokens_out.append(logits.argmax(dim=-1))
                if len(tokens_out) == tokens or _all_over(tokens_out, ends):
                    break
                position = position + 1
                mask = torch.cat([mask, torch.ones_like(mask[:, :1])], dim=1)
                logits = self.network(
                    input_ids=tokens_out[-1][:, None],
                    attention_mask=mask,
                    position_ids=position,
                    past_key_values=self.cache,
                    use_cache=True,
                    logits_to_keep=1,
                ).logits[:, -1]
        finally:  # the network has appended the answer to the cache, also where an error ended it
            self.cache.crop(length)
        return torch.stack(tokens_out, dim=1) if tokens_out else torch.zeros(len(mask), 0, dtype=torch.long)


def _all_over(tokens_out: list[Tensor], ends: Collection[int]) -> bool:
    spoken = torch.stack(tokens_out, dim=1).cpu().numpy()
    return bool(np.isin(spoken, list(ends)).any(axis=1).all())


class SpeakingModel(AnswerModel):
    """A model whose answers continue from a `Prefill`."""

    @property
    @abstractmethod
    def speaker(self) -> Any:
        """The network that continues a prompt."""

    @property
    @abstractmethod
    def ends(self) -> frozenset[int]:
        """Ids that end an answer."""

    @abstractmethod
    def words(self, ids: Sequence[int]) -> str:
        """The text of an answer's ids, up to its end."""

    def speak(self, reading: Reading, tokens: int) -> list[str]:
        """Greedy text from the keys and values of the prompt on; see the contract. Raises UsageError."""
        if not isinstance(reading.state, Prefill) or reading.state.network is not self.speaker:
            raise UsageError("this reading does not come from this model; pass what its read() returned")
        with torch.inference_mode():
            ids = reading.state.speak(tokens, self.ends)
        return [self.words(row) for row in ids.tolist()]
