"""A replay session: a run's policy and scene, set up again to repeat and edit its inferences."""

from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from dataclasses import dataclass, field, replace
from math import nan
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol, Self

import numpy as np
from numpy.typing import NDArray

from probe_kit.env import SceneSpec
from probe_kit.errors import (
    CaptureChangedActionError,
    NoTrajectoryError,
    OtherFramesError,
    SettingsMismatchError,
)
from probe_kit.extract.plan import PlannedEpisode
from probe_kit.extract.rollout.capturing import SMALL
from probe_kit.extract.rollout.stage import Seen, Stage
from probe_kit.extract.rollout.worker import torch_threads
from probe_kit.hashing import derive_seed
from probe_kit.hooks.checkpoints.checkpoint import cached_folder
from probe_kit.hooks.checkpoints.commits import pinned_commits
from probe_kit.hooks.checkpoints.containment import copied
from probe_kit.hooks.checkpoints.third_party import while_acting
from probe_kit.hooks.contract.card import EMBEDDED
from probe_kit.hooks.contract.observation import Observation
from probe_kit.hooks.family import SIZE
from probe_kit.runs.run import Run
from probe_kit.runs.sources import RunSources
from probe_kit.suite.counterparts import counterparts_of
from probe_kit.suite.items import Episode, Item, Layout, Side
from probe_kit.train.data.run_suite import suite_of

if TYPE_CHECKING:
    from torch import Tensor

    from probe_kit.hooks import Policy

Chunk = NDArray[np.float32]
FAR = 0.01
"""Metres by which a repeated first action may differ from the stored one; more is another policy or scene."""


class Progress(Protocol):
    """Called after every item."""

    def __call__(self, done: int, total: int, what: str, /) -> None:
        """done: items so far, of `total`. what: the last one."""


@dataclass(frozen=True)
class ReplaySource:
    """Where a run's policy, pictures and files are found again; what is found must have the run's hashes.

    suite: folder; None for that of the run, see `suite_of`. checkpoint, options, weights_seed: as for
    `probe-kit extract`; by default those of the run, of a checkpoint its folder if it is still there. Options of
    the run stay but for those that are named anew. device: of the model. files: of the scene, by field, such as
    `background`; by default those of the run that are still there.
    """

    suite: Path | None = None
    checkpoint: str | None = None
    options: Mapping[str, Any] = field(default_factory=dict)
    weights_seed: int | None = None
    device: str = "cpu"
    files: Mapping[str, Path] = field(default_factory=dict)


@dataclass(frozen=True)
class ReplayInput:
    """The first inference of one episode, and the observation with the two images swapped.

    row: in the run's episodes. seed: of the inference. tiles: (H, W) where in its picture each tile's own is seen.
    stored: (n, 7) actions that the run executed of it, None where it does not say.
    """

    row: int
    episode_id: str
    item_id: str
    group_id: str
    category: str
    side_correct: Side
    layout: Layout
    seen: Observation
    swapped: Observation
    seed: int
    tiles: Mapping[Side, NDArray[np.bool_]] = field(repr=False)
    stored: Chunk | None = None


class ReplaySession:
    """A policy and a scene; a context manager, because it holds a simulator.

    items: of the run's suite, by id. counterparts: of those that have one, see `counterparts_of`. on_fit_progress:
    called after every item that is inferred beforehand, for directions and erasers. passed_over: places of a
    wildcard, each with its role, at which an answer has no direction, and why.
    """

    def __init__(self, run: Run, policy: "Policy", scene: SceneSpec, items: Mapping[str, Item]) -> None:
        self.run, self.policy, self.scene = run, policy, scene
        self.items, self.counterparts = items, counterparts_of(items.values())
        self.on_fit_progress: Progress | None = None
        self.passed_over: dict[str, str] = {}
        self.stage = Stage(scene, None)
        left, right = np.array(scene.tile_left), np.array(scene.tile_right)
        self._middle, self._across = (left + right) / 2, (left - right) / float(np.linalg.norm(left - right))

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.stage.close()

    def replay_inputs(self, item_id: str) -> list[ReplayInput]:
        """The committed episodes of one item, their first frames drawn again, both layouts of one state.

        Raises OtherFramesError if a frame is not the one that the run began with.
        """
        episodes = self.run.episodes
        rows = np.flatnonzero((episodes["item_id"] == item_id).to_numpy())
        frames: dict[Layout, Seen] = {}
        found = []
        for row in rows:
            record = episodes.iloc[int(row)]
            item = replace(self.items[item_id], instruction=str(record["instruction"]))
            own: Layout = "original" if record["layout"] == "original" else "swapped"
            other: Layout = "swapped" if own == "original" else "original"
            if own not in frames:
                frames[own] = self._look(item, own, int(record["scene_seed"]))
                frames[other], tiles = self.stage.look_swapped(), self.stage.tile_masks()
            self._check_frame(record, frames[own])
            found.append(
                ReplayInput(
                    row=int(row),
                    episode_id=str(record["episode_id"]),
                    item_id=item_id,
                    group_id=str(record["group_id"]),
                    category=str(record["category"]),
                    side_correct="left" if record["side_correct"] == "left" else "right",
                    layout=own,
                    seen=frames[own].observation,
                    swapped=frames[other].observation,
                    seed=derive_seed(int(record["policy_seed"]), "inference", 0),
                    tiles=tiles,
                    stored=self._stored(int(row)),
                )
            )
        return found

    def _look(self, item: Item, layout: Layout, scene_seed: int) -> Seen:
        answer = self.stage.look(PlannedEpisode(0, Episode(item, layout), scene_seed, 0))
        assert isinstance(answer, Seen)
        return answer

    def _check_frame(self, record: Any, seen: Seen) -> None:
        wanted, found = record.get("first_frame_sha256"), seen.facts["first_frame_sha256"]
        if wanted is not None and wanted != found:
            raise OtherFramesError(
                f"the first frame of {record['episode_id']}, drawn again, is {found[:12]}; {self.run.location} "
                f"began with {str(wanted)[:12]}. Its pictures, its scene or the renderer are others here; use the "
                "machine and versions that its provenance names"
            )

    def _stored(self, row: int) -> Chunk | None:
        try:
            commanded = self.run.trajectory(row).commanded
        except NoTrajectoryError:
            return None
        executed = 1 if self.policy.card.ensemble is not None else int(self.run.settings["execute"])
        return np.asarray(commanded[:executed], np.float32)

    @contextmanager
    def ready(self) -> Iterator[None]:
        """With as many threads as the run had, so that sums are rounded alike."""
        threads = 1 if self.policy.card.parameters < SMALL else None
        with torch_threads(threads):
            yield

    def act(self, seen: Observation, seed: int) -> Chunk:
        """(chunk, 7): one inference, alone in its batch. Raises PolicyFailedError for what the policy raises."""
        with while_acting(self.run.model, self.policy.card.checkpoint):
            return np.asarray(self.policy.act(copied([seen]), [seed])[0], np.float32)

    def replay_error(self, replay_input: ReplayInput, chunk: Chunk) -> float:
        """By how much a clean inference differs from what the run executed; NaN where it does not say.

        Raises CaptureChangedActionError if it is another action altogether.
        """
        if replay_input.stored is None:
            return nan
        known = min(len(replay_input.stored), len(chunk))
        largest = float(np.abs(chunk[:known] - replay_input.stored[:known]).max())
        if not largest <= FAR:
            raise CaptureChangedActionError(
                f"the first action of {replay_input.episode_id}, inferred again, differs from the stored one by "
                f"{largest:.3g}; expected the same. The policy has other options than the run's, or is not "
                "deterministic"
            )
        return largest

    def lateral_displacement(self, chunk: Chunk, seen: Observation) -> float:
        """Where the chunk would bring the hand, in metres from the middle between the tiles; left is positive."""
        end = np.asarray(seen.state[:2], np.float64) + chunk[:, :2].astype(np.float64).sum(axis=0)
        return self.lateral_offset(end)

    def lateral_motion(self, chunk: "Tensor") -> "Tensor":
        """How far a chunk (chunk, 7) moves the hand, in metres; left is positive. Keeps the graph behind it."""
        return (chunk[:, :2].sum(dim=0) * chunk.new_tensor(self._across)).sum()

    def lateral_offset(self, point: NDArray[np.float64]) -> float:
        """How far a point (2,) is from the middle between the tiles, in metres; left is positive."""
        return float((point - self._middle) @ self._across)


def open_session(
    run: Run, source: ReplaySource, load: "Callable[[Run, ReplaySource], Policy] | None" = None
) -> ReplaySession:
    """Load the run's policy and set up its scene.

    load: how the policy is found, if not by its name. Raises SettingsMismatchError if it is another one,
    SuiteError for another suite, SuiteNotFoundError for one that is neither given nor can be drawn again,
    SceneError for a scene that needs a file which is not given.
    """
    scene = SceneSpec.from_json(run.settings["scene"], {**_scene_files(run), **source.files})
    suite = suite_of(run, source.suite)
    policy = (load or load_policy_of)(run, source)
    _check_policy(run, policy)
    return ReplaySession(run, policy, scene, {item.item_id: item for item in suite.items})


def load_policy_of(run: Run, source: ReplaySource) -> "Policy":
    """The policy that a run names, loaded as its own process loaded it.

    A file whose weights call themselves random is loaded as a file: only requested random weights are drawn.
    """
    from probe_kit.hooks import load_policy

    made = _sources_of(run)
    checkpoint = source.checkpoint or _folder_of(run)
    # Branches of its vision-language model or tokenizer may have gone on since the run was made.
    with pinned_commits(made.repositories):
        return load_policy(
            run.model,
            checkpoint,
            source.device,
            run.settings["dtype"],
            made.random_weights,
            made.weights_seed if source.weights_seed is None else source.weights_seed,
            **{**_options_of(made, checkpoint), **source.options},
        )


def _sources_of(run: Run) -> RunSources:
    return run.sources[0] if run.sources else RunSources()


def _options_of(made: RunSources, checkpoint: str | None) -> dict[str, Any]:
    """Options of the run, without the one that stands for a checkpoint where there is a checkpoint."""
    return {name: value for name, value in made.options.items() if checkpoint is None or name != SIZE}


def _scene_files(run: Run) -> dict[str, Path]:
    """Files of the scene from which the run was made, as far as they exist here."""
    files = {name: Path(path) for name, path in _sources_of(run).scene_files.items()}
    return {name: path for name, path in files.items() if path.is_file()}


def _folder_of(run: Run) -> str | None:
    """The checkpoint from which the run was made, if its folder, or its commit of the hub, is here.

    A hub id of a run is never fetched.
    """
    made = _sources_of(run).checkpoint
    if cached_folder(made) is not None:
        return made
    is_folder = made not in ("", EMBEDDED) and Path(made).expanduser().is_dir()
    return made if is_folder else None


def _check_policy(run: Run, policy: "Policy") -> None:
    card = policy.card
    if card.weights_sha256 != run.weights_sha256:
        made = _sources_of(run).checkpoint or "an unknown checkpoint"
        raise SettingsMismatchError(
            f"the weights of {card.checkpoint} are {card.weights_sha256[:12]}; {run.location} was made with "
            f"{str(run.weights_sha256)[:12]}, loaded from {made}. Give that --checkpoint (or --weights-seed)"
        )
    was, now = dict(run.settings.get("policy", {})), dict(card.settings)
    if was != now:
        different = sorted(name for name in was | now if was.get(name) != now.get(name))
        lines = "; ".join(f"{name}: stored {was.get(name)!r}, here {now.get(name)!r}" for name in different)
        raise SettingsMismatchError(f"{run.location} was made with other options ({lines}). Give the same with -M")
