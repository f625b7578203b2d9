"""`LeRobotSource`: which frames of which recording are shown to a model, and how."""

import re
from collections.abc import Iterable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Self

from probe_kit.errors import UsageError

IMAGES = "observation.images."
STATE, ACTION = "observation.state", "action"
TURNS = (90, 180, 270)
"""Degrees that pictures can be rotated by, counterclockwise."""
MOST_EPISODES = 1_000_000
_RANGE = re.compile(r"(\d+)(?::(\d+))?")
_EVERY = re.compile(r"every:([1-9]\d*)")
_HUB = re.compile(r"[\w.-]+/[\w.-]+(@[\w./-]+)?")

Pairs = tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class LeRobotSource:
    """Frames of a LeRobotDataset in place of a scene.

    folder: the data set's folder, or USER/NAME@COMMIT of the hub. episodes: indices; None for all. every: of each
    episode, frame 0 and each so many frames on. cameras: feature of the data set by camera of the model; empty
    where both have one, or the names are equal. rotations: degrees by camera of the model, counterclockwise.
    instruction: what the model reads in place of the task of a frame. pixels: whether pictures at 32 × 32 are
    stored for controls.
    Raises UsageError for what no data set can have.
    """

    folder: str
    episodes: tuple[int, ...] | None = None
    every: int = 1
    cameras: Pairs = ()
    rotations: tuple[tuple[str, int], ...] = ()
    instruction: str | None = None
    pixels: bool = True

    def __post_init__(self) -> None:
        object.__setattr__(self, "folder", str(self.folder))
        if self.episodes is not None:
            object.__setattr__(self, "episodes", tuple(sorted({int(one) for one in self.episodes})))
        object.__setattr__(self, "cameras", _pairs(self.cameras))
        object.__setattr__(self, "rotations", _pairs(self.rotations))
        self._check()

    def _check(self) -> None:
        if self.episodes is not None and (not self.episodes or self.episodes[0] < 0):
            raise UsageError(f"episodes are {list(self.episodes)[:5]}; expected indices from 0 on, at least one")
        if self.every < 1:
            raise UsageError(f"every is {self.every}; expected 1 or more")
        for part, names in (
            ("camera", [name for name, _ in self.cameras]),
            ("feature", [*dict(self.cameras).values()]),
        ):
            if twice := [name for name in names if names.count(name) > 1]:
                raise UsageError(f"the {part} {twice[0]!r} is mapped twice; give each once")
        if wrong := [turn for _, turn in self.rotations if turn not in TURNS]:
            raise UsageError(
                f"pictures are rotated by {wrong[0]} degrees; expected one of {', '.join(map(str, TURNS))}"
            )

    @classmethod
    def from_options(
        cls, dataset: str, episodes: str | None = None, select: str = "every:1",
        cameras: Iterable[str] = (), rotations: Iterable[str] = (), **further: Any,
    ) -> Self:  # fmt: skip
        """The source that the options of a command name. Raises UsageError."""
        turns = []
        for camera, degrees in _read_pairs("--rotate", rotations, "base=180"):
            if not degrees.isdecimal():
                raise UsageError(f"--rotate {camera}={degrees}; expected degrees, such as {camera}=180")
            turns.append((camera, int(degrees)))
        return cls(
            dataset,
            None if episodes is None else read_episodes(episodes),
            read_every(select),
            _read_pairs("--camera", cameras, f"base={IMAGES}top"),
            tuple(turns),
            **further,
        )

    @property
    def is_local(self) -> bool:
        """Whether it names a folder, not a data set of the hub."""
        return Path(self.folder).expanduser().exists() or not _HUB.fullmatch(self.folder)

    @property
    def name(self) -> str:
        """What tables call it; where it lies is no part of a run."""
        return Path(self.folder).expanduser().resolve().name if self.is_local else self.folder.partition("@")[0]


def read_episodes(text: str) -> tuple[int, ...]:
    """The indices of `0:5` (0 to 4), of `7`, or of several such, comma-separated. Raises UsageError."""
    found: list[int] = []
    for part in filter(None, (one.strip() for one in text.split(","))):
        matched = _RANGE.fullmatch(part)
        start, stop = (int(matched[1]), int(matched[2] or int(matched[1]) + 1)) if matched else (0, 0)
        if not start < stop <= MOST_EPISODES:
            raise UsageError(
                f"--episodes {text!r}: {part!r} is no range of episodes; expected START:STOP, such as 0:5 for the "
                "first five, or single indices"
            )
        found += range(start, stop)
    if not found:
        raise UsageError(f"--episodes {text!r} names none; expected START:STOP, such as 0:5")
    return tuple(found)


def read_every(text: str) -> int:
    """N of `every:N`. Raises UsageError."""
    matched = _EVERY.fullmatch(text)
    if matched is None:
        raise UsageError(f"--select {text!r}; expected every:N, such as every:5")
    return int(matched[1])


def _read_pairs(option: str, texts: Iterable[str], example: str) -> Pairs:
    pairs = []
    for text in texts:
        name, equals, value = text.partition("=")
        if not (name and equals and value):
            raise UsageError(f"{option} {text!r}; expected CAMERA=VALUE, such as {option} {example}")
        pairs.append((name, value))
    return tuple(pairs)


def _pairs(given: Any) -> Any:
    return tuple(given.items()) if isinstance(given, Mapping) else tuple(map(tuple, given))
