"""Tables of a run's episodes by outcome rule and by behaviour, computed from stored trajectories."""

from collections.abc import Iterable, Mapping
from dataclasses import asdict, dataclass
from typing import Any

import pandas as pd

from probe_kit.env.scoring import RULES, Trajectory, behaviour_of, judge, rule_of
from probe_kit.env.spec import SceneSpec
from probe_kit.suite.items import Side, other_side


def judged(
    trajectories: Iterable[Trajectory], sides: Iterable[Side], scene: Mapping[str, Any], rule: str, last_steps: int
) -> pd.DataFrame:
    """A row per episode with the fields of `Judgement`; scene: `SceneSpec.to_json()`. Raises UsageError."""
    by = rule_of(rule, scene)
    rows = [
        judge(trajectory, by, side, last_steps, scene["max_steps"])
        for trajectory, side in zip(trajectories, sides, strict=True)
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


@dataclass(frozen=True)
class Watched:
    """The content of the trajectories of all episodes: `Judgement` by rule, at the last step, and `Behaviour`."""

    verdicts: Mapping[str, pd.DataFrame]
    behaviour: pd.DataFrame


def watch(trajectories: Iterable[Trajectory], sides: Iterable[Side], scene: Mapping[str, Any]) -> Watched:
    """All of it in one reading of the trajectories, which takes longer than every judgement of them.

    scene: `SceneSpec.to_json()`.
    """
    default = SceneSpec()  # scenes without these fields have the default ones
    half = scene.get("scoring_side", default.scoring_side) / 2 + scene.get("box_margin", default.box_margin)
    rules = {name: rule_of(name, scene) for name in RULES}
    verdicts: dict[str, list[dict[str, Any]]] = {name: [] for name in rules}
    acts: list[dict[str, Any]] = []
    for trajectory, side in zip(trajectories, sides, strict=True):
        for name, rule in rules.items():
            verdicts[name].append(asdict(judge(trajectory, rule, side, 1, scene["max_steps"])))
        acts.append(asdict(behaviour_of(trajectory, side, half, scene["moved"])))
    return Watched({name: pd.DataFrame(rows) for name, rows in verdicts.items()}, pd.DataFrame(acts))
