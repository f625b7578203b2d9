"""Runs whose probe accuracies are set by hand: decisions are right with a given probability."""

import sys
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from probe_kit.hashing import derive_seed
from probe_kit.hooks import Site
from probe_kit.train import ArrayRun, ProbeCurve, ProbeResults, ProbeSettings, save_results
from probe_kit.train.results.probe_results import episodes_sha256
from tests.support.inner_qualities import inner_of


def outcomes(correct: int, wrong: int, oob: int, category: str = "color") -> pd.DataFrame:
    """Two layouts per item, with as many outcomes of each kind, in this order."""
    outcome = ["correct"] * correct + ["wrong"] * wrong + ["oob"] * oob
    rows = []
    for number, result in enumerate(outcome):
        item, swapped = divmod(number, 2)
        side = ("left", "right")[(item + swapped) % 2]
        other = {"left": "right", "right": "left"}[side]
        rows.append(
            {
                "episode_id": f"{category}-{item}:{'os'[swapped]}",
                "item_id": f"{category}-{item}",
                "group_id": f"{category}-{item}",
                "category": category,
                "layout": ("original", "swapped")[swapped],
                "side_correct": side,
                "outcome": result,
                "side_placed": {"correct": side, "wrong": other, "oob": "none"}[result],
            }
        )
    return pd.DataFrame(rows)


def curve(
    episodes: pd.DataFrame,
    backbone: Sequence[float],
    expert: Sequence[Sequence[float]],
    null_top: float = 0.6,
    action_stream: str = "expert",
) -> ProbeCurve:
    """One backbone accuracy per layer and one expert accuracy per iteration and layer; nulls up to `null_top`."""
    sites = [Site("backbone", layer) for layer in range(len(backbone))]
    sites += [
        Site(action_stream, layer, "residual", step)
        for step, row in enumerate(expert)
        for layer in range(len(row))
    ]
    share = np.array([*backbone, *(value for row in expert for value in row)])
    labels = (episodes["side_correct"] == "left").to_numpy()
    generator = np.random.default_rng(derive_seed("decisions", len(episodes)))
    # The same number of right decisions for the same share, so that accuracies are exactly as asked.
    rank = generator.permuted(np.tile(np.arange(len(episodes)), (len(sites), 1)), axis=1)
    right = rank < np.round(share * len(episodes))[:, None]
    groups, fold_of = episodes["group_id"].to_numpy(dtype=str), np.arange(len(episodes)) // 2 % 5
    return ProbeCurve(
        sites=tuple(sites),
        labels=labels,
        episodes=episodes["episode_id"].to_numpy(dtype=str),
        items=episodes["item_id"].to_numpy(dtype=str),
        groups=groups,
        fold_of=fold_of,
        decisions=np.where(right == labels, 1.0, -1.0),
        strengths=np.ones((len(sites), 5)),
        null=np.tile(np.linspace(1 - null_top, null_top, 99), (len(sites), 1)),
        inner=inner_of(right, fold_of, groups),
    )


@pytest.fixture
def curve_of() -> Callable[..., ProbeCurve]:
    return curve


@pytest.fixture
def outcome_table() -> Callable[..., pd.DataFrame]:
    return outcomes


@pytest.fixture
def probed_run(tmp_path: Path) -> Callable[..., ArrayRun]:
    """Makes a run with stored probes; see `runs_in`."""
    return runs_in(tmp_path)


def runs_in(folder: Path) -> Callable[..., ArrayRun]:
    """Makes runs with stored probes in `folder`.

    accuracies: per category, the backbone's per layer and the expert's per iteration and layer.
    """

    def make(
        accuracies: dict[str, tuple[list[float], list[list[float]]]],
        model: str = "pi0",
        *,
        random_weights: bool = False,
        suite: str = "suite@1#0123456789ab",
        action_stream: str = "expert",
    ) -> ArrayRun:
        tables = {category: outcomes(120, 60, 20, category) for category in accuracies}
        episodes = pd.concat(tables.values(), ignore_index=True)
        blank = np.zeros((len(episodes), 1))
        features = {(Site("backbone", 0), "mean"): blank, (Site(action_stream, 0, "residual", 0), "mean"): blank}
        run = ArrayRun(folder / model, model, suite, episodes, features, random_weights)
        settings = ProbeSettings(
            model=model,
            random_weights=random_weights,
            weights=None,
            suite=suite,
            seed_text=suite,
            run_settings=run.settings_sha256,
            episodes=episodes_sha256(run),
            categories=tuple(accuracies),
            views=("mean",),
            target="side.correct",
            permutations=99,
            seed=0,
        )
        curves = {
            (category, "mean"): curve(tables[category], backbone, expert, action_stream=action_stream)
            for category, (backbone, expert) in accuracies.items()
        }
        save_results(ProbeResults(settings, curves), run.path)
        return run

    return make


@pytest.fixture(autouse=True)
def _close_figures() -> Iterator[None]:
    """pyplot warns of many open figures, and it counts those of every test of a process."""
    yield
    if "matplotlib.pyplot" in sys.modules:
        sys.modules["matplotlib.pyplot"].close("all")
