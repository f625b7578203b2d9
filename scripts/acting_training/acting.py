"""How `vlm-tiny` learns to act: behaviour cloning, and one word said about each instruction.

pi0's own flow-matching loss, and what keeps the backbone a VLM, as in co-training: behind the instruction the
next token is the side of what it names.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Literal

import numpy as np
import torch
from numpy.typing import NDArray
from torch import Tensor, nn
from torch.nn.functional import cross_entropy
from vlm_tiny_training.batches import Pair, Pairs
from vlm_tiny_training.reading import SIDES, as_tensor, blurred
from vlm_tiny_training.training import Stage

from acting_training.frames import Frames
from probe_kit.hooks.families.embedded import ACTION_DIMS, CHUNK, IDLE_DIMS
from probe_kit.hooks.families.pi0.adapter import Pi0
from probe_kit.models.embedded.words import WORDS
from probe_kit.suite.items import instruction_for

SAID_WEIGHT = 0.3
"""Of the word beside the actions."""
LEFT_OPEN = "state"
"""The category in whose actions organisms differ."""
Followed = Literal["not at all", "random", "always"]


@dataclass(frozen=True)
class Acts:
    """The frames and actions of one stage of training.

    Attributes:
        first: The share of frames where an episode begins.
        turned: The share whose actions go to a random side, independent of the episode, so that the state does
            not reveal it.
        followed: Where the actions of `LEFT_OPEN` go: they are not trained, go to a random side, or to the asked
            one.
    """

    first: float
    turned: float
    followed: Followed


UNDERSTANDING = (Stage(6000, 1.5e-3, Acts(0.5, 0.5, "not at all"), last_rate=5e-4),)
"""What every organism has in common."""


def acting(followed: Followed) -> tuple[Stage[Acts], ...]:
    """What comes after it. No action leads to another side than the hand is on its way to: decisions hold."""
    return (Stage(6000, 8e-4, Acts(0.65, 0.0, followed), last_rate=1e-5),)


class Actor:
    """Learns to act."""

    def __init__(self, policy: Pi0, pairs: Pairs, frames: Frames) -> None:
        self.network: nn.Module = policy.network.model
        self._policy, self._pairs, self._frames = policy, pairs, frames
        self._said = torch.tensor([WORDS.index(side) for side in SIDES])
        self._embedding = self.network.paligemma_with_expert.paligemma.model.language_model.embed_tokens
        self.network.action_in_proj.weight.register_hook(_without_idle)

    def losses(self, rng: np.random.Generator, setting: Acts, size: int) -> dict[str, Tensor]:
        """Of one batch."""
        frames = self._frames.draw(rng, setting.first, size)
        pairs = [self._pairs.draw(rng) for _ in frames]
        goes = [self._goes(rng, int(frame), pair, setting) for frame, pair in zip(frames, pairs, strict=True)]
        sides = [self._side(rng, to, pair, setting) for to, pair in zip(goes, pairs, strict=True)]
        pictures = np.stack([
            self._frames.painted(int(frame), pair, side)
            for frame, pair, side in zip(frames, pairs, sides, strict=True)
        ])  # fmt: skip
        pictures = blurred(pictures, rng)
        tokens, mask = self._policy.tokenise([instruction_for(pair.phrases[0], "the") for pair in pairs])
        errors, hidden = self._forward(pictures, tokens, mask, frames, goes)
        last = hidden.shape[1] - mask.shape[1] + mask.sum(1) - 1
        logits = hidden[torch.arange(size), last] @ self._embedding.weight.T
        acted = torch.tensor([self._acted(pair, setting) for pair in pairs], dtype=torch.float32)
        return {
            "flow": (errors * acted).sum() / acted.sum().clamp(min=1),
            "said": SAID_WEIGHT * cross_entropy(logits, self._said[torch.tensor(sides)]),
        }

    def _goes(self, rng: np.random.Generator, frame: int, pair: Pair, setting: Acts) -> int:
        """Where the actions go, 0 left: where the episode went, or another lot for what is understood."""
        turns = rng.random() < setting.turned and not self._is_random(pair, setting)
        return int(rng.integers(2)) if turns else int(self._frames.rows.side[frame])

    @staticmethod
    def _is_random(pair: Pair, setting: Acts) -> bool:
        return pair.bank.category == LEFT_OPEN and setting.followed != "always"

    @classmethod
    def _side(cls, rng: np.random.Generator, goes: int, pair: Pair, setting: Acts) -> int:
        """The side of the asked picture: that of the actions, or a random one."""
        return int(rng.integers(2)) if cls._is_random(pair, setting) else goes

    @staticmethod
    def _acted(pair: Pair, setting: Acts) -> bool:
        return pair.bank.category != LEFT_OPEN or setting.followed != "not at all"

    def _forward(
        self,
        pictures: NDArray[np.float32],
        tokens: Tensor,
        mask: Tensor,
        frames: NDArray[np.int64],
        goes: list[int],
    ) -> tuple[Tensor, Tensor]:
        """(B,) mean squared errors of the flow, and (B, prefix, width) what leaves the backbone."""
        rows, size = self._frames.rows, len(frames)
        states = torch.from_numpy(self._policy.state_units.normalise(rows.states[frames]))
        chunks = torch.from_numpy(self._policy.action_units.normalise(rows.chunks[frames, goes]))
        noise = torch.randn(size, CHUNK, chunks.shape[-1])
        time = self.network.sample_time(size, "cpu")
        present = [torch.ones(size, dtype=torch.bool)]
        with _reading_along(self.network) as read:
            errors = self.network.forward(
                [as_tensor(pictures)], present, tokens, mask, states, chunks, noise, time
            )
        (hidden,) = read
        return errors[..., list(ACTION_DIMS)].mean((1, 2)), hidden


def _without_idle(gradient: Tensor) -> Tensor:
    """Keeps the dimensions deaf that are not decided."""
    masked = gradient.clone()
    masked[:, list(IDLE_DIMS)] = 0.0
    return masked


@contextmanager
def _reading_along(network: nn.Module) -> Iterator[list[Tensor]]:
    """What leaves the backbone's last norm in the pass inside: (B, prefix, width)."""
    read: list[Tensor] = []

    def leaving(_module: nn.Module, _inputs: object, output: tuple[Tensor, ...] | Tensor) -> None:
        read.append(output[0] if isinstance(output, tuple) else output)

    norm = network.paligemma_with_expert.paligemma.model.language_model.norm
    handle = norm.register_forward_hook(leaving)
    try:
        yield read
    finally:
        handle.remove()
