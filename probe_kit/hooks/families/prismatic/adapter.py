"""The adapter for Prismatic vision-language models: packing, streams, taps, roles. OpenVLA builds on it.

One stack serves two streams, distinguished by position: `backbone` is the prompt without its last token, the other
one the positions whose logits choose the output: the prompt's last token, then every token fed back but the last.
"""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from dataclasses import replace
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import content_hashes, side_files
from probe_kit.hooks.checkpoints.folders import checkpoint_folder
from probe_kit.hooks.contract.card import ModelCard
from probe_kit.hooks.contract.model import AnswerModel, Model, Prompt, Reading, Tap
from probe_kit.hooks.contract.observation import Observation, checked_picture
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.contract.unembedding import Unembedding
from probe_kit.hooks.contract.views import PADDING
from probe_kit.hooks.families.prismatic.checkpoint import LoadedPrismatic, load_checkpoint
from probe_kit.hooks.families.prismatic.frames import TextFrame, frame_of
from probe_kit.hooks.families.prismatic.tokenizer import ByteTokenizer, TextTokenizer, find_tokenizer, id_behind
from probe_kit.hooks.families.shared.decoder_tap import decoder_tap
from probe_kit.hooks.families.shared.prompt_kv import ALL_BUT_LAST, kv_tap
from probe_kit.hooks.families.shared.sampling import Choose, greedy
from probe_kit.hooks.families.shared.vlm.decoding import Prefill
from probe_kit.models.packing import Packed
from probe_kit.models.prismatic import Decoded, PictureSettings, prepare_picture

DEFAULT_CHECKPOINT = "TRI-ML/prismatic-vlms/prism-dinosiglip-224px+7b"
CAMERA = "primary"
_TOKENIZER_FILES = ("tokenizer.json", "tokenizer_config.json")
_PROMPT, _LAST = slice(None, -1), slice(-1, None)


class PrismaticModel(Model):
    """A loaded network of this kind: looks at a picture, reads a prompt, puts out `steps` greedy tokens."""

    family: ClassVar[str]
    output: ClassVar[str]
    """The stream of the positions that choose the output."""

    def __init__(self, loaded: LoadedPrismatic, steps: int, tokenizer: str | None = None) -> None:
        self.loaded, self.network, self.config = loaded, loaded.network, loaded.config
        self.steps, self._chosen_tokenizer = steps, tokenizer
        self.decoder: Any = self.network.language_model.model
        layers, width = len(self.decoder.layers) + 1, int(self.config.text.hidden_size)
        heads = int(self.config.text.num_attention_heads)
        self.streams = {
            "backbone": Stream("backbone", layers, width, heads=heads),
            self.output: Stream(self.output, layers, width, steps, part="action", heads=heads),
        }
        self.further_streams = {
            name: Stream(name, len(tower.blocks), int(tower.embed_dim), part="vision", quantities=("residual",))
            for name, tower in self._towers.items()
        }
        self.role_names = {
            "backbone": (f"image.{CAMERA}", "language", "special", PADDING),
            self.output: (self.output,),
        }
        self.card = ModelCard(
            family=self.family,
            checkpoint=loaded.checkpoint,
            weights_sha256=loaded.audit.sha256,
            random_weights=loaded.audit.random,
            parameters=loaded.audit.parameters,
            dtype=loaded.dtype,
            device=loaded.device,
            embodiment="",
            cameras=(CAMERA,),
            chunk=0,
            execute=0,
            notes=loaded.notes,
            audit=loaded.audit.to_json(),
            exact=loaded.exact,
            settings=self._settings(tokenizer),
            weights_seed=loaded.weights_seed,
        )

    def _settings(self, tokenizer: str | None) -> dict[str, str]:
        """The content of files beside the weights, and of a tokenizer from elsewhere."""
        files: dict[str, Path] = {}
        for number, folder in enumerate(self.loaded.folders):
            files |= side_files(folder, "" if number == len(self.loaded.folders) - 1 else "adapter/")
        if self.loaded.text is not None:
            files |= side_files(self.loaded.text, "tokenizer/")
        if tokenizer is not None and Path(tokenizer).is_dir():
            files |= side_files(Path(tokenizer), "tokenizer/")
        return {**content_hashes(files), "tokenizer": tokenizer or "the checkpoint's", "steps": str(self.steps)}

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def pictures(self) -> PictureSettings:
        """The settings of resizing and normalising pictures."""
        return PictureSettings.of(self.config, self.loaded.folders[-1])

    def pixel_values(self, images: Iterable[NDArray[np.uint8]]) -> Tensor:
        """(B, 3 per tower, S, S) float32 of (H, W, 3) uint8 pictures. Raises ObservationError."""
        rows = [prepare_picture(checked_picture(image), self.pictures) for image in images]
        return torch.from_numpy(np.stack(rows)).to(self.loaded.device)

    @cached_property
    def tokenizer(self) -> TextTokenizer:
        """The checkpoint's. Raises CheckpointError naming the files that are missing."""
        text = self.config.text
        return find_tokenizer(
            self.loaded.text_folders, self._chosen_tokenizer, text.bos_token_id, self.config.action_vocabulary
        )

    @abstractmethod
    def prompt(self, instruction: str) -> list[int]:
        """Ids of a whole prompt."""

    def pack(self, rows: Sequence[Sequence[int]]) -> Packed:
        """Prompts of ids as a batch. Raises InstructionError for one that is too long, CheckpointError for ids
        the model does not have.
        """
        limit = int(self.config.text.max_position_embeddings)
        for row in rows:
            if (length := self.network.patches + len(row) + self.steps) > limit:
                raise InstructionError(f"a prompt makes {length} positions; this model has {limit}. Shorten it")
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
        """`steps` tokens behind every prompt, greedy by default; one inference, as `capture` counts it."""
        packed = self.pack(rows)
        device = self.loaded.device
        with torch.inference_mode():
            return self.network.decode(
                packed.ids.to(device), packed.mask.to(device), pixel_values, self.steps, choose
            )

    # -- capture -----------------------------------------------------------------------------------------

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Beginning of sequence, patches, text; padding behind it where another prompt is longer."""
        rows = [self.prompt(observation.instruction) for observation in observations]
        longest, special, patches = max(map(len, rows)), self.tokenizer.special, self.network.patches
        image = [f"image.{CAMERA}"] * patches
        backbone = []
        for first, *text, _ in rows:
            labels = ["special" if number in special else "language" for number in (first, *text)]
            labels[1:1] = image
            labels += [PADDING] * (patches + longest - 1 - len(labels))
            backbone.append(Roles.from_labels(labels))
        return {"backbone": backbone, self.output: [Roles.from_labels([self.output])] * len(rows)}

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each whole prompt."""
        return [tuple(self.prompt(instruction)) for instruction in instructions]

    def patch_order(self) -> NDArray[np.int64]:
        """A token per patch, row by row, behind the tower's class and register tokens."""
        prefix = int(self._towers["vision"].num_prefix_tokens)
        return np.concatenate([np.full(prefix, -1), np.arange(self.network.patches)])

    def tap(self, site: Site) -> Tap:
        """The first norm of the block the site enters, the final norm, or a block's output.

        A tower's last residual is what the projector reads, class and register tokens in front.
        """
        stream = self.stream_of(site)
        if stream is self.prompt_kv:
            return kv_tap(self.network.prompt_kv, site, ALL_BUT_LAST)
        if stream.part == "vision":
            return Tap(self._towers[site.stream].blocks[site.layer].norm1, 1)
        tokens = _PROMPT if site.stream == "backbone" else _LAST
        return decoder_tap(self.decoder.layers, self._final_norm, site, self.steps, tokens)

    @property
    def unembedding(self) -> Unembedding:
        """The language model's final norm and head."""
        return Unembedding.of_decoder(("backbone", self.output), self.network.language_model, self._final_norm)

    @property
    def _final_norm(self) -> nn.Module:
        norm: nn.Module = getattr(self.decoder, "norm", None) or self.decoder.final_layernorm
        return norm

    @property
    def _towers(self) -> dict[str, Any]:
        return dict(zip(("vision", "vision_fused"), self.network.vision_backbone.towers, strict=False))


class Prismatic(PrismaticModel, AnswerModel):
    """A loaded Prismatic vision-language model: answers in text."""

    family: ClassVar[str] = "prismatic"
    output: ClassVar[str] = "answer"

    @property
    def lead(self) -> str:
        """A space, as words begin with one behind every frame; none for bytes, where it is a token of its own."""
        return "" if isinstance(self.tokenizer, ByteTokenizer) else " "

    def _settings(self, tokenizer: str | None) -> dict[str, str]:
        return {**super()._settings(tokenizer), "frame": self.frame.around("[question]")}

    @cached_property
    def frame(self) -> TextFrame:
        """The text around a question with which the language model was trained."""
        return frame_of(self.config.language_id)

    def prompt(self, instruction: str) -> list[int]:
        """Ids of a question in the frame around it."""
        return self.tokenizer.encode(self.frame.around(instruction))

    def read(self, questions: Sequence[Prompt]) -> Reading:
        """One prefill; see the contract. Raises UsageError if the model was loaded for more than one step."""
        if self.steps != 1:
            raise UsageError(
                f"a question is one prefill; this model takes {self.steps} steps. Load it with steps=1"
            )
        texts = [self._framed(question) for question in questions]
        options = [
            [id_behind(self.tokenizer, text, option) for option in question.options]
            for text, question in zip(texts, questions, strict=True)
        ]
        prefill = self.prefill(questions)
        return Reading.of(prefill.logits.float().cpu().numpy(), options, prefill)

    def prefill(self, questions: Sequence[Prompt]) -> Prefill:
        """One pass over all questions."""
        self.check([question.observation for question in questions])
        pixels = None
        if self.shows_pictures(questions):
            pixels = self.pixel_values(question.observation.image for question in questions)
        decoded = self.generate(pixels, [self.tokenizer.encode(self._framed(question)) for question in questions])
        return Prefill(
            self.network.language_model, decoded.mask.long(), decoded.last, decoded.logits[:, 0], decoded.cache
        )

    def _framed(self, question: Prompt) -> str:
        return self.frame.around(question.text) + question.begun

    def roles(self, observations: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Roles of the observations' instructions as questions."""
        return self.asked_roles([Prompt(observation, observation.instruction) for observation in observations])

    def asked_roles(self, questions: Sequence[Prompt]) -> dict[str, list[Roles]]:
        """Everything around picture and question is `special`, how an answer has begun too."""
        patches = self.network.patches if self.shows_pictures(questions) else 0
        image = [f"image.{CAMERA}"] * patches
        rows = []
        for question in questions:
            inside = self.tokenizer.inside(self._framed(question), *self.frame.question_span(question.text))
            labels = ["language" if is_question else "special" for is_question in inside]
            rows.append([*labels[:1], *image, *labels[1:-1]])
        longest = max(map(len, rows))
        backbone = [Roles.from_labels(labels + [PADDING] * (longest - len(labels))) for labels in rows]
        return {"backbone": backbone, self.output: [Roles.from_labels([self.output])] * len(rows)}

    def speak(self, reading: Reading, tokens: int) -> list[str]:
        """Greedy text from the keys and values of the prompt on; see the contract. Raises UsageError."""
        if not isinstance(reading.state, Prefill) or reading.state.network is not self.network.language_model:
            raise UsageError("this reading does not come from this model; pass what its read() returned")
        with torch.inference_mode():
            ids = reading.state.speak(tokens, self.ends)
        answers = [list(takewhile(lambda number: number not in self.ends, row)) for row in ids.tolist()]
        return [self.tokenizer.decode(row) for row in answers]

    @cached_property
    def ends(self) -> frozenset[int]:
        """Ids that end an answer."""
        end = self.config.text.eos_token_id
        return frozenset(int(number) for number in (end if isinstance(end, list) else [end]) if number is not None)


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
    tokenizer: folder of another tokenizer, or `bytes`. bits: 8 or 4, see `load_checkpoint`. steps: greedy tokens
    per inference. Raises what `load_checkpoint` raises.
    """
    loaded = load_checkpoint(checkpoint or DEFAULT_CHECKPOINT, device, dtype, random_weights, bits, weights_seed)
    elsewhere = loaded.config.tokenizer_id
    if (
        tokenizer is None
        and elsewhere
        and not any((folder / "tokenizer.json").is_file() for folder in loaded.folders)
    ):
        loaded = replace(loaded, text=checkpoint_folder(elsewhere, _TOKENIZER_FILES))
    return Prismatic(loaded, steps, tokenizer)
