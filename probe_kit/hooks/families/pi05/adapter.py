"""The adapter for pi0.5.

Prefix: every camera's patches, then a prompt with the instruction and the state as digits.
Suffix: the action chunk, with the time of the flow step in the expert's adaptive norms.

Source: arXiv 2504.16054, through lerobot's `PI05Policy`.
"""

import re
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from torch import Tensor, nn

from probe_kit.hooks.contract.model import Tap
from probe_kit.hooks.contract.sites import Site
from probe_kit.hooks.contract.views import PADDING
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.hooks.families.shared.lerobot.evaluation import Evaluation, Picture
from probe_kit.hooks.families.shared.lerobot.stacks import Stack
from probe_kit.models.lerobot.pi0 import Pi0Size
from probe_kit.models.lerobot.pi0_keys import current_pi05_keys
from probe_kit.models.lerobot.pi05 import build_pi05

BINS = np.linspace(-1, 1, 256 + 1)[:-1]
"""Lower edges of the 256 bins of a normalised state."""
_PROMPT = re.compile(
    r"Task: ?(?P<language>.*), ?State: ?(?P<state>[-\d ]*); ?\n? ?Action:", re.DOTALL | re.IGNORECASE
)


def digits(state: NDArray[np.float32]) -> list[str]:
    """(B, numbers) normalised to the numbers of their bins: 0 to 255, and -1 below the range."""
    return [" ".join(map(str, row)) for row in np.digitize(state, BINS) - 1]


class GatedStack(Stack):
    """The expert, whose blocks add what they compute through a gate."""

    def tap(self, site: Site) -> Tap:
        """What a block adds is read behind its gate."""
        if site.quantity in ("attention", "mlp") and site.layer < len(self.layers):
            return Tap(getattr(self.layers[site.layer], f"{site.quantity}_gate"), self.iterations or 1, "output")
        return super().tap(site)


class Pi05(Pi0):
    """A loaded pi0.5."""

    family = "pi05"
    config_type = "pi05"

    other_roles = ("language", "state", "special")
    suffix_roles = ("action",)

    @classmethod
    def network_of(cls, config: Any, size: Pi0Size | None) -> nn.Module:
        """lerobot's policy of this size."""
        network: nn.Module = build_pi05(config, size)
        return network

    @classmethod
    def current_keys(cls, tensors: Mapping[str, Tensor]) -> dict[str, Tensor]:
        """Older names brought to today's."""
        return current_pi05_keys(tensors)

    def _stacks(self) -> dict[str, Stack]:
        stacks = super()._stacks()
        return {**stacks, "expert": GatedStack(**vars(stacks["expert"]))}

    def suffix_labels(self) -> list[str]:
        """The chunk."""
        return ["action"] * self.config.chunk_size

    def prompts(self, instructions: Sequence[str], state: NDArray[np.float32]) -> list[str]:
        """As lerobot's `Pi05PrepareStateTokenizerProcessorStep` words it."""
        tasks = [text.strip().replace("_", " ").replace("\n", " ") for text in instructions]
        return [f"Task: {task}, State: {own};\nAction: " for task, own in zip(tasks, digits(state), strict=True)]

    def text_labels(self, ids: Sequence[int], valid: Sequence[bool]) -> list[str]:
        """The instruction is `language`, the digits are `state`, and the words around them are `special`."""
        special = frozenset(self.tokenizer.all_special_ids)
        pieces = [
            "" if one in special or not kept else piece.replace("\u2581", " ")
            for one, kept, piece in zip(ids, valid, self.tokenizer.convert_ids_to_tokens(list(ids)), strict=True)
        ]
        ends = np.cumsum([len(piece) for piece in pieces])
        labels = ["special" if kept else PADDING for kept in valid]
        if (found := _PROMPT.search("".join(pieces))) is None:
            return labels
        for role in ("language", "state"):
            first, last = found.span(role)
            for position, (piece, end) in enumerate(zip(pieces, ends, strict=True)):
                if piece and end - len(piece) < last and end > first:
                    labels[position] = role
        return labels

    def token_ids(self, instructions: Sequence[str]) -> list[tuple[int, ...]]:
        """The ids of each prompt without padding and without the digits, which change at every inference."""
        tokens, mask = self.tokenise(instructions)
        rows = zip(tokens.tolist(), mask.tolist(), strict=True)
        return [
            tuple(
                one for one, label in zip(ids, self.text_labels(ids, valid), strict=True) if label not in _LEFT_OUT
            )
            for ids, valid in rows
        ]


_LEFT_OUT = (PADDING, "state")


def load_pi05(
    checkpoint: str,
    device: str = "cpu",
    dtype: str | None = None,
    random_weights: bool = False,
    *,
    statistics: str | None = None,
    picture: Picture | None = None,
    openness: str = "measured",
    weights_seed: int = 0,
) -> Pi05:
    """Load a lerobot pi0.5 checkpoint; see `LerobotFlow.load`. statistics, picture, openness: see `Evaluation`."""
    return Pi05.load(
        checkpoint, device, dtype, random_weights, weights_seed, Evaluation(statistics, picture, openness)
    )


def check_pi05_words(checkpoint: str, instructions: Sequence[str], **_: Any) -> None:
    """See `Family.words`."""
    Pi05.check_words(checkpoint, instructions)
