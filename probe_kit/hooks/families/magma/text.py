"""Magma's chat as token ids, from the checkpoint's `tokenizer.json`, with the positions of the question."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path

from probe_kit._system.bounded_files import read_regular_text
from probe_kit.errors import CheckpointError
from probe_kit.hooks.checkpoints.checkpoint import GENERATION_FILE
from probe_kit.hooks.families.shared.tokenizer_file import (
    TokenizerFile,
    first_behind,
    positions_of,
    token_ids_of,
    values_of,
)
from probe_kit.models.magma import MagmaConfig, chat_text, conversation, picture_question


@dataclass(frozen=True)
class TokenPrompt:
    """A whole prompt as ids, and which of them are the question, not the frames around it."""

    ids: tuple[int, ...]
    question: tuple[bool, ...]


@dataclass(frozen=True)
class ChatText(TokenizerFile):
    """Magma's chat template: header tokens, image placeholder, question.

    user_first: the user's turn stands before the system's, as Act2Answer's release has it.
    """

    config: MagmaConfig
    user_first: bool = False

    @classmethod
    def of(cls, folder: Path, config: MagmaConfig, user_first: bool = False) -> "ChatText":
        """Read the tokenizer in `folder`. Raises CheckpointError for missing files and another model's."""
        TokenizerFile(folder).check_present()
        text = cls(folder, config, user_first)
        text.check()
        return text

    @cached_property
    def _template(self) -> str | None:
        """The checkpoint's chat template in Jinja, None if it has none."""
        file = self.folder / "chat_template.jinja"
        stored = read_regular_text(file) if file.is_file() else self.settings.get("chat_template")
        if stored is not None and not isinstance(stored, str):
            raise CheckpointError(
                f"{self.folder} has {len(stored)} chat templates; expected one. Keep the one the model was "
                "trained with"
            )
        return stored

    @cached_property
    def _beginning(self) -> dict[str, str]:
        token = self.token_of("bos_token")
        return {"beginning": token} if token else {}

    def check(self) -> None:
        """Refuse a tokenizer that belongs to another model. Raises CheckpointError."""
        counts = self.vocabulary, self.config.base_vocabulary
        if counts[1] not in (None, counts[0]):
            raise CheckpointError(
                f"{self.file} has {counts[0]} ids before the added ones, config.json says {counts[1]} "
                "(tokenizer_vocab_size): every action would be decoded wrongly. Take the checkpoint's tokenizer"
            )
        self.check_vocabulary(int(self.config.text.vocab_size))

    @property
    def vocabulary(self) -> int:
        """Number of ids before the added tokens; the last of them name action bins."""
        return int(self.tokenizer.get_vocab_size(with_added_tokens=False))

    @cached_property
    def ends(self) -> frozenset[int]:
        """Ids that end the assistant's turn."""
        stored = values_of(self.folder / GENERATION_FILE).get("eos_token_id")
        return token_ids_of(self.config.text.eos_token_id, stored, self.tokenizer.token_to_id("<|eot_id|>"))

    def prompt(self, question: str, begun: str = "", pictured: bool = True) -> TokenPrompt:
        """The whole prompt of a question about one picture, or in words alone.

        begun: how the answer has begun already.
        Raises InstructionError for a question that holds a token of the frames.
        """
        self.check_marks(question + begun)
        before = picture_question("", self.config.image_start_end) if pictured else ""
        turn = before + question
        frames = chat_text(conversation(turn, self.user_first), self._template, **self._beginning)
        start, stop = self._question_span(turn, frames)
        start += len(before)
        encoding = self.tokenizer.encode(frames + begun)
        return TokenPrompt(tuple(encoding.ids), positions_of(encoding, start, stop))

    def _question_span(self, turn: str, frames: str) -> tuple[int, int]:
        """The beginning and end of the user's words in `frames`."""
        words = turn.strip()  # as templates do
        start = frames.find(words)
        if start < 0:
            raise CheckpointError(
                f"the chat template in {self.folder} changes the words of a turn: {words!r} is not in {frames!r}. "
                "Take the template the model was trained with"
            )
        return start, start + len(words)

    def option(self, question: str, begun: str, option: str, pictured: bool = True) -> int:
        """The first id of an option behind a prompt. Raises UsageError if it changes the prompt's own ids."""
        before, behind = (self.prompt(question, text, pictured).ids for text in (begun, begun + option))
        return first_behind(before, behind, option)

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids up to the end of the turn, without special tokens."""
        return self.words(ids, self.ends)
