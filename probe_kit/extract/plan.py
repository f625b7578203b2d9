"""The plan: which episodes in which order, and what they will cost, before anything is written."""

import shutil
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from probe_kit.errors import DiskSpaceError
from probe_kit.extract.layout import StoredStream
from probe_kit.identity import derive_seed
from probe_kit.suite import Episode, Suite

# The estimate is of uncompressed bytes; this much more covers commits and file-system blocks.
HEADROOM = 1.1


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


def make_plan(suite: Suite, streams: list[StoredStream], seed: int, calls: int, with_tokens: bool) -> Plan:
    """Plan every episode of `suite`."""
    episodes = tuple(
        PlannedEpisode(
            index,
            episode,
            scene_seed=derive_seed(seed, "scene", episode.item.item_id),
            policy_seed=derive_seed(seed, "policy", episode.episode_id),
        )
        for index, episode in enumerate(suite.episodes())
    )
    per_call = sum(stream.raw_bytes(with_tokens) for stream in streams)
    return Plan(suite, episodes, tuple(streams), per_call * calls * len(episodes))


def refuse_if_full(plan: Plan, out: Path) -> None:
    """Raise DiskSpaceError if the plan with headroom exceeds the free space where `out` will lie."""
    place = next(parent for parent in (out, *out.resolve().parents) if parent.exists())
    free = shutil.disk_usage(place).free
    if plan.bytes * HEADROOM > free:
        raise DiskSpaceError(
            f"the run needs up to {plan.bytes * HEADROOM / 1e9:.1f} GB but {place} has {free / 1e9:.1f} GB free. "
            "Use fewer --items, --tokens pooled, another --out, or --force"
        )
