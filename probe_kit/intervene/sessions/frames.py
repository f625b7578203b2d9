"""Frames of a run without sides, shown again: of its recordings, or first observations of its environment."""

from abc import ABC, abstractmethod
from collections.abc import Sequence
from dataclasses import replace
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from probe_kit.errors import OtherFramesError, UsageError
from probe_kit.extract.sources.donors import Frame
from probe_kit.hashing import derive_seed
from probe_kit.hooks.contract.observation import Observation
from probe_kit.intervene.sessions.session import ReplaySource, origin_of
from probe_kit.intervene.settings import why_not_replayed
from probe_kit.runs import Run
from probe_kit.runs.layout import DATASET

CACHED = 256
"""Observations that are kept: those of the nearest frames are compared again and again."""


class Frames(ABC):
    """All frames of a run that can be shown again. cameras: of the policy, those that get a picture."""

    def __init__(self, run: Run) -> None:
        self.run = run
        self._cached = lru_cache(maxsize=CACHED)(self.observe)
        self.index = list(self._listed())

    @property
    @abstractmethod
    def cameras(self) -> tuple[str, ...]:
        """Return the model's cameras that get a picture."""

    @abstractmethod
    def observe(self, frame: Frame) -> Observation:
        """Read the observation of a frame. Raises OtherFramesError if it is not the run's."""

    @abstractmethod
    def _numbers(self, row: int) -> Sequence[int]:
        """Return the numbers of the frames of one row, in the order of its inferences."""

    def close(self) -> None:  # noqa: B027 - recordings hold nothing
        """Free what it holds."""

    def _listed(self) -> Any:
        inputs = self.run.inputs
        assert inputs is not None
        states = inputs.read("state").astype(np.float64) if "state" in inputs.kinds else None
        kind = next((name for name in ("prediction", "action") if name in inputs.kinds), None)
        actions = None if kind is None else inputs.read(kind)
        for row, record in enumerate(self.run.episodes.to_dict("records")):
            for call, number in enumerate(self._numbers(row)):
                yield Frame(
                    name=f"{record['episode_id']}@{number}",
                    group=str(record["group_id"]),
                    seed=derive_seed(int(record["policy_seed"]), "inference", number),
                    instruction=str(record["instruction"]),
                    state=np.zeros(0) if states is None else states[row, call],
                    observe=self._cached,
                    row=row,
                    number=number,
                    item=str(record["item_id"]),
                    episode=str(record["episode_id"]),
                    category=str(record["category"]),
                    stored=None if actions is None else np.asarray(actions[row, call], np.float32),
                )


class RecordedFrames(Frames):
    """Frames of the LeRobotDataset that a run showed."""

    def __init__(self, run: Run, source: ReplaySource) -> None:
        from probe_kit.extract.sources.lerobot_folder import open_lerobot
        from probe_kit.extract.sources.lerobot_frames import LeRobotFrames
        from probe_kit.extract.sources.recording import LeRobotSource

        self._dataset = run.settings[DATASET]
        self._folder = open_lerobot(LeRobotSource(_folder_of(run, source)))
        self._reader = LeRobotFrames(self._folder)
        self._features = {camera: feature for camera, feature, _ in self._dataset["cameras"]}
        super().__init__(run)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Return the mapped cameras."""
        return tuple(self._features)

    def _numbers(self, row: int) -> Sequence[int]:
        record = self.run.episodes.iloc[row]
        first, step, count = (int(record[name]) for name in ("first_frame", "frame_step", "frames"))
        return range(first, first + step * count, step)

    def observe(self, frame: Frame) -> Observation:
        """Read a frame from the data set, as the run showed it."""
        record = self.run.episodes.iloc[frame.row]
        episode, features = int(record["source_episode"]), list(self._features.values())
        if self._folder.content_blake2b(episode, features) != record["content_blake2b"]:
            raise OtherFramesError(
                f"{self._folder.path.name}: the files of {frame.item} are not those of {self.run.location}: their "
                "hash differs. Give the data set of the run (--dataset)"
            )
        pictures = self._reader.pictures(episode, frame.number, features)
        images = {camera: pictures[feature] for camera, feature in self._features.items()}
        for camera, degrees in self._dataset["rotations"]:
            images[camera] = np.ascontiguousarray(np.rot90(images[camera], degrees // 90))
        first, *other_cameras = images
        return Observation(
            images[first], frame.state.astype(np.float32) if frame.state.size else np.zeros(8, np.float32),
            frame.instruction, None, {name: images[name] for name in other_cameras},
        )  # fmt: skip


class EnvironmentFrames(Frames):
    """The first observation of every episode of the environment that a run played."""

    def __init__(self, run: Run, source: ReplaySource) -> None:
        from probe_kit.extract.sources.environment import EnvSource
        from probe_kit.extract.sources.opening import listed_episodes, open_environment

        stored = run.settings["environment"]
        options = {**stored["options"], **source.environment_options}
        env_source = EnvSource(stored["environment"], options=options)
        self._name, self._environment = env_source.name, open_environment(env_source)
        if self._environment.revision != stored["revision"]:
            raise OtherFramesError(
                f"{self._name} has the revision {self._environment.revision!r}; {run.location} was played in "
                f"{stored['revision']!r}. Use that version"
            )
        self._cameras = tuple(stored["cameras"])
        self._episodes = {episode.id: episode for _, episode in listed_episodes(self._environment, env_source)}
        super().__init__(run)

    @property
    def cameras(self) -> tuple[str, ...]:
        """Return the cameras of the environment."""
        return self._cameras

    def _numbers(self, row: int) -> Sequence[int]:
        del row
        return (0,)

    def observe(self, frame: Frame) -> Observation:
        """Set an episode up, and return what it shows first."""
        from probe_kit.extract.sources.opening import started

        if frame.episode not in self._episodes:
            raise OtherFramesError(
                f"{self._name} has no episode {frame.episode!r} any more; use the run's version"
            )
        observation = started(self._environment, self._episodes[frame.episode], self._name).observation
        if frame.state.size and not np.array_equal(observation.state.astype(np.float64), frame.state):
            raise OtherFramesError(
                f"{self._name}, {frame.episode}: the state at the beginning is not that of "
                f"{self.run.location}. Take all randomness from the episode's seed, and use the run's version"
            )
        pictures = {name: np.array(picture) for name, picture in observation.cameras.items()}
        return replace(
            observation, image=np.array(observation.image), state=np.array(observation.state), cameras=pictures
        )

    def close(self) -> None:
        """Close the environment."""
        self._environment.close()


def frames_of(run: Run, source: ReplaySource) -> Frames:
    """Return the frames of a run on recordings or in an environment. Raises UsageError for another source."""
    if reason := why_not_replayed(run):
        raise UsageError(f"{run.location}: {reason}")
    return (RecordedFrames if run.recorded else EnvironmentFrames)(run, source)


def _folder_of(run: Run, source: ReplaySource) -> str:
    """Return the folder or hub id of the run's recordings. Raises UsageError if it is not here."""
    dataset = run.settings[DATASET]
    if source.dataset is not None:
        return str(source.dataset)
    if "repo" in dataset:
        return f"{dataset['repo']}@{dataset['revision']}"
    stored = origin_of(run).files.get("folder", "")
    if not stored or not Path(stored).is_dir():
        raise UsageError(
            f"the recordings of {run.location} are not where they were{f' ({stored})' if stored else ''}; name "
            "their folder with --dataset"
        )
    return stored
