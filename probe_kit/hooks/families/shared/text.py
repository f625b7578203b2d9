"""The text side of a model: a checkpoint's `tokenizer.json`, and the text around a question or an instruction.

The file is read by the `tokenizers` library itself. transformers 5 rebuilds Llama's tokenizer by rules of its own,
while the released models were trained with what the file says.
"""

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any

from tokenizers import Tokenizer

from probe_kit._system.bounded_files import load_json
from probe_kit._system.foreign_files import while_reading
from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import GENERATION_FILE

TOKENIZER_FILE, SETTINGS_FILE = "tokenizer.json", "tokenizer_config.json"


@dataclass(frozen=True)
class TokenizerFile:
    """The tokenizer of a folder, with the names of special tokens from the file beside it, if any."""

    folder: Path

    @property
    def file(self) -> Path:
        """The file of the tokenizer."""
        return self.folder / TOKENIZER_FILE

    def check_present(self) -> None:
        """Raise CheckpointError where the file is missing."""
        if not self.file.is_file():
            raise CheckpointError(
                f"{self.file} is missing. The tokenizer comes with the checkpoint or with the model it was made "
                "of: copy it from that model's page, or name a folder that has it with -M tokenizer=DIR"
            )

    def check_vocabulary(self, vocabulary: int, allow_added: bool = False) -> None:
        """Raise CheckpointError for ids that a model with `vocabulary` of them does not have.

        Args:
            vocabulary: Number of ids that the model has.
            allow_added: Whether words that were added to the tokenizer may have higher ids: they are refused where
                a text has one. The processor of PaliGemma adds words that small models never learn.
        """
        added = self.tokenizer.get_added_tokens_decoder()
        left_out = {token.content for token in added.values() if allow_added and not token.special}
        ids = self.tokenizer.get_vocab(with_added_tokens=True)
        if (highest := max(number for word, number in ids.items() if word not in left_out)) >= vocabulary:
            raise CheckpointError(
                f"{self.file} has ids up to {highest}; this model has {vocabulary}. The tokenizer belongs to "
                "another checkpoint"
            )

    @cached_property
    def tokenizer(self) -> Any:
        """The library's tokenizer."""
        with while_reading(self.file, advice="Take the tokenizer that came with the checkpoint"):
            return Tokenizer.from_file(str(self.file))

    @cached_property
    def settings(self) -> dict[str, Any]:
        """The settings beside it; none without the file.

        Raises:
            CheckpointError: For a file that is not JSON.
        """
        return values_of(self.folder / SETTINGS_FILE)

    def token_of(self, kind: str) -> str | None:
        """The text of a special token such as `pad_token`, None where the settings name none."""
        token = self.settings.get(kind)
        return (token.get("content") if isinstance(token, dict) else token) or None

    @cached_property
    def special(self) -> frozenset[int]:
        """The ids that stand for no text, such as the ends of a chat's turns."""
        added = self.tokenizer.get_added_tokens_decoder()
        return frozenset(number for number, token in added.items() if token.special)

    def encoding(self, text: str, special: bool = False) -> Any:
        """Return the library's encoding of a text; `special` adds the tokens that the file puts around it.

        Raises:
            InstructionError: For a word that the tokenizer does not know.
        """
        encoding = self.tokenizer.encode(text, add_special_tokens=special)
        unknown = getattr(self.tokenizer.model, "unk_token", None)
        if unknown is not None and self.tokenizer.token_to_id(unknown) in encoding.ids:
            raise InstructionError(
                f"{text!r} has a word this checkpoint's tokenizer does not know; the model would not read it. "
                f"Tokens: {encoding.tokens}"
            )
        return encoding

    def check_marks(self, text: str) -> None:
        """Raise InstructionError for a text that holds a special token."""
        for token in self.tokenizer.get_added_tokens_decoder().values():
            if token.special and token.content in text:
                raise InstructionError(
                    f"the text {text!r} holds {token.content!r}, which stands for something else in the prompt; "
                    "write it without"
                )

    @cached_property
    def texts(self) -> tuple[str, ...]:
        """The text of every token by its id, alone; empty for ids that the tokenizer leaves out."""
        return token_texts(self.tokenizer)

    def words(self, ids: Sequence[int], ends: Collection[int] = ()) -> str:
        """The text of ids up to one of `ends`, without special tokens."""
        answer = list(takewhile(lambda number: number not in ends, ids))
        return str(self.tokenizer.decode(answer, skip_special_tokens=True)).strip()


@dataclass(frozen=True)
class FileTokenizer(TokenizerFile):
    """A tokenizer that begins every text.

    Attributes:
        beginning: The id of the model's configuration that begins a text; None where it has none.
    """

    beginning: int | None

    @cached_property
    def _beginning(self) -> int | None:
        """The beginning-of-sequence id, from the tokenizer's own files before the model's configuration."""
        content = self.token_of("bos_token")
        number: int | None = self.tokenizer.token_to_id(content) if content else None
        return self.beginning if number is None else number

    @cached_property
    def special(self) -> frozenset[int]:
        """The ids that the file declares special, and the one that begins a text."""
        return super().special | {self._beginning or 0}

    def encode(self, text: str) -> list[int]:
        """Return ids, the beginning-of-sequence token first, also where the file does not add it."""
        ids: list[int] = self.encoding(text, special=True).ids
        begins = self._beginning is None or ids[:1] == [self._beginning]
        return ids if begins else [self._beginning, *ids]  # type: ignore[list-item]

    def inside(self, text: str, start: int, stop: int) -> list[bool]:
        """Return per id whether it holds any of these characters, by the offsets that the tokenizer gives."""
        flags = positions_of(self.encoding(text, special=True), start, stop)
        return [False] * (len(self.encode(text)) - len(flags)) + list(flags)

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids, without special tokens."""
        return self.words(ids)


def find_tokenizer(folders: Sequence[Path], tokenizer: str | None, beginning: int | None) -> FileTokenizer:
    """The checkpoint's tokenizer, or the one in the folder `tokenizer`.

    Args:
        folders: The folders that may hold the checkpoint's, the first one before the others.
        tokenizer: Folder of another tokenizer; None for the checkpoint's.
        beginning: The id of the model's configuration that begins a text.

    Raises:
        CheckpointError: For missing files, which it names.
    """
    places = list(folders) if tokenizer is None else [Path(tokenizer).expanduser()]
    for folder in places:
        if (folder / TOKENIZER_FILE).is_file():
            return FileTokenizer(folder, beginning)
    raise CheckpointError(
        f"{TOKENIZER_FILE} and {SETTINGS_FILE} are missing in {' and '.join(map(str, places))}. The tokenizer "
        "comes with the checkpoint: copy these files from the model's page, or from the model it was fine-tuned "
        "from, or name their folder with -M tokenizer=DIR"
    )


def token_texts(tokenizer: Any) -> tuple[str, ...]:
    """Return the text of every token of a tokenizer of `tokenizers` by its id, alone; special ones by name."""
    ids = tokenizer.get_vocab(with_added_tokens=True).values()
    texts = tokenizer.decode_batch([[number] for number in range(max(ids) + 1)], skip_special_tokens=False)
    return tuple(text if tokenizer.id_to_token(number) is not None else "" for number, text in enumerate(texts))


def positions_of(encoding: Any, start: int, stop: int) -> tuple[bool, ...]:
    """Return True for ids, special ones left out, that hold characters from `start` up to `stop` of the text."""
    return tuple(
        first < stop and last > start and not special
        for (first, last), special in zip(encoding.offsets, encoding.special_tokens_mask, strict=True)
    )


def first_behind(before: Sequence[int], extended: Sequence[int], option: str) -> int:
    """Return the first id of an option.

    Args:
        before: The ids of a prompt without the option.
        extended: The ids of the prompt with the option behind.
        option: The text of the option, for messages.

    Raises:
        UsageError: For an option that changes the prompt's own ids: its logit would be that of another prompt.
    """
    count = len(before)
    if len(extended) == count or extended[:count] != before:
        raise UsageError(
            f"the option {option!r} merges with the end of the prompt: {list(extended[count - 2 :])} instead of "
            f"{list(before[-2:])} and more. Give it as it stands behind the prompt, such as ' A'"
        )
    return int(extended[count])


def token_ids_of(*stored: Any) -> frozenset[int]:
    """The ids in values of configurations, each of which is an id, a list of them, or None."""
    flat = [number for value in stored for number in (value if isinstance(value, list) else [value])]
    return frozenset(int(number) for number in flat if number is not None)


def values_of(file: Path) -> dict[str, Any]:
    """The values of a JSON file; none without it.

    Raises:
        CheckpointError: For a file that is not JSON.
    """
    if not file.is_file():
        return {}
    try:
        return dict(load_json(file))
    except ValueError as error:
        raise CheckpointError(f"{file} is not JSON ({error}); download the checkpoint again") from error


# -- frames of questions --------------------------------------------------------------------------------------


@dataclass(frozen=True)
class QuestionFrame:
    """The fixed strings around a question.

    Attributes:
        before: The text in front of the picture's positions.
        behind: The text between them and the question.
        bare: The text in front of a question that comes without a picture.
        end: The text behind the question; the answer begins there.
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

    Attributes:
        text: The text behind the picture's positions.
        ids: The ids of everything.
        question: Per id, whether it is of the question.
        picture: First position of the picture and the one behind its last; equal where there is none, or where one
            placeholder stands for it.
    """

    text: str
    ids: tuple[int, ...]
    question: tuple[bool, ...]
    picture: tuple[int, int] = (0, 0)


@dataclass(frozen=True)
class FramedText(TokenizerFile):
    """A model's tokenizer and frame.

    Attributes:
        vocabulary: Number of ids that the model has.
        ends: End tokens of an answer.
    """

    frame: QuestionFrame
    vocabulary: int
    ends: frozenset[int]

    @classmethod
    def of(cls, folder: Path, frame: QuestionFrame, config: Any, generation: Path) -> "FramedText":
        """Read the files in `folder`.

        Args:
            folder: The folder of the tokenizer.
            frame: The strings around a question.
            config: Configuration of the language model.
            generation: Folder that may hold generation_config.json.

        Raises:
            CheckpointError: For missing files and for a tokenizer of another model.
        """
        TokenizerFile(folder).check_present()
        text = cls(folder, frame, int(config.vocab_size), _ends(generation, config))
        text.check_vocabulary(text.vocabulary, allow_added=True)
        return text

    def encoding(self, text: str, special: bool = False) -> Any:
        """Return the library's encoding of a text, as in `TokenizerFile`.

        Raises:
            InstructionError: For a word that tokenizer or model does not know.
        """
        encoding = super().encoding(text, special)
        if beyond := [
            word for word, number in zip(encoding.tokens, encoding.ids, strict=True) if number >= self.vocabulary
        ]:
            raise InstructionError(
                f"{text!r} has {beyond[0]!r}, which was added to the tokenizer and is none of the "
                f"{self.vocabulary} ids of this model; write it without"
            )
        return encoding

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

        Args:
            question: The text of the question.
            begun: The beginning of the answer, behind the frame.
            picture: Ids at the positions of a picture, None without one.
            marks: Count of the ids at either end of `picture` that are no picture but say where it begins and
                ends.

        Raises:
            InstructionError: For text that holds a token of the frames or one the tokenizer does not know.
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
        """The first id of `option` behind a prompt.

        Raises:
            UsageError: If it changes the prompt's own ids.
        """
        return first_behind(self.encoding(prompt.text).ids, self.encoding(prompt.text + option).ids, option)

    def decode(self, ids: Sequence[int]) -> str:
        """The text of ids up to an end, without special tokens."""
        return self.words(ids, self.ends)


def _ends(folder: Path, config: Any) -> frozenset[int]:
    """The end tokens in generation_config.json, or else in the configuration.

    Raises:
        CheckpointError: If neither names one.
    """
    stored = values_of(folder / GENERATION_FILE).get("eos_token_id", getattr(config, "eos_token_id", None))
    numbers = stored if isinstance(stored, list) else [stored]
    if None in numbers or not numbers:
        raise CheckpointError(
            f"neither {folder / GENERATION_FILE} nor config.json names eos_token_id, the end of an answer. "
            "Copy the file from the model's page"
        )
    return frozenset(map(int, numbers))


# -- prompts of instructions ----------------------------------------------------------------------------------

SLOT = "{instruction}"


def template_of(name: str, prompts: Mapping[str, str]) -> str:
    """Return a prompt by its name, or a template as it is.

    Raises:
        UsageError: For a template without a place for words.
    """
    template = prompts.get(name, name)
    if SLOT not in template:
        raise UsageError(f"prompt {name!r} is neither one of {', '.join(prompts)} nor a template with {SLOT}")
    return template
