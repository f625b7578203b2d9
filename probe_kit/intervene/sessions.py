"""Replay sessions: a run's policy and observations, set up again to repeat and edit its inferences.

In the scene, both layouts of an item are drawn again from the same state. In other runs, a pair is two frames. The
source is the clean frame with one of the inputs of a donor, another frame of another group.
"""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit._system.machine import AUTO
from probe_kit._system.types import Progress
from probe_kit.errors import (
    CaptureChangedActionError,
)
from probe_kit.extract.rollout.capturing import FEWEST_FOR_THREADS
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.hooks.checkpoints.third_party import copy_observations, while_acting
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.pairs import Chunk, Given, Pair
from probe_kit.runs.run import Run

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.extract.sources.player import Ending, Player
    from probe_kit.hooks import Policy
    from probe_kit.runs.plan import Row


FAR = 0.01
"""Largest difference of a number of a repeated first action from the stored one, in its unit.

Batches of another size, threads and GPUs round differently. A larger difference means another policy or scene.
"""


@dataclass(frozen=True)
class ReplayFiles:
    """The places of a run's policy, pictures and files; their hashes must be the run's.

    Attributes:
        suite: Folder of the suite; None for that of the run, see `suite_of`.
        checkpoint: Checkpoint as for `probe-kit extract`; None for the run's, for a checkpoint its folder if that
            still exists.
        options: Options of the model that are added to the run's or replace them.
        weights_seed: Seed of untrained weights; None for the run's.
        device: Device of the model.
        moved: New places of parts of the run's source, by field of its settings: `folder` and `table` of
            recordings and pictures, `environment` (and `options`, added to those of the run), `scene.background`,
            `scene.arm_urdf`. Parts that are not named are where the run had them.
    """

    suite: Path | None = None
    checkpoint: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    weights_seed: int | None = None
    device: str = AUTO
    moved: Mapping[str, Any] = field(default_factory=dict)


def largest_difference(first: NDArray[np.float32], second: NDArray[np.float32]) -> float:
    """Return the largest difference over the rows that both have; 0 only if they are bit for bit the same."""
    if np.array_equal(first, second, equal_nan=True):
        return 0.0
    both = min(len(first), len(second))
    apart = np.abs(first[:both].astype(np.float64) - second[:both])
    return max(float(np.nanmax(apart)), float(np.finfo(np.float32).tiny))


LoadPolicy = Callable[[Run, ReplayFiles], "Policy"]


class ReplaySession(ABC):
    """A policy and its observations; a context manager, because it can hold a simulator.

    `on_fit_progress` is called after every item that is inferred beforehand, for directions and erasers.
    `passed_over` has the places of a wildcard, each with its role, at which an answer has no direction, and why.
    `certificate` has entries of the kind's own.
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
        """Return the pairs of an item's episodes.

        Raises:
            OtherFramesError: For other observations than the run's.
        """

    @abstractmethod
    def displacement(self, chunk: Chunk, pair: Pair) -> float:
        """Return the displacement of a chunk (chunk, D) of actions after the pair's clean observation."""

    @abstractmethod
    def slope(self, pair: Pair) -> "Callable[[Tensor], Tensor]":
        """Return `displacement` up to a constant, as a function of actions (chunk, D) that keeps their graph."""

    @property
    @abstractmethod
    def player(self) -> "Player":
        """The player of the run's episodes."""

    @abstractmethod
    def planned(self, pair: Pair) -> "Row":
        """Return a pair's episode as the run planned it."""

    @abstractmethod
    def pair_at(self, pair: Pair, observation: Observation, call: int, swapping: bool) -> Pair:
        """Return the pair of an inference of the episode that `player` plays.

        Args:
            pair: First pair of the episode.
            observation: Observation that is inferred now.
            call: Number of the inference in the episode.
            swapping: Whether the source is needed.
        """

    @abstractmethod
    def end_position(self, ending: "Ending") -> float:
        """Return where an episode ended: the cube's lateral offset in metres, or success as 1 or 0."""

    @abstractmethod
    def trajectory_difference(self, pair: Pair, ending: "Ending", actions: Sequence[Chunk]) -> float:
        """Return by how much an episode that was played again differs from the stored one.

        Args:
            pair: First pair of the episode.
            ending: End of the episode.
            actions: Executed actions (n, D) of every inference.

        Returns:
            The largest difference of any number, 0 only if all are bit for bit the same; NaN where the run keeps
            nothing to compare with.
        """

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
        """Return the actions (chunk, D) of one inference, alone in its batch.

        Raises:
            PolicyFailedError: If the policy raises.
        """
        assert isinstance(model_input, Observation), "pairs of runs are of observations"
        with while_acting(self.run.model, self.policy.card.checkpoint):
            return np.asarray(self.policy.act(copy_observations([model_input]), [seed])[0], np.float32)

    def replay_error(self, pair: Pair, chunk: Chunk) -> float:
        """Return by how much a clean inference differs from the stored actions; NaN where there are none.

        Raises:
            CaptureChangedActionError: If it is a different action.
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
