"""Text to ids with the checkpoint's `tokenizer.json`, or with bytes."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Protocol

from probe_kit.errors import CheckpointError
from probe_kit.hooks.families.shared.tokenizer_file import (
    SETTINGS_FILE,
    TOKENIZER_FILE,
    TokenizerFile,
    first_behind,
    positions_of,
)

BYTES = "bytes"
"""Asks for `ByteTokenizer`."""


class TextTokenizer(Protocol):
    """The methods that an adapter needs. special: ids that stand for no text."""

    @property
    def special(self) -> frozenset[int]:
        """Ids that stand for no text."""

    def encode(self, text: str) -> list[int]:
        """Ids, the beginning-of-sequence token first. Raises InstructionError for a word it does not know."""

    def inside(self, text: str, start: int, stop: int) -> list[bool]:
        """Per id of `encode(text)` whether it holds any of the characters from `start` to `stop`."""

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids that the model put out, without special tokens."""


def id_behind(tokenizer: TextTokenizer, prompt: str, answer: str) -> int:
    """The first id of `answer` behind `prompt`. Raises UsageError if it changes the prompt's own ids."""
    return first_behind(tokenizer.encode(prompt), tokenizer.encode(prompt + answer), answer)


@dataclass(frozen=True)
class FileTokenizer(TokenizerFile):
    """A tokenizer that begins every text. beginning: the id of the model's configuration."""

    beginning: int | None

    @cached_property
    def _beginning(self) -> int | None:
        """The beginning-of-sequence id, from the tokenizer's own files before the model's configuration."""
        content = self.token_of("bos_token")
        number: int | None = self.tokenizer.token_to_id(content) if content else None
        return self.beginning if number is None else number

    @cached_property
    def special(self) -> frozenset[int]:
        """Ids that the file declares special."""
        return super().special | {self._beginning or 0}

    def encode(self, text: str) -> list[int]:
        """Ids, the beginning-of-sequence token first, also where the file does not add it."""
        ids: list[int] = self.encoding(text, special=True).ids
        begins = self._beginning is None or ids[:1] == [self._beginning]
        return ids if begins else [self._beginning, *ids]  # type: ignore[list-item]

    def inside(self, text: str, start: int, stop: int) -> list[bool]:
        """Per id whether it holds any of these characters, by the offsets that the tokenizer gives."""
        flags = positions_of(self.encoding(text, special=True), start, stop)
        return [False] * (len(self.encode(text)) - len(flags)) + list(flags)

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids, without special tokens."""
        return self.words(ids)


@dataclass(frozen=True)
class ByteTokenizer:
    """UTF-8 bytes as ids 3 … 258, for development checkpoints that come without a tokenizer.

    No model was trained with it, so a trained checkpoint would read noise.
    """

    beginning: int

    @property
    def special(self) -> frozenset[int]:
        """The beginning-of-sequence token."""
        return frozenset({self.beginning})

    def encode(self, text: str) -> list[int]:
        """Ids, the beginning-of-sequence token first."""
        return [self.beginning, *(3 + byte for byte in text.encode())]

    def inside(self, text: str, start: int, stop: int) -> list[bool]:
        """Per id whether it is a byte of these characters."""
        before, length = (len(part.encode()) for part in (text[:start], text[start:stop]))
        return [False] + [before <= position < before + length for position in range(len(text.encode()))]

    def decode(self, ids: Sequence[int]) -> str:
        """The bytes among the ids as text."""
        return bytes(number - 3 for number in ids if 3 <= number < 259).decode(errors="replace").strip()


def find_tokenizer(
    folders: Sequence[Path], tokenizer: str | None, beginning: int | None, vocabulary: int
) -> TextTokenizer:
    """The checkpoint's tokenizer, or the one in the folder `tokenizer`, or bytes if that is asked for.

    vocabulary: the number of text ids the model has. Raises CheckpointError naming the missing files.
    """
    if tokenizer == BYTES:
        if vocabulary < 259:
            raise CheckpointError(f"bytes need 259 text ids; this checkpoint has {vocabulary}")
        return ByteTokenizer(1 if beginning is None else beginning)
    places = list(folders) if tokenizer is None else [Path(tokenizer).expanduser()]
    for folder in places:
        if (folder / TOKENIZER_FILE).is_file():
            return FileTokenizer(folder, beginning)
    raise CheckpointError(
        f"{TOKENIZER_FILE} and {SETTINGS_FILE} are missing in {' and '.join(map(str, places))}. The tokenizer "
        "comes with the checkpoint: copy these files from the model's page, or from the model it was fine-tuned "
        f"from, or name their folder with -M tokenizer=DIR. For a development checkpoint that has none: "
        f"-M tokenizer={BYTES}"
    )
