"""A replay session: a run's policy and observations, set up again to repeat and edit its inferences."""

from abc import ABC, abstractmethod
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np

from probe_kit.errors import CaptureChangedActionError, SettingsMismatchError
from probe_kit.extract.rollout.capturing import SMALL
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.hooks.checkpoints.checkpoint import cached_folder, pinned_commits
from probe_kit.hooks.checkpoints.third_party import copied, while_acting
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.family import SIZE
from probe_kit.intervene.pairs import Chunk, Given, Pair
from probe_kit.runs.reader import origin_of
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

    suite: folder; None for that of the run, see `suite_of`. checkpoint, options, weights_seed: as for
    `probe-kit extract`; by default those of the run, of a checkpoint its folder if it is still there. Options of
    the run stay but for those that are named anew. device: of the model. moved: parts of the run's source that lie
    elsewhere now, by field of its settings: `folder` and `table` of recordings and pictures, `environment` (and
    `options`, beside those of the run), `scene.background`, `scene.arm_urdf`; by default where the run had them.
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
    """

    def __init__(self, run: Run, policy: "Policy") -> None:
        self.run, self.policy = run, policy
        self.on_fit_progress: Progress | None = None
        self.passed_over: dict[str, str] = {}

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
        threads = 1 if self.policy.card.parameters < SMALL else None
        with torch_threads(threads):
            yield

    def act(self, model_input: Given, seed: int) -> Chunk:
        """Return (chunk, D): one inference, alone in its batch. Raises PolicyFailedError if the policy raises."""
        with while_acting(self.run.model, self.policy.card.checkpoint):
            return np.asarray(self.policy.act(copied([_observation(model_input)]), [seed])[0], np.float32)

    def replay_error(self, pair: Pair, chunk: Chunk) -> float:
        """Return by how much a clean inference differs from the stored actions; NaN where there are none.

        Raises CaptureChangedActionError if it is another action altogether.
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


def _observation(model_input: Given) -> Observation:
    assert isinstance(model_input, Observation), "pairs of runs are of observations"
    return model_input


def load_policy_of(run: Run, source: ReplaySource) -> "Policy":
    """Return the policy that a run names, loaded as its own process loaded it.

    A file whose weights call themselves random is loaded as a file: only requested random weights are drawn.
    """
    from probe_kit.hooks import load_policy

    origin = origin_of(run)
    checkpoint = source.checkpoint or _folder_of(run)
    options = {name: value for name, value in origin.options.items() if checkpoint is None or name != SIZE}
    # Branches of its vision-language model or tokenizer may have gone on since the run was made.
    with pinned_commits(origin.repositories):
        return load_policy(
            run.model,
            checkpoint,
            source.device,
            run.settings["dtype"],
            origin.random_weights,
            origin.weights_seed if source.weights_seed is None else source.weights_seed,
            **{**options, **source.options},
        )


def _folder_of(run: Run) -> str | None:
    """Return the checkpoint from which the run was made, if its folder, or its commit of the hub, is here.

    A hub id of a run is never fetched.
    """
    checkpoint = origin_of(run).checkpoint
    if cached_folder(checkpoint) is not None:
        return checkpoint
    is_folder = checkpoint not in ("", EMBEDDED) and Path(checkpoint).expanduser().is_dir()
    return checkpoint if is_folder else None


def check_policy(run: Run, policy: "Policy") -> None:
    """Raise SettingsMismatchError for other weights or options than the run's."""
    card = policy.card
    if card.weights_sha256 != run.weights_sha256:
        checkpoint = origin_of(run).checkpoint or "an unknown checkpoint"
        raise SettingsMismatchError(
            f"the weights of {card.checkpoint} are {card.weights_sha256[:12]}; {run.location} was made with "
            f"{str(run.weights_sha256)[:12]}, loaded from {checkpoint}. Give that --checkpoint (or --weights-seed)"
        )
    was, now = dict(run.settings.get("policy", {})), dict(card.settings)
    if was != now:
        different = sorted(name for name in was | now if was.get(name) != now.get(name))
        lines = "; ".join(f"{name}: stored {was.get(name)!r}, here {now.get(name)!r}" for name in different)
        raise SettingsMismatchError(f"{run.location} was made with other options ({lines}). Give the same with -M")
