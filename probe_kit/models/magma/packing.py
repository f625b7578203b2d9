"""The place of a picture in its prompt: that of the one placeholder."""

from collections.abc import Sequence
from dataclasses import dataclass

from probe_kit.errors import CheckpointError


@dataclass(frozen=True)
class PictureSpan:
    """The positions of a picture's tokens in its row: `start`, then `rows` times `columns` and a separator."""

    start: int
    rows: int
    columns: int

    @property
    def length(self) -> int:
        """Tokens, separators included."""
        return self.rows * (self.columns + 1)


def placeholder(ids: Sequence[int], image_token: int) -> int:
    """The position of the placeholder. Raises CheckpointError unless there is exactly one."""
    places = [position for position, number in enumerate(ids) if number == image_token]
    if len(places) != 1:
        raise CheckpointError(
            f"the prompt has {len(places)} picture placeholders (id {image_token}); expected one. The tokenizer "
            "does not know <image> as one token, or the text itself contains it"
        )
    return places[0]
