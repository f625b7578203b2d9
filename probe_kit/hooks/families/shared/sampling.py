"""Choice of output tokens: greedy, or sampled as evaluations do but with fixed seeds."""

from collections.abc import Callable, Sequence

import torch
from torch import Tensor

from probe_kit.errors import UsageError

Choose = Callable[[Tensor], Tensor]
"""(B,) ids of the next tokens from their logits (B, V)."""
# What `generate` of transformers 4 keeps of the distribution by default.
TOP = 50


def greedy(logits: Tensor) -> Tensor:
    """The likeliest."""
    return logits.argmax(dim=-1)


def chooser(temperature: float, seeds: Sequence[int], top: int | None = TOP, among: range | None = None) -> Choose:
    """Greedy for temperature 0; else draws, each row by its own seed.

    top: draw from so many of the likeliest only; None from all. among: draw from these ids only; None from all.
    Raises UsageError for a negative or non-finite temperature.
    """
    if not 0 <= temperature < float("inf"):
        raise UsageError(f"temperature is {temperature}; expected 0 for the likeliest token, or a positive number")
    if temperature == 0:
        return greedy
    generators = [torch.Generator().manual_seed(seed % 2**63) for seed in seeds]

    def draw(logits: Tensor) -> Tensor:
        first, end = (0, logits.shape[-1]) if among is None else (among.start, among.stop)
        offered = logits[:, first:end].float().cpu()
        rows = [_draw(row, temperature, top, own) for row, own in zip(offered, generators, strict=True)]
        return (torch.stack(rows) + first).to(logits.device)

    return draw


def _draw(logits: Tensor, temperature: float, top: int | None, generator: torch.Generator) -> Tensor:
    best, ids = logits.topk(min(top or logits.shape[0], logits.shape[0]))
    place = torch.multinomial(torch.softmax(best / temperature, dim=0), 1, generator=generator)
    return ids[place[0]]
