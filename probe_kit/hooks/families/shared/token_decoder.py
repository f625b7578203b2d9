"""Base of native models whose language model chooses tokens behind a prompt: streams, taps, roles, length."""

import warnings
from collections.abc import Mapping, Sequence
from contextlib import AbstractContextManager
from types import MappingProxyType
from typing import Any, ClassVar

from torch import nn

from probe_kit.errors import InstructionError
from probe_kit.hooks.contract.model import Model, Tap
from probe_kit.hooks.contract.roles import Roles
from probe_kit.hooks.contract.sites import Site, Stream
from probe_kit.hooks.contract.unembedding import Unembedding
from probe_kit.hooks.contract.views import IMAGE_ROLE, PADDING
from probe_kit.hooks.families.shared.attention_weights import Note, of_decoder
from probe_kit.hooks.families.shared.decoder_tap import decoder_tap
from probe_kit.hooks.families.shared.network_loading import Loaded
from probe_kit.hooks.families.shared.prompt_kv import ALL_BUT_LAST, LAST, kv_tap


class TokenDecoder(Model):
    """A model with two streams in one stack, by position.

    `backbone` is the prompt without its last token. `output` are the positions whose logits choose a token: the
    prompt's last token, then every token that is fed back but the last.
    """

    output: ClassVar[str] = "action"
    picture_roles: ClassVar[tuple[str, ...]] = (IMAGE_ROLE,)
    """What the positions of a picture hold."""
    added: ClassVar[Mapping[str, str]] = MappingProxyType({})
    """See `decoder_tap`."""

    def __init__(self, loaded: Loaded[Any], steps: int, captured: int | None = None) -> None:
        """steps: tokens per inference. captured: those that `output` captures, all by default."""
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
        """The first norm of the block the site enters, the final norm, or what a block adds; see `vision_tap`."""
        stream = self.stream_of(site)
        if stream is self.prompt_kv:
            return kv_tap(self.network.prompt_kv, site, ALL_BUT_LAST)
        if stream.part == "vision":
            return self.vision_tap(site)
        tokens = ALL_BUT_LAST if site.stream == "backbone" else LAST
        return decoder_tap(self.decoder.layers, self.final_norm, site, self.steps, tokens, added=self.added)

    def roles_of(self, rows: Sequence[Sequence[str]]) -> dict[str, list[Roles]]:
        """The roles of a batch. rows: labels of the backbone's positions, padded behind to the longest."""
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
        """Computed once more for the position that chooses a token."""
        return of_decoder(self.decoder.layers, note)

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
