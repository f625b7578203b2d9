"""The adapter for Prismatic vision-language models: packing, streams, taps, roles. OpenVLA builds on it.

One stack serves two streams, distinguished by position: `backbone` is the prompt without its last token. The other
one has the positions whose logits choose the output: the prompt's last token, then every token fed back but the
last.
"""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor

from probe_kit.errors import CheckpointError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import side_files
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.model import Prompt, Reading, Tap
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import IMAGE_ROLE, Site, Stream
from probe_kit.hooks.families.prismatic.checkpoint import load_checkpoint
from probe_kit.hooks.families.prismatic.network import PictureSettings, PrismaticNetwork, prepare_picture
from probe_kit.hooks.families.shared.loading import Loaded
from probe_kit.hooks.families.shared.text import (
    SETTINGS_FILE,
    TOKENIZER_FILE,
    FileTokenizer,
    find_tokenizer,
    first_behind,
    token_ids_of,
)
from probe_kit.hooks.families.shared.token_decoder import TokenDecoder
from probe_kit.hooks.families.shared.vlm import Prefill, SpeakingModel
from probe_kit.models.decoding import Choose, Decoded, Packed, greedy

VICUNA_SYSTEM = (
    "A chat between a curious user and an artificial intelligence assistant. "
    "The assistant gives helpful, detailed, and polite answers to the user's questions."
)
_LLAMA_SYSTEM = (
    "You are a helpful language and vision assistant. You are able to understand the visual content that the user "
    "provides, and assist the user with a variety of tasks using natural language."
)


@dataclass(frozen=True)
class TextFrame:
    """The text around a question: `before` it and `behind` it."""

    before: str
    behind: str

    def around(self, question: str) -> str:
        """Return the whole text; the original strips white space from both ends of a question."""
        return f"{self.before}{question.strip()}{self.behind}"

    def question_span(self, question: str) -> tuple[int, int]:
        """The beginning and end of the question in the text."""
        return len(self.before), len(self.before) + len(question.strip())


_PURE = TextFrame("In: ", "\nOut:")
_INSTRUCT = TextFrame("[INST] ", " [/INST]")
# The bracket that is missing behind <<SYS> is missing in the original, too.
_CHAT = TextFrame(f"[INST] <<SYS>\n{_LLAMA_SYSTEM}\n<</SYS>>\n\n", " [/INST]")
_VICUNA = TextFrame(f"{VICUNA_SYSTEM} USER: ", " ASSISTANT:")
_PHI = TextFrame("Input: ", "\nOutput:")


def frame_of(language_id: str) -> TextFrame:
    """The frame of a `llm_backbone_id`; all ids of the configuration's table have one."""
    if language_id.startswith("vicuna"):
        return _VICUNA
    if language_id.startswith("phi"):
        return _PHI
    if language_id.endswith("-chat"):
        return _CHAT
    return _INSTRUCT if language_id.endswith("-instruct") else _PURE


# -- tokenizers -----------------------------------------------------------------------------------------------


def id_behind(tokenizer: "FileTokenizer", prompt: str, answer: str) -> int:
    """The first id of `answer` behind `prompt`.

    Raises:
        UsageError: If it changes the prompt's own ids.
    """
    return first_behind(tokenizer.encode(prompt), tokenizer.encode(prompt + answer), answer)


# -- the adapter ----------------------------------------------------------------------------------------------

DEFAULT_CHECKPOINT = "TRI-ML/prismatic-vlms/prism-dinosiglip-224px+7b"


class PrismaticModel(TokenDecoder):
    """A loaded network of this kind: looks at a picture, reads a prompt, puts out `steps` greedy tokens."""

    family: ClassVar[str]
    loaded: Loaded[PrismaticNetwork]
    network: PrismaticNetwork

    def __init__(
        self,
        loaded: Loaded[PrismaticNetwork],
        steps: int,
        tokenizer: str | None = None,
        text_folder: Path | None = None,
    ) -> None:
        """Make the streams and the card of a model.

        Args:
            loaded: The network, with what loading proved.
            steps: Tokens per inference.
            tokenizer: Folder of another tokenizer; None for the checkpoint's.
            text_folder: Folder of a tokenizer that does not come with the checkpoint; None where it does.
        """
        super().__init__(loaded, steps)
        self._chosen_tokenizer, self._text_folder = tokenizer, text_folder
        self.further_streams = {
            name: Stream(name, len(tower.blocks), int(tower.embed_dim), part="vision", quantities=("residual",))
            for name, tower in self._towers.items()
        }
        self.card = loaded.card(self.family, self._settings(), files=self._files(), tokenizer=tokenizer)

    def _files(self) -> dict[str, Path]:
        """Return every file besides the weights, with that of a tokenizer that comes from elsewhere."""
        files: dict[str, Path] = {}
        for number, folder in enumerate(self.loaded.folders):
            files |= side_files(folder, "" if number == len(self.loaded.folders) - 1 else "adapter/")
        return files if self._text_folder is None else files | side_files(self._text_folder, "tokenizer/")

    def _settings(self) -> dict[str, str]:
        """The choices that the numbers depend on."""
        return {"tokenizer": self._chosen_tokenizer or "the checkpoint's", "steps": str(self.steps)}

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def pictures(self) -> PictureSettings:
        """The settings of resizing and normalising pictures."""
        return PictureSettings.of(self.config, self.loaded.folders)

    def pixel_values(self, images: Iterable[NDArray[np.uint8]]) -> Tensor:
        """Return (B, 3 per tower, S, S) float32 of (H, W, 3) uint8 pictures.

        Raises:
            ObservationError: For a picture of another dtype or shape.
        """
        rows = [prepare_picture(checked_picture(image), self.pictures) for image in images]
        return torch.from_numpy(np.stack(rows)).to(self.loaded.device)

    def token_texts(self) -> tuple[str, ...]:
        """Return the text of every token by its id."""
        return self.tokenizer.texts

    @cached_property
    def tokenizer(self) -> FileTokenizer:
        """The tokenizer of the checkpoint, or the chosen one.

        Raises:
            CheckpointError: For files that are missing, which it names.
        """
        folders = [*self.loaded.folders, *filter(None, [self._text_folder])]
        return find_tokenizer(folders, self._chosen_tokenizer, self.config.text.bos_token_id)

    @abstractmethod
    def prompt(self, instruction: str) -> list[int]:
        """Return the ids of a whole prompt."""

    def pack(self, rows: Sequence[Sequence[int]]) -> Packed:
        """Return prompts of ids as a batch.

        Raises:
            InstructionError: For a prompt that is too long.
            CheckpointError: For ids that the model does not have.
        """
        for row in rows:
            self.check_length(self.network.patches + len(row))
            if max(row) >= self.config.text.vocab_size:
                raise CheckpointError(
                    f"the tokenizer gave id {max(row)}; this model has {self.config.text.vocab_size}. "
                    "The tokenizer belongs to another checkpoint"
                )
        padding = self.config.text.pad_token_id
        return Packed.of(rows, 0 if padding is None else int(padding))

    # -- running -----------------------------------------------------------------------------------------

    def generate(
        self, pixel_values: Tensor | None, rows: Sequence[Sequence[int]], choose: Choose = greedy
    ) -> Decoded:
        """Return `steps` tokens behind every prompt, greedy by default; one inference, as `capture` counts it."""
        packed = self.pack(rows)
        device = self.loaded.device
        with torch.inference_mode():
            return self.network.decode(
                packed.ids.to(device), packed.mask.to(device), pixel_values, self.steps, choose
            )

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of beginning of sequence, patches and text, with padding behind the shorter prompts."""
        rows = [self.prompt(observation.instruction) for observation in observations]
        backbone = []
        for row in rows:
            labels = ["special" if number in self.tokenizer.special else "language" for number in row[:-1]]
            labels[1:1] = [IMAGE_ROLE] * self.network.patches
            backbone.append(labels)
        return self.roles_of(backbone)

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each whole prompt."""
        return [tuple(self.prompt(instruction)) for instruction in instructions]

    def patch_order(self) -> NDArray[np.int64]:
        """Return a token per patch, row by row, behind the tower's class and register tokens."""
        prefix = int(self._towers["vision"].num_prefix_tokens)
        return np.concatenate([np.full(prefix, -1), np.arange(self.network.patches)])

    def vision_tap(self, site: Site) -> Tap:
        """Return the input of a block; the last is what the projector reads, class and register tokens first."""
        return Tap(self._towers[site.stream].blocks[site.layer].norm1, 1)

    @property
    def _towers(self) -> dict[str, Any]:
        return dict(zip(("vision", "vision_fused"), self.network.vision_backbone.towers, strict=False))


class Prismatic(PrismaticModel, SpeakingModel):
    """A loaded Prismatic vision-language model, which answers in text."""

    family: ClassVar[str] = "prismatic"
    output: ClassVar[str] = "answer"

    @property
    def lead(self) -> str:
        """A space, as words begin with one behind every frame."""
        return " "

    def _settings(self) -> dict[str, str]:
        return {**super()._settings(), "frame": self.frame.around("[question]")}

    @cached_property
    def frame(self) -> TextFrame:
        """The text around a question with which the language model was trained."""
        return frame_of(self.config.language_id)

    def prompt(self, instruction: str) -> list[int]:
        """Return the ids of a question in the frame around it."""
        return self.tokenizer.encode(self.frame.around(instruction))

    def read(self, questions: Sequence[Prompt]) -> Reading:
        """Read all questions in one prefill; see the contract.

        Raises:
            UsageError: If the model was loaded for more than one step.
        """
        if self.steps != 1:
            raise UsageError(
                f"a question is one prefill; this model takes {self.steps} steps. Load it with steps=1"
            )
        return super().read(questions)

    def option_ids(self, question: Prompt) -> list[int]:
        """The first id of every option."""
        return [id_behind(self.tokenizer, self._framed(question), option) for option in question.options]

    def prefill(self, questions: Sequence[Prompt]) -> Prefill:
        """Read all questions in one pass."""
        self.check([question.observation for question in questions])
        pixels = None
        if self.shows_pictures(questions):
            pixels = self.pixel_values(question.observation.image for question in questions)
        decoded = self.generate(pixels, [self.tokenizer.encode(self._framed(question)) for question in questions])
        return Prefill.of_decoded(self.speaker, decoded)

    def _framed(self, question: Prompt) -> str:
        return self.frame.around(question.text) + question.begun

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """The roles of the observations' instructions as questions."""
        return self.asked_roles([Prompt(observation, observation.instruction) for observation in observations])

    def asked_roles(self, questions: Sequence[Prompt]) -> dict[str, list[Roles]]:
        """Return the roles of questions: everything around picture and question is `special`.

        The beginning of an answer is `special` too.
        """
        patches = self.network.patches if self.shows_pictures(questions) else 0
        image = [IMAGE_ROLE] * patches
        rows = []
        for question in questions:
            inside = self.tokenizer.inside(self._framed(question), *self.frame.question_span(question.text))
            labels = ["language" if is_question else "special" for is_question in inside]
            rows.append([*labels[:1], *image, *labels[1:-1]])
        return self.roles_of(rows)

    @property
    def speaker(self) -> Any:
        """The language model."""
        return self.network.language_model

    def words(self, ids: Sequence[int]) -> str:
        """The text of an answer's ids, up to its end."""
        return self.tokenizer.decode(list(takewhile(lambda number: number not in self.ends, ids)))

    @cached_property
    def ends(self) -> frozenset[int]:
        """The ids that end an answer."""
        return token_ids_of(self.config.text.eos_token_id)


def load_prismatic(
    checkpoint: str | None = None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    tokenizer: str | None = None,
    bits: int | None = None,
    steps: int = 1,
    weights_seed: int = 0,
) -> Prismatic:
    """Load a Prismatic model, from a folder or hub id.

    Its layout is that of `PrismaticForConditionalGeneration`, or of a training run as TRI-ML releases it, of which
    a hub id has the form `owner/repo/folder`. Towers and tokenizer of such a run are downloaded where they are.
    The options are those of the family. Raises what `load_checkpoint` raises.
    """
    loaded = load_checkpoint(checkpoint or DEFAULT_CHECKPOINT, device, dtype, random_weights, bits, weights_seed)
    elsewhere, text_folder = loaded.network.config.tokenizer_id, None
    has_one = any((folder / TOKENIZER_FILE).is_file() for folder in loaded.folders)
    if tokenizer is None and elsewhere and not has_one:
        text_folder = checkpoint_folder(elsewhere, (TOKENIZER_FILE, SETTINGS_FILE))
    return Prismatic(loaded, steps, tokenizer, text_folder)
