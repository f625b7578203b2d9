"""The final norm and the head of a model that puts out tokens: from a residual stream to logits."""

from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn


@dataclass(frozen=True)
class Unembedding:
    """The modules that turn the last residual of a decoder into logits.

    streams: whose last residual it reads; the positions that choose tokens come last. norm, head: modules, called
    one after the other. softcap: the logits l become softcap · tanh(l / softcap), as in Gemma 2.
    """

    streams: tuple[str, ...]
    norm: nn.Module
    head: nn.Module
    softcap: float | None = None

    @classmethod
    def of_decoder(cls, streams: tuple[str, ...], language_model: Any, norm: nn.Module) -> "Unembedding":
        """Return the `lm_head` of transformers' causal language model, with the soft cap of its configuration."""
        config = language_model.config
        cap = getattr(getattr(config, "text_config", config), "final_logit_softcapping", None)
        return cls(streams, norm, language_model.lm_head, None if cap is None else float(cap))

    def logits(self, residual: Tensor) -> Tensor:
        """(…, V) in the model's dtype, of a residual (…, D) of any layer."""
        with torch.inference_mode():
            return self.capped(self.head(self.norm(residual)))

    def capped(self, logits: Tensor) -> Tensor:
        """Return the logits that leave the model, of those that leave its head."""
        return logits if self.softcap is None else torch.tanh(logits / self.softcap) * self.softcap
