"""Qwen's chat as text: the placeholder of an image and its number of tokens."""

from collections.abc import Sequence

from probe_kit.errors import CheckpointError

IMAGE = "<|vision_start|><|image_pad|><|vision_end|>"
"""Where a picture goes in a prompt; `image_slots` repeats the middle token."""


def image_slots(ids: Sequence[int], image_token: int, counts: Sequence[int]) -> list[int]:
    """Ids of a prompt in which the k-th image token is repeated `counts[k]` times.

    ids: of a prompt with one image token per picture. Raises CheckpointError where their number differs: the
    tokenizer then does not know the token, or is another model's.
    """
    slots = [position for position, number in enumerate(ids) if number == image_token]
    if len(slots) != len(counts):
        raise CheckpointError(
            f"the tokenizer gave {len(slots)} image tokens (id {image_token}) for {len(counts)} pictures; "
            "tokenizer.json does not belong to this checkpoint"
        )
    filled: list[int] = []
    start = 0
    for slot, count in zip(slots, counts, strict=True):
        filled += [*ids[start:slot], *([image_token] * count)]
        start = slot + 1
    return [*filled, *ids[start:]]
