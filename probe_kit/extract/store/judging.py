"""The episodes of a run judged by an outcome rule, and what was done in them: tables made from trajectories."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict
from typing import Any

import pandas as pd

from probe_kit.env.behaviour import behaviour_of
from probe_kit.env.rules import judge, rule_of
from probe_kit.env.spec import SceneSpec
from probe_kit.env.trajectory import Trajectory
from probe_kit.suite.items import Side, other_side


def judged(
    trajectories: Iterable[Trajectory], sides: Iterable[Side], scene: Mapping[str, Any], rule: str, last_steps: int
) -> pd.DataFrame:
    """A row per episode with the fields of `Judgement`; scene: `SceneSpec.to_json()`. Raises UsageError."""
    by = rule_of(rule, scene)
    rows = [
        judge(seen, by, side, last_steps, scene["max_steps"])
        for seen, side in zip(trajectories, sides, strict=True)
    ]
    return pd.DataFrame([asdict(row) for row in rows])


def with_outcomes(episodes: pd.DataFrame, verdicts: pd.DataFrame) -> pd.DataFrame:
    """Episodes with their outcome, and all that follows from it, as judged; and the shares of the judged steps."""
    outcome = verdicts["outcome"]
    placed = [
        "none" if zone == "oob" else side if zone == "correct" else other_side(side)
        for zone, side in zip(outcome, episodes["side_correct"], strict=True)
    ]
    moved = episodes["cube_moved"].astype(bool)
    return episodes.assign(
        outcome=outcome.to_numpy(),
        is_success=(outcome == "correct").to_numpy(),
        side_placed=placed,
        never_moved=(outcome == "oob").to_numpy() & ~moved,
        **{f"share_{name}": verdicts[name].to_numpy() for name in ("correct", "wrong", "oob")},
    )


def behaviour_table(
    trajectories: Iterable[Trajectory], sides: Iterable[Side], scene: Mapping[str, Any]
) -> pd.DataFrame:
    """A row per episode with the fields of `Behaviour`."""
    default = SceneSpec()
    side = scene.get("scoring_side", default.scoring_side)
    half = side / 2 + scene.get("box_margin", default.box_margin)
    rows = [behaviour_of(seen, own, half, scene["moved"]) for seen, own in zip(trajectories, sides, strict=True)]
    return pd.DataFrame([asdict(row) for row in rows])
