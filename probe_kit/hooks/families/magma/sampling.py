"""How output tokens are chosen: the likeliest, or drawn as the evaluation client does, but from our seeds."""

from collections.abc import Sequence

import torch
from torch import Tensor

from probe_kit.errors import UsageError
from probe_kit.models.magma import Choose, greedy

# What `generate` of transformers 4 keeps of the distribution where nobody says otherwise, as the client does not.
TOP = 50


def chooser(temperature: float, seeds: Sequence[int]) -> Choose:
    """Greedy for temperature 0; else draws from the likeliest `TOP` tokens, each row by its own seed.

    Raises UsageError for a negative or non-finite temperature.
    """
    if not 0 <= temperature < float("inf"):
        raise UsageError(f"temperature is {temperature}; expected 0 for the likeliest token, or a positive number")
    if temperature == 0:
        return greedy
    generators = [torch.Generator().manual_seed(seed % 2**63) for seed in seeds]

    def draw(logits: Tensor) -> Tensor:
        rows = [_draw(row, temperature, own) for row, own in zip(logits.float().cpu(), generators, strict=True)]
        return torch.stack(rows).to(logits.device)

    return draw


def _draw(logits: Tensor, temperature: float, generator: torch.Generator) -> Tensor:
    best, ids = logits.topk(min(TOP, logits.shape[0]))
    place = torch.multinomial(torch.softmax(best / temperature, dim=0), 1, generator=generator)
    return ids[place[0]]
