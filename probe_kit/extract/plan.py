"""The plan of a run: episodes, their order and their estimated cost, computed before anything is written."""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from typing import Any, Self

from probe_kit.errors import UsageError
from probe_kit.extract.run_layout import StoredStream
from probe_kit.hashing import derive_seed, sha256_json
from probe_kit.suite import Episode, Suite
from probe_kit.suite.ladder import Wording, in_words


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
class Plan:
    """All episodes of a run, and the size of what they leave.

    skipped: by wording, how many items have none and are not asked in it; None for items in their own words.
    """

    suite: Suite
    episodes: tuple[PlannedEpisode, ...]
    streams: tuple[StoredStream, ...]
    bytes: int
    skipped: dict[Wording, int] | None = None

    def to_json(self) -> dict[str, Any]:
        """As stored in `plan/`: the episodes, each with its item's content hash, and the suite's parent."""
        return {"episodes": plan_rows(self.suite, self.episodes), "suite_parent": self.suite.parent}

    @property
    def selection(self) -> dict[str, Any]:
        """What was selected of which suite, as it stands among a run's settings; no part of its identity."""
        suite = self.suite
        return {
            "suite": {"identity": suite.identity, "content_sha256": suite.content_sha256},
            "categories": list(suite.categories),
            "items": len(suite.items),
            **({} if self.wordings is None else {"wordings": self.wordings}),
        }

    def numbered(self, numbers: Mapping[str, int]) -> Self:
        """The same episodes, in the same order, with the numbers that a run has for their ids."""
        episodes = (replace(one, index=numbers[one.episode.episode_id]) for one in self.episodes)
        return replace(self, episodes=tuple(episodes))

    def only(self, episodes: Iterable[PlannedEpisode]) -> Self:
        """A plan of these episodes alone, with their share of the bytes."""
        kept = tuple(episodes)
        return replace(self, episodes=kept, bytes=self.bytes * len(kept) // max(1, len(self.episodes)))

    def episode(self, number: int) -> PlannedEpisode:
        """The episode that has this number. Raises KeyError."""
        return self._by_number[number]

    @cached_property
    def _by_number(self) -> dict[int, PlannedEpisode]:
        return {one.index: one for one in self.episodes}

    @property
    def wordings(self) -> dict[str, Any] | None:
        """What names the wordings of a run beside its suite, None for items in their own words."""
        if self.skipped is None:
            return None
        texts = [[e.episode.episode_id, e.episode.item.instruction] for e in self.episodes]
        return {"names": list(self.skipped), "skipped": self.skipped, "texts_sha256": sha256_json(texts)}

    @property
    def sites(self) -> int:
        """Number of captured sites per inference."""
        return sum(len(stream.stream.sites()) for stream in self.streams)


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
) -> Plan:  # fmt: skip
    """Plan every episode of `suite`. Raises UsageError for a wording that no item has."""
    episodes = tuple(plan_episodes(suite, seed, wordings, asked_objects))
    per_call = sum(stream.raw_bytes(with_tokens) for stream in streams)
    skipped = None if wordings is None else skipped_items(suite, episodes, wordings)
    return Plan(suite, episodes, tuple(streams), per_call * calls * len(episodes), skipped)


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
