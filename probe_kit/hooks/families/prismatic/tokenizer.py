"""Text to ids with the checkpoint's `tokenizer.json`.

Read by the `tokenizers` library itself: transformers 5 rebuilds Llama's tokenizer by rules of its own, while the
released models were trained with what the file says.
"""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any, Protocol

from tokenizers import Tokenizer

from probe_kit._system.bounded_json import load_json
from probe_kit.errors import CheckpointError, InstructionError, UsageError

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
    """The first id of `answer` where it stands behind `prompt`.

    Raises UsageError if the answer changes the prompt's own ids: its logit would be that of another prompt.
    """
    before, extended = tokenizer.encode(prompt), tokenizer.encode(prompt + answer)
    if extended[: len(before)] != before or len(extended) == len(before):
        raise UsageError(
            f"the answer {answer!r} merges with the end of the prompt: {extended[len(before) - 2 :]} instead of "
            f"{before[len(before) - 2 :]} and more. Give the option as it stands behind the prompt, such as ' A'"
        )
    return extended[len(before)]


@dataclass(frozen=True)
class FileTokenizer:
    """A `tokenizer.json`, with the names of special tokens from the `tokenizer_config.json` beside it, if any."""

    file: Path
    beginning: int | None

    @cached_property
    def _tokenizer(self) -> Any:
        return Tokenizer.from_file(str(self.file))

    @cached_property
    def _beginning(self) -> int | None:
        """The beginning-of-sequence id, from the tokenizer's own files before the model's configuration."""
        bos_token = self._config.get("bos_token")
        content = bos_token.get("content") if isinstance(bos_token, dict) else bos_token
        number: int | None = self._tokenizer.token_to_id(content) if content else None
        return self.beginning if number is None else number

    @cached_property
    def _config(self) -> dict[str, Any]:
        file = self.file.with_name("tokenizer_config.json")
        return dict(load_json(file)) if file.is_file() else {}

    @cached_property
    def special(self) -> frozenset[int]:
        """Ids that the file declares special."""
        added = self._tokenizer.get_added_tokens_decoder()
        return frozenset(number for number, token in added.items() if token.special) | {self._beginning or 0}

    def encode(self, text: str) -> list[int]:
        """Ids, the beginning-of-sequence token first, also where the file does not add it."""
        ids: list[int] = self._tokenizer.encode(text).ids
        if self._beginning is not None and ids[:1] != [self._beginning]:
            ids = [self._beginning, *ids]
        unknown = getattr(self._tokenizer.model, "unk_token", None)
        if unknown is not None and self._tokenizer.token_to_id(unknown) in ids:
            raise InstructionError(
                f"{text!r} has a word this checkpoint's tokenizer does not know; the model would act without "
                f"reading it. Tokens: {self._tokenizer.encode(text).tokens}"
            )
        return ids

    def inside(self, text: str, start: int, stop: int) -> list[bool]:
        """Per id whether it holds any of these characters, by the offsets that the tokenizer gives."""
        encoding = self._tokenizer.encode(text)
        flags = [
            first < stop and last > start and not special
            for (first, last), special in zip(encoding.offsets, encoding.special_tokens_mask, strict=True)
        ]
        return [False] * (len(self.encode(text)) - len(flags)) + flags

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids, without special tokens."""
        return str(self._tokenizer.decode(list(ids), skip_special_tokens=True)).strip()


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
        if (folder / "tokenizer.json").is_file():
            return FileTokenizer(folder / "tokenizer.json", beginning)
    raise CheckpointError(
        f"tokenizer.json and tokenizer_config.json are missing in {' and '.join(map(str, places))}. The tokenizer "
        "comes with the checkpoint: copy these files from the model's page, or from the model it was fine-tuned "
        f"from, or name their folder with -M tokenizer=DIR. For a development checkpoint that has none: "
        f"-M tokenizer={BYTES}"
    )
