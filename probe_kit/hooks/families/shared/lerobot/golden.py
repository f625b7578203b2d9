"""The golden references of lerobot policies: what an adapter gives beside its actions for a comparison."""

from abc import abstractmethod
from typing import Any

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hooks.families.shared.lerobot.packing import LerobotPacking
from probe_kit.hooks.outputs import Arrays, Produce, RecordedRun


class RecordedPolicy(LerobotPacking):
    """The quantities that `verify` compares with those of the original implementation."""

    @abstractmethod
    def replay(self, batch: dict[str, Tensor], recorded: Arrays) -> dict[str, NDArray[Any]]:
        """Return what the network puts out with the randomness of a golden reference.

        These are `actions` (B, chunk, action numbers), and quantities that only this inference has.
        """

    def recorded_modules(self) -> dict[str, nn.Module]:
        """Return modules whose outputs a golden reference holds, by the name of the quantity."""
        return {}

    def watched_inputs(self) -> dict[str, nn.Module]:
        """Return modules whose inputs `further_outputs` reads, by any name."""
        return {}

    def recorded_padding(self, recorded: Arrays) -> NDArray[np.bool_]:
        """Return (B, T): the validity of every backbone position for recorded ids, by the adapter's own roles."""
        tokens, mask = (torch.from_numpy(recorded[name]) for name in ("in_lang_tokens", "in_lang_mask"))
        return np.stack([row.valid for row in self.packed_roles(tokens, mask.bool())["backbone"]])

    def further_outputs(self, run: RecordedRun) -> dict[str, Produce]:
        """Return quantities of a golden reference that only this family has, or has in another form."""
        del run
        return {}
