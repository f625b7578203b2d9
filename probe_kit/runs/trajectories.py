"""Trajectories in a run, and the outcomes and behaviour that are computed from them.

    data.zarr/trajectory   float32 (episode, frame, channel); frames behind the end of an episode are not numbers

One array beside the streams, one chunk per episode, named in the episode's commit. Frames and channels are those
of `probe_kit.env.scoring.Trajectory`.
"""

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict
from typing import Any, cast

import numpy as np
import pandas as pd
import zarr
from numpy.typing import NDArray
from zarr.abc.store import Store

from probe_kit.env.scoring import CHANNELS, RULES, Trajectory, behaviour_of, judge, rule_of
from probe_kit.env.spec import SceneSpec
from probe_kit.errors import RunDamagedError
from probe_kit.runs.arrays import EpisodeRows, create_array
from probe_kit.runs.layout import ROOM, TRAJECTORY
from probe_kit.suite.items import Side, other_side


def create_trajectories(store: Store, frames: int, codec: str) -> None:
    """Create the array, with `frames` one more than an episode has actions at most."""
    group = zarr.open_group(store, mode="a", zarr_format=3)
    length, names = len(CHANNELS), ("episode", "frame", "channel")
    create_array(
        group, TRAJECTORY, (ROOM, frames, length), (1, frames, length), "float32", np.nan, codec, names,
        {"channels": list(CHANNELS)},
    )  # fmt: skip


class Trajectories:
    """The trajectories of the committed episodes of a run, in their order.

    Args:
        rows: The rows of the array `trajectory`.
        steps: The number of actions of every committed episode.
        where: The run's name, for messages.

    Raises:
        RunDamagedError: If other channels are stored than those that are read today.
    """

    def __init__(self, rows: EpisodeRows, steps: Sequence[int], where: str) -> None:
        self._rows, self._steps, self._where = rows, steps, where
        channels = cast("list[str]", self._rows.array.attrs["channels"])
        if channels != list(CHANNELS):
            raise RunDamagedError(
                f"the trajectories of {where} have other channels than {', '.join(CHANNELS)}; another version of "
                "probe_kit stored them. Read them with the version that the run's provenance names"
            )

    def __len__(self) -> int:
        return len(self._steps)

    def __getitem__(self, position: int) -> Trajectory:
        """Return one episode's trajectory. Raises RunDamagedError if its bytes are missing, changed or too few."""
        return self._trajectory(self._rows[position], self._steps[position])

    def __iter__(self) -> Iterator[Trajectory]:
        return map(self._trajectory, self._rows, self._steps)

    def _trajectory(self, row: NDArray[np.float32], steps: int) -> Trajectory:
        frames = steps + 1
        if frames > len(row):
            raise RunDamagedError(
                f"a trajectory of {self._where} has room for {len(row)} frames; its outcome says {frames - 1} "
                "actions. Check the run with `probe-kit run verify --deep`"
            )
        return Trajectory.of_frames(row[:frames])


def judge_again(
    trajectories: Iterable[Trajectory], sides: Iterable[Side], scene: Mapping[str, Any], rule: str, last_steps: int
) -> pd.DataFrame:
    """Return a row per episode with the fields of `Judgement`.

    Args:
        trajectories: One of each episode.
        sides: Side of the correct picture of each episode.
        scene: The scene's settings as JSON, see `SceneSpec.to_json`.
        rule: Name of an outcome rule.
        last_steps: Number of control steps at the end that the rule judges.

    Raises:
        UsageError: For an unknown rule, or steps that it cannot judge.
    """
    by = rule_of(rule, scene)
    rows = [
        judge(trajectory, by, side, last_steps, scene["max_steps"])
        for trajectory, side in zip(trajectories, sides, strict=True)
    ]
    return pd.DataFrame([asdict(row) for row in rows])


def with_outcomes(episodes: pd.DataFrame, verdicts: pd.DataFrame) -> pd.DataFrame:
    """Return episodes with their outcome as judged, what follows from it, and the shares of the judged steps."""
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


def watch(
    trajectories: Iterable[Trajectory], sides: Iterable[Side], scene: Mapping[str, Any]
) -> tuple[dict[str, pd.DataFrame], pd.DataFrame]:
    """Return `Judgement` by rule, at the last step, and `Behaviour` of all episodes.

    Both come from one reading of the trajectories, which takes longer than every judgement of them.

    Args:
        trajectories: One trajectory per episode.
        sides: The correct side of every episode.
        scene: The scene as `SceneSpec.to_json()`.
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
    return {name: pd.DataFrame(rows) for name, rows in verdicts.items()}, pd.DataFrame(acts)
