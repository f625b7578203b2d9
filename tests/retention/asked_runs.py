"""VLM runs and policy runs of outcomes made by chance, and probes whose decisions are set by hand."""

from dataclasses import dataclass, field
from pathlib import Path

import numpy as np
import pandas as pd

from probe_kit.hooks import Site
from probe_kit.train import ArrayRun, ProbeCurve, ProbeResults, ProbeSettings
from probe_kit.train.results.probe_results import episodes_sha256
from tests.support.inner_qualities import inner_of

SUITE = "suite@1#0123456789ab"
ASK = {"prompt": "p1", "picture": "frame", "picture_size": "224x224", "object": "target"}


@dataclass(frozen=True)
class SaidRun(ArrayRun):
    """An `ArrayRun` that says what it was asked, and what its card says."""

    settings: dict = field(default_factory=dict)
    certificate: dict = field(default_factory=dict)
    called: str = ""
    lens_margins: np.ndarray | None = None

    @property
    def label(self) -> str:
        return self.called or self.model


def episodes(right: dict[str, tuple[np.ndarray, ...]], readable: float = 1.0, seed: int = 0) -> pd.DataFrame:
    """Two layouts per item, two items per group. right: per category (N, 2) bool, item by layout."""
    rows = []
    draw = np.random.default_rng(seed)
    for category, items in right.items():
        for number, layouts in enumerate(items):
            for swapped, hit in enumerate(layouts):
                side = ("left", "right")[(number + swapped) % 2]
                other = {"left": "right", "right": "left"}[side]
                outcome = "correct" if hit else "wrong" if draw.random() < readable else "oob"
                name = f"{category}-{number}:{'os'[swapped]}"
                rows.append(
                    {
                        "episode_id": name,
                        "item_id": f"{category}-{number}",
                        "group_id": f"{category}-group-{number // 2}",
                        "category": category,
                        "layout": ("original", "swapped")[swapped],
                        "side_correct": side,
                        "outcome": outcome,
                        "side_placed": {"correct": side, "wrong": other, "oob": "none"}[outcome],
                        "first_frame_sha256": f"frame of {name}",
                    }
                )
    return pd.DataFrame(rows)


def answer_run(path: Path, right: dict, model: str = "qwen3-vl", called: str = "", **ask: object) -> SaidRun:
    """A VLM run whose text is right where `right` says; its logits always say left, and debiased the truth."""
    table = episodes(right, readable=0.5, seed=1)
    is_left = table["side_correct"] == "left"
    table = table.assign(
        parse="letter",
        parse_tier=np.where(np.arange(len(table)) % 4 == 0, "clause", "strict"),
        outcome_logits=np.where(is_left, "correct", "wrong"),
        side_logits="left",
        outcome_debiased="correct",
        side_debiased=table["side_correct"],
        option_mass=0.8,
        letter_bias=1.5,
        near_tie=False,
        side_word=table["item_id"].str.endswith("-0") if ask.pop("worded", False) else False,
    )
    return SaidRun(path / "asked", model, SUITE, table, {}, settings={"ask": ASK | ask}, called=called)


def acted(path: Path, right: dict, model: str = "xiaomi-r0", source: str | None = None) -> SaidRun:
    """A policy run."""
    card = {"policy": {"source": source}}
    return SaidRun(path / "acted", model, SUITE, episodes(right), {}, certificate=card)


def probes(
    run: ArrayRun, accuracies: dict[str, list[float]], null_top: float = 0.6, seed: int = 5
) -> ProbeResults:
    """Probes of the backbone whose layers are right with these probabilities."""
    draw = np.random.default_rng(seed)
    curves = {}
    for category, shares in accuracies.items():
        category_episodes = run.episodes[run.episodes["category"] == category]
        labels = (category_episodes["side_correct"] == "left").to_numpy()
        groups = category_episodes["group_id"].to_numpy(dtype=str)
        fold_of = np.unique(groups, return_inverse=True)[1] % 5
        right = draw.random((len(shares), len(category_episodes))) < np.array(shares)[:, None]
        curves[category, "mean"] = ProbeCurve(
            sites=tuple(Site("backbone", layer) for layer in range(len(shares))),
            labels=labels,
            episodes=category_episodes["episode_id"].to_numpy(dtype=str),
            items=category_episodes["item_id"].to_numpy(dtype=str),
            groups=groups,
            fold_of=fold_of,
            decisions=np.where(right == labels, 1.0, -1.0),
            strengths=np.ones((len(shares), 5)),
            null=np.tile(np.linspace(1 - null_top, null_top, 99), (len(shares), 1)),
            inner=inner_of(right, fold_of, groups),
        )
    settings = ProbeSettings(
        model=run.model, random_weights=False, weights=None, suite=run.suite, seed_text=run.suite,
        run_settings=run.settings_sha256,
        episodes=episodes_sha256(run), categories=tuple(accuracies), views=("mean",), target="side.correct",
        permutations=99, seed=0,
    )  # fmt: skip
    return ProbeResults(settings, curves)
