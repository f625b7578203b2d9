"""The plan: which episodes in which order, and what they will cost, before anything is written."""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

from probe_kit.extract.store.layout import StoredStream
from probe_kit.identity import derive_seed
from probe_kit.suite import Episode, Suite


@dataclass(frozen=True)
class PlannedEpisode:
    """One row of the plan. Seeds depend on the run's seed and the episode alone.

    Both layouts of an item start from the same scene.
    """

    index: int
    episode: Episode
    scene_seed: int
    policy_seed: int

    def to_json(self) -> dict[str, Any]:
        """As stored in `plan.json`."""
        item = self.episode.item
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
        }


@dataclass(frozen=True)
class Plan:
    """All episodes of a run, and the size of what they leave."""

    suite: Suite
    episodes: tuple[PlannedEpisode, ...]
    streams: tuple[StoredStream, ...]
    bytes: int

    @property
    def sites(self) -> int:
        """Number of captured sites per inference."""
        return sum(len(stream.stream.sites()) for stream in self.streams)


def plan_episodes(suite: Suite, seed: int) -> Iterator[PlannedEpisode]:
    """Every episode of `suite` in order, with its seeds."""
    for index, episode in enumerate(suite.episodes()):
        yield PlannedEpisode(
            index,
            episode,
            scene_seed=derive_seed(seed, "scene", episode.item.item_id),
            policy_seed=derive_seed(seed, "policy", episode.episode_id),
        )


def make_plan(suite: Suite, streams: list[StoredStream], seed: int, calls: int, with_tokens: bool) -> Plan:
    """Plan every episode of `suite`."""
    episodes = tuple(plan_episodes(suite, seed))
    per_call = sum(stream.raw_bytes(with_tokens) for stream in streams)
    return Plan(suite, episodes, tuple(streams), per_call * calls * len(episodes))
