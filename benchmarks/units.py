"""How often is a data set refused for its units, of its own checkpoint and of one in other units?

    python benchmarks/units.py [--worlds 40] [--seed 0] [--folder FOLDER]

A world is a robot and a task: joints, a gripper, and a joint that never moves, at a small or a large value.
Its episodes lie at other places, more or less far apart. lerobot writes the training data, a part of its episodes,
a fresh recording, and one at a single spot. A checkpoint has the statistics that lerobot wrote of the training
data: all of them, or those of its mode alone. The first table counts refusals of unchanged data. The second says
what was noticed of data that lerobot wrote in other units. Exits with 1 if own data are refused in over 1 % of the
comparisons, or a factor of 57.3 or 1,000 is missed in over 5 %.
"""

import argparse
import contextlib
import io
import json
import logging
import sys
import tempfile
from collections import Counter
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import tests_of_checkout  # noqa: F401
from numpy.typing import NDArray

from probe_kit.extract.sources.lerobot_folder import LeRobotFolder, LeRobotFrames
from probe_kit.extract.sources.units import Units, compare_units
from probe_kit.hooks.contract.feature_statistics import FeatureStatistics
from probe_kit.hooks.families.shared.lerobot.normaliser import Normaliser

FEATURES = {"observation.state": 8, "action": 7}
MODES = {"MEAN_STD": ("mean", "std"), "MIN_MAX": ("min", "max"), "QUANTILES": ("q01", "q99"),
         "QUANTILE10": ("q10", "q90")}  # fmt: skip
JOINTS, GRIPPER = 6, 6
Episodes = list[dict[str, NDArray[np.float32]]]


@dataclass(frozen=True)
class World:
    """The distribution of the numbers of a robot's episodes."""

    centers: NDArray[np.float64]
    between: NDArray[np.float64]
    within: NDArray[np.float64]
    skew: NDArray[np.float64]
    closed: float
    constant: float
    lengths: tuple[int, int]

    @classmethod
    def draw(cls, random: np.random.Generator) -> "World":
        """Draw a world; the spread between episodes is a fiftieth to fifty times that inside of one."""
        ratio = 10 ** random.uniform(-1.7, 1.7)
        spread = random.choice([0.05, 0.3, 1.0], JOINTS) * random.uniform(0.5, 2, JOINTS)
        between = spread * ratio / np.hypot(1, ratio)
        centers = random.choice([0.0, 1.0], JOINTS, p=[0.4, 0.6]) * random.normal(0, 1, JOINTS)
        constant = float(random.choice([0.0, 0.3, -1.5708, 100.3, 1000.3, 1e-3]))
        shortest = int(random.choice([8, 20, 50]))
        skew = random.choice([0.0, 0.6], JOINTS)
        return cls(centers, between, np.sqrt(spread**2 - between**2), skew, random.uniform(0.05, 0.6), constant,
                   (shortest, 2 * shortest))  # fmt: skip

    def at_one_spot(self, random: np.random.Generator) -> "World":
        """Return the same robot at one place of its workspace, where it moves a tenth to a thirtieth as far."""
        share = random.uniform(10, 30, JOINTS)
        centre = self.centers + self.between * random.standard_normal(JOINTS)
        return replace(self, centers=centre, between=self.between / share, within=self.within / share)

    def play(self, episodes: int, random: np.random.Generator) -> Episodes:
        """Return episodes: a smooth motion around a place of each, and actions that follow it."""
        return [self._episode(random) for _ in range(episodes)]

    def _episode(self, random: np.random.Generator) -> dict[str, NDArray[np.float32]]:
        frames = int(random.integers(*self.lengths))
        time = np.linspace(0, 1, frames)[:, None]
        centre = self.centers + self.between * random.standard_normal(JOINTS)
        waves = sum(
            random.standard_normal(JOINTS) * np.cos(np.pi * k * time + random.uniform(0, 6)) for k in (1, 2, 3)
        )
        # Some numbers are bent, so that their distribution is not symmetric.
        bent = (1 - self.skew) * waves + self.skew * (waves**2 - 1.5) / 1.5
        joints = centre + self.within * bent / 1.22 + 0.02 * self.within * random.standard_normal((frames, JOINTS))
        share = np.clip(self.closed + random.normal(0, 0.1), 0.02, 0.98)
        gripper = np.where(time[:, 0] < share, 0.02, 0.98) + random.normal(0, 0.005, frames)
        state = np.column_stack([joints, gripper, np.full(frames, self.constant)])
        action = np.column_stack([np.diff(joints, axis=0, append=joints[-1:]), np.round(gripper)])
        return {"observation.state": state.astype(np.float32), "action": action.astype(np.float32)}


# -- data sets that lerobot writes ----------------------------------------------------------------------------


def write(folder: Path, episodes: Episodes) -> LeRobotFolder:
    """Return a data set that lerobot wrote of these numbers, without pictures."""
    from lerobot.datasets.lerobot_dataset import LeRobotDataset

    features = {name: {"dtype": "float32", "shape": (width,), "names": None} for name, width in FEATURES.items()}
    with contextlib.redirect_stderr(io.StringIO()):
        data = LeRobotDataset.create("local/set", 10, features, root=folder, use_videos=False)
        for episode in episodes:
            for frame in range(len(episode["action"])):
                data.add_frame({**{name: numbers[frame] for name, numbers in episode.items()}, "task": "Reach"})
            data.save_episode()
        data.finalize()
    return LeRobotFolder.read(folder)


def expected_of(folder: LeRobotFolder, feature: str, mode: str, complete: bool) -> FeatureStatistics:
    """Return the statistics of a checkpoint that was trained on a data set, as its processor has them."""
    stored = json.loads((folder.path / "meta" / "stats.json").read_text(encoding="utf-8"))[feature]
    low, high = (np.asarray(stored[name], np.float32) for name in MODES[mode])
    other_statistics = (
        {name: np.asarray(numbers, np.float32) for name, numbers in stored.items()} if complete else {}
    )
    statistics = Normaliser(mode, low, high, 1e-8, "file", stored=other_statistics).statistics
    assert statistics is not None
    return statistics


def compare(
    expected: FeatureStatistics, folder: LeRobotFolder, feature: str, episodes: Sequence[int] | None = None
) -> Units:
    """Compare chosen episodes of a data set as `dataset show` does."""
    reader = LeRobotFrames(folder)
    compared_episodes = range(len(folder.lengths)) if episodes is None else episodes
    frames = [reader.numbers(episode, [feature])[feature].astype(np.float32) for episode in compared_episodes]
    return compare_units(expected, frames, folder.names(feature), folder.statistics(feature))


# -- other units -----------------------------------------------------------------------------------------------


def scaled(factor: float, numbers: Sequence[int]) -> Callable[[NDArray[np.float32]], NDArray[np.float32]]:
    """Return a function that multiplies some numbers (T, D)."""

    def change(values: NDArray[np.float32]) -> NDArray[np.float32]:
        changed = values.copy()
        changed[:, list(numbers)] *= np.float32(factor)
        return changed

    return change


def shifted(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the first number with a quarter turn more."""
    changed = values.copy()
    changed[:, 0] += np.float32(np.pi / 2)
    return changed


def exchanged(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the first and the fourth number in each other's place."""
    return values[:, [3, 1, 2, 0, *range(4, values.shape[1])]]


def turned_round(values: NDArray[np.float32]) -> NDArray[np.float32]:
    """Return the gripper as 1 − x."""
    changed = values.copy()
    changed[:, GRIPPER] = 1 - changed[:, GRIPPER]
    return changed


DEGREES, ALL, SOME = 180 / np.pi, range(JOINTS), range(3)
CHANGES: dict[str, tuple[str, Callable[[NDArray[np.float32]], NDArray[np.float32]]]] = {
    "× 57.3, six numbers": ("factor", scaled(DEGREES, ALL)),
    "÷ 57.3, six numbers": ("factor", scaled(1 / DEGREES, ALL)),
    "× 57.3, three numbers": ("factor", scaled(DEGREES, SOME)),
    "÷ 57.3, three numbers": ("factor", scaled(1 / DEGREES, SOME)),
    "× 1,000, three numbers": ("factor", scaled(1000, SOME)),
    "÷ 1,000, three numbers": ("factor", scaled(1e-3, SOME)),
    "× 100, gripper": ("factor", scaled(100, [GRIPPER])),
    "÷ 100, gripper": ("factor", scaled(0.01, [GRIPPER])),
    "sign of one number": ("sign", scaled(-1, [0])),
    "one number + π/2": ("offset", shifted),
    "two numbers exchanged": ("exchange", exchanged),
    "gripper as 1 − x": ("inverted", turned_round),
}
BOUND = ("× 57.3, six numbers", "÷ 57.3, six numbers", "× 57.3, three numbers", "÷ 57.3, three numbers",
         "× 1,000, three numbers", "÷ 1,000, three numbers")  # fmt: skip

SHARES = 3
"""One in so many changes is made of every world."""


def changed(episodes: Episodes, change: Callable[[NDArray[np.float32]], NDArray[np.float32]]) -> Episodes:
    """Return the episodes with changed numbers."""
    return [{name: change(numbers) for name, numbers in episode.items()} for episode in episodes]


# -- the tables ------------------------------------------------------------------------------------------------


def checkpoints(training: LeRobotFolder, feature: str) -> Iterator[FeatureStatistics]:
    """Yield the statistics of a checkpoint of every mode, with all that lerobot stores and with two alone."""
    for mode in MODES:
        yield expected_of(training, feature, mode, complete=True)
    yield expected_of(training, feature, "MEAN_STD", complete=False)
    yield expected_of(training, feature, "MIN_MAX", complete=False)


def measure(folder: Path, seed: int, same_counts: Counter[Any], other: Counter[Any]) -> None:
    """Add the outcomes of one world to the counts, with a third of the changes."""
    random = np.random.default_rng(seed)
    world = World.draw(random)
    count = int(random.choice([1, 2, 4, 10, 16]))
    episodes, fresh = world.play(count, random), world.play(8, random)
    training = write(folder / "training", episodes)
    part = write(folder / "part", episodes[: max(1, count // 3)])
    later = write(folder / "later", fresh)
    spot = write(folder / "spot", world.at_one_spot(random).play(4, random))
    some = sorted(random.choice(count, size=min(count, 2), replace=False).tolist())
    sets: dict[str, tuple[LeRobotFolder, Sequence[int] | None]] = {
        "own, all episodes": (training, None),
        "own, one or two episodes chosen": (training, some),
        "own, a third as a data set": (part, None),
        f"fresh, trained on {'1 to 4' if count < 10 else '10 or 16'} episodes": (later, None),
        f"one spot, trained on {'1 to 4' if count < 10 else '10 or 16'} episodes": (spot, None),
    }
    for feature in FEATURES:
        for expected in checkpoints(training, feature):
            for name, (data, selected) in sets.items():
                outcome = compare(expected, data, feature, selected)
                same_counts[name, "refused" if outcome.are_other else "warned" if outcome.misfits else "fits"] += 1
    for name in list(CHANGES)[seed % SHARES :: SHARES]:
        kind, change = CHANGES[name]
        for origin, numbers in (("own", episodes), ("fresh", fresh)):
            data = write(folder / f"{origin}-{name}", changed(numbers, change))
            for feature in FEATURES:
                for expected in checkpoints(training, feature):
                    outcome = compare(expected, data, feature)
                    is_named = any(misfit.kind == kind for misfit in outcome.misfits)
                    weight = "refused" if outcome.are_other else "warned" if outcome.misfits else "missed"
                    group = origin if origin == "own" or count >= 10 else "few"
                    other[name, group, feature, weight] += 1
                    other[name, group, feature, "named"] += is_named


def main() -> None:
    """Print both tables."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--worlds", type=int, default=40, help="robots and tasks that are drawn")
    parser.add_argument("--seed", type=int, default=0, help="of the first world")
    parser.add_argument("--folder", type=Path, help="for the data sets; a temporary one by default")
    options = parser.parse_args()
    logging.disable(logging.WARNING)
    same_counts, other = Counter[Any](), Counter[Any]()
    for seed in range(options.seed, options.seed + options.worlds):
        with tempfile.TemporaryDirectory(dir=options.folder) as folder:
            measure(Path(folder), seed, same_counts, other)
        print(f"world {seed}", file=sys.stderr)
    print("unchanged data                          comparisons  refused %  warned %")
    for name in dict.fromkeys(name for name, _ in same_counts):
        counts = [same_counts[name, weight] for weight in ("refused", "warned", "fits")]
        total = sum(counts)
        print(f"{name:40}{total:11}{100 * counts[0] / total:11.1f}{100 * counts[1] / total:10.1f}")
    heads = f"{'comparisons':>11}{'refused %':>11}{'warned %':>10}{'missed %':>10}{'named %':>9}"
    print(f"\n{'change':26}{'data':7}{'feature':19}{heads}")
    rows = sorted({key[:3] for key in other}, key=lambda key: ([*CHANGES].index(key[0]), key))
    for name, origin, feature in rows:
        counts = [other[name, origin, feature, weight] for weight in ("refused", "warned", "missed", "named")]
        total = sum(counts[:3])
        shares = [100 * part / total for part in counts]
        print(
            f"{name:26}{origin:7}{feature:19}{total:11}{shares[0]:11.1f}{shares[1]:15.1f}{shares[2]:10.1f}{shares[3]:9.1f}"
        )
    refused = sum(
        count for (name, weight), count in same_counts.items() if name.startswith("own") and weight == "refused"
    )
    compared = sum(count for (name, _), count in same_counts.items() if name.startswith("own"))
    bound = Counter[str]()
    for (name, _, _, weight), count in other.items():
        if name in BOUND and weight != "named":
            bound[weight] += count
    sys.exit(int(refused > 0.01 * compared or bound["missed"] > 0.05 * bound.total()))


if __name__ == "__main__":
    main()
