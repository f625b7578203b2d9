"""The plan of a run: episodes, their order and their estimated cost, computed before anything is written."""

from abc import ABC, abstractmethod
from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Protocol, Self

from probe_kit.errors import UsageError
from probe_kit.hashing import derive_seed, sha256_json
from probe_kit.runs.layout import LaterViews, StoredStream
from probe_kit.suite import Episode, Suite
from probe_kit.suite.wording import Wording, in_words


class PlannedRow(Protocol):
    """One row of a plan, wherever its observations come from: an episode of a scene, a stretch of a recording."""

    @property
    def index(self) -> int:
        """Its number in the run, where its objects lie."""

    @property
    def policy_seed(self) -> int:
        """From which every inference of the row derives its own seed."""

    @property
    def episode_id(self) -> str:
        """Its id, the same in every selection."""

    @property
    def category(self) -> str:
        """What tables group it by."""

    @property
    def instruction(self) -> str:
        """What the model reads."""

    def numbered(self, index: int) -> Self:
        """The same row under another number."""

    def control_step(self, call: int, executed: int) -> int:
        """What inference `call` saw: the frame after `executed` actions, or a recorded frame by its number."""

    def noise_of(self, call: int) -> int:
        """Which number its seed for inference `call` is derived from."""

    def to_json(self) -> dict[str, Any]:
        """The row as flat columns."""


@dataclass(frozen=True)
class PlannedEpisode:
    """One row of the plan. Seeds depend on the run's seed and the episode alone.

    Both layouts of an item start from the same scene, and all wordings of an episode from the same seeds.
    index: its number in the run, where its objects lie. In a run that grew, numbers are not in the plan's order.
    asked_object: what a question asks for, where this is not the object of the instruction.
    """

    index: int
    episode: Episode
    scene_seed: int
    policy_seed: int
    asked_object: str | None = None

    @property
    def episode_id(self) -> str:
        """Item, layout and wording."""
        return self.episode.episode_id

    @property
    def category(self) -> str:
        """That of its item."""
        return self.episode.item.category

    @property
    def instruction(self) -> str:
        """That of its item, in the wording of the episode."""
        return self.episode.item.instruction

    def numbered(self, index: int) -> Self:
        """The same episode under another number."""
        return replace(self, index=index)

    def control_step(self, call: int, executed: int) -> int:
        """As many actions as were executed before."""
        del call
        return executed

    def noise_of(self, call: int) -> int:
        """The inference itself."""
        return call

    def to_json(self) -> dict[str, Any]:
        """The planned episode as flat columns."""
        item, wording = self.episode.item, self.episode.wording
        return {
            "episode": self.index,
            "episode_id": self.episode.episode_id,
            "item_id": item.item_id,
            "category": item.category,
            "group_id": item.group_id,
            "pair_id": item.pair_id,
            "layout": self.episode.layout,
            "side_correct": self.episode.side_correct,
            "instruction": item.instruction,
            "target_concept": item.target_concept,
            "distractor_concept": item.distractor_concept,
            "scene_seed": self.scene_seed,
            "policy_seed": self.policy_seed,
            **({} if wording is None else {"wording": wording}),
            **({} if self.asked_object is None else {"asked_object": self.asked_object}),
        }


@dataclass(frozen=True)
class RowPlan(ABC):
    """All rows of a run in order, and the size of what they leave."""

    episodes: tuple[PlannedRow, ...]
    streams: tuple[StoredStream, ...]
    bytes: int

    @property
    @abstractmethod
    def identity(self) -> dict[str, Any]:
        """What a run's identity says of where its observations come from."""

    @property
    @abstractmethod
    def name_parts(self) -> list[Any]:
        """What the default name of a run depends on beside its identity."""

    @property
    @abstractmethod
    def selection(self) -> dict[str, Any]:
        """What was selected, as it stands among a run's settings; no part of its identity."""

    @property
    def decoder(self) -> str | None:
        """What makes pictures of stored videos here, with its version; None where nothing is decoded."""
        return None

    @abstractmethod
    def to_json(self) -> dict[str, Any]:
        """As stored in `plan/`: `episodes` as flat columns, and `suite_parent`."""

    def numbered(self, numbers: Mapping[str, int]) -> Self:
        """The same episodes, in the same order, with the numbers that a run has for their ids."""
        return replace(self, episodes=tuple(one.numbered(numbers[one.episode_id]) for one in self.episodes))

    def only(self, episodes: Iterable[PlannedRow]) -> Self:
        """A plan of these episodes alone, with their share of the bytes."""
        kept = tuple(episodes)
        return replace(self, episodes=kept, bytes=self.bytes * len(kept) // max(1, len(self.episodes)))

    def episode(self, number: int) -> PlannedRow:
        """The episode that has this number. Raises KeyError."""
        return self._by_number[number]

    @cached_property
    def _by_number(self) -> dict[int, PlannedRow]:
        return {one.index: one for one in self.episodes}

    @property
    def sites(self) -> int:
        """Number of captured sites per inference."""
        return sum(len(stream.stream.sites()) for stream in self.streams)


@dataclass(frozen=True)
class Plan(RowPlan):
    """All episodes of a suite.

    skipped: by wording, how many items have none and are not asked in it; None for items in their own words.
    """

    episodes: tuple[PlannedEpisode, ...]
    suite: Suite
    skipped: dict[Wording, int] | None = None

    @property
    def identity(self) -> dict[str, Any]:
        """Name and version of the suite; items are compared one by one, by their content."""
        return {"suite": suite_name(self.suite)}

    @property
    def name_parts(self) -> list[Any]:
        """The whole suite and the selected categories."""
        return [self.suite.whole.content_sha256, self.suite.categories]

    def to_json(self) -> dict[str, Any]:
        """As stored in `plan/`: the episodes, each with its item's content hash, and the suite's parent."""
        return {"episodes": plan_rows(self.suite, self.episodes), "suite_parent": self.suite.parent}

    @property
    def selection(self) -> dict[str, Any]:
        """What was selected of which suite, as it stands among a run's settings; no part of its identity."""
        suite = self.suite
        return {
            "suite": {
                "identity": suite.identity,
                "content_sha256": suite.content_sha256,
                "seed_text": suite.seed_text,
            },
            "categories": list(suite.categories),
            "items": len(suite.items),
            **({} if self.wordings is None else {"wordings": self.wordings}),
        }

    @property
    def wordings(self) -> dict[str, Any] | None:
        """What names the wordings of a run beside its suite, None for items in their own words."""
        if self.skipped is None:
            return None
        texts = [[e.episode.episode_id, e.episode.item.instruction] for e in self.episodes]
        return {"names": list(self.skipped), "skipped": self.skipped, "texts_sha256": sha256_json(texts)}


def suite_name(suite: Suite) -> dict[str, str]:
    """What a run's identity says of its suite; items are compared one by one, by their content."""
    return {"name": suite.name, "version": suite.version}


def plan_episodes(
    suite: Suite, seed: int, wordings: Sequence[Wording] | None = None, asked_objects: Mapping[str, str] = {}
) -> Iterator[PlannedEpisode]:
    """Every episode of `suite` in order, with its seeds, in each of `wordings` that its item has.

    Nothing about an episode depends on which others are planned, so the plan of more items holds that of fewer.
    asked_objects: by item, what a question asks for. Raises SuiteError if an item's own words for a wording are
    none.
    """
    worded = suite.episodes() if wordings is None else _in_every_wording(suite, wordings)
    for index, episode in enumerate(worded):
        yield PlannedEpisode(
            index,
            episode,
            scene_seed=derive_seed(seed, "scene", episode.item.item_id),
            policy_seed=derive_seed(seed, "policy", episode.seed_id),
            asked_object=asked_objects.get(episode.item.item_id),
        )


def plan_rows(suite: Suite, episodes: Iterable[PlannedEpisode]) -> list[dict[str, Any]]:
    """The episodes as flat columns, each with its item's content hash."""
    # Of the items themselves: an episode in another wording holds its item with that wording as instruction.
    content = {item.item_id: item.content_sha256 for item in suite.items}
    return [
        {**planned.to_json(), "item_content_sha256": content[planned.episode.item.item_id]} for planned in episodes
    ]


def _in_every_wording(suite: Suite, wordings: Sequence[Wording]) -> Iterator[Episode]:
    for episode in suite.episodes():
        yield from filter(None, (in_words(episode, wording) for wording in wordings))


def instructions_of(episodes: Iterable[PlannedEpisode]) -> tuple[str, ...]:
    """Every instruction once, in the order of their letters."""
    return tuple(sorted({planned.episode.item.instruction for planned in episodes}))


def make_plan(
    suite: Suite, streams: list[StoredStream], seed: int, calls: int, with_tokens: bool,
    wordings: Sequence[Wording] | None = None, asked_objects: Mapping[str, str] = {},
    later_views: LaterViews = "all",
) -> Plan:  # fmt: skip
    """Plan every episode of `suite`. Raises UsageError for a wording that no item has."""
    episodes = tuple(plan_episodes(suite, seed, wordings, asked_objects))
    size = sum(stream.raw_bytes(with_tokens, calls, later_views) for stream in streams)
    skipped = None if wordings is None else skipped_items(suite, episodes, wordings)
    return Plan(episodes, tuple(streams), size * len(episodes), suite, skipped)


def skipped_items(
    suite: Suite, episodes: Sequence[PlannedEpisode], wordings: Sequence[Wording]
) -> dict[Wording, int]:
    """By wording, how many items of `suite` have none. Raises UsageError for a wording that no item has."""
    skipped = {}
    for wording in wordings:
        asked = {planned.episode.item.item_id for planned in episodes if planned.episode.wording == wording}
        if not asked:
            raise UsageError(
                f"no item of {suite.identity} has the wording {wording!r}. Leave it out of --wordings, or "
                "write it into the suite's metadata (field `wordings`)"
            )
        skipped[wording] = len(suite.items) - len(asked)
    return skipped
