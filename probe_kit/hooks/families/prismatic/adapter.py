"""The adapter for Prismatic vision-language models: packing, streams, taps, roles. OpenVLA builds on it.

One stack serves two streams, told apart by position: `backbone` is the prompt without its last token, the other
one the positions whose logits choose the output: the prompt's last token, then every token fed back but the last.
"""

from abc import abstractmethod
from collections.abc import Iterable, Sequence
from functools import cached_property
from itertools import takewhile
from pathlib import Path
from typing import Any, ClassVar

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.card import Card
from probe_kit.hooks.checkpoint import content_hashes, side_files
from probe_kit.hooks.families.prismatic.checkpoint import LoadedPrismatic, load_checkpoint
from probe_kit.hooks.families.prismatic.tokenizer import ByteTokenizer, TextTokenizer, find_tokenizer, id_behind
from probe_kit.hooks.model import Model, Question, Reader, Reading, Tap
from probe_kit.hooks.observation import Observation, checked_picture
from probe_kit.hooks.roles import Roles
from probe_kit.hooks.sites import Site, Stream
from probe_kit.hooks.views import PADDING
from probe_kit.models.packing import Packed
from probe_kit.models.prismatic import Decoded, PictureSettings, prepare_picture

CAMERA = "primary"
# The frame around a question that prism-dinosiglip-224px+7b and its siblings without a chat were trained with.
_FRAME = "In: {}\nOut:"
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
        self.streams = {
            "backbone": Stream("backbone", layers, width),
            self.output: Stream(self.output, layers, width, steps, part="action"),
        }
        self.further_streams = {
            name: Stream(name, len(tower.blocks), int(tower.embed_dim), part="vision", quantities=("residual",))
            for name, tower in self._towers.items()
        }
        self.role_names = {
            "backbone": (f"image.{CAMERA}", "language", "special", PADDING),
            self.output: (self.output,),
        }
        self.card = Card(
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
        """By content: what lies beside the weights, and a tokenizer from elsewhere."""
        files: dict[str, Path] = {}
        for number, folder in enumerate(self.loaded.folders):
            files |= side_files(folder, "" if number == len(self.loaded.folders) - 1 else "adapter/")
        if tokenizer is not None and Path(tokenizer).is_dir():
            files |= side_files(Path(tokenizer), "tokenizer/")
        return {**content_hashes(files), "tokenizer": tokenizer or "the checkpoint's", "steps": str(self.steps)}

    # -- inputs ------------------------------------------------------------------------------------------

    @cached_property
    def pictures(self) -> PictureSettings:
        """How pictures are resized and normalised."""
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
            self.loaded.folders, self._chosen_tokenizer, text.bos_token_id, self.config.action_vocabulary
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

    def generate(self, pixel_values: Tensor | None, rows: Sequence[Sequence[int]]) -> Decoded:
        """`steps` greedy tokens behind every prompt; one inference, as `capture` counts it."""
        packed = self.pack(rows)
        device = self.loaded.device
        with torch.inference_mode():
            return self.network.decode(packed.ids.to(device), packed.mask.to(device), pixel_values, self.steps)

    # -- listening ---------------------------------------------------------------------------------------

    def roles(self, seen: Sequence[Observation]) -> dict[str, list[Roles]]:
        """Beginning of sequence, patches, text; padding behind it where another prompt is longer."""
        return self._roles([self.prompt(observation.instruction) for observation in seen], self.network.patches)

    def _roles(self, rows: Sequence[Sequence[int]], patches: int) -> dict[str, list[Roles]]:
        longest, special = max(map(len, rows)), self.tokenizer.special
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

    def tap(self, site: Site) -> Tap:
        """The first norm of the block the site enters, the final norm, or a block's output.

        A tower's last residual is what the projector reads, class and register tokens in front.
        """
        if self.stream_of(site).part == "vision":
            return Tap(self._towers[site.stream].blocks[site.layer].norm1, 1)
        return self._language_tap(site)

    def _language_tap(self, site: Site) -> Tap:
        tokens = _PROMPT if site.stream == "backbone" else _LAST
        norm: nn.Module = getattr(self.decoder, "norm", None) or self.decoder.final_layernorm
        if site.quantity == "final_norm":
            return Tap(norm, self.steps, "output", tokens)
        if site.layer == len(self.decoder.layers):
            return Tap(norm, self.steps, tokens=tokens)
        block = self.decoder.layers[site.layer]
        if site.quantity == "mlp":
            return Tap(block.mlp, self.steps, "output", tokens)
        if site.quantity == "attention":
            projection = getattr(block.self_attn, "o_proj", None) or block.self_attn.dense
            return Tap(projection, self.steps, "output", tokens)
        return Tap(block.input_layernorm, self.steps, tokens=tokens)

    @property
    def _towers(self) -> dict[str, Any]:
        return dict(zip(("vision", "vision_fused"), self.network.vision_backbone.towers, strict=False))


class Prismatic(PrismaticModel, Reader):
    """A loaded Prismatic vision-language model: answers in text."""

    family: ClassVar[str] = "prismatic"
    output: ClassVar[str] = "answer"

    @property
    def lead(self) -> str:
        """A space, as behind "Out:" words begin with one; none for bytes, where it would be a token of its own."""
        return "" if isinstance(self.tokenizer, ByteTokenizer) else " "

    def prompt(self, instruction: str) -> list[int]:
        """Ids of a question in the frame around it."""
        return self.tokenizer.encode(_FRAME.format(instruction))

    def read(self, questions: Sequence[Question]) -> Reading:
        """One prefill; see the contract. Raises UsageError if the model was loaded for more than one step."""
        if self.steps != 1:
            raise UsageError(
                f"a question is one prefill; this model takes {self.steps} steps. Load it with steps=1"
            )
        self.check([question.seen for question in questions])
        texts = _asked(questions)
        rows = [self.tokenizer.encode(text) for text in texts]
        options = [
            [id_behind(self.tokenizer, text, option) for option in question.options]
            for text, question in zip(texts, questions, strict=True)
        ]
        pixels = None
        if self.shows_pictures(questions):
            pixels = self.pixel_values(question.seen.image for question in questions)
        logits = self.generate(pixels, rows).logits[:, 0].float().cpu()
        return Reading.of(logits.numpy(), options, (pixels, rows))

    def asked_roles(self, questions: Sequence[Question]) -> dict[str, list[Roles]]:
        """As `roles`; how an answer has begun is language too."""
        rows = [self.tokenizer.encode(text) for text in _asked(questions)]
        return self._roles(rows, self.network.patches if self.shows_pictures(questions) else 0)

    def speak(self, reading: Reading, tokens: int) -> list[str]:
        """Greedy text behind every prompt, up to its end-of-sequence token; see the contract."""
        pixels, rows = reading.state
        if tokens < 1:
            return [""] * len(rows)
        packed, device = self.pack(rows), self.loaded.device
        with torch.inference_mode():
            decoded = self.network.decode(packed.ids.to(device), packed.mask.to(device), pixels, tokens)
        end = self.config.text.eos_token_id
        spoken = [list(takewhile(lambda number: number != end, row)) for row in decoded.ids.tolist()]
        return [self.tokenizer.decode(row) for row in spoken]


def _asked(questions: Sequence[Question]) -> list[str]:
    return [_FRAME.format(question.text) + question.begun for question in questions]


def load_prismatic(
    checkpoint: str | None,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    tokenizer: str | None = None,
    bits: int | None = None,
    steps: int = 1,
    weights_seed: int = 0,
) -> Prismatic:
    """Load a Prismatic model in the layout of `PrismaticForConditionalGeneration`, from a folder or hub id.

    tokenizer: folder of another tokenizer, or `bytes`. bits: 8 or 4, see `load_checkpoint`. steps: greedy tokens
    per inference. Raises UsageError without a checkpoint, and what `load_checkpoint` raises.
    """
    if checkpoint is None:
        raise UsageError("prismatic has no default checkpoint; pass a folder or hub id as --checkpoint")
    loaded = load_checkpoint(checkpoint, device, dtype, random_weights, bits, weights_seed)
    return Prismatic(loaded, steps, tokenizer)
