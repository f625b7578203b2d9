"""The payload of all episodes of a run: one column per property."""

from typing import Any

import numpy as np

from probe_kit.hashing import sha256_json
from probe_kit.intervene.kinds.image_swap import swap_responses_by_episode
from probe_kit.runs.layout import FIRST_FRAME
from probe_kit.view.payloads.coding import Packed, code_words, pack_log_odds, rounded
from probe_kit.view.payloads.run_payload import best_places
from probe_kit.view.viewed_run import ViewedRun

_WORDS = {
    "item": "item_id",
    "category": "category",
    "layout": "layout",
    "instruction": "instruction",
    "target": "target_concept",
    "distractor": "distractor_concept",
    "side_correct": "side_correct",
    "side_placed": "side_placed",
    "ending": "truncation_reason",
}
"""Coded columns by the column of `run.episodes`; None where the run has no such column."""
_SHORT = 12
"""Hexadecimal digits that tell the seeds of episodes apart."""


def episodes_payload(viewed: ViewedRun) -> dict[str, Any]:
    """Numbers, ids and words of all episodes in the order of the plan.

    `log_odds`: of the category's best sites, held out, at the inference that the probes are of, toward the correct
    side. `swap`: of the stored image swap, 1 where the action follows the pictures, -1 where it does the reverse,
    else 0; None without any. `seeds`: equal where scene and policy seed are equal, by which runs are paired.
    """
    episodes = viewed.run.episodes
    words = _WORDS | ({"item": "picture"} if "picture" in episodes else {})
    none, zeros = [None] * len(episodes), [0] * len(episodes)
    return {
        "number": [int(number) for number in episodes["episode"]],
        "id": [str(name) for name in episodes["episode_id"]],
        **{
            name: code_words([_word(value) for value in episodes[column]] if column in episodes else none)
            for name, column in words.items()
        },
        "outcome": code_words([viewed.outcome_word(_word(value)) for value in episodes["outcome"]]),
        "steps": [None if value is None else int(value) for value in episodes.get("steps", none)],
        "distance": [rounded(value, 3) for value in episodes.get("distance_correct", none)],
        "seeds": [
            sha256_json([int(scene), int(policy)])[:_SHORT]
            for scene, policy in zip(episodes.get("scene_seed", zeros), episodes["policy_seed"], strict=True)
        ],
        "first_frame": [None if value is None else str(value)[:_SHORT] for value in _first_frames(viewed)],
        "swap": _swap_responses(viewed),
        "log_odds": {part: _best_log_odds(viewed, part) for part in ("backbone", "action")},
    }


def _swap_responses(viewed: ViewedRun) -> list[int | None]:
    responses = swap_responses_by_episode(viewed.run) if viewed.has_sides else {}
    return [responses.get(str(name)) for name in viewed.run.episodes["episode_id"]]


def _word(value: Any) -> str | None:
    return None if value is None or value != value else str(value)


def _first_frames(viewed: ViewedRun) -> list[Any]:
    episodes = viewed.run.episodes
    return list(episodes[FIRST_FRAME]) if FIRST_FRAME in episodes else [None] * len(episodes)


def _best_log_odds(viewed: ViewedRun, part: str) -> Packed | None:
    """Packed (E,); None without probes of that part."""
    places = {name: best_places(viewed, name)[part] for name in viewed.probed_categories}
    if all(best is None for best in places.values()):
        return None
    log_odds = np.full(len(viewed.run.episodes), np.nan)
    for position, category in enumerate(viewed.run.episodes["category"]):
        best = places.get(category)
        if best is not None:
            log_odds[position] = viewed.probes[category].first(position)[best["site"]]
    return pack_log_odds(log_odds)
