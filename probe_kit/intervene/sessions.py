"""Replay sessions: a run's policy and observations, set up again to repeat and edit its inferences.

In the scene both layouts of an item are drawn again from the same state. Of other runs a pair is two frames: the
source is the clean frame with one of the inputs of a donor, another frame of another group.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np

from probe_kit.errors import (
    CaptureChangedActionError,
)
from probe_kit.extract.rollout.capturing import FEWEST_FOR_THREADS
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.hooks.checkpoints.third_party import copied, while_acting
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.pairs import Chunk, Given, Pair
from probe_kit.runs.run import Run

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import Policy


FAR = 0.01
"""By how much a number of a repeated first action may differ from the stored one, in its unit.

Batches of another size, threads and GPUs round otherwise. More is another policy or scene.
"""


class Progress(Protocol):
    """Called after every item."""

    def __call__(self, count: int, total: int, what: str, /) -> None:
        """Take items so far, of `total`, and the last one."""


@dataclass(frozen=True)
class ReplaySource:
    """The places of a run's policy, pictures and files; their hashes must be the run's.

    Attributes:
        suite: Folder; None for that of the run, see `suite_of`.
        checkpoint: As for `probe-kit extract`; by default those of the run, of a checkpoint its folder if it is
            still there. Options of the run stay but for those that are named anew.
        options: As `checkpoint`.
        weights_seed: As `checkpoint`.
        device: Of the model.
        moved: Parts of the run's source that lie elsewhere now, by field of its settings: `folder` and `table` of
            recordings and pictures, `environment` (and `options`, beside those of the run), `scene.background`,
            `scene.arm_urdf`; by default where the run had them.
    """

    suite: Path | None = None
    checkpoint: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    weights_seed: int | None = None
    device: str = "cpu"
    moved: Mapping[str, Any] = field(default_factory=dict)


LoadPolicy = Callable[[Run, ReplaySource], "Policy"]


class ReplaySession(ABC):
    """A policy and its observations; a context manager, because it can hold a simulator.

    on_fit_progress: called after every item that is inferred beforehand, for directions and erasers. passed_over:
    places of a wildcard, each with its role, at which an answer has no direction, and why.
    certificate: entries of the kind's own.
    """

    def __init__(self, run: Run, policy: "Policy") -> None:
        self.run, self.policy = run, policy
        self.on_fit_progress: Progress | None = None
        self.passed_over: dict[str, str] = {}
        self.certificate: dict[str, Any] = {}

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    @abstractmethod
    def close(self) -> None:
        """Free a simulator or files."""

    @abstractmethod
    def pairs(self, item: str) -> list[Pair]:
        """Return the pairs of an item's episodes. Raises OtherFramesError for other observations."""

    @abstractmethod
    def displacement(self, chunk: Chunk, pair: Pair) -> float:
        """Return the number that is read off a chunk (chunk, D) of actions after the pair's clean observation."""

    @abstractmethod
    def slope(self, pair: Pair) -> "Callable[[Tensor], Tensor]":
        """Return the same up to a constant, as a function of actions (chunk, D) that keeps their graph."""

    @abstractmethod
    def with_other_instruction(self, pair: Pair) -> Observation | None:
        """Return the clean observation under its counterpart's instruction; None without one."""

    @abstractmethod
    def has_other_instruction(self, item: str) -> bool:
        """Whether an item has a counterpart that asks for another action before the same observation."""

    def categories_of(self, items: Sequence[str]) -> list[str]:
        """Return the category of every item."""
        episodes = self.run.episodes
        by_item = dict(zip(episodes["item_id"].astype(str), episodes["category"].astype(str), strict=True))
        return [by_item[item] for item in items]

    @contextmanager
    def ready(self) -> Iterator[None]:
        """Use as many threads as the run had, so that sums are rounded alike."""
        threads = 1 if self.policy.card.parameters < FEWEST_FOR_THREADS else None
        with torch_threads(threads):
            yield

    def act(self, model_input: Given, seed: int) -> Chunk:
        """Return (chunk, D): one inference, alone in its batch. Raises PolicyFailedError if the policy raises."""
        assert isinstance(model_input, Observation), "pairs of runs are of observations"
        with while_acting(self.run.model, self.policy.card.checkpoint):
            return np.asarray(self.policy.act(copied([model_input]), [seed])[0], np.float32)

    def replay_error(self, pair: Pair, chunk: Chunk) -> float:
        """Return by how much a clean inference differs from the stored actions; NaN where there are none.

        Raises:
            CaptureChangedActionError: If it is another action altogether.
        """
        if pair.stored is None:
            return nan
        count = min(len(pair.stored), len(chunk))
        largest = float(np.abs(chunk[:count] - pair.stored[:count]).max())
        if not largest <= FAR:  # negated, so that NaN is refused too
            raise CaptureChangedActionError(
                f"the first action of {pair.episode}, inferred again, differs from the stored one by "
                f"{largest:.3g}; expected the same. The policy has other options than the run's, or is not "
                "deterministic"
            )
        return largest
