"""The plan of a run on recordings: stretches of at most 64 chosen frames of one episode each."""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from importlib.metadata import version
from itertools import groupby
from typing import Any, Self

from probe_kit.errors import RecordingError
from probe_kit.extract.plan import RowPlan
from probe_kit.extract.recordings.lerobot_folder import MOST_FRAMES, LeRobotFolder
from probe_kit.extract.recordings.lerobot_frames import LeRobotFrames
from probe_kit.extract.recordings.lerobot_meta import IMAGE
from probe_kit.extract.sources.recording import ACTION, IMAGES, STATE, LeRobotSource, Pairs
from probe_kit.hashing import derive_seed
from probe_kit.runs.layout import OTHER_ACTIONS, RECORDED_EPISODES, TRUTHS

CATEGORY = "all"
"""Of every row: recordings have no categories."""
SIDE = 32
"""Pixels along the stored pictures."""
_TASK = "task_index"


@dataclass(frozen=True)
class PlannedStretch:
    """One row: `count` frames of one recorded episode, `first`, `first + every` …, under one instruction.

    length: frames of the whole episode. part: which stretch of the episode, from 0. content: hash of its files.
    """

    index: int
    source_episode: int
    part: int
    first: int
    every: int
    count: int
    length: int
    instruction: str
    policy_seed: int
    content: str

    @property
    def item_id(self) -> str:
        """The recorded episode."""
        return f"episode-{self.source_episode:06d}"

    @property
    def episode_id(self) -> str:
        """The recorded episode, with the part behind the first one."""
        return self.item_id + (f".{self.part}" if self.part else "")

    @property
    def category(self) -> str:
        """The same for all."""
        return CATEGORY

    @property
    def frames(self) -> range:
        """The chosen frames, by their numbers in the episode."""
        return range(self.first, self.first + self.every * self.count, self.every)

    def numbered(self, index: int) -> Self:
        """The same stretch under another number."""
        return replace(self, index=index)

    def control_step(self, call: int, executed: int) -> int:
        """The recorded frame that inference `call` saw; nothing is executed."""
        del executed
        return self.frames[call]

    def noise_of(self, call: int) -> int:
        """The recorded frame: whichever others were chosen, its numbers are the same."""
        return self.frames[call]

    def to_json(self) -> dict[str, Any]:
        """The stretch as flat columns."""
        return {
            "episode": self.index,
            "episode_id": self.episode_id,
            "item_id": self.item_id,
            "category": self.category,
            "group_id": self.item_id,
            "instruction": self.instruction,
            "source_episode": self.source_episode,
            "first_frame": self.first,
            "frame_step": self.every,
            "frames": self.count,
            "recorded_frames": self.length,
            "policy_seed": self.policy_seed,
            "content_blake2b": self.content,
        }


@dataclass(frozen=True)
class RecordedPlan(RowPlan):
    """All stretches of a run. dataset: what its identity says of the data set. name: what tables call it.

    recorded: episodes that the data set has, chosen or not.
    other_actions: why the recorded actions of these episodes are not what the policy predicts; None if they are.
    """

    episodes: tuple[PlannedStretch, ...]
    dataset: Mapping[str, Any]
    name: str
    recorded: int
    other_actions: str | None = None

    @property
    def identity(self) -> dict[str, Any]:
        """The data set by its content, and how it is shown."""
        return {"dataset": dict(self.dataset)}

    @property
    def name_parts(self) -> list[Any]:
        """Nothing beside the identity: a command with more episodes finds its run."""
        return []

    @property
    def selection(self) -> dict[str, Any]:
        """Which episodes were chosen, and whether their actions are those that the policy predicts."""
        chosen = sorted({one.source_episode for one in self.episodes})
        return {
            "recording": {
                "name": self.name,
                "episodes": chosen,
                RECORDED_EPISODES: self.recorded,
                OTHER_ACTIONS: self.other_actions,
            }
        }

    @property
    def decoder(self) -> str | None:
        """PyAV where a camera is a video: pixels of lossy videos are those of their decoder."""
        encodings = {encoding for _, _, encoding in self.dataset["cameras"]}
        return f"PyAV {version('av')}" if encodings - {IMAGE} else None

    def to_json(self) -> dict[str, Any]:
        """As stored in `plan/`."""
        return {"episodes": [one.to_json() for one in self.episodes], "suite_parent": None}

    @property
    def frames(self) -> int:
        """Frames that are shown."""
        return sum(one.count for one in self.episodes)


@dataclass(frozen=True)
class Recording:
    """A data set that lies here, and what was chosen of it. source: as given, later with every camera mapped."""

    folder: LeRobotFolder
    source: LeRobotSource
    episodes: tuple[int, ...]
    reader: LeRobotFrames

    @classmethod
    def of(cls, folder: LeRobotFolder, source: LeRobotSource) -> Self:
        """What `source` chooses. Raises RecordingError for an episode that is not there."""
        episodes = tuple(folder.chosen(source.episodes))
        return cls(folder, source, episodes, LeRobotFrames(folder))

    @property
    def features(self) -> list[str]:
        """Of the data set, in the order of the model's cameras."""
        return [feature for _, feature in self.source.cameras]

    @property
    def most_frames(self) -> int:
        """Chosen frames of the longest row that any episode of the data set can have."""
        longest = max(self.folder.lengths, default=1)
        return min(MOST_FRAMES, -(-longest // self.source.every))

    def mapped(self, cameras: Sequence[str]) -> Self:
        """The same with a feature for the model's cameras. Raises RecordingError where none follows."""
        pairs = mapped_cameras(self.source.cameras, cameras, self.folder.cameras)
        known = [camera for camera, _ in pairs]
        if strange := [camera for camera, _ in self.source.rotations if camera not in known]:
            raise RecordingError(
                f"--rotate {strange[0]}=…: that camera gets no picture; those with one are {', '.join(known)}"
            )
        return replace(self, source=self.source.changed(cameras=pairs))

    def check(self) -> None:
        """Raise RecordingError for files, numbers or pictures of the chosen episodes that cannot be shown.

        Pictures are those of the mapped cameras, or of all where none is mapped. Of a hub data set they are not
        here before that.
        """
        every = [] if self.folder.repo is not None else self.folder.cameras
        features = self.features or every
        if strange := [feature for feature in features if feature not in self.folder.cameras]:
            raise RecordingError(
                f"{self.folder.path.name} has no picture {strange[0]!r}; it has "
                f"{', '.join(self.folder.cameras) or 'none'}. Correct --camera"
            )
        self.folder.check_files(self.episodes, features)
        self.reader.check(self.episodes, features)

    @property
    def instructions(self) -> tuple[str, ...]:
        """Every instruction once, in the order of their letters."""
        return tuple(sorted({text for episode in self.episodes for text in self._texts(episode)}))

    def stretches(self, seed: int) -> Iterator[PlannedStretch]:
        """The rows of the chosen episodes, in order."""
        index = 0
        for episode in self.episodes:
            frames = range(0, self.folder.lengths[episode], self.source.every)
            content = self.folder.content_blake2b(episode, self.features)
            policy_seed = derive_seed(seed, "policy", f"episode-{episode:06d}")
            texts = self._texts(episode)
            part = 0
            for text, group in groupby(frames, key=lambda frame, texts=texts: texts[frame]):  # type: ignore[misc]
                own = list(group)
                for start in range(0, len(own), MOST_FRAMES):
                    kept = own[start : start + MOST_FRAMES]
                    yield PlannedStretch(
                        index, episode, part, kept[0], self.source.every, len(kept), len(texts), text, policy_seed,
                        content,
                    )  # fmt: skip
                    index, part = index + 1, part + 1

    def _texts(self, episode: int) -> list[str]:
        """What the model reads at every frame of an episode."""
        if self.source.instruction is not None:
            return [self.source.instruction] * self.folder.lengths[episode]
        numbers = self.reader.numbers(episode, [_TASK])[_TASK][:, 0].astype(int)
        return [self.folder.task(number) for number in numbers]

    def dataset(self, prediction: Sequence[int]) -> dict[str, Any]:
        """What a run's identity says. prediction: (chunk, D), the shape of what the model predicts per frame."""
        own, folder = self.source, self.folder
        state, action = folder.width(STATE), folder.width(ACTION)
        columns = folder.columns
        truths = [name for name in columns if folder.features[name]["dtype"] == "bool"]
        shapes: dict[str, list[int]] = {"columns": [len(columns)], "prediction": list(prediction)}
        shapes |= {} if state is None else {"state": [state]}
        shapes |= {} if action is None else {"action": [prediction[0], action]}
        shapes |= {"pixels": [len(own.cameras), SIDE, SIDE, 3]} if own.pixels else {}
        return {
            "kind": "lerobot",
            **({} if folder.repo is None else {"repo": folder.repo, "revision": folder.revision}),
            "meta_blake2b": folder.meta_blake2b,
            "fps": folder.fps,
            "frames": f"every:{own.every}",
            "cameras": [[camera, feature, folder.encoding(feature)] for camera, feature in own.cameras],
            "rotations": [list(one) for one in own.rotations],
            "instruction": own.instruction,
            "inputs": dict(sorted(shapes.items())),
            "columns": columns,
            "names": {
                **{
                    name: folder.names(feature)
                    for name, feature, width in (("state", STATE, state), ("action", ACTION, action))
                    if width is not None
                },
                **({TRUTHS: truths} if truths else {}),
            },
        }


def mapped_cameras(given: Pairs, model: Sequence[str], recorded: Sequence[str]) -> Pairs:
    """Camera of the model and feature of the data set, in the model's order.

    given: as the user mapped them; empty for equal names, or the only one of either. Raises RecordingError.
    """
    known = f"the model has {', '.join(model) or 'none'}; the data set has {', '.join(recorded) or 'none'}"
    how = (
        f"Map them, such as --camera {model[0] if model else 'base'}={recorded[0] if recorded else IMAGES + 'top'}"
    )
    for camera, feature in given:
        if camera not in model:
            raise RecordingError(f"--camera {camera}=…: the model has no such camera ({known}). {how}")
        if feature not in recorded:
            raise RecordingError(f"--camera {camera}={feature}: the data set has no such picture ({known}). {how}")
    chosen = dict(given)
    if not given:
        names = {feature.removeprefix(IMAGES): feature for feature in recorded}
        chosen = {camera: names[camera] for camera in model if camera in names}
        if not chosen and len(model) == len(recorded) == 1:
            chosen = {model[0]: recorded[0]}
    if not chosen or model[0] not in chosen:
        raise RecordingError(f"no picture is mapped to the model's first camera: {known}. {how}")
    return tuple((camera, chosen[camera]) for camera in model if camera in chosen)
