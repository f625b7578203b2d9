"""A text answer of Magma, decoded token by token."""

from typing import Any

import numpy as np
import torch
from torch import Tensor

from probe_kit.models.magma import Decoded, greedy


class Answer:
    """The tokens of an answer so far, one (B,) tensor each, and the state from which decoding continues."""

    def __init__(self, decoded: Decoded) -> None:
        self.ids: list[Tensor] = list(decoded.ids.unbind(dim=1))
        self._decoding = decoded.decoding

    def over(self, ends: frozenset[int]) -> bool:
        """Whether every row has ended its turn."""
        spoken = torch.stack(self.ids, dim=1).cpu().numpy()
        return bool(np.isin(spoken, list(ends)).any(axis=1).all())

    def advance(self, unhooked: Any) -> None:
        """One more greedy token per row."""
        self.ids.append(greedy(self._decoding.feed(self.ids[-1], unhooked)))
