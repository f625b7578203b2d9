"""Prompts as batches, their keys and values, and token-by-token decoding."""

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any, cast

import torch
from torch import Tensor, nn
from transformers import DynamicCache


class Passage(nn.Module):
    """A module that returns its input, the same tensor.

    It is a place for hooks, without weights and without arithmetic.
    """

    def forward(self, passing: Tensor) -> Tensor:
        """Return `passing`."""
        return passing


class PromptKV(nn.Module):
    """The passages for keys and values: one each for every block.

    An inference sends the keys and values of the prompt through them once: after the prompt is read, and before
    the part that acts reads them.
    """

    def __init__(self, blocks: int) -> None:
        super().__init__()
        self.keys = nn.ModuleList(Passage() for _ in range(blocks))
        self.values = nn.ModuleList(Passage() for _ in range(blocks))

    def forward(self, layers: Sequence[Any]) -> None:
        """Send through `keys` and `values` (B, H, T, E) of every layer of transformers' cache, block by block."""
        for layer, keys, values in zip(layers, self.keys, self.values, strict=True):
            layer.keys, layer.values = cast(Tensor, keys(layer.keys)), cast(Tensor, values(layer.values))


# -- decoding -------------------------------------------------------------------------------------------------

Choose = Callable[[Tensor], Tensor]
"""Function that chooses ids (B,) of the next tokens from their logits (B, V)."""


def greedy(logits: Tensor) -> Tensor:
    """Return the likeliest ids, (B,)."""
    return logits.argmax(dim=-1)


def positions(mask: Tensor) -> Tensor:
    """Return positions (B, S) that count tokens, not padding."""
    return (mask.long().cumsum(dim=1) - 1).clamp(min=0)


def mask_if_padded(mask: Tensor) -> Tensor | None:
    """Return the mask where there is padding: without one, attention takes its exact causal path."""
    return None if bool(mask.all()) else mask


def last_logits(language_model: Any, embeddings: Tensor, mask: Tensor, cache: DynamicCache) -> Tensor:
    """Return the logits (B, V) behind the last position, in one pass of a language model.

    Args:
        language_model: Causal language model of transformers.
        embeddings: (B, T, D) embeddings of the new tokens.
        mask: (B, past + T) bool, False at padding.
        cache: Keys and values of the past, to which those of the new tokens are added.
    """
    output = language_model(
        inputs_embeds=embeddings,
        position_ids=positions(mask)[:, -embeddings.shape[1] :],
        attention_mask=mask_if_padded(mask),
        past_key_values=cache,
        use_cache=True,
        logits_to_keep=1,
    )
    logits: Tensor = output.logits[:, -1]
    return logits


@dataclass(frozen=True)
class Decoded:
    """The tokens behind a prompt.

    Attributes:
        ids: (B, N) int64 ids.
        logits: (B, N, V) logits that chose them.
        mask: (B, S) bool of the prompt.
        cache: Keys and values of the prompt and of all ids but the last.
    """

    ids: Tensor
    logits: Tensor
    mask: Tensor
    cache: DynamicCache


class TokenNetwork(nn.Module):
    """A network whose language model reads a prompt of embeddings and chooses tokens behind it."""

    language_model: Any
    prompt_kv: PromptKV
    """Passages through which the kept keys and values of the prompt pass once."""

    def whole_pass(self, embeddings: Tensor, mask: Tensor) -> Any:
        """Return the output of transformers for one pass over (B, S, D).

        It holds logits (B, S, V) and all hidden states.
        """
        return self.language_model(
            inputs_embeds=embeddings,
            position_ids=positions(mask),
            attention_mask=mask_if_padded(mask),
            output_hidden_states=True,
        )

    def next_logits(self, embeddings: Tensor, mask: Tensor, cache: DynamicCache) -> Tensor:
        """Return the logits (B, V) behind the last position; see `last_logits`."""
        return last_logits(self.language_model, embeddings, mask, cache)

    def decode_behind(
        self, embeddings: Tensor, mask: Tensor, steps: int, choose: Choose = greedy, fed: Tensor | None = None
    ) -> Decoded:
        """Return exactly `steps` tokens behind the prompt, whatever they are.

        The language model is called once with the prompt and `steps - 1` times with one token.

        Args:
            embeddings: (B, S, D) embeddings of the prompt.
            mask: (B, S) bool, True at the end of every row.
            steps: Number N of tokens.
            choose: Function from logits (B, V) to the next ids (B,); the likeliest by default.
            fed: (B, steps - 1) ids to feed back instead of those chosen.
        """
        prompt, cache = mask, DynamicCache(config=self.language_model.config)
        ids: list[Tensor] = []
        logits: list[Tensor] = []
        while True:
            logits.append(self.next_logits(embeddings, mask, cache))
            if not ids:  # the prompt is read; the tokens behind it read what is kept of it
                self.prompt_kv(cache.layers)
            ids.append(choose(logits[-1]))
            if len(ids) == steps:
                return Decoded(torch.stack(ids, dim=1), torch.stack(logits, dim=1), prompt, cache)
            following = ids[-1] if fed is None else fed[:, len(ids) - 1]
            embeddings = self.language_model.get_input_embeddings()(following[:, None])
            mask = torch.cat([mask, torch.ones_like(mask[:, :1])], dim=1)


# -- batches --------------------------------------------------------------------------------------------------


def pack_rows(rows: Sequence[Tensor], padding: int = 0) -> tuple[Tensor, Tensor]:
    """Return rows (T, …) as one batch (B, S, …), and its mask (B, S) bool, False at padding.

    Padding stands before the last token of a row: the last tokens line up, and no other token moves, whatever else
    is in the batch. Positions count tokens only, so the network computes the same numbers as without padding.
    """
    longest = max(map(len, rows))
    batch = rows[0].new_full((len(rows), longest, *rows[0].shape[1:]), padding)
    mask = torch.zeros((len(rows), longest), dtype=torch.bool, device=batch.device)
    for index, row in enumerate(rows):
        batch[index, : len(row) - 1], batch[index, -1] = row[:-1], row[-1]
        mask[index, : len(row) - 1], mask[index, -1] = True, True
    return batch, mask


@dataclass(frozen=True)
class Packed:
    """The prompts as one batch: ids (B, T) int64 and mask (B, T) bool, see `pack_rows`."""

    ids: Tensor
    mask: Tensor

    @classmethod
    def of(cls, rows: Sequence[Sequence[int]], padding: int) -> "Packed":
        """Pack one prompt per row."""
        return cls(*pack_rows([torch.tensor(row) for row in rows], padding))


@dataclass(frozen=True)
class LeftPacked:
    """The prompts as one batch: ids (B, T) int64 and mask (B, T) int64.

    The mask is 0 at padding, which stands before each row.
    """

    ids: Tensor
    mask: Tensor

    @classmethod
    def of(cls, rows: Sequence[Sequence[int]], padding: int, device: str = "cpu") -> "LeftPacked":
        """Pack one prompt per row."""
        longest = max(map(len, rows))
        ids = torch.full((len(rows), longest), padding)
        mask = torch.zeros((len(rows), longest), dtype=torch.long)
        for index, row in enumerate(rows):
            ids[index, longest - len(row) :] = torch.tensor(row)
            mask[index, longest - len(row) :] = 1
        return cls(ids.to(device), mask.to(device))

    def positions(self, first: int = 0) -> Tensor:
        """Return positions (B, T) that count tokens, not padding, from `first`."""
        return positions(self.mask) + first
