"""Prompts to ids, with the template strings that a vision-language model was trained with; none is rendered."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import GENERATION_FILE
from probe_kit.hooks.families.shared.tokenizer_file import (
    TokenizerFile,
    first_behind,
    positions_of,
    values_of,
)


@dataclass(frozen=True)
class Frame:
    """The fixed strings around a question.

    before: in front of the picture's positions. behind: between them and the question. bare: in front of a
    question that comes without a picture. end: behind the question; the answer begins there.
    """

    before: str
    behind: str
    bare: str
    end: str

    def __str__(self) -> str:
        return f"{self.before}[picture]{self.behind}[question]{self.end} or {self.bare}[question]{self.end}"


@dataclass(frozen=True)
class TokenPrompt:
    """A whole prompt.

    text: behind the picture's positions. ids: of everything. question: which of the ids are the question.
    picture: first position of the picture and the one behind its last; equal where there is none.
    """

    text: str
    ids: tuple[int, ...]
    question: tuple[bool, ...]
    picture: tuple[int, int]


@dataclass(frozen=True)
class FramedText(TokenizerFile):
    """A model's tokenizer and frame. vocabulary: ids the model has. ends: end tokens of an answer."""

    frame: Frame
    vocabulary: int
    ends: frozenset[int]

    @classmethod
    def of(cls, folder: Path, frame: Frame, config: Any, generation: Path) -> "FramedText":
        """Read the files in `folder`.

        config: of the language model. generation: folder that may hold generation_config.json.
        Raises CheckpointError for missing files and for a tokenizer of another model.
        """
        TokenizerFile(folder).check_present()
        text = cls(folder, frame, int(config.vocab_size), _ends(generation, config))
        text.check_vocabulary(text.vocabulary)
        return text

    @cached_property
    def padding(self) -> int:
        """The id that pads; it is masked."""
        content = self.token_of("pad_token")
        number = self.tokenizer.token_to_id(content) if content else None
        return 0 if number is None else int(number)

    def check_token(self, token: str, number: int) -> None:
        """Raise CheckpointError unless the tokenizer knows `token` by the id that the model expects."""
        if (tokenizer_id := self.tokenizer.token_to_id(token)) != number:
            raise CheckpointError(
                f"{self.file} has {token} as id {tokenizer_id}, config.json says {number}. "
                "The tokenizer belongs to another checkpoint"
            )

    def prompt(
        self, question: str, begun: str = "", picture: Sequence[int] | None = None, marks: int = 0
    ) -> TokenPrompt:
        """The prompt of a question.

        begun: how the answer has begun already. picture: ids at the positions of a picture, None without one;
        `marks` of them at either end are no picture but say where it begins and ends.
        Raises InstructionError for text that holds a token of the frames or one the tokenizer does not know.
        """
        self.check_marks(question + begun)
        lead = self.frame.bare if picture is None else self.frame.behind
        text = lead + question + self.frame.end + begun
        before = [] if picture is None else [*self.encoding(self.frame.before).ids, *picture]
        behind = self.encoding(text)
        start, stop = len(lead), len(lead) + len(question)
        is_question = positions_of(behind, start, stop)
        picture_span = (len(before) - len(picture or ()) + marks, len(before) - marks) if picture else (0, 0)
        return TokenPrompt(text, (*before, *behind.ids), (*[False] * len(before), *is_question), picture_span)

    def option(self, prompt: TokenPrompt, option: str) -> int:
        """The first id of `option` behind a prompt. Raises UsageError if it changes the prompt's own ids."""
        return first_behind(self.encoding(prompt.text).ids, self.encoding(prompt.text + option).ids, option)

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids up to an end, without special tokens."""
        return self.words(ids, self.ends)


def _ends(folder: Path, config: Any) -> frozenset[int]:
    """The end tokens in generation_config.json, or else in the configuration. Raises CheckpointError for none."""
    stored = values_of(folder / GENERATION_FILE).get("eos_token_id", getattr(config, "eos_token_id", None))
    numbers = stored if isinstance(stored, list) else [stored]
    if None in numbers or not numbers:
        raise CheckpointError(
            f"neither {folder / GENERATION_FILE} nor config.json names eos_token_id, the end of an answer. "
            "Copy the file from the model's page"
        )
    return frozenset(map(int, numbers))
