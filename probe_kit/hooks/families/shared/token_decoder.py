"""Base of native models whose language model writes tokens after a prompt: streams, taps, roles, sampling."""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from pathlib import Path
from types import MappingProxyType
from typing import Any, ClassVar

import torch
from torch import Tensor, nn

from probe_kit._system.bounded_files import read_json_object
from probe_kit._system.table_cells import is_count
from probe_kit.errors import CheckpointError, InstructionError, UsageError
from probe_kit.hooks.checkpoints.checkpoint import GENERATION_FILE
from probe_kit.hooks.contract.model import Model, Tap, Unembedding
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import IMAGE_ROLE, PADDING, Site, Stream
from probe_kit.hooks.families.shared.loading import Loaded
from probe_kit.hooks.families.shared.taps import ALL_BUT_LAST, LAST, Note, decoder_attention, decoder_tap, kv_tap
from probe_kit.models.decoding import Choose, greedy

# What `generate` of transformers 4 keeps of the distribution by default.
TOP = 50
ALL, CHECKPOINT = "all", "checkpoint"
# Settings of generation that shape the draw and are not followed here, with the values that change nothing.
_NEUTRAL = {
    "top_p": 1, "min_p": 0, "typical_p": 1, "epsilon_cutoff": 0, "eta_cutoff": 0, "repetition_penalty": 1,
    "no_repeat_ngram_size": 0, "num_beams": 1,
}  # fmt: skip


def chooser(temperature: float, seeds: Sequence[int], top: int | None = TOP, among: range | None = None) -> Choose:
    """Return a function that chooses tokens: greedy for temperature 0; else it draws, each row by its own seed.

    Args:
        temperature: Divides the logits before the softmax; 0 takes the likeliest token.
        seeds: One per row.
        top: Draw from so many of the likeliest only, and from those as likely as the last of them, as `generate`
            does; None from all.
        among: Draw from these ids only; None from all.

    Raises:
        UsageError: For a negative or non-finite temperature.
    """
    if not 0 <= temperature < float("inf"):
        raise UsageError(f"temperature is {temperature}; expected 0 for the likeliest token, or a positive number")
    if temperature == 0:
        return greedy
    # On the CPU, one per row: draws do not depend on the device, nor on the other rows of a batch.
    generators = [torch.Generator().manual_seed(seed % 2**63) for seed in seeds]

    def draw(logits: Tensor) -> Tensor:
        first, end = (0, logits.shape[-1]) if among is None else (among.start, among.stop)
        offered = logits[:, first:end].float().cpu()
        rows = [
            _draw(row, temperature, top, generator) for row, generator in zip(offered, generators, strict=True)
        ]
        return (torch.stack(rows) + first).to(logits.device)

    return draw


def seeded_noise(seeds: Sequence[int], shape: tuple[int, ...], device: str) -> Tensor:
    """Return (B, *shape) float32 standard normal numbers, a row per seed, the same on every device."""
    rows = [torch.randn(shape, generator=torch.Generator().manual_seed(seed)) for seed in seeds]
    return torch.stack(rows).to(device)


def _draw(logits: Tensor, temperature: float, top: int | None, generator: torch.Generator) -> Tensor:
    count = logits.shape[0]
    if top is not None and top < count:  # ties with the last of them stay in
        count = int((logits >= logits.topk(top).values[-1]).sum())
    best, ids = logits.topk(count)
    drawn = torch.multinomial(torch.softmax(best / temperature, dim=0), 1, generator=generator)
    return ids[drawn[0]]


def top_of(top_k: str, folders: Sequence[Path]) -> int | None:
    """The number of likeliest ids to draw from; None for all.

    Args:
        top_k: A number, `all`, or `checkpoint`: what its generation_config.json says, else `TOP`, as `generate` of
            transformers 4 does it.
        folders: Where that file may lie, the first one before the others.

    Raises:
        UsageError: For another word.
        CheckpointError: For a file that shapes the draw by other settings too.
    """
    if top_k == ALL:
        return None
    if top_k == CHECKPOINT:
        file = next((folder / GENERATION_FILE for folder in folders if (folder / GENERATION_FILE).is_file()), None)
        return TOP if file is None else _stored_top(file)
    if not is_count(top_k) or int(top_k) < 1:
        raise UsageError(f"top_k is {top_k!r}; expected a number from 1 on, {ALL} or {CHECKPOINT}")
    return int(top_k)


def _stored_top(file: Path) -> int | None:
    values = read_json_object(file, CheckpointError, "Download the checkpoint again")
    unfollowed = {
        name: values[name] for name, neutral in _NEUTRAL.items() if values.get(name) not in (None, neutral)
    }
    top = values.get("top_k", TOP)
    if unfollowed or not (top is None or (isinstance(top, int) and not isinstance(top, bool) and top >= 0)):
        settings = ", ".join(f"{name} {value!r}" for name, value in (unfollowed or {"top_k": top}).items())
        raise CheckpointError(
            f"{file} asks for {settings}; only a whole top_k is followed here. Use temperature 0, or another -M "
            "top_k where the family has that option"
        )
    return top or None


# -- the decoder ----------------------------------------------------------------------------------------------


class TokenDecoder(Model):
    """A model with two streams in one stack, by position.

    `backbone` is the prompt without its last token. `output` are the positions whose logits choose a token: the
    prompt's last token, then every token that is fed back but the last.
    """

    output: ClassVar[str] = "action"
    picture_roles: ClassVar[tuple[str, ...]] = (IMAGE_ROLE,)
    """The roles of the positions of a picture."""
    added: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """The paths of submodules by quantity, see `decoder_tap`."""

    def __init__(self, loaded: Loaded[Any], steps: int, captured: int | None = None) -> None:
        """Make the streams of a model.

        Args:
            loaded: The network, with what loading proved.
            steps: Tokens per inference.
            captured: Count of the tokens that `output` captures; None for all.
        """
        self.loaded, self.network, self.steps = loaded, loaded.network, steps
        self.config = config = loaded.network.config
        self.decoder: Any = self.network.language_model.model
        layers, width = len(self.decoder.layers) + 1, int(config.text.hidden_size)
        heads = int(config.text.num_attention_heads)
        # The last token is fed back by nothing, so that there are as many positions as tokens.
        self.streams = {
            "backbone": Stream("backbone", layers, width, heads=heads),
            self.output: Stream(self.output, layers, width, captured or steps, part="action", heads=heads),
        }
        self.role_names = {
            "backbone": (*self.picture_roles, "language", "special", PADDING),
            self.output: (self.output,),
        }

    def vision_tap(self, site: Site) -> Tap:
        """Return the tap of a site of a vision tower."""
        raise NotImplementedError

    def tap(self, site: Site) -> Tap:
        """Return the first norm of the block the site enters, the final norm, or what a block adds.

        Sites of a vision tower have the tap that `vision_tap` gives.
        """
        stream = self.stream_of(site)
        if stream is self.prompt_kv:
            return kv_tap(self.network.prompt_kv, site, ALL_BUT_LAST)
        if stream.part == "vision":
            return self.vision_tap(site)
        tokens = ALL_BUT_LAST if site.stream == "backbone" else LAST
        return decoder_tap(self.decoder.layers, self.final_norm, site, self.steps, added=self.added, tokens=tokens)

    def roles_of(self, rows: Sequence[Sequence[str]]) -> dict[str, list[Roles]]:
        """The roles of a batch; `rows` are labels of the backbone's positions, padded behind to the longest."""
        return {"backbone": Roles.padded(rows), self.output: [Roles.from_labels([self.output])] * len(rows)}

    @property
    def final_norm(self) -> nn.Module:
        """The norm behind the last block, which Phi calls otherwise."""
        norm: nn.Module = getattr(self.decoder, "norm", None) or self.decoder.final_layernorm
        return norm

    @property
    def unembedding(self) -> Unembedding:
        """The language model's final norm and head."""
        return Unembedding.of_decoder(("backbone", self.output), self.network.language_model, self.final_norm)

    def record_attention(self, note: Note) -> AbstractContextManager[None]:
        """Record attention that is computed once more for the position that chooses a token."""
        return decoder_attention(self.decoder.layers, note)

    @property
    def positions(self) -> int:
        """The most positions of a prompt and its output."""
        return int(self.config.text.max_position_embeddings)

    def check_length(self, prompt: int) -> None:
        """Raise InstructionError for a prompt of so many positions that no room is left for the output."""
        if (length := prompt + self.steps) > self.positions:
            raise InstructionError(
                f"a prompt makes {length} positions; this model has {self.positions}. Shorten it"
            )


def warn_of_unknown() -> None:
    """Warn of ids that name no action, in the same words at every step, so that a run says it once."""
    warnings.warn(
        "the model put out tokens that name no action; they count as the nearest bin, as in the original "
        "software, and the step as flagged. Random weights do this; if trained ones do, prompt or tokenizer "
        "are wrong",
        stacklevel=3,
    )
