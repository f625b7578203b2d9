"""The plan of a run: its rows, their order and their estimated cost, computed before anything is written."""

from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any, Self

from probe_kit.runs.layout import StoredStream


@dataclass(frozen=True)
class Row:
    """One row of a plan, whatever its source: an episode of a scene, a stretch of a recording, a picture.

    index: its number in the run, where its objects lie. In a run that grew, numbers are not in the plan's order.
    columns: the row as flat columns, of which every source has `episode_id`, `item_id`, `category`, `group_id`,
    `instruction` and `policy_seed`. content: what the source's player plays. frames: recorded frames that the
    inferences see; None where every inference sees what the actions before it led to.
    """

    index: int
    columns: Mapping[str, Any]
    content: Any = None
    frames: Sequence[int] | None = None

    @property
    def episode_id(self) -> str:
        """Its id, the same in every selection."""
        return str(self.columns["episode_id"])

    @property
    def category(self) -> str:
        """The category that tables group it by."""
        return str(self.columns["category"])

    @property
    def instruction(self) -> str:
        """The words that the model reads."""
        return str(self.columns["instruction"])

    @property
    def policy_seed(self) -> int:
        """The seed from which every inference of the row derives its own."""
        return int(self.columns["policy_seed"])

    def numbered(self, index: int) -> Self:
        """The same row under another number."""
        return replace(self, index=index)

    def control_step(self, call: int, executed: int) -> int:
        """The step that inference `call` sees: a recorded frame, or as many actions as were executed before."""
        return executed if self.frames is None else self.frames[call]

    def noise_of(self, call: int) -> int:
        """The number that the seed of inference `call` is derived from, whichever other frames were chosen."""
        return call if self.frames is None else self.frames[call]

    def to_json(self) -> dict[str, Any]:
        """The row as flat columns."""
        return {"episode": self.index, **self.columns}


@dataclass(frozen=True)
class Plan:
    """All rows of a run in order, and the size of what they leave.

    identity: the part of a run's identity that says where observations come from. selection: what was selected, as
    it stands among a run's settings; no part of its identity. name_parts: what the default name of a run depends
    on beside its identity. suite_parent: of a suite that was selected of another one, the hash of that. decoder:
    what makes pictures of stored videos here, with its version.
    """

    episodes: tuple[Row, ...]
    streams: tuple[StoredStream, ...]
    bytes: int
    identity: Mapping[str, Any] = field(default_factory=dict)
    selection: dict[str, Any] = field(default_factory=dict)
    name_parts: Sequence[Any] = ()
    suite_parent: Any = None
    decoder: str | None = None

    def to_json(self) -> dict[str, Any]:
        """Return the plan as stored in `plan/`: `episodes` as flat columns, and `suite_parent`."""
        return {"episodes": [row.to_json() for row in self.episodes], "suite_parent": self.suite_parent}

    def numbered(self, numbers: Mapping[str, int]) -> Self:
        """The same rows, in the same order, with the numbers that a run has for their ids."""
        return replace(self, episodes=tuple(row.numbered(numbers[row.episode_id]) for row in self.episodes))

    def only(self, episodes: Iterable[Row]) -> Self:
        """A plan of these rows alone, with their share of the bytes."""
        rows = tuple(episodes)
        return replace(self, episodes=rows, bytes=self.bytes * len(rows) // max(1, len(self.episodes)))

    def episode(self, number: int) -> Row:
        """The row that has this number. Raises KeyError."""
        return self._by_number[number]

    @cached_property
    def _by_number(self) -> dict[int, Row]:
        return {row.index: row for row in self.episodes}

    @property
    def sites(self) -> int:
        """Number of captured sites per inference."""
        return sum(len(stream.stream.sites()) for stream in self.streams)
