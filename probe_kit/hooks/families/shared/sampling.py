"""The draws from fixed seeds: output tokens, greedy or sampled as evaluations do, and the noise of flows."""

from collections.abc import Sequence
from pathlib import Path

import torch
from torch import Tensor

from probe_kit._system.bounded_json import read_json_object
from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import GENERATION_FILE
from probe_kit.models.decoding import Choose, greedy

# What `generate` of transformers 4 keeps of the distribution by default.
TOP = 50
ALL, CHECKPOINT = "all", "checkpoint"
# Settings of generation that shape the draw and are not followed here, with the values that change nothing.
_NEUTRAL = {
    "top_p": 1, "min_p": 0, "typical_p": 1, "epsilon_cutoff": 0, "eta_cutoff": 0, "repetition_penalty": 1,
    "no_repeat_ngram_size": 0, "num_beams": 1,
}  # fmt: skip


def chooser(temperature: float, seeds: Sequence[int], top: int | None = TOP, among: range | None = None) -> Choose:
    """Greedy for temperature 0; else draws, each row by its own seed.

    top: draw from so many of the likeliest only, and from those as likely as the last of them, as `generate` does;
    None from all. among: draw from these ids only; None from all.
    Raises UsageError for a negative or non-finite temperature.
    """
    if not 0 <= temperature < float("inf"):
        raise UsageError(f"temperature is {temperature}; expected 0 for the likeliest token, or a positive number")
    if temperature == 0:
        return greedy
    # On the CPU, one per row: draws do not depend on the device, nor on the other rows of a batch.
    generators = [torch.Generator().manual_seed(seed % 2**63) for seed in seeds]

    def draw(logits: Tensor) -> Tensor:
        first, end = (0, logits.shape[-1]) if among is None else (among.start, among.stop)
        offered = logits[:, first:end].float().cpu()
        rows = [
            _draw(row, temperature, top, generator) for row, generator in zip(offered, generators, strict=True)
        ]
        return (torch.stack(rows) + first).to(logits.device)

    return draw


def seeded_noise(seeds: Sequence[int], shape: tuple[int, ...], device: str) -> Tensor:
    """Return (B, *shape) float32 standard normal numbers, a row per seed, the same on every device."""
    rows = [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    return torch.stack(rows).to(device)


def _draw(logits: Tensor, temperature: float, top: int | None, generator: torch.Generator) -> Tensor:
    count = logits.shape[0]
    if top is not None and top < count:  # ties with the last of them stay in
        count = int((logits >= logits.topk(top).values[-1]).sum())
    best, ids = logits.topk(count)
    drawn = torch.multinomial(torch.softmax(best / temperature, dim=0), 1, generator=generator)
    return ids[drawn[0]]


def top_of(top_k: str, folders: Sequence[Path]) -> int | None:
    """The number of likeliest ids to draw from; None for all.

    top_k: a number, `all`, or `checkpoint`: what its generation_config.json says, else `TOP`, as `generate` of
    transformers 4 does it. folders: where that file may lie, the first one before the others.
    Raises UsageError for another word, CheckpointError for a file that shapes the draw by other settings too.
    """
    if top_k == ALL:
        return None
    if top_k == CHECKPOINT:
        file = next((folder / GENERATION_FILE for folder in folders if (folder / GENERATION_FILE).is_file()), None)
        return TOP if file is None else _stored_top(file)
    if not top_k.isdecimal() or int(top_k) < 1:
        raise UsageError(f"top_k is {top_k!r}; expected a number from 1 on, {ALL} or {CHECKPOINT}")
    return int(top_k)


def _stored_top(file: Path) -> int | None:
    values = read_json_object(file, CheckpointError, "Download the checkpoint again")
    unfollowed = {
        name: values[name] for name, neutral in _NEUTRAL.items() if values.get(name) not in (None, neutral)
    }
    top = values.get("top_k", TOP)
    if unfollowed or not (top is None or (isinstance(top, int) and not isinstance(top, bool) and top >= 0)):
        settings = ", ".join(f"{name} {value!r}" for name, value in (unfollowed or {"top_k": top}).items())
        raise CheckpointError(
            f"{file} asks for {settings}; only a whole top_k is followed here. Use temperature 0, or another -M "
            "top_k where the family has that option"
        )
    return top or None
