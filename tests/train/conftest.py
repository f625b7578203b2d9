"""Runs in memory with a signal planted where a test wants it."""

from collections.abc import Callable, Iterator, Mapping
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd
import pytest
from threadpoolctl import threadpool_limits

from probe_kit.hashing import derive_seed
from probe_kit.hooks import Site, Stream
from probe_kit.train import ArrayRun, ProbeSettings, Target
from probe_kit.train.probe_sweep import ProbeSweep
from probe_kit.train.problem import Problem

PlantedRun = Callable[..., ArrayRun]


@pytest.fixture(autouse=True, scope="session")
def one_thread() -> Iterator[None]:
    """The matrices are tiny: on a busy machine more threads wait for each other."""
    with threadpool_limits(1):
        yield


def episode_table(n_items: int, category: str, seed: int = 0) -> pd.DataFrame:
    """Both layouts of `n_items` items; items 2k and 2k+1 share a picture."""
    generator = np.random.default_rng(derive_seed(category, seed))
    rows = []
    for number in range(n_items):
        left_first = bool(generator.random() < 0.5)
        for layout in ("original", "swapped"):
            side = "left" if left_first == (layout == "original") else "right"
            placed = str(generator.choice(["left", "right", "none"], p=[0.45, 0.35, 0.2]))
            outcome = "oob" if placed == "none" else "correct" if placed == side else "wrong"
            rows.append(
                {
                    "episode_id": f"{category}-{number}:{layout[0]}",
                    "item_id": f"{category}-{number}",
                    "category": category,
                    "group_id": f"{category}-group-{number // 2}",
                    "layout": layout,
                    "instruction": f"put the cube on picture {number % 7}",
                    "side_correct": side,
                    "side_placed": placed,
                    "outcome": outcome,
                }
            )
    return pd.DataFrame(rows)


def plant(
    folder: Path,
    planted: Mapping[Site, float] | None = None,
    n_items: int = 40,
    categories: tuple[str, ...] = ("color",),
) -> ArrayRun:
    """Make a run: a backbone of 5 layers and an expert of 2 layers × 2 iterations, noise except where planted.

    planted: per site, how strongly the side of the correct picture moves one feature.
    """
    episodes = pd.concat([episode_table(n_items, name) for name in categories], ignore_index=True)
    sign = np.where(episodes["side_correct"] == "left", 1.0, -1.0)
    features = {}
    for stream in (Stream("backbone", 5, 20), Stream("expert", 2, 8, iterations=2)):
        for site in stream.sites():
            noise = np.random.default_rng(derive_seed(str(site)))
            array = noise.standard_normal((len(episodes), stream.width))
            array[:, 3] += (planted or {}).get(site, 0.0) * sign
            features[site, "mean"] = array
    return ArrayRun(folder, "planted", "noise@1#0123456789ab", episodes, features)


@pytest.fixture
def planted_run(tmp_path: Path) -> PlantedRun:
    """Makes runs, see `plant`."""
    return partial(plant, tmp_path / "run")


def problem_of(
    run: ArrayRun | pd.DataFrame, category: str = "color", target: Target | str = "side.correct", **options: Any
) -> Problem:
    """Return the problem of a category that `train_probes` would probe; of a table the features are zeros."""
    if isinstance(run, pd.DataFrame):
        episodes = run.reset_index(drop=True)
        blank = np.zeros((len(episodes), 1), np.float32)
        run = ArrayRun(Path("nowhere"), "m", "s@1#0", episodes, {(Site("backbone", 0), "mean"): blank})
    options = {"views": ("mean",), "permutations": 30, "seed": 0, **options}
    return ProbeSweep.of(run, target, (category,), **options).problems[category]


def settings_of(permutations: int, seed: int = 0) -> ProbeSettings:
    """Return settings of which only the label permutations and the seed decide the problem of a label."""
    return ProbeSettings("m", False, None, "", "", "", "", ("all",), ("mean",), "y", permutations, seed)
