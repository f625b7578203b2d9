"""Text to ids with a Qwen checkpoint's `tokenizer.json`, read by the `tokenizers` library."""

from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from tokenizers import Tokenizer

from probe_kit.errors import CheckpointError

TOKENIZER_FILE = "tokenizer.json"


@dataclass(frozen=True)
class QwenTokenizer:
    """A byte-level tokenizer: it knows every word, and begins with no token of its own."""

    file: Path

    @classmethod
    def find(cls, folder: Path) -> "QwenTokenizer":
        """The one of `folder`. Raises CheckpointError naming the missing file."""
        if not (folder / TOKENIZER_FILE).is_file():
            raise CheckpointError(
                f"{folder / TOKENIZER_FILE} is missing. The tokenizer comes with the checkpoint or with the "
                "vision-language model it was made of: copy it from that model's page, or name a folder that has "
                "it with -M tokenizer=DIR"
            )
        return cls(folder / TOKENIZER_FILE)

    @cached_property
    def _tokenizer(self) -> Any:
        return Tokenizer.from_file(str(self.file))

    @cached_property
    def special(self) -> frozenset[int]:
        """Ids that stand for no text, such as the ends of a chat's turns."""
        added = self._tokenizer.get_added_tokens_decoder()
        return frozenset(number for number, token in added.items() if token.special)

    def encode(self, text: str, vocabulary: int) -> list[int]:
        """Ids of a whole prompt. vocabulary: ids the model has; raises CheckpointError for one beyond."""
        ids: list[int] = self._tokenizer.encode(text, add_special_tokens=False).ids
        if max(ids) >= vocabulary:
            raise CheckpointError(
                f"{self.file} gave id {max(ids)}; this model has {vocabulary}. It belongs to another checkpoint"
            )
        return ids
